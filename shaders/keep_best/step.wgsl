// Where loss[b] < best_loss[b]: best_loss[b] = loss[b], best_pose6[b] = pose6[b].
// One invocation looks after one pose.
// loss [B], pose6 [B, 6] → best_loss [B], best_pose6 [B, 6].
// OVERWRITES best_loss and best_pose6 where the loss is lower; a NaN never is.

struct Params {
    poses: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> loss: array<f32>;
@group(0) @binding(2) var<storage, read> pose6: array<f32>;
@group(0) @binding(3) var<storage, read_write> best_loss: array<f32>;
@group(0) @binding(4) var<storage, read_write> best_pose6: array<f32>;

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
    if (loss[pose] < best_loss[pose]) {
        best_loss[pose] = loss[pose];
        for (var i = 6u * pose; i < 6u * pose + 6u; i++) {
            best_pose6[i] = pose6[i];
        }
    }
}
