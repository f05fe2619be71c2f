// y = relu(gamma (x - mean) rstd + beta), rstd = 1 / √(var + 1e-5), var the mean of (x - mean)² over the features; of centred x mean = 0.
// One invocation holds eight vectors of one or more rows in registers, so that they are read once; eight lanes add up what belongs to one, and take as many turns as there are rows for each such team.
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

fn put(row: u32, column: u32, value: vec4<f32>) {
    if (row < params.rows && column < params.features / 4u) {
        y[row * (params.features / 4u) + column] = max(value, vec4(0.0));
    }
}

// Of a vector within the row.
fn sum(column: u32, value: vec4<f32>) -> f32 {
    return select(0.0, dot(value, vec4(1.0)), column < params.features / 4u);
}

@compute @workgroup_size(32)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_size) subgroup_size: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    // Eight lanes of a subgroup are a team, whatever its size: 1, 2, 4 or 8 vectors of each make a row.
    let n = params.features / 4u;
    let per_row = select(select(select(1u, 2u, n > 8u), 4u, n > 16u), 8u, n > 32u);
    let team = (subgroup * subgroup_size + lane) / 8u;
    // Rows side by side for each team, in whole turns.
    let turn = 8u / per_row;
    let of_all = turn * 4u * workgroups.x * workgroups.y;
    let share = turn * ((params.rows + of_all - 1u) / of_all);
    let first = share * (4u * (workgroup.y * workgroups.x + workgroup.x) + team);
    // Columns of the vectors; the last one stands in for those beyond the row, which count as zero and are not stored.
    let c0 = lane % 8u;
    let c1 = lane % 8u + 8u * (1u % per_row);
    let c2 = lane % 8u + 8u * (2u % per_row);
    let c3 = lane % 8u + 8u * (3u % per_row);
    let c4 = lane % 8u + 8u * (4u % per_row);
    let c5 = lane % 8u + 8u * (5u % per_row);
    let c6 = lane % 8u + 8u * (6u % per_row);
    let c7 = lane % 8u + 8u * (7u % per_row);
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
    let last = params.rows - 1u;
    for (var row = first; row < min(first + share, params.rows); row += turn) {
        let r0 = row;
        let r1 = row + 1u / per_row;
        let r2 = row + 2u / per_row;
        let r3 = row + 3u / per_row;
        let r4 = row + 4u / per_row;
        let r5 = row + 5u / per_row;
        let r6 = row + 6u / per_row;
        let r7 = row + 7u / per_row;
        let x0 = x[min(r0, last) * n + j0];
        let x1 = x[min(r1, last) * n + j1];
        let x2 = x[min(r2, last) * n + j2];
        let x3 = x[min(r3, last) * n + j3];
        let x4 = x[min(r4, last) * n + j4];
        let x5 = x[min(r5, last) * n + j5];
        let x6 = x[min(r6, last) * n + j6];
        let x7 = x[min(r7, last) * n + j7];
        var mean = Slots(vec4(0.0), vec4(0.0));
        if (params.centred == 0u) {
            let sums = total(Slots(
                vec4(sum(c0, x0), sum(c1, x1), sum(c2, x2), sum(c3, x3)),
                vec4(sum(c4, x4), sum(c5, x5), sum(c6, x6), sum(c7, x7)),
            ), per_row);
            mean = Slots(sums.a / f32(params.features), sums.b / f32(params.features));
        }
        let d0 = x0 - mean.a.x;
        let d1 = x1 - mean.a.y;
        let d2 = x2 - mean.a.z;
        let d3 = x3 - mean.a.w;
        let d4 = x4 - mean.b.x;
        let d5 = x5 - mean.b.y;
        let d6 = x6 - mean.b.z;
        let d7 = x7 - mean.b.w;
        let squares = total(Slots(
            vec4(sum(c0, d0 * d0), sum(c1, d1 * d1), sum(c2, d2 * d2), sum(c3, d3 * d3)),
            vec4(sum(c4, d4 * d4), sum(c5, d5 * d5), sum(c6, d6 * d6), sum(c7, d7 * d7)),
        ), per_row);
        let rstd = Slots(
            1.0 / sqrt(squares.a / f32(params.features) + 1e-5),
            1.0 / sqrt(squares.b / f32(params.features) + 1e-5),
        );
        put(r0, c0, gamma0 * (d0 * rstd.a.x) + beta0);
        put(r1, c1, gamma1 * (d1 * rstd.a.y) + beta1);
        put(r2, c2, gamma2 * (d2 * rstd.a.z) + beta2);
        put(r3, c3, gamma3 * (d3 * rstd.a.w) + beta3);
        put(r4, c4, gamma4 * (d4 * rstd.b.x) + beta4);
        put(r5, c5, gamma5 * (d5 * rstd.b.y) + beta5);
        put(r6, c6, gamma6 * (d6 * rstd.b.z) + beta6);
        put(r7, c7, gamma7 * (d7 * rstd.b.w) + beta7);
        // Each lane stores what belongs to one row.
        let mine = row + lane % 8u;
        if (lane % 8u < 8u / per_row && mine < params.rows) {
            stats[2u * mine] = pick(mean, lane % 8u * per_row);
            stats[2u * mine + 1u] = pick(rstd, lane % 8u * per_row);
        }
    }
}
