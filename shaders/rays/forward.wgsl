// q = ((u - cx) / fx, (v - cy) / fy, 1), direction = normalize(R q), origin = t + s direction + R (z0 q), s to the sphere of radius `sphere`.
// One invocation computes one row (one ray).
// world_from_camera [images, 12], intrinsics [images, 4] = (fx, fy, cx, cy), uv [rows, 2], z0 [rows] → origin, direction [rows, 3].
// OVERWRITES origin and direction.

struct Params {
    groups: u32,
    rows_per_group: u32,
    first_group: u32,
    chunk_rows: u32,
    chunks: u32,
    sphere: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> world_from_camera: array<f32>;
@group(0) @binding(2) var<storage, read> intrinsics: array<f32>;
@group(0) @binding(3) var<storage, read> uv: array<f32>;
@group(0) @binding(4) var<storage, read> z0: array<f32>;
@group(0) @binding(5) var<storage, read_write> origin: array<f32>;
@group(0) @binding(6) var<storage, read_write> direction: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let row = flat_index(workgroup, workgroups, local);
    if (row >= params.groups * params.rows_per_group) {
        return;
    }
    let image = params.first_group + row / params.rows_per_group;
    let w = 12u * image;
    let k = 4u * image;
    let q = vec3(
        (uv[2u * row] - intrinsics[k + 2u]) / intrinsics[k],
        (uv[2u * row + 1u] - intrinsics[k + 3u]) / intrinsics[k + 1u],
        1.0,
    );
    // R q, written with the columns of R.
    let ray = vec3(world_from_camera[w], world_from_camera[w + 4u], world_from_camera[w + 8u]) * q.x
        + vec3(world_from_camera[w + 1u], world_from_camera[w + 5u], world_from_camera[w + 9u]) * q.y
        + vec3(world_from_camera[w + 2u], world_from_camera[w + 6u], world_from_camera[w + 10u]);
    let t = vec3(world_from_camera[w + 3u], world_from_camera[w + 7u], world_from_camera[w + 11u]);

    let d = ray / length(ray);
    let x0 = t + z0[row] * ray + ray_beginning(t, d, params.sphere).distance * d;
    for (var a = 0u; a < 3u; a++) {
        origin[3u * row + a] = x0[a];
        direction[3u * row + a] = d[a];
    }
}
