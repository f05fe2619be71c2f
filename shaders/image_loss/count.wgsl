// partial[g, c] = Σ w over the wanted values that are not exactly 1 in the rows of chunk c.
// One invocation counts one chunk of one image.
// wanted [groups · rows_per_group, 4] = (r, g, b, w) → partial [groups, chunks].
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
@group(0) @binding(1) var<storage, read> wanted: array<f32>;
@group(0) @binding(2) var<storage, read_write> partial: array<f32>;

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
    let image = (index / params.chunks) * params.rows_per_group;
    let first = (index % params.chunks) * params.chunk_rows;
    let end = min(first + params.chunk_rows, params.rows_per_group);
    var total = 0.0;
    for (var row = image + first; row < image + end; row++) {
        for (var c = 0u; c < 3u; c++) {
            total += select(0.0, wanted[4u * row + 3u], wanted[4u * row + c] != 1.0);
        }
    }
    partial[index] = total;
}
