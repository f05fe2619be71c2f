// d_R_m = d_R R_sᵀ + d_t t_sᵀ, d_t_m = d_t.
// One invocation computes one pose.
// d_world_from_camera, start [B, 12] → d_motion [B, 12], all 3×4 row-major.
// OVERWRITES d_motion.

struct Params {
    poses: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> start: array<f32>;
@group(0) @binding(2) var<storage, read> d_world_from_camera: array<f32>;
@group(0) @binding(3) var<storage, read_write> d_motion: array<f32>;

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
        let d = vec4(
            d_world_from_camera[row],
            d_world_from_camera[row + 1u],
            d_world_from_camera[row + 2u],
            d_world_from_camera[row + 3u],
        );
        d_motion[row] = dot(d, start_row(at));
        d_motion[row + 1u] = dot(d, start_row(at + 4u));
        d_motion[row + 2u] = dot(d, start_row(at + 8u));
        d_motion[row + 3u] = d.w;
    }
}
