// B ξ = -g, shortened to the radius, to whole grains; (ω, υ) = ξ, E = exp(ω): R' = R E, t' = R (E Rᵀt + υ).
// One invocation solves for one pose, by Cholesky's factors; ξ goes along -g where B is not positive.
// state [B, 47] → world_from_camera [B, 12].
// OVERWRITES world_from_camera and the step in state.

// ξ turns and shifts the camera about the world's origin, in the camera's axes. Its six numbers are rounded to multiples of the grain, if there is
// one: steps that differ in their last digits then lead to the same pose.

struct Params {
    poses: u32,
    grain: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read_write> world_from_camera: array<f32>;
@group(0) @binding(2) var<storage, read_write> state: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let number = flat_index(workgroup, workgroups, local);
    if (number >= params.poses) {
        return;
    }
    let at = STATE * number;
    // Rows of the lower factor L, then L y = -g, then Lᵀ ξ = y.
    var lower: array<array<f32, 6>, 6>;
    var xi: array<f32, 6>;
    var solvable = true;
    for (var i = 0u; i < 6u; i++) {
        var y = -state[at + STATE_GRADIENT + i];
        for (var j = 0u; j <= i; j++) {
            var sum = state[at + entry(j, i)];
            for (var k = 0u; k < j; k++) {
                sum -= lower[i][k] * lower[j][k];
            }
            if (i == j) {
                solvable = solvable && sum > 0.0;
                lower[i][i] = sqrt(abs(sum));
            } else {
                lower[i][j] = sum / lower[j][j];
                y -= lower[i][j] * xi[j];
            }
        }
        xi[i] = y / lower[i][i];
    }
    for (var back = 0u; back < 6u; back++) {
        let i = 5u - back;
        for (var k = i + 1u; k < 6u; k++) {
            xi[i] -= lower[k][i] * xi[k];
        }
        xi[i] /= lower[i][i];
    }
    var squares = 0.0;
    for (var i = 0u; i < 6u; i++) {
        if (!solvable) {
            xi[i] = -state[at + STATE_GRADIENT + i];
        }
        squares += xi[i] * xi[i];
    }
    let size = sqrt(squares);
    let usable = size > 0.0 && size < 1e30;
    let factor = min(1.0, state[at + STATE_RADIUS] / size);
    for (var i = 0u; i < 6u; i++) {
        xi[i] = select(0.0, factor * xi[i], usable);
        if (params.grain > 0.0) {
            xi[i] = params.grain * round(xi[i] / params.grain);
        }
        state[at + STATE_STEP + i] = xi[i];
    }
    let turn = vec3(xi[0], xi[1], xi[2]);
    let shift = vec3(xi[3], xi[4], xi[5]);

    let p = at + STATE_POSE;
    let w = 12u * number;
    let r = mat3x3(
        state[p], state[p + 4u], state[p + 8u],
        state[p + 1u], state[p + 5u], state[p + 9u],
        state[p + 2u], state[p + 6u], state[p + 10u],
    );
    let centre = vec3(state[p + 3u], state[p + 7u], state[p + 11u]) * r;
    // Rodrigues: exp(ω) v = v + sin|ω|/|ω| ω×v + (1 - cos|ω|)/|ω|² ω×(ω×v), the factors by half angles and series.
    let angle2 = dot(turn, turn);
    let angle = sqrt(angle2);
    let half = 0.5 * angle;
    let half_sinc = select(sin(half) / half, 1.0 - half * half / 6.0, half < 1e-2);
    let a = half_sinc * cos(half);
    let b = 0.5 * half_sinc * half_sinc;
    let e0 = rotated(vec3(1.0, 0.0, 0.0), turn, a, b);
    let e1 = rotated(vec3(0.0, 1.0, 0.0), turn, a, b);
    let e2 = rotated(vec3(0.0, 0.0, 1.0), turn, a, b);
    let columns = array(r * e0, r * e1, r * e2, r * (rotated(centre, turn, a, b) + shift));
    for (var row = 0u; row < 3u; row++) {
        for (var column = 0u; column < 4u; column++) {
            world_from_camera[w + 4u * row + column] = columns[column][row];
        }
    }
}

fn rotated(v: vec3<f32>, turn: vec3<f32>, a: f32, b: f32) -> vec3<f32> {
    let once = cross(turn, v);
    return v + a * once + b * cross(turn, once);
}
