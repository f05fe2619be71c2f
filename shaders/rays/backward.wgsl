// d_t = Σ d_origin + ⟨d_origin, direction⟩ ∂s/∂t, d_R = Σ d_ray qᵀ: d_ray = z0 d_origin + (1 - direction directionᵀ) (d_direction + s d_origin + ⟨d_origin, direction⟩ ∂s/∂direction) / ‖R q‖.
// One invocation sums one chunk of the rows of one image.
// world_from_camera [images, 12], intrinsics [images, 4], uv [rows, 2], z0 [rows], d_origin, d_direction [rows, 3] → partial [groups, chunks, 12].
// OVERWRITES partial.

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
@group(0) @binding(5) var<storage, read> d_origin: array<f32>;
@group(0) @binding(6) var<storage, read> d_direction: array<f32>;
@group(0) @binding(7) var<storage, read_write> partial: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let index = flat_index(workgroup, workgroups, local);
    if (index >= params.groups * params.chunks) {
        return;
    }
    let group = index / params.chunks;
    let first = (index % params.chunks) * params.chunk_rows;
    let end = min(first + params.chunk_rows, params.rows_per_group);

    let w = 12u * (params.first_group + group);
    let k = 4u * (params.first_group + group);
    let column0 = vec3(world_from_camera[w], world_from_camera[w + 4u], world_from_camera[w + 8u]);
    let column1 = vec3(world_from_camera[w + 1u], world_from_camera[w + 5u], world_from_camera[w + 9u]);
    let column2 = vec3(world_from_camera[w + 2u], world_from_camera[w + 6u], world_from_camera[w + 10u]);
    let t = vec3(world_from_camera[w + 3u], world_from_camera[w + 7u], world_from_camera[w + 11u]);
    let focal = vec2(intrinsics[k], intrinsics[k + 1u]);
    let centre = vec2(intrinsics[k + 2u], intrinsics[k + 3u]);

    // Columns of the 3×4 gradient.
    var d_column0 = vec3(0.0);
    var d_column1 = vec3(0.0);
    var d_column2 = vec3(0.0);
    var d_t = vec3(0.0);
    for (var r = first; r < end; r++) {
        let row = group * params.rows_per_group + r;
        let q = (vec2(uv[2u * row], uv[2u * row + 1u]) - centre) / focal;
        let ray = column0 * q.x + column1 * q.y + column2;
        let norm = length(ray);
        let direction = ray / norm;
        let d_o = vec3(d_origin[3u * row], d_origin[3u * row + 1u], d_origin[3u * row + 2u]);
        let begins = ray_beginning(t, direction, params.sphere);
        let d_s = dot(d_o, direction);
        let d_d = vec3(d_direction[3u * row], d_direction[3u * row + 1u], d_direction[3u * row + 2u])
            + begins.distance * d_o + d_s * begins.d_direction;
        let d_ray = z0[row] * d_o + (d_d - direction * dot(direction, d_d)) / norm;
        d_column0 += d_ray * q.x;
        d_column1 += d_ray * q.y;
        d_column2 += d_ray;
        d_t += d_o + d_s * begins.d_eye;
    }
    for (var a = 0u; a < 3u; a++) {
        let at = 12u * index + 4u * a;
        partial[at] = d_column0[a];
        partial[at + 1u] = d_column1[a];
        partial[at + 2u] = d_column2[a];
        partial[at + 3u] = d_t[a];
    }
}
