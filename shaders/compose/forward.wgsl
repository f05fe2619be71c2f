// world_from_camera = frame · motion · start, rigid motions as 3×4 matrices: (A B)[r] = Σ_k A[r,k] B[k] + (0, 0, 0, A[r,3]).
// One invocation computes one pose.
// frame, motion, start [B, 12] → world_from_camera [B, 12], all 3×4 row-major.
// OVERWRITES world_from_camera.

struct Params {
    poses: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> frame: array<f32>;
@group(0) @binding(2) var<storage, read> motion: array<f32>;
@group(0) @binding(3) var<storage, read> start: array<f32>;
@group(0) @binding(4) var<storage, read_write> world_from_camera: array<f32>;

fn start_row(at: u32) -> vec4<f32> {
    return vec4(start[at], start[at + 1u], start[at + 2u], start[at + 3u]);
}

// Row of motion · start, for the pose whose matrices begin at `at`.
fn moved_row(at: u32, row: u32) -> vec4<f32> {
    let m = at + 4u * row;
    return motion[m] * start_row(at) + motion[m + 1u] * start_row(at + 4u) + motion[m + 2u] * start_row(at + 8u)
        + vec4(0.0, 0.0, 0.0, motion[m + 3u]);
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
    let moved = array(moved_row(at, 0u), moved_row(at, 1u), moved_row(at, 2u));
    for (var row = at; row < at + 12u; row += 4u) {
        let product = frame[row] * moved[0] + frame[row + 1u] * moved[1] + frame[row + 2u] * moved[2];
        world_from_camera[row] = product.x;
        world_from_camera[row + 1u] = product.y;
        world_from_camera[row + 2u] = product.z;
        world_from_camera[row + 3u] = product.w + frame[row + 3u];
    }
}
