// luma = mean over 2×2 pixels of 0.299 R + 0.587 G + 0.114 B, with RGB moved from [-1, 1] to [0, 1] (not clamped).
// One invocation computes one pooled pixel.
// rgb [images, height, width, 3] → luma [images, height / 2, width / 2], rounded down.
// OVERWRITES luma.

struct Params {
    images: u32,
    width: u32,
    height: u32,
    chunk: u32,
    chunks: u32,
    scale: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> rgb: array<f32>;
@group(0) @binding(2) var<storage, read_write> luma: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let index = flat_index(workgroup, workgroups, local);
    let width2 = params.width / 2u;
    let height2 = params.height / 2u;
    if (index >= params.images * height2 * width2) {
        return;
    }
    let row2 = index / width2;
    let x = 2u * (index % width2);
    let y = 2u * (row2 % height2);
    let image = row2 / height2;
    var total = vec3(0.0);
    for (var dy = 0u; dy < 2u; dy++) {
        for (var dx = 0u; dx < 2u; dx++) {
            let at = 3u * ((image * params.height + y + dy) * params.width + x + dx);
            total += vec3(rgb[at], rgb[at + 1u], rgb[at + 2u]);
        }
    }
    luma[index] = dot(total / 4.0 * 0.5 + 0.5, LUMA);
}
