// e = gamma d_y where y > 0, else 0; x̂ = (x - mean) rstd; d_x = rstd (e - mean(e) - x̂ mean(e x̂)), means over the features; of centred x without mean(e).
// One invocation holds eight vectors of one or more rows in registers, so that they are read once; eight lanes add up what belongs to one, and take as many turns as there are rows for each such team.
// x, d_y [rows, features], stats [rows, 2] = (mean, rstd), affine [2, features] = (gamma, beta) → d_x [rows, features]; features a multiple of 4, at most 256.
// OVERWRITES d_x.

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
@group(0) @binding(2) var<storage, read> stats: array<f32>;
@group(0) @binding(3) var<storage, read> affine: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> d_y: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> d_x: array<vec4<f32>>;

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
    let octet = lane - lane % 8u;
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
        // Each lane loads what belongs to one row.
        let mine = min(row + lane % 8u, last);
        let mean_of_mine = stats[2u * mine];
        let rstd_of_mine = stats[2u * mine + 1u];
        let mean0 = subgroupShuffle(mean_of_mine, octet);
        let rstd0 = subgroupShuffle(rstd_of_mine, octet);
        let mean1 = subgroupShuffle(mean_of_mine, octet + 1u / per_row);
        let rstd1 = subgroupShuffle(rstd_of_mine, octet + 1u / per_row);
        let mean2 = subgroupShuffle(mean_of_mine, octet + 2u / per_row);
        let rstd2 = subgroupShuffle(rstd_of_mine, octet + 2u / per_row);
        let mean3 = subgroupShuffle(mean_of_mine, octet + 3u / per_row);
        let rstd3 = subgroupShuffle(rstd_of_mine, octet + 3u / per_row);
        let mean4 = subgroupShuffle(mean_of_mine, octet + 4u / per_row);
        let rstd4 = subgroupShuffle(rstd_of_mine, octet + 4u / per_row);
        let mean5 = subgroupShuffle(mean_of_mine, octet + 5u / per_row);
        let rstd5 = subgroupShuffle(rstd_of_mine, octet + 5u / per_row);
        let mean6 = subgroupShuffle(mean_of_mine, octet + 6u / per_row);
        let rstd6 = subgroupShuffle(rstd_of_mine, octet + 6u / per_row);
        let mean7 = subgroupShuffle(mean_of_mine, octet + 7u / per_row);
        let rstd7 = subgroupShuffle(rstd_of_mine, octet + 7u / per_row);
        let x0 = (x[min(r0, last) * n + j0] - mean0) * rstd0;
        let x1 = (x[min(r1, last) * n + j1] - mean1) * rstd1;
        let x2 = (x[min(r2, last) * n + j2] - mean2) * rstd2;
        let x3 = (x[min(r3, last) * n + j3] - mean3) * rstd3;
        let x4 = (x[min(r4, last) * n + j4] - mean4) * rstd4;
        let x5 = (x[min(r5, last) * n + j5] - mean5) * rstd5;
        let x6 = (x[min(r6, last) * n + j6] - mean6) * rstd6;
        let x7 = (x[min(r7, last) * n + j7] - mean7) * rstd7;
        let e0 = d_normalised(c0, x0, gamma0, beta0, d_y[min(r0, last) * n + j0]);
        let e1 = d_normalised(c1, x1, gamma1, beta1, d_y[min(r1, last) * n + j1]);
        let e2 = d_normalised(c2, x2, gamma2, beta2, d_y[min(r2, last) * n + j2]);
        let e3 = d_normalised(c3, x3, gamma3, beta3, d_y[min(r3, last) * n + j3]);
        let e4 = d_normalised(c4, x4, gamma4, beta4, d_y[min(r4, last) * n + j4]);
        let e5 = d_normalised(c5, x5, gamma5, beta5, d_y[min(r5, last) * n + j5]);
        let e6 = d_normalised(c6, x6, gamma6, beta6, d_y[min(r6, last) * n + j6]);
        let e7 = d_normalised(c7, x7, gamma7, beta7, d_y[min(r7, last) * n + j7]);
        var mean = Slots(vec4(0.0), vec4(0.0));
        if (params.centred == 0u) {
            let sums = total(Slots(
                vec4(dot(e0, vec4(1.0)), dot(e1, vec4(1.0)), dot(e2, vec4(1.0)), dot(e3, vec4(1.0))),
                vec4(dot(e4, vec4(1.0)), dot(e5, vec4(1.0)), dot(e6, vec4(1.0)), dot(e7, vec4(1.0))),
            ), per_row);
            mean = Slots(sums.a / f32(params.features), sums.b / f32(params.features));
        }
        let alongs = total(Slots(
            vec4(dot(e0, x0), dot(e1, x1), dot(e2, x2), dot(e3, x3)),
            vec4(dot(e4, x4), dot(e5, x5), dot(e6, x6), dot(e7, x7)),
        ), per_row);
        let along = Slots(alongs.a / f32(params.features), alongs.b / f32(params.features));
        put(r0, c0, rstd0 * (e0 - mean.a.x - x0 * along.a.x));
        put(r1, c1, rstd1 * (e1 - mean.a.y - x1 * along.a.y));
        put(r2, c2, rstd2 * (e2 - mean.a.z - x2 * along.a.z));
        put(r3, c3, rstd3 * (e3 - mean.a.w - x3 * along.a.w));
        put(r4, c4, rstd4 * (e4 - mean.b.x - x4 * along.b.x));
        put(r5, c5, rstd5 * (e5 - mean.b.y - x5 * along.b.y));
        put(r6, c6, rstd6 * (e6 - mean.b.z - x6 * along.b.z));
        put(r7, c7, rstd7 * (e7 - mean.b.w - x7 * along.b.w));
    }
}
