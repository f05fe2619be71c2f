// y = relu(gamma (z - mean) rstd + beta), z = W x + b, rstd = 1 / √(var + 1e-5), var the mean of (z - mean)² over the features, weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation computes one row; it makes z anew for each of three passes.
// x [groups, rows_per_group, 3], weights [.., 3 features + features], slots [..], affine [2, features] = (gamma, beta) → y [groups, rows_per_group, features].
// OVERWRITES y.

struct Params {
    groups: u32,
    rows_per_group: u32,
    first_group: u32,
    features: u32,
    weight_stride: u32,
    accumulate: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read> weights: array<f32>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read> affine: array<f32>;
@group(0) @binding(5) var<storage, read_write> y: array<f32>;

fn linear(first: u32, j: u32, point: vec3<f32>) -> f32 {
    let w = vec3(weights[first + 3u * j], weights[first + 3u * j + 1u], weights[first + 3u * j + 2u]);
    return dot(w, point) + weights[first + 3u * params.features + j];
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let row = flat_index(workgroup, workgroups, local);
    let group = workgroup.z;
    if (row >= params.rows_per_group || group >= params.groups) {
        return;
    }
    let n = params.features;
    let first = weights_of(group);
    let at = group * params.rows_per_group + row;
    let point = vec3(x[3u * at], x[3u * at + 1u], x[3u * at + 2u]);

    var sum = 0.0;
    for (var j = 0u; j < n; j++) {
        sum += linear(first, j, point);
    }
    let mean = sum / f32(n);

    var squares = 0.0;
    for (var j = 0u; j < n; j++) {
        let centred = linear(first, j, point) - mean;
        squares += centred * centred;
    }
    let rstd = 1.0 / sqrt(squares / f32(n) + 1e-5);

    for (var j = 0u; j < n; j++) {
        let normalised = (linear(first, j, point) - mean) * rstd;
        y[at * n + j] = max(affine[j] * normalised + affine[n + j], 0.0);
    }
}
