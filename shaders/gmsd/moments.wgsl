// partial[b, c] = (Σ (q - 1), Σ (q - 1)²) over the pooled pixels of chunk c.
// One invocation sums one chunk of one image.
// quality [images, h2, w2] → partial [images, chunks, 2].
// OVERWRITES partial.

struct Params {
    images: u32,
    width: u32,
    height: u32,
    chunk: u32,
    chunks: u32,
    scale: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> quality: array<f32>;
@group(0) @binding(2) var<storage, read_write> partial: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let index = flat_index(workgroup, workgroups, local);
    if (index >= params.images * params.chunks) {
        return;
    }
    let pixels = (params.width / 2u) * (params.height / 2u);
    let image = (index / params.chunks) * pixels;
    let first = (index % params.chunks) * params.chunk;
    var total = vec2(0.0);
    for (var i = first; i < min(first + params.chunk, pixels); i++) {
        let q = quality[image + i] - 1.0;
        total += vec2(q, q * q);
    }
    partial[2u * index] = total.x;
    partial[2u * index + 1u] = total.y;
}
