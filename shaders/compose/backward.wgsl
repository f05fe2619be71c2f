// d = R_fᵀ d_world_from_camera; d_motion[r,k] = ⟨d[r], start[k]⟩ for k < 3, d_motion[r,3] = d[r,3].
// One invocation computes one pose.
// frame, start, d_world_from_camera [B, 12] → d_motion [B, 12], all 3×4 row-major.
// OVERWRITES d_motion.

struct Params {
    poses: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> frame: array<f32>;
@group(0) @binding(2) var<storage, read> start: array<f32>;
@group(0) @binding(3) var<storage, read> d_world_from_camera: array<f32>;
@group(0) @binding(4) var<storage, read_write> d_motion: array<f32>;

fn start_row(at: u32) -> vec4<f32> {
    return vec4(start[at], start[at + 1u], start[at + 2u], start[at + 3u]);
}

fn d_row(at: u32) -> vec4<f32> {
    return vec4(d_world_from_camera[at], d_world_from_camera[at + 1u], d_world_from_camera[at + 2u], d_world_from_camera[at + 3u]);
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
    for (var r = 0u; r < 3u; r += 1u) {
        let d = frame[at + r] * d_row(at) + frame[at + 4u + r] * d_row(at + 4u) + frame[at + 8u + r] * d_row(at + 8u);
        let row = at + 4u * r;
        d_motion[row] = dot(d, start_row(at));
        d_motion[row + 1u] = dot(d, start_row(at + 4u));
        d_motion[row + 2u] = dot(d, start_row(at + 8u));
        d_motion[row + 3u] = d.w;
    }
}
