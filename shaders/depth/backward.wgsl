// d_x = 2 scale min(depth, 0) R[:,2], the gradient of scale Σ min(depth, 0)².
// One invocation computes one row.
// world_from_camera [images, 12], depth [rows] → d_x [rows, 3].
// OVERWRITES d_x.

struct Params {
    groups: u32,
    rows_per_group: u32,
    first_group: u32,
    scale: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> world_from_camera: array<f32>;
@group(0) @binding(2) var<storage, read> depth: array<f32>;
@group(0) @binding(3) var<storage, read_write> d_x: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let row = flat_index(workgroup, workgroups, local);
    if (row >= params.groups * params.rows_per_group) {
        return;
    }
    let w = 12u * (params.first_group + row / params.rows_per_group);
    let d_depth = 2.0 * params.scale * min(depth[row], 0.0);
    d_x[3u * row] = d_depth * world_from_camera[w + 2u];
    d_x[3u * row + 1u] = d_depth * world_from_camera[w + 6u];
    d_x[3u * row + 2u] = d_depth * world_from_camera[w + 10u];
}
