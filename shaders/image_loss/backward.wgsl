// d_rgb = scale normaliser w ρ'(e), e = rgb - wanted; ρ': sign(e) (MAE, norm_l1; sign(0) = 0), 2e (MSE, norm_l2), e / √(e² + s²) (Charbonnier).
// One invocation computes one value.
// rgb [groups · rows_per_group, 3], wanted [groups · rows_per_group, 4] = (r, g, b, w), count [images] (norm_l1, norm_l2) → d_rgb as rgb.
// OVERWRITES d_rgb.

struct Params {
    kind: u32,
    groups: u32,
    rows_per_group: u32,
    first_group: u32,
    values_per_image: u32,
    chunk_rows: u32,
    chunks: u32,
    scale: f32,
    soft: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> rgb: array<f32>;
@group(0) @binding(2) var<storage, read> wanted: array<f32>;
@group(0) @binding(3) var<storage, read> count: array<f32>;
@group(0) @binding(4) var<storage, read_write> d_rgb: array<f32>;

fn normaliser(image: u32) -> f32 {
    if (params.kind == NORM_L1 || params.kind == NORM_L2) {
        return 1.0 / (1.0 + count[image]);
    }
    return 1.0 / f32(params.values_per_image);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let i = flat_index(workgroup, workgroups, local);
    let values_per_group = 3u * params.rows_per_group;
    if (i >= params.groups * values_per_group) {
        return;
    }
    let row = i / 3u;
    let e = rgb[i] - wanted[i + row];
    var slope = select(sign(e), 2.0 * e, params.kind == MSE || params.kind == NORM_L2);
    if (params.kind == CHARBONNIER) {
        slope = e / sqrt(e * e + params.soft * params.soft);
    }
    d_rgb[i] = params.scale * normaliser(params.first_group + i / values_per_group) * wanted[4u * row + 3u] * slope;
}
