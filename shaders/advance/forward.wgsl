// x_next = x + direction · step.
// One invocation computes one row.
// x, direction [rows, 3], step [rows] → x_next [rows, 3].
// OVERWRITES x_next.

struct Params {
    rows: u32,
    accumulate: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read> direction: array<f32>;
@group(0) @binding(3) var<storage, read> step: array<f32>;
@group(0) @binding(4) var<storage, read_write> x_next: array<f32>;

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
    for (var a = 3u * row; a < 3u * row + 3u; a++) {
        x_next[a] = x[a] + direction[a] * step[row];
    }
}
