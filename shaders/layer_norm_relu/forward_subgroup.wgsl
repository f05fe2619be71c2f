// y = relu(gamma (x - mean) rstd + beta), rstd = 1 / √(var + 1e-5), var the mean of (x - mean)² over the features.
// One invocation holds up to eight vectors of a row in registers, which is read once; the lanes of a row add up their sums. At most 32 rows.
// x [rows, features], affine [2, features] = (gamma, beta) → y [rows, features], stats [rows, 2] = (mean, rstd); features a multiple of 4, at most 256.
// OVERWRITES y and stats.

struct Params {
    rows: u32,
    features: u32,
    chunk_rows: u32,
    chunks: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> affine: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> y: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> stats: array<f32>;

// The sum over the lanes of a row, 1, 2, 4 or 8 of them, which all get it.
fn total(mine: vec4<f32>, lanes: u32) -> f32 {
    var sum = dot(mine, vec4(1.0));
    let one = sum + subgroupShuffleXor(sum, 1u);
    sum = select(sum, one, lanes > 1u);
    let two = sum + subgroupShuffleXor(sum, 2u);
    sum = select(sum, two, lanes > 2u);
    let four = sum + subgroupShuffleXor(sum, 4u);
    return select(sum, four, lanes > 4u);
}

fn put(row: u32, column: u32, value: vec4<f32>) {
    if (row < params.rows && column < params.features / 4u) {
        y[row * (params.features / 4u) + column] = max(value, vec4(0.0));
    }
}

// Zero beyond the row.
fn within(column: u32, value: vec4<f32>) -> vec4<f32> {
    return select(vec4(0.0), value, column < params.features / 4u);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_size) subgroup_size: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    // As few lanes to a row as hold it in eight vectors each; eight lanes of a subgroup do 32 rows, whatever its size.
    let n = params.features / 4u;
    let lanes = select(select(select(1u, 2u, n > 8u), 4u, n > 16u), 8u, n > 32u);
    let team = (subgroup * subgroup_size + lane) / 8u;
    let first = 32u * (8u * (workgroup.y * workgroups.x + workgroup.x) + team) + lane % 8u / lanes;
    let column = lane % lanes;
    // Columns of this lane; the last one stands in for those beyond the row, which count as zero and are not stored.
    let c0 = column;
    let c1 = column + 1u * lanes;
    let c2 = column + 2u * lanes;
    let c3 = column + 3u * lanes;
    let c4 = column + 4u * lanes;
    let c5 = column + 5u * lanes;
    let c6 = column + 6u * lanes;
    let c7 = column + 7u * lanes;
    let j0 = min(c0, n - 1u);
    let j1 = min(c1, n - 1u);
    let j2 = min(c2, n - 1u);
    let j3 = min(c3, n - 1u);
    let j4 = min(c4, n - 1u);
    let j5 = min(c5, n - 1u);
    let j6 = min(c6, n - 1u);
    let j7 = min(c7, n - 1u);
    let gamma0 = affine[j0];
    let gamma1 = affine[j1];
    let gamma2 = affine[j2];
    let gamma3 = affine[j3];
    let gamma4 = affine[j4];
    let gamma5 = affine[j5];
    let gamma6 = affine[j6];
    let gamma7 = affine[j7];
    let beta0 = affine[n + j0];
    let beta1 = affine[n + j1];
    let beta2 = affine[n + j2];
    let beta3 = affine[n + j3];
    let beta4 = affine[n + j4];
    let beta5 = affine[n + j5];
    let beta6 = affine[n + j6];
    let beta7 = affine[n + j7];
    let step = 8u / lanes;
    for (var k = 0u; k < 32u; k += step) {
        let row = first + k;
        // Every lane adds up with its neighbours, also where no row is left.
        let at = min(row, params.rows - 1u) * n;
        let x0 = x[at + j0];
        let x1 = x[at + j1];
        let x2 = x[at + j2];
        let x3 = x[at + j3];
        let x4 = x[at + j4];
        let x5 = x[at + j5];
        let x6 = x[at + j6];
        let x7 = x[at + j7];
        let sum = within(c0, x0) + within(c1, x1) + within(c2, x2) + within(c3, x3) + within(c4, x4) + within(c5, x5) + within(c6, x6) + within(c7, x7);
        let mean = total(sum, lanes) / f32(params.features);
        let d0 = within(c0, x0 - mean);
        let d1 = within(c1, x1 - mean);
        let d2 = within(c2, x2 - mean);
        let d3 = within(c3, x3 - mean);
        let d4 = within(c4, x4 - mean);
        let d5 = within(c5, x5 - mean);
        let d6 = within(c6, x6 - mean);
        let d7 = within(c7, x7 - mean);
        let squares = d0 * d0 + d1 * d1 + d2 * d2 + d3 * d3 + d4 * d4 + d5 * d5 + d6 * d6 + d7 * d7;
        let rstd = 1.0 / sqrt(total(squares, lanes) / f32(params.features) + 1e-5);
        put(row, c0, gamma0 * (d0 * rstd) + beta0);
        put(row, c1, gamma1 * (d1 * rstd) + beta1);
        put(row, c2, gamma2 * (d2 * rstd) + beta2);
        put(row, c3, gamma3 * (d3 * rstd) + beta3);
        put(row, c4, gamma4 * (d4 * rstd) + beta4);
        put(row, c5, gamma5 * (d5 * rstd) + beta5);
        put(row, c6, gamma6 * (d6 * rstd) + beta6);
        put(row, c7, gamma7 * (d7 * rstd) + beta7);
        if (row < params.rows && column == 0u) {
            stats[2u * row] = mean;
            stats[2u * row + 1u] = rstd;
        }
    }
}
