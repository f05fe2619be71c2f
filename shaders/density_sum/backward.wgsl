// d_density[r] = ⟨d_phi[r], feature[r]⟩, d_feature[r] = density[r] d_phi[r], d_hidden[r, k] = d_density[r] head[k].
// One invocation computes one row.
// density [rows], feature, d_phi [rows, features], head [in + 1] → d_density [rows], d_feature [rows, features], d_hidden [rows, in].
// OVERWRITES d_density, d_feature and d_hidden.

struct Params {
    rows: u32,
    in_features: u32,
    features: u32,
    accumulate: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> density: array<f32>;
@group(0) @binding(2) var<storage, read> feature: array<f32>;
@group(0) @binding(3) var<storage, read> d_phi: array<f32>;
@group(0) @binding(4) var<storage, read> head: array<f32>;
@group(0) @binding(5) var<storage, read_write> d_density: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_feature: array<f32>;
@group(0) @binding(7) var<storage, read_write> d_hidden: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let row = flat_index(workgroup, workgroups, local);
    if (row >= params.rows) {
        return;
    }
    let m = params.in_features;
    let n = params.features;
    let sigma = density[row];
    var total = 0.0;
    for (var j = row * n; j < (row + 1u) * n; j++) {
        total += d_phi[j] * feature[j];
        d_feature[j] = sigma * d_phi[j];
    }
    d_density[row] = total;
    for (var k = 0u; k < m; k++) {
        d_hidden[row * m + k] = total * head[k];
    }
}
