// e = gamma d_y where y > 0, else 0; x̂ = (x - mean) rstd; d_x = rstd (e - mean(e) - x̂ mean(e x̂)), means over the features.
// One invocation holds up to eight vectors of a row in registers, which is read once; the lanes of a row add up their sums. At most 32 rows.
// x, d_y [rows, features], stats [rows, 2] = (mean, rstd), affine [2, features] = (gamma, beta) → d_x [rows, features]; features a multiple of 4, at most 256.
// OVERWRITES d_x.

struct Params {
    rows: u32,
    features: u32,
    chunk_rows: u32,
    chunks: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> stats: array<f32>;
@group(0) @binding(3) var<storage, read> affine: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> d_y: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> d_x: array<vec4<f32>>;

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

// The gradient to the normalised values; zero beyond the row.
fn d_normalised(column: u32, normalised: vec4<f32>, gamma: vec4<f32>, beta: vec4<f32>, gradient: vec4<f32>) -> vec4<f32> {
    let passes = gamma * normalised + beta > vec4(0.0);
    return select(vec4(0.0), gamma * gradient, passes & vec4(column < params.features / 4u));
}

fn put(row: u32, column: u32, value: vec4<f32>) {
    if (row < params.rows && column < params.features / 4u) {
        d_x[row * (params.features / 4u) + column] = value;
    }
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
        let mean = stats[2u * min(row, params.rows - 1u)];
        let rstd = stats[2u * min(row, params.rows - 1u) + 1u];
        let x0 = (x[at + j0] - mean) * rstd;
        let x1 = (x[at + j1] - mean) * rstd;
        let x2 = (x[at + j2] - mean) * rstd;
        let x3 = (x[at + j3] - mean) * rstd;
        let x4 = (x[at + j4] - mean) * rstd;
        let x5 = (x[at + j5] - mean) * rstd;
        let x6 = (x[at + j6] - mean) * rstd;
        let x7 = (x[at + j7] - mean) * rstd;
        let e0 = d_normalised(c0, x0, gamma0, beta0, d_y[at + j0]);
        let e1 = d_normalised(c1, x1, gamma1, beta1, d_y[at + j1]);
        let e2 = d_normalised(c2, x2, gamma2, beta2, d_y[at + j2]);
        let e3 = d_normalised(c3, x3, gamma3, beta3, d_y[at + j3]);
        let e4 = d_normalised(c4, x4, gamma4, beta4, d_y[at + j4]);
        let e5 = d_normalised(c5, x5, gamma5, beta5, d_y[at + j5]);
        let e6 = d_normalised(c6, x6, gamma6, beta6, d_y[at + j6]);
        let e7 = d_normalised(c7, x7, gamma7, beta7, d_y[at + j7]);
        let sum = e0 + e1 + e2 + e3 + e4 + e5 + e6 + e7;
        let along = e0 * x0 + e1 * x1 + e2 * x2 + e3 * x3 + e4 * x4 + e5 * x5 + e6 * x6 + e7 * x7;
        let mean_e = total(sum, lanes) / f32(params.features);
        let mean_along = total(along, lanes) / f32(params.features);
        put(row, c0, rstd * (e0 - mean_e - x0 * mean_along));
        put(row, c1, rstd * (e1 - mean_e - x1 * mean_along));
        put(row, c2, rstd * (e2 - mean_e - x2 * mean_along));
        put(row, c3, rstd * (e3 - mean_e - x3 * mean_along));
        put(row, c4, rstd * (e4 - mean_e - x4 * mean_along));
        put(row, c5, rstd * (e5 - mean_e - x5 * mean_along));
        put(row, c6, rstd * (e6 - mean_e - x6 * mean_along));
        put(row, c7, rstd * (e7 - mean_e - x7 * mean_along));
    }
}
