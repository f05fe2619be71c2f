// partial[c] = scale Σ z² over the values of chunk c.
// One invocation sums one chunk.
// z [count] → partial [chunks].
// OVERWRITES partial.

struct Params {
    count: u32,
    chunk: u32,
    chunks: u32,
    scale: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> z: array<f32>;
@group(0) @binding(2) var<storage, read_write> partial: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let chunk = flat_index(workgroup, workgroups, local);
    if (chunk >= params.chunks) {
        return;
    }
    let first = chunk * params.chunk;
    var total = 0.0;
    for (var i = first; i < min(first + params.chunk, params.count); i++) {
        total += z[i] * z[i];
    }
    partial[chunk] = params.scale * total;
}
