// d_θk = Σ_ab d_R[a,b] ∂R[a,b]/∂θk, d_t = last column of d_world_from_camera.
// One invocation computes one pose.
// pose6 [B, 6], d_world_from_camera [B, 12] → d_pose6 [B, 6].
// OVERWRITES d_pose6.

struct Params {
    poses: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> pose6: array<f32>;
@group(0) @binding(2) var<storage, read> d_world_from_camera: array<f32>;
@group(0) @binding(3) var<storage, read_write> d_pose6: array<f32>;

fn d_row(at: u32) -> vec3<f32> {
    return vec3(d_world_from_camera[at], d_world_from_camera[at + 1u], d_world_from_camera[at + 2u]);
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
    let row0 = vec3(c.y * c.z, -c.y * s.z, s.y);
    let row1 = vec3(c.x * s.z + c.z * s.x * s.y, c.x * c.z - s.x * s.y * s.z, -c.y * s.x);
    let row2 = vec3(s.x * s.z - c.x * c.z * s.y, c.z * s.x + c.x * s.y * s.z, c.x * c.y);

    let w = 12u * pose;
    let d_row0 = d_row(w);
    let d_row1 = d_row(w + 4u);
    let d_row2 = d_row(w + 8u);

    // ∂R/∂θ1: row1 becomes -row2, row2 becomes row1, row0 becomes 0.
    d_pose6[p] = dot(d_row2, row1) - dot(d_row1, row2);
    // ∂R/∂θ2: row1 becomes s1 · row0, row2 becomes -c1 · row0.
    d_pose6[p + 1u] = dot(d_row0, vec3(-s.y * c.z, s.y * s.z, c.y)) + dot(s.x * d_row1 - c.x * d_row2, row0);
    // ∂R/∂θ3: column 0 becomes column 1, column 1 becomes -column 0, column 2 becomes 0.
    d_pose6[p + 2u] = dot(vec3(d_row0.x, d_row1.x, d_row2.x), vec3(row0.y, row1.y, row2.y))
        - dot(vec3(d_row0.y, d_row1.y, d_row2.y), vec3(row0.x, row1.x, row2.x));

    d_pose6[p + 3u] = d_world_from_camera[w + 3u];
    d_pose6[p + 4u] = d_world_from_camera[w + 7u];
    d_pose6[p + 5u] = d_world_from_camera[w + 11u];
}
