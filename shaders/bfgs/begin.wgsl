// B = 0.3 (A + 0.01 diag A), best = trial, radius = 0.1, step = 0; a loss that is not a number becomes the largest there is.
// One invocation begins the search of one pose.
// equations [B, 27] = (upper triangle of A, g), loss [B], world_from_camera [B, 12] → state [B, 47].
// OVERWRITES state.

// A of least squares is larger than the loss's own second derivatives, which see how the derivatives of neighbouring rays cancel.

struct Params {
    poses: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> equations: array<f32>;
@group(0) @binding(2) var<storage, read> loss: array<f32>;
@group(0) @binding(3) var<storage, read> world_from_camera: array<f32>;
@group(0) @binding(4) var<storage, read_write> state: array<f32>;

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
    let at = STATE * pose;
    for (var k = 0u; k < 27u; k++) {
        state[at + k] = select(1.0, 0.3, k < STATE_GRADIENT) * equations[27u * pose + k];
    }
    for (var k = 0u; k < 6u; k++) {
        state[at + entry(k, k)] *= 1.01;
    }
    state[at + STATE_LOSS] = select(NO_LOSS, loss[pose], loss[pose] < NO_LOSS);
    for (var k = 0u; k < 12u; k++) {
        state[at + STATE_POSE + k] = world_from_camera[12u * pose + k];
    }
    for (var k = 0u; k < 6u; k++) {
        state[at + STATE_STEP + k] = 0.0;
    }
    state[at + STATE_RADIUS] = 0.1;
}
