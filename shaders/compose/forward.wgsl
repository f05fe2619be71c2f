// world_from_camera = motion · start: R = R_m R_s, t = R_m t_s + t_m.
// One invocation computes one pose.
// motion, start [B, 12] → world_from_camera [B, 12], all 3×4 row-major.
// OVERWRITES world_from_camera.

struct Params {
    poses: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> motion: array<f32>;
@group(0) @binding(2) var<storage, read> start: array<f32>;
@group(0) @binding(3) var<storage, read_write> world_from_camera: array<f32>;

fn start_row(at: u32) -> vec4<f32> {
    return vec4(start[at], start[at + 1u], start[at + 2u], start[at + 3u]);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let pose = flat_index(workgroup, workgroups, local);
    if (pose >= params.poses) {
        return;
    }
    let at = 12u * pose;
    for (var row = at; row < at + 12u; row += 4u) {
        let product = motion[row] * start_row(at) + motion[row + 1u] * start_row(at + 4u) + motion[row + 2u] * start_row(at + 8u);
        world_from_camera[row] = product.x;
        world_from_camera[row + 1u] = product.y;
        world_from_camera[row + 2u] = product.z;
        world_from_camera[row + 3u] = product.w + motion[row + 3u];
    }
}
