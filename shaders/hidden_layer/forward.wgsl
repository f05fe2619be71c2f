// z[r, o] = Σ_i W[o, i] x[r, i] + b[o], weights at slots[first_group + r / rows_per_group] · weight_stride; y = relu(gamma (z - mean) rstd + beta), rstd = 1 / √(var + 1e-5), var the mean of (z - mean)² over the features; of centred z mean = 0.
// One invocation computes one row.
// x [groups, rows_per_group, in], weights [.., out·in + out], slots [..], affine [2, out] = (gamma, beta) → z, y [groups, rows_per_group, out], stats [groups, rows_per_group, 2] = (mean, rstd).
// OVERWRITES z, y and stats.

struct Params {
    groups: u32,
    rows_per_group: u32,
    first_group: u32,
    in_features: u32,
    out_features: u32,
    weight_stride: u32,
    centred: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read> weights: array<f32>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read> affine: array<f32>;
@group(0) @binding(5) var<storage, read_write> z: array<f32>;
@group(0) @binding(6) var<storage, read_write> y: array<f32>;
@group(0) @binding(7) var<storage, read_write> stats: array<f32>;

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
    let n = params.out_features;
    let first = weights_of(group);
    let at = group * params.rows_per_group + row;

    var sum = 0.0;
    for (var o = 0u; o < n; o++) {
        var value = weights[first + params.in_features * n + o];
        for (var i = 0u; i < params.in_features; i++) {
            value += weights[first + params.in_features * o + i] * x[params.in_features * at + i];
        }
        z[n * at + o] = value;
        sum += value;
    }
    let mean = select(0.0, sum / f32(n), params.centred == 0u);

    var squares = 0.0;
    for (var o = 0u; o < n; o++) {
        let from_mean = z[n * at + o] - mean;
        squares += from_mean * from_mean;
    }
    let rstd = 1.0 / sqrt(squares / f32(n) + 1e-5);
    stats[2u * at] = mean;
    stats[2u * at + 1u] = rstd;

    for (var o = 0u; o < n; o++) {
        let normalised = (z[n * at + o] - mean) * rstd;
        y[n * at + o] = max(affine[o] * normalised + affine[n + o], 0.0);
    }
}
