// depth = R[:,2] · (x - t), the z of x in the camera frame.
// One invocation computes one row.
// world_from_camera [images, 12], x [rows, 3] → depth [rows].
// OVERWRITES depth.

struct Params {
    groups: u32,
    rows_per_group: u32,
    first_group: u32,
    scale: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> world_from_camera: array<f32>;
@group(0) @binding(2) var<storage, read> x: array<f32>;
@group(0) @binding(3) var<storage, read_write> depth: array<f32>;

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
    let forward = vec3(world_from_camera[w + 2u], world_from_camera[w + 6u], world_from_camera[w + 10u]);
    let t = vec3(world_from_camera[w + 3u], world_from_camera[w + 7u], world_from_camera[w + 11u]);
    depth[row] = dot(forward, vec3(x[3u * row], x[3u * row + 1u], x[3u * row + 2u]) - t);
}
