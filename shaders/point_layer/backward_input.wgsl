// z = W x + b, x̂ = (z - mean) rstd, e = gamma d_y where y > 0, else 0; d_z = rstd (e - mean(e) - x̂ mean(e x̂)), means over the features; d_x[r, i] (+)= Σ_j W[j, i] d_z[r, j], weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation computes one row; it makes z anew for each of four passes.
// x [groups, rows_per_group, 3], weights [.., 3 features + features], slots [..], affine [2, features] = (gamma, beta), d_y [groups, rows_per_group, features] → d_x [groups, rows_per_group, 3].
// ACCUMULATES d_x where accumulate is 1, else OVERWRITES it.

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
@group(0) @binding(5) var<storage, read> d_y: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_x: array<f32>;

fn w(first: u32, j: u32) -> vec3<f32> {
    return vec3(weights[first + 3u * j], weights[first + 3u * j + 1u], weights[first + 3u * j + 2u]);
}

fn linear(first: u32, j: u32, point: vec3<f32>) -> f32 {
    return dot(w(first, j), point) + weights[first + 3u * params.features + j];
}

fn d_normalised(at: u32, j: u32, normalised: f32) -> f32 {
    let gamma = affine[j];
    return select(0.0, gamma * d_y[at + j], gamma * normalised + affine[params.features + j] > 0.0);
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

    var sum_e = 0.0;
    var along = 0.0;
    for (var j = 0u; j < n; j++) {
        let normalised = (linear(first, j, point) - mean) * rstd;
        let e = d_normalised(at * n, j, normalised);
        sum_e += e;
        along += e * normalised;
    }
    let mean_e = sum_e / f32(n);
    let mean_along = along / f32(n);

    var d_point = vec3(0.0);
    for (var j = 0u; j < n; j++) {
        let normalised = (linear(first, j, point) - mean) * rstd;
        let d_z = rstd * (d_normalised(at * n, j, normalised) - mean_e - normalised * mean_along);
        d_point += w(first, j) * d_z;
    }
    for (var i = 0u; i < 3u; i++) {
        var value = d_point[i];
        if (params.accumulate == 1u) {
            value += d_x[3u * at + i];
        }
        d_x[3u * at + i] = value;
    }
}
