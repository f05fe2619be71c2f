// R = Rx(θ1) · Ry(θ2) · Rz(θ3), world_from_camera = [R | t].
// One invocation computes one pose.
// pose6 [B, 6] = (θ1, θ2, θ3, t1, t2, t3) → world_from_camera [B, 12], 3×4 row-major.
// OVERWRITES world_from_camera.

struct Params {
    poses: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> pose6: array<f32>;
@group(0) @binding(2) var<storage, read_write> world_from_camera: array<f32>;

fn write_row(at: u32, row: vec3<f32>, translation: f32) {
    world_from_camera[at] = row.x;
    world_from_camera[at + 1u] = row.y;
    world_from_camera[at + 2u] = row.z;
    world_from_camera[at + 3u] = translation;
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
    let p = 6u * pose;
    let angles = vec3(pose6[p], pose6[p + 1u], pose6[p + 2u]);
    let s = sin(angles);
    let c = cos(angles);

    let w = 12u * pose;
    write_row(w, vec3(c.y * c.z, -c.y * s.z, s.y), pose6[p + 3u]);
    write_row(w + 4u, vec3(c.x * s.z + c.z * s.x * s.y, c.x * c.z - s.x * s.y * s.z, -c.y * s.x), pose6[p + 4u]);
    write_row(w + 8u, vec3(s.x * s.z - c.x * c.z * s.y, c.z * s.x + c.x * s.y * s.z, c.x * c.y), pose6[p + 5u]);
}
