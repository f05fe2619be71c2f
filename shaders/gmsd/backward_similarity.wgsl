// d_a = scale ∂loss/∂q ∂q/∂a, ∂loss/∂q = (q - mean) / (n loss), ∂q/∂a = 2 (b - a q) / (a² + b² + c); d_response = d_a · response / a.
// One invocation computes one pooled pixel.
// luma, target_luma, quality [images, h2, w2], moments [images, 2], loss [images] → d_response [images, 2, h2, w2], x then y.
// OVERWRITES d_response; zero where the magnitude a or the image's loss is zero.

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
@group(0) @binding(3) var<storage, read> quality: array<f32>;
@group(0) @binding(4) var<storage, read> moments: array<f32>;
@group(0) @binding(5) var<storage, read> loss: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_response: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let index = flat_index(workgroup, workgroups, local);
    let size = vec2(params.width, params.height) / 2u;
    let pixels = size.x * size.y;
    if (index >= params.images * pixels) {
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
    let response = prewitt(render);
    let a = length(response);
    let b = length(prewitt(reference));

    let image = index / pixels;
    let n = f32(pixels);
    var d = vec2(0.0);
    if (a > 0.0 && loss[image] > 0.0) {
        let q = quality[index];
        let d_q = params.scale * (q - 1.0 - moments[2u * image] / n) / (n * loss[image]);
        d = d_q * 2.0 * (b - a * q) / (a * a + b * b + GMSD_C) * response / a;
    }
    let at = image * pixels + index;
    d_response[at] = d.x;
    d_response[at + pixels] = d.y;
}
