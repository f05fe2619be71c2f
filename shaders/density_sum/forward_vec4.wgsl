// phi[r, j] (+)= density[r] feature[r, j].
// One invocation computes four values of phi.
// density [rows], feature [rows, features] → phi [rows, features]; features a multiple of 4.
// ACCUMULATES phi where accumulate is 1, else OVERWRITES it.

struct Params {
    rows: u32,
    features: u32,
    accumulate: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> density: array<f32>;
@group(0) @binding(2) var<storage, read> feature: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> phi: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let index = flat_index(workgroup, workgroups, local);
    let n = params.features / 4u;
    if (index >= params.rows * n) {
        return;
    }
    var value = density[index / n] * feature[index];
    if (params.accumulate == 1u) {
        value += phi[index];
    }
    phi[index] = value;
}
