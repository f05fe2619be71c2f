// d_step = ⟨d_x_next, direction⟩, d_direction (+)= d_x_next step, d_h[r, k] (+)= d_step[r] head[k].
// One invocation computes one row.
// direction [rows, 3], step [rows], d_x_next [rows, 3], head [hidden + 1] → d_step [rows], d_direction [rows, 3], d_h [rows, hidden].
// OVERWRITES d_step; ACCUMULATES d_direction and d_h where accumulate is 1, else OVERWRITES them.

struct Params {
    rows: u32,
    hidden: u32,
    accumulate: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> direction: array<f32>;
@group(0) @binding(2) var<storage, read> step: array<f32>;
@group(0) @binding(3) var<storage, read> d_x_next: array<f32>;
@group(0) @binding(4) var<storage, read> head: array<f32>;
@group(0) @binding(5) var<storage, read_write> d_step: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_direction: array<f32>;
@group(0) @binding(7) var<storage, read_write> d_h: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let row = flat_index(workgroup, workgroups, local);
    if (row >= params.rows) {
        return;
    }
    let n = params.hidden;
    var along = 0.0;
    for (var a = 3u * row; a < 3u * row + 3u; a++) {
        along += d_x_next[a] * direction[a];
        var d = d_x_next[a] * step[row];
        if (params.accumulate == 1u) {
            d += d_direction[a];
        }
        d_direction[a] = d;
    }
    d_step[row] = along;
    for (var k = 0u; k < n; k++) {
        var d = along * head[k];
        if (params.accumulate == 1u) {
            d += d_h[row * n + k];
        }
        d_h[row * n + k] = d;
    }
}
