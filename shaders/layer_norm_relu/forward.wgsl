// y = relu(gamma (x - mean) rstd + beta), rstd = 1 / √(var + 1e-5), var the mean of (x - mean)² over the features; of centred x mean = 0.
// One invocation computes one row.
// x [rows, features], affine [2, features] = (gamma, beta) → y [rows, features], stats [rows, 2] = (mean, rstd).
// OVERWRITES y and stats.

struct Params {
    rows: u32,
    rows_per_group: u32,
    features: u32,
    accumulate: u32,
    chunk_rows: u32,
    chunks: u32,
    centred: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read> affine: array<f32>;
@group(0) @binding(3) var<storage, read_write> y: array<f32>;
@group(0) @binding(4) var<storage, read_write> stats: array<f32>;

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
    let n = params.features;
    let at = row * n;

    var sum = 0.0;
    if (params.centred == 0u) {
        for (var j = 0u; j < n; j++) {
            sum += x[at + j];
        }
    }
    let mean = sum / f32(n);

    var squares = 0.0;
    for (var j = 0u; j < n; j++) {
        let centred = x[at + j] - mean;
        squares += centred * centred;
    }
    let rstd = 1.0 / sqrt(squares / f32(n) + 1e-5);

    for (var j = 0u; j < n; j++) {
        y[at + j] = max(affine[j] * ((x[at + j] - mean) * rstd) + affine[n + j], 0.0);
    }
    stats[2u * row] = mean;
    stats[2u * row + 1u] = rstd;
}
