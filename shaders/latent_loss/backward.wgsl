// d_z += 2 scale z, the gradient of scale Σ z².
// One invocation computes one value.
// z [count] → d_z [count].
// ACCUMULATES d_z, onto the gradient that came through the hypernetwork.

struct Params {
    count: u32,
    chunk: u32,
    chunks: u32,
    scale: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> z: array<f32>;
@group(0) @binding(2) var<storage, read_write> d_z: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let i = flat_index(workgroup, workgroups, local);
    if (i >= params.count) {
        return;
    }
    d_z[i] += 2.0 * params.scale * z[i];
}
