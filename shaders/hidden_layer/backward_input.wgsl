// d_y[r, i] = Σ_o W[o, i] d_z[r, o], weights at slots[first_group + r / rows_per_group] · weight_stride; e = gamma d_y where y > 0, else 0; x̂ = (x - mean) rstd; d_z = rstd (e - mean(e) - x̂ mean(e x̂)) of the layer before, means over the features; of centred x without mean(e).
// One invocation computes one row.
// weights [.., out·in + out], slots [..], x [groups, rows_per_group, in], stats [groups, rows_per_group, 2] = (mean, rstd), affine [2, in] = (gamma, beta), d_z [groups, rows_per_group, out] → d_y, d_z [groups, rows_per_group, in]; in = out.
// OVERWRITES d_y and d_z.

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
@group(0) @binding(1) var<storage, read> weights: array<f32>;
@group(0) @binding(2) var<storage, read> slots: array<u32>;
@group(0) @binding(3) var<storage, read> x: array<f32>;
@group(0) @binding(4) var<storage, read> stats: array<f32>;
@group(0) @binding(5) var<storage, read> affine: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_y: array<f32>;
@group(0) @binding(7) var<storage, read_write> d_z: array<f32>;

// The gradient to a normalised value.
fn d_normalised(at: u32, i: u32, normalised: f32) -> f32 {
    let gamma = affine[i];
    return select(0.0, gamma * d_y[at + i], gamma * normalised + affine[params.in_features + i] > 0.0);
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
    let n = params.in_features;
    let first = weights_of(group);
    let at = group * params.rows_per_group + row;
    let mean = stats[2u * at];
    let rstd = stats[2u * at + 1u];

    var sum = 0.0;
    var along = 0.0;
    for (var i = 0u; i < n; i++) {
        var value = 0.0;
        for (var o = 0u; o < params.out_features; o++) {
            value += weights[first + n * o + i] * d_z[params.out_features * at + o];
        }
        d_y[n * at + i] = value;
        let normalised = (x[n * at + i] - mean) * rstd;
        let e = d_normalised(n * at, i, normalised);
        sum += e;
        along += e * normalised;
    }
    let mean_e = select(0.0, sum / f32(n), params.centred == 0u);
    let mean_along = along / f32(n);

    for (var i = 0u; i < n; i++) {
        let normalised = (x[n * at + i] - mean) * rstd;
        d_z[n * at + i] = rstd * (d_normalised(n * at, i, normalised) - mean_e - normalised * mean_along);
    }
}
