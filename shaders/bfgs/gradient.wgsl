// ∂L/∂ω = Σ over columns p of [R | t]: (Rᵀp) × (Rᵀ ∂L/∂p), ∂L/∂υ = Rᵀ ∂L/∂t: the gradient over the motion ξ = (ω, υ) of solve.
// One invocation looks after one pose.
// world_from_camera, d_world_from_camera [B, 12] → gradient [B, 6].
// OVERWRITES gradient.

struct Params {
    poses: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> world_from_camera: array<f32>;
@group(0) @binding(2) var<storage, read> d_world_from_camera: array<f32>;
@group(0) @binding(3) var<storage, read_write> gradient: array<f32>;

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
    let w = 12u * pose;
    let r = mat3x3(
        world_from_camera[w], world_from_camera[w + 4u], world_from_camera[w + 8u],
        world_from_camera[w + 1u], world_from_camera[w + 5u], world_from_camera[w + 9u],
        world_from_camera[w + 2u], world_from_camera[w + 6u], world_from_camera[w + 10u],
    );
    var turn = vec3(0.0);
    var shift = vec3(0.0);
    for (var column = 0u; column < 4u; column++) {
        let p = vec3(world_from_camera[w + column], world_from_camera[w + 4u + column], world_from_camera[w + 8u + column]);
        let d_p = vec3(d_world_from_camera[w + column], d_world_from_camera[w + 4u + column], d_world_from_camera[w + 8u + column]);
        // v * r is Rᵀv; the last column's is ∂L/∂υ.
        shift = d_p * r;
        turn += cross(p * r, shift);
    }
    for (var k = 0u; k < 3u; k++) {
        gradient[6u * pose + k] = turn[k];
        gradient[6u * pose + 3u + k] = shift[k];
    }
}
