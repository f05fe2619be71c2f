// quality = (2ab + c) / (a² + b² + c), a and b the Prewitt magnitudes (3×3 / 3, zero padding) of the two images, c = 170 / 255².
// One invocation computes one pooled pixel.
// luma, target_luma [images, h2, w2] → quality [images, h2, w2]; h2 = height / 2, w2 = width / 2 rounded down.
// OVERWRITES quality.

struct Params {
    images: u32,
    width: u32,
    height: u32,
    chunk: u32,
    chunks: u32,
    scale: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> luma: array<f32>;
@group(0) @binding(2) var<storage, read> target_luma: array<f32>;
@group(0) @binding(3) var<storage, read_write> quality: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let index = flat_index(workgroup, workgroups, local);
    let size = vec2(params.width, params.height) / 2u;
    if (index >= params.images * size.x * size.y) {
        return;
    }
    // The 3×3 windows around the pixel.
    var render: mat3x3<f32>;
    var reference: mat3x3<f32>;
    for (var j = 0u; j < 3u; j++) {
        for (var i = 0u; i < 3u; i++) {
            let at = neighbour(index, size, i, j);
            if (at != OUTSIDE) {
                render[i][j] = luma[at];
                reference[i][j] = target_luma[at];
            }
        }
    }
    quality[index] = gmsd_quality(length(prewitt(render)), length(prewitt(reference)));
}
