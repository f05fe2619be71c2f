// y = relu(gamma (z - mean) rstd + beta), z = W x + b, rstd = 1 / √(var + 1e-5), var the mean of (z - mean)² over the features, weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation holds the weights of two vectors of features, less their mean over the features, in registers; eight, sixteen or thirty-two lanes have a row, four rows at a time; those of a team of eight add up by shuffles, and teams through workgroup memory.
// x [groups, rows_per_group, 3], weights [.., 3 features + features], slots [..], affine [2, features] = (gamma, beta) → y [groups, rows_per_group, features]; features a multiple of 4, at most 256.
// OVERWRITES y.

struct Params {
    groups: u32,
    rows_per_group: u32,
    first_group: u32,
    features: u32,
    weight_stride: u32,
    accumulate: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read> weights: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read> affine: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> y: array<vec4<f32>>;

// The point of a row.
fn point(at: u32) -> vec3<f32> {
    return vec3(x[3u * at], x[3u * at + 1u], x[3u * at + 2u]);
}

fn put(group: u32, row: u32, column: u32, value: vec4<f32>) {
    if (row < params.rows_per_group && column < params.features / 4u) {
        y[(group * params.rows_per_group + row) * (params.features / 4u) + column] = max(value, vec4(0.0));
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
    let turns = (params.rows_per_group + at_once - 1u) / at_once;
    let first = 4u * turns * (sharers * (workgroup.y * workgroups.x + workgroup.x) + index / lanes);
    let group = workgroup.z;
    let of_group = group * params.rows_per_group;
    let last = params.rows_per_group - 1u;
    // Columns of the two vectors; the last one stands in for those beyond the row, whose weights are zero.
    let c = member;
    let d = member + lanes;
    let i = min(c, n - 1u);
    let j = min(d, n - 1u);
    let first_weight = weights_of(group) / 4u;
    let raw_c = column(first_weight, c);
    let raw_d = column(first_weight, d);
    let mean = total(sums(raw_c, true) + sums(raw_d, true), index, 1u) / f32(params.features);
    let w_c = centred(raw_c, mean, c);
    let w_d = centred(raw_d, mean, d);
    let gamma_c = affine[i];
    let gamma_d = affine[j];
    let beta_c = affine[n + i];
    let beta_d = affine[n + j];
    for (var turn = 0u; turn < turns; turn++) {
        let row = first + 4u * turn;
        let p0 = point(of_group + min(row, last));
        let p1 = point(of_group + min(row + 1u, last));
        let p2 = point(of_group + min(row + 2u, last));
        let p3 = point(of_group + min(row + 3u, last));
        let c0 = linear(w_c, p0);
        let d0 = linear(w_d, p0);
        let c1 = linear(w_c, p1);
        let d1 = linear(w_d, p1);
        let c2 = linear(w_c, p2);
        let d2 = linear(w_d, p2);
        let c3 = linear(w_c, p3);
        let d3 = linear(w_d, p3);
        let squares = vec4(dot(c0, c0) + dot(d0, d0), dot(c1, c1) + dot(d1, d1), dot(c2, c2) + dot(d2, d2), dot(c3, c3) + dot(d3, d3));
        let rstd = 1.0 / sqrt(total(squares, index, turn % 2u) / f32(params.features) + 1e-5);
        put(group, row, c, gamma_c * (c0 * rstd.x) + beta_c);
        put(group, row, d, gamma_d * (d0 * rstd.x) + beta_d);
        put(group, row + 1u, c, gamma_c * (c1 * rstd.y) + beta_c);
        put(group, row + 1u, d, gamma_d * (d1 * rstd.y) + beta_d);
        put(group, row + 2u, c, gamma_c * (c2 * rstd.z) + beta_c);
        put(group, row + 2u, d, gamma_d * (d2 * rstd.z) + beta_d);
        put(group, row + 3u, c, gamma_c * (c3 * rstd.w) + beta_c);
        put(group, row + 3u, d, gamma_d * (d3 * rstd.w) + beta_d);
    }
}
