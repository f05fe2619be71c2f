// A = Σ ω J Jᵀ, g = Σ ω e J: e = rgb - wanted, ω = scale w / √(e² + s²), J = ∂rgb/∂ξ of one channel.
// One invocation sums one chunk of the rows of one image.
// world_from_camera [images, 12], origin, direction, d_origin, d_direction, rgb [rows, 3], wanted [rows, 4] = (r, g, b, w) → partial [groups, chunks, 27].
// OVERWRITES partial.

// The motion ξ = (ω, υ) turns the ray about the world's origin and shifts it, both in the camera's axes.
// Of the 27 values, 21 are the upper triangle of A by rows, 6 are g.

struct Params {
    groups: u32,
    rows_per_group: u32,
    first_group: u32,
    chunk_rows: u32,
    chunks: u32,
    channel: u32,
    seed: f32,
    scale: f32,
    soft: f32,
    sphere: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> world_from_camera: array<f32>;
@group(0) @binding(2) var<storage, read> origin: array<f32>;
@group(0) @binding(3) var<storage, read> direction: array<f32>;
@group(0) @binding(4) var<storage, read> d_origin: array<f32>;
@group(0) @binding(5) var<storage, read> d_direction: array<f32>;
@group(0) @binding(6) var<storage, read> rgb: array<f32>;
@group(0) @binding(7) var<storage, read> wanted: array<f32>;
@group(0) @binding(8) var<storage, read_write> partial: array<f32>;

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
    let column0 = vec3(world_from_camera[w], world_from_camera[w + 4u], world_from_camera[w + 8u]);
    let column1 = vec3(world_from_camera[w + 1u], world_from_camera[w + 5u], world_from_camera[w + 9u]);
    let column2 = vec3(world_from_camera[w + 2u], world_from_camera[w + 6u], world_from_camera[w + 10u]);
    let t = vec3(world_from_camera[w + 3u], world_from_camera[w + 7u], world_from_camera[w + 11u]);

    var sums: array<f32, 27>;
    for (var r = first; r < end; r++) {
        let at = 3u * (group * params.rows_per_group + r);
        let pixel = 4u * (group * params.rows_per_group + r);
        let e = rgb[at + params.channel] - wanted[pixel + params.channel];
        let root = sqrt(e * e + params.soft * params.soft);
        let weight = params.scale * wanted[pixel + 3u] / root;

        let d_o = vec3(d_origin[at], d_origin[at + 1u], d_origin[at + 2u]) / params.seed;
        let d_d = vec3(d_direction[at], d_direction[at + 1u], d_direction[at + 2u]) / params.seed;
        let ray = vec3(direction[at], direction[at + 1u], direction[at + 2u]);
        let turn = cross(vec3(origin[at], origin[at + 1u], origin[at + 2u]), d_o) + cross(ray, d_d);
        let shift = d_o + dot(d_o, ray) * ray_beginning(t, ray, params.sphere).d_eye;
        let jacobian = array(
            dot(column0, turn), dot(column1, turn), dot(column2, turn),
            dot(column0, shift), dot(column1, shift), dot(column2, shift),
        );
        var k = 0u;
        for (var a = 0u; a < 6u; a++) {
            for (var b = a; b < 6u; b++) {
                sums[k] += weight * jacobian[a] * jacobian[b];
                k++;
            }
            sums[21u + a] += weight * e * jacobian[a];
        }
    }
    for (var k = 0u; k < 27u; k++) {
        partial[27u * index + k] = sums[k];
    }
}
