// partial[g, c] = normaliser Σ w ρ(e) over the rows of chunk c, e = rgb - wanted; ρ: |e| (MAE, norm_l1), e² (MSE, norm_l2), √(e² + s²) - s (Charbonnier).
// One invocation sums one chunk of one image.
// rgb [groups · rows_per_group, 3], wanted [groups · rows_per_group, 4] = (r, g, b, w), count [images] (norm_l1, norm_l2) → partial [groups, chunks].
// OVERWRITES partial.

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
@group(0) @binding(4) var<storage, read_write> partial: array<f32>;

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
    let index = flat_index(workgroup, workgroups, local);
    if (index >= params.groups * params.chunks) {
        return;
    }
    let group = index / params.chunks;
    let image = group * params.rows_per_group;
    let first = (index % params.chunks) * params.chunk_rows;
    let end = min(first + params.chunk_rows, params.rows_per_group);
    let squared = params.kind == MSE || params.kind == NORM_L2;
    var total = 0.0;
    for (var row = image + first; row < image + end; row++) {
        for (var c = 0u; c < 3u; c++) {
            let e = rgb[3u * row + c] - wanted[4u * row + c];
            var rho = select(abs(e), e * e, squared);
            if (params.kind == CHARBONNIER) {
                // The same as the root less s, without the cancellation.
                rho = e * e / (sqrt(e * e + params.soft * params.soft) + params.soft);
            }
            total += wanted[4u * row + 3u] * rho;
        }
    }
    partial[index] = normaliser(params.first_group + group) * total;
}
