// d_codes[n] = Σ_{b: index[b] = n} d_z[b], zero for codes outside the batch.
// One invocation computes one value of d_codes.
// index [batch], d_z [batch, latent] → d_codes [instances, latent].
// OVERWRITES d_codes.

struct Params {
    batch: u32,
    instances: u32,
    latent: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> index: array<u32>;
@group(0) @binding(2) var<storage, read> d_z: array<f32>;
@group(0) @binding(3) var<storage, read_write> d_codes: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let i = flat_index(workgroup, workgroups, local);
    if (i >= params.instances * params.latent) {
        return;
    }
    let instance = i / params.latent;
    var total = 0.0;
    for (var b = 0u; b < params.batch; b++) {
        if (index[b] == instance) {
            total += d_z[b * params.latent + i % params.latent];
        }
    }
    d_codes[i] = total;
}
