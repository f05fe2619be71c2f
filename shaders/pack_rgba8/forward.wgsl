// packed = r | g << 8 | b << 16 | 255 << 24 with each channel round(255 clamp((c + 1) / 2, 0, 1)).
// One invocation packs one pixel.
// rgb [.., 3] from pixel first_pixel on → packed [height, stride], of which width pixels a row are written.
// OVERWRITES packed.

struct Params {
    width: u32,
    height: u32,
    stride: u32,
    first_pixel: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> rgb: array<f32>;
@group(0) @binding(2) var<storage, read_write> packed: array<u32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let pixel = flat_index(workgroup, workgroups, local);
    if (pixel >= params.width * params.height) {
        return;
    }
    let at = 3u * (params.first_pixel + pixel);
    let colour = vec3(rgb[at], rgb[at + 1u], rgb[at + 2u]) * 0.5 + 0.5;
    packed[(pixel / params.width) * params.stride + pixel % params.width] = pack4x8unorm(vec4(colour, 1.0));
}
