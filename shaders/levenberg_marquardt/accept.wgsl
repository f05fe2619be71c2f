// Where the trial's loss is lower: best = trial, damping = max(damping / 6, 1e-4); elsewhere damping = min(4 damping, 1e6).
// One invocation looks after one pose.
// equations [B, 28], world_from_camera [B, 12] → best_equations [B, 28], best_pose [B, 12], damping [B].
// OVERWRITES best_equations and best_pose where the loss (the last of the 28) is lower, which a NaN never is; ACCUMULATES damping.

struct Params {
    poses: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> equations: array<f32>;
@group(0) @binding(2) var<storage, read> world_from_camera: array<f32>;
@group(0) @binding(3) var<storage, read_write> best_equations: array<f32>;
@group(0) @binding(4) var<storage, read_write> best_pose: array<f32>;
@group(0) @binding(5) var<storage, read_write> damping: array<f32>;

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
    if (equations[28u * pose + 27u] < best_equations[28u * pose + 27u]) {
        for (var i = 28u * pose; i < 28u * pose + 28u; i++) {
            best_equations[i] = equations[i];
        }
        for (var i = 12u * pose; i < 12u * pose + 12u; i++) {
            best_pose[i] = world_from_camera[i];
        }
        damping[pose] = max(damping[pose] / 6.0, 1e-4);
    } else {
        damping[pose] = min(4.0 * damping[pose], 1e6);
    }
}
