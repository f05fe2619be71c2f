// y = relu(gamma (x - mean) rstd + beta), rstd = 1 / √(var + 1e-5), var the mean of (x - mean)² over the features; of centred x mean = 0.
// One invocation holds two vectors of each of four rows in registers, so that they are read once; eight, sixteen or thirty-two lanes have a row, those of a team of eight add up by shuffles, and teams through workgroup memory.
// x [rows, features], affine [2, features] = (gamma, beta) → y [rows, features], stats [rows, 2] = (mean, rstd); features a multiple of 4, at most 256.
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
@group(0) @binding(1) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> affine: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> y: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> stats: array<f32>;

// Of a vector within the row.
fn sum(column: u32, value: vec4<f32>) -> f32 {
    return select(0.0, dot(value, vec4(1.0)), column < params.features / 4u);
}

fn put(row: u32, column: u32, value: vec4<f32>) {
    if (row < params.rows && column < params.features / 4u) {
        y[row * (params.features / 4u) + column] = max(value, vec4(0.0));
    }
}

@compute @workgroup_size(32)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_size) subgroup_size: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    let n = params.features / 4u;
    let index = subgroup * subgroup_size + lane;
    let lanes = 8u * teams_of_row();
    let member = index % lanes;
    // Rows side by side for those who share them, in whole turns of four.
    let sharers = 32u / lanes;
    let at_once = 4u * sharers * workgroups.x * workgroups.y;
    let turns = (params.rows + at_once - 1u) / at_once;
    let first = 4u * turns * (sharers * (workgroup.y * workgroups.x + workgroup.x) + index / lanes);
    // Columns of the two vectors; the last one stands in for those beyond the row, which count as zero and are not stored.
    let c = member;
    let d = member + lanes;
    let i = min(c, n - 1u);
    let j = min(d, n - 1u);
    let gamma_c = affine[i];
    let gamma_d = affine[j];
    let beta_c = affine[n + i];
    let beta_d = affine[n + j];
    let last = params.rows - 1u;
    for (var turn = 0u; turn < turns; turn++) {
        let row = first + 4u * turn;
        let r0 = n * min(row, last);
        let r1 = n * min(row + 1u, last);
        let r2 = n * min(row + 2u, last);
        let r3 = n * min(row + 3u, last);
        var c0 = x[r0 + i];
        var d0 = x[r0 + j];
        var c1 = x[r1 + i];
        var d1 = x[r1 + j];
        var c2 = x[r2 + i];
        var d2 = x[r2 + j];
        var c3 = x[r3 + i];
        var d3 = x[r3 + j];
        var mean = vec4(0.0);
        if (params.centred == 0u) {
            let sums = vec4(sum(c, c0) + sum(d, d0), sum(c, c1) + sum(d, d1), sum(c, c2) + sum(d, d2), sum(c, c3) + sum(d, d3));
            mean = total(sums, index, 0u) / f32(params.features);
            c0 -= mean.x;
            d0 -= mean.x;
            c1 -= mean.y;
            d1 -= mean.y;
            c2 -= mean.z;
            d2 -= mean.z;
            c3 -= mean.w;
            d3 -= mean.w;
        }
        let squares = vec4(
            sum(c, c0 * c0) + sum(d, d0 * d0),
            sum(c, c1 * c1) + sum(d, d1 * d1),
            sum(c, c2 * c2) + sum(d, d2 * d2),
            sum(c, c3 * c3) + sum(d, d3 * d3),
        );
        let rstd = 1.0 / sqrt(total(squares, index, select(1u, turn % 2u, params.centred == 1u)) / f32(params.features) + 1e-5);
        put(row, c, gamma_c * (c0 * rstd.x) + beta_c);
        put(row, d, gamma_d * (d0 * rstd.x) + beta_d);
        put(row + 1u, c, gamma_c * (c1 * rstd.y) + beta_c);
        put(row + 1u, d, gamma_d * (d1 * rstd.y) + beta_d);
        put(row + 2u, c, gamma_c * (c2 * rstd.z) + beta_c);
        put(row + 2u, d, gamma_d * (d2 * rstd.z) + beta_d);
        put(row + 3u, c, gamma_c * (c3 * rstd.w) + beta_c);
        put(row + 3u, d, gamma_d * (d3 * rstd.w) + beta_d);
        // Each of four lanes stores what belongs to one row.
        let mine = row + member;
        if (member < 4u && mine < params.rows) {
            stats[2u * mine] = mean[member];
            stats[2u * mine + 1u] = rstd[member];
        }
    }
}
