// z[b] = codes[index[b]].
// One invocation copies one value.
// codes [instances, latent], index [batch] → z [batch, latent].
// OVERWRITES z.

struct Params {
    batch: u32,
    instances: u32,
    latent: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> codes: array<f32>;
@group(0) @binding(2) var<storage, read> index: array<u32>;
@group(0) @binding(3) var<storage, read_write> z: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let i = flat_index(workgroup, workgroups, local);
    if (i >= params.batch * params.latent) {
        return;
    }
    let instance = min(index[i / params.latent], params.instances - 1u);
    z[i] = codes[instance * params.latent + i % params.latent];
}
