// d_density[r] = ⟨d_phi[r], feature[r]⟩, d_feature[r] = density[r] d_phi[r].
// One invocation computes one row, four features at a time.
// density [rows], feature, d_phi [rows, features] → d_density [rows], d_feature [rows, features]; features a multiple of 4.
// OVERWRITES d_density and d_feature.

struct Params {
    rows: u32,
    features: u32,
    accumulate: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> density: array<f32>;
@group(0) @binding(2) var<storage, read> feature: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> d_phi: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> d_density: array<f32>;
@group(0) @binding(5) var<storage, read_write> d_feature: array<vec4<f32>>;

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
    let sigma = density[row];
    let n = params.features / 4u;
    var total = vec4(0.0);
    for (var j = row * n; j < (row + 1u) * n; j++) {
        total += d_phi[j] * feature[j];
        d_feature[j] = sigma * d_phi[j];
    }
    d_density[row] = dot(total, vec4(1.0));
}
