// step[r] = Σ_k head[k] h[r, k] + head[hidden], x_next = x + direction · step.
// One invocation computes one row.
// x, direction [rows, 3], h [rows, hidden], head [hidden + 1] → step [rows], x_next [rows, 3].
// OVERWRITES step and x_next.

struct Params {
    rows: u32,
    hidden: u32,
    accumulate: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read> direction: array<f32>;
@group(0) @binding(3) var<storage, read> h: array<f32>;
@group(0) @binding(4) var<storage, read> head: array<f32>;
@group(0) @binding(5) var<storage, read_write> step: array<f32>;
@group(0) @binding(6) var<storage, read_write> x_next: array<f32>;

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
    var along = head[n];
    for (var k = 0u; k < n; k++) {
        along += head[k] * h[row * n + k];
    }
    step[row] = along;
    for (var a = 3u * row; a < 3u * row + 3u; a++) {
        x_next[a] = x[a] + direction[a] * along;
    }
}
