// e = gamma d_y where y > 0, else 0; x̂ = (x - mean) rstd; d_x = rstd (e - mean(e) - x̂ mean(e x̂)), means over the features; of centred x without mean(e).
// One invocation holds two vectors of each of four rows in registers, so that they are read once; eight, sixteen or thirty-two lanes have a row, those of a team of eight add up by shuffles, and teams through workgroup memory.
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

// A vector of x, normalised.
fn normalised(row: u32, j: u32) -> vec4<f32> {
    return (x[row * (params.features / 4u) + j] - stats[2u * row]) * stats[2u * row + 1u];
}

// The gradient to the normalised values; zero beyond the row.
fn d_normalised(column: u32, normalised: vec4<f32>, gamma: vec4<f32>, beta: vec4<f32>, gradient: vec4<f32>) -> vec4<f32> {
    let passes = gamma * normalised + beta > vec4(0.0);
    return select(vec4(0.0), gamma * gradient, passes & vec4(column < params.features / 4u));
}

fn put(row: u32, column: u32, value: vec4<f32>) {
    if (row < params.rows && column < params.features / 4u) {
        d_x[row * (params.features / 4u) + column] = stats[2u * row + 1u] * value;
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
        let r0 = min(row, last);
        let r1 = min(row + 1u, last);
        let r2 = min(row + 2u, last);
        let r3 = min(row + 3u, last);
        let c0 = normalised(r0, i);
        let d0 = normalised(r0, j);
        let c1 = normalised(r1, i);
        let d1 = normalised(r1, j);
        let c2 = normalised(r2, i);
        let d2 = normalised(r2, j);
        let c3 = normalised(r3, i);
        let d3 = normalised(r3, j);
        let e_c0 = d_normalised(c, c0, gamma_c, beta_c, d_y[n * r0 + i]);
        let e_d0 = d_normalised(d, d0, gamma_d, beta_d, d_y[n * r0 + j]);
        let e_c1 = d_normalised(c, c1, gamma_c, beta_c, d_y[n * r1 + i]);
        let e_d1 = d_normalised(d, d1, gamma_d, beta_d, d_y[n * r1 + j]);
        let e_c2 = d_normalised(c, c2, gamma_c, beta_c, d_y[n * r2 + i]);
        let e_d2 = d_normalised(d, d2, gamma_d, beta_d, d_y[n * r2 + j]);
        let e_c3 = d_normalised(c, c3, gamma_c, beta_c, d_y[n * r3 + i]);
        let e_d3 = d_normalised(d, d3, gamma_d, beta_d, d_y[n * r3 + j]);
        var mean = vec4(0.0);
        if (params.centred == 0u) {
            let one = vec4(1.0);
            let sums = vec4(dot(e_c0 + e_d0, one), dot(e_c1 + e_d1, one), dot(e_c2 + e_d2, one), dot(e_c3 + e_d3, one));
            mean = total(sums, index, 0u) / f32(params.features);
        }
        let products = vec4(
            dot(e_c0, c0) + dot(e_d0, d0),
            dot(e_c1, c1) + dot(e_d1, d1),
            dot(e_c2, c2) + dot(e_d2, d2),
            dot(e_c3, c3) + dot(e_d3, d3),
        );
        let along = total(products, index, select(1u, turn % 2u, params.centred == 1u)) / f32(params.features);
        put(row, c, e_c0 - mean.x - c0 * along.x);
        put(row, d, e_d0 - mean.x - d0 * along.x);
        put(row + 1u, c, e_c1 - mean.y - c1 * along.y);
        put(row + 1u, d, e_d1 - mean.y - d1 * along.y);
        put(row + 2u, c, e_c2 - mean.z - c2 * along.z);
        put(row + 2u, d, e_d2 - mean.z - d2 * along.z);
        put(row + 3u, c, e_c3 - mean.w - c3 * along.w);
        put(row + 3u, d, e_d3 - mean.w - d3 * along.w);
    }
}
