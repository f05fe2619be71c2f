// phi[r, j] (+)= density[r] feature[r, j].
// One invocation computes one value of phi.
// density [rows], feature [rows, features] → phi [rows, features].
// ACCUMULATES phi where accumulate is 1, else OVERWRITES it.

struct Params {
    rows: u32,
    features: u32,
    accumulate: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> density: array<f32>;
@group(0) @binding(2) var<storage, read> feature: array<f32>;
@group(0) @binding(3) var<storage, read_write> phi: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let index = flat_index(workgroup, workgroups, local);
    if (index >= params.rows * params.features) {
        return;
    }
    var value = density[index / params.features] * feature[index];
    if (params.accumulate == 1u) {
        value += phi[index];
    }
    phi[index] = value;
}
