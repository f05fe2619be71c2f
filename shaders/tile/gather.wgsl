// part[g, r, j] = whole[first_group + g, first_row + r, j].
// One invocation copies one value.
// whole [images, rows_per_image, columns] → part [groups, rows_per_group, columns].
// OVERWRITES part.

struct Params {
    groups: u32,
    rows_per_group: u32,
    first_group: u32,
    first_row: u32,
    rows_per_image: u32,
    columns: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> whole: array<f32>;
@group(0) @binding(2) var<storage, read_write> part: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let index = flat_index(workgroup, workgroups, local);
    if (index >= params.groups * params.rows_per_group * params.columns) {
        return;
    }
    let row = index / params.columns;
    let image = params.first_group + row / params.rows_per_group;
    let image_row = params.first_row + row % params.rows_per_group;
    part[index] = whole[(image * params.rows_per_image + image_row) * params.columns + index % params.columns];
}
