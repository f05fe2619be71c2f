// y = g_trial - g, s = step, r = θ y + (1 - θ) B s, sᵀr ≥ 0.2 sᵀBs: B += r rᵀ / sᵀr - (B s)(B s)ᵀ / sᵀBs; best = the lower of both.
// One invocation looks after one pose.
// gradient [B, 6], loss [B] and world_from_camera [B, 12] of the trial → state [B, 47].
// ACCUMULATES state; where the loss is not a number, or there was no step, B stays.

// Broyden, Fletcher, Goldfarb, Shanno, with Powell's θ that keeps B positive. Steps may be longer, 1.5-fold up to 0.2, after one that was
// kept; after one that was not, 0.4 of its length.

struct Params {
    poses: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> gradient: array<f32>;
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
    var bs: array<f32, 6>;
    var sbs = 0.0;
    var sy = 0.0;
    var squares = 0.0;
    for (var i = 0u; i < 6u; i++) {
        for (var j = 0u; j < 6u; j++) {
            bs[i] += state[at + entry(min(i, j), max(i, j))] * state[at + STATE_STEP + j];
        }
        let s = state[at + STATE_STEP + i];
        sbs += s * bs[i];
        sy += s * (gradient[6u * pose + i] - state[at + STATE_GRADIENT + i]);
        squares += s * s;
    }
    let is_number = loss[pose] < NO_LOSS && abs(sy) < 1e30;
    if (is_number && sbs > 0.0) {
        let theta = select(0.8 * sbs / (sbs - sy), 1.0, sy >= 0.2 * sbs);
        let sr = theta * sy + (1.0 - theta) * sbs;
        var r: array<f32, 6>;
        for (var i = 0u; i < 6u; i++) {
            r[i] = theta * (gradient[6u * pose + i] - state[at + STATE_GRADIENT + i]) + (1.0 - theta) * bs[i];
        }
        for (var i = 0u; i < 6u; i++) {
            for (var j = i; j < 6u; j++) {
                state[at + entry(i, j)] += r[i] * (r[j] / sr) - bs[i] * (bs[j] / sbs);
            }
        }
    }
    if (is_number && loss[pose] < state[at + STATE_LOSS]) {
        for (var k = 0u; k < 6u; k++) {
            state[at + STATE_GRADIENT + k] = gradient[6u * pose + k];
        }
        state[at + STATE_LOSS] = loss[pose];
        for (var k = 0u; k < 12u; k++) {
            state[at + STATE_POSE + k] = world_from_camera[12u * pose + k];
        }
        state[at + STATE_RADIUS] = min(1.5 * state[at + STATE_RADIUS], 0.2);
    } else if (squares > 0.0) {
        state[at + STATE_RADIUS] = 0.4 * sqrt(squares);
    }
}
