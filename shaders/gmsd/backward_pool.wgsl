// d_luma = transposed Prewitt of d_response; d_rgb = d_luma / 4 · (0.299, 0.587, 0.114) / 2 in each pixel of the 2×2 block.
// One invocation computes one full-size pixel.
// d_response [images, 2, h2, w2] → d_rgb [images, height, width, 3].
// OVERWRITES d_rgb; zero in an odd last row or column, which pooling leaves out.

struct Params {
    images: u32,
    width: u32,
    height: u32,
    chunk: u32,
    chunks: u32,
    scale: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> d_response: array<f32>;
@group(0) @binding(2) var<storage, read_write> d_rgb: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let index = flat_index(workgroup, workgroups, local);
    if (index >= params.images * params.height * params.width) {
        return;
    }
    let size = vec2(params.width, params.height) / 2u;
    let pixels = size.x * size.y;
    let row = index / params.width;
    let x = (index % params.width) / 2u;
    let y = (row % params.height) / 2u;
    let image = row / params.height;

    var d_luma = 0.0;
    if (x < size.x && y < size.y) {
        let plane_x = 2u * image * pixels;
        let plane_y = plane_x + pixels;
        let pooled = y * size.x + x;
        // The 3×3 windows of both planes around the pooled pixel.
        var across: mat3x3<f32>;
        var down: mat3x3<f32>;
        for (var j = 0u; j < 3u; j++) {
            for (var i = 0u; i < 3u; i++) {
                let at = neighbour(pooled, size, i, j);
                if (at != OUTSIDE) {
                    across[i][j] = d_response[plane_x + at];
                    down[i][j] = d_response[plane_y + at];
                }
            }
        }
        // The Prewitt kernels are odd: their transposes are their negatives.
        d_luma = -prewitt(across).x - prewitt(down).y;
    }
    let d = d_luma / 4.0 * LUMA / 2.0;
    d_rgb[3u * index] = d.x;
    d_rgb[3u * index + 1u] = d.y;
    d_rgb[3u * index + 2u] = d.z;
}
