// z = W x + b, x̂ = (z - mean) rstd, e = gamma d_y where y > 0, else 0; d_z = rstd (e - mean(e) - x̂ mean(e x̂)), means over the features; d_x[r, i] (+)= Σ_j W[j, i] d_z[r, j], weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation holds the weights of two vectors of features, less their mean over the features, in registers; eight, sixteen or thirty-two lanes have a row, four rows at a time; those of a team of eight add up by shuffles, and teams through workgroup memory.
// x [groups, rows_per_group, 3], weights [.., 3 features + features], slots [..], affine [2, features] = (gamma, beta), d_y [groups, rows_per_group, features] → d_x [groups, rows_per_group, 3]; features a multiple of 4, at most 256.
// ACCUMULATES d_x where accumulate is 1, else OVERWRITES it.

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
@group(0) @binding(5) var<storage, read> d_y: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> d_x: array<f32>;

// The point of a row.
fn point(at: u32) -> vec3<f32> {
    return vec3(x[3u * at], x[3u * at + 1u], x[3u * at + 2u]);
}

// The gradient to the normalised values.
fn d_normalised(normalised: vec4<f32>, gamma: vec4<f32>, beta: vec4<f32>, gradient: vec4<f32>) -> vec4<f32> {
    return select(vec4(0.0), gamma * gradient, gamma * normalised + beta > vec4(0.0));
}

fn put(at: u32, value: f32) {
    if (params.accumulate == 1u) {
        d_x[at] += value;
    } else {
        d_x[at] = value;
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
        let odd = turn % 2u;
        let r0 = of_group + min(row, last);
        let r1 = of_group + min(row + 1u, last);
        let r2 = of_group + min(row + 2u, last);
        let r3 = of_group + min(row + 3u, last);
        let p0 = point(r0);
        let p1 = point(r1);
        let p2 = point(r2);
        let p3 = point(r3);
        let c0 = linear(w_c, p0);
        let d0 = linear(w_d, p0);
        let c1 = linear(w_c, p1);
        let d1 = linear(w_d, p1);
        let c2 = linear(w_c, p2);
        let d2 = linear(w_d, p2);
        let c3 = linear(w_c, p3);
        let d3 = linear(w_d, p3);
        let squares = vec4(dot(c0, c0) + dot(d0, d0), dot(c1, c1) + dot(d1, d1), dot(c2, c2) + dot(d2, d2), dot(c3, c3) + dot(d3, d3));
        let rstd = 1.0 / sqrt(total(squares, index, odd) / f32(params.features) + 1e-5);
        let e_c0 = d_normalised(c0 * rstd.x, gamma_c, beta_c, d_y[n * r0 + i]);
        let e_d0 = d_normalised(d0 * rstd.x, gamma_d, beta_d, d_y[n * r0 + j]);
        let e_c1 = d_normalised(c1 * rstd.y, gamma_c, beta_c, d_y[n * r1 + i]);
        let e_d1 = d_normalised(d1 * rstd.y, gamma_d, beta_d, d_y[n * r1 + j]);
        let e_c2 = d_normalised(c2 * rstd.z, gamma_c, beta_c, d_y[n * r2 + i]);
        let e_d2 = d_normalised(d2 * rstd.z, gamma_d, beta_d, d_y[n * r2 + j]);
        let e_c3 = d_normalised(c3 * rstd.w, gamma_c, beta_c, d_y[n * r3 + i]);
        let e_d3 = d_normalised(d3 * rstd.w, gamma_d, beta_d, d_y[n * r3 + j]);
        let products = vec4(
            dot(e_c0, c0) + dot(e_d0, d0),
            dot(e_c1, c1) + dot(e_d1, d1),
            dot(e_c2, c2) + dot(e_d2, d2),
            dot(e_c3, c3) + dot(e_d3, d3),
        );
        // d_z / rstd but for mean(e), which the centred weights take to nothing.
        let factor = total(products, index, 1u - odd) * rstd * rstd / f32(params.features);
        let z_c0 = e_c0 - c0 * factor.x;
        let z_d0 = e_d0 - d0 * factor.x;
        let z_c1 = e_c1 - c1 * factor.y;
        let z_d1 = e_d1 - d1 * factor.y;
        let z_c2 = e_c2 - c2 * factor.z;
        let z_d2 = e_d2 - d2 * factor.z;
        let z_c3 = e_c3 - c3 * factor.w;
        let z_d3 = e_d3 - d3 * factor.w;
        let sums_x = vec4(
            dot(w_c.x, z_c0) + dot(w_d.x, z_d0),
            dot(w_c.x, z_c1) + dot(w_d.x, z_d1),
            dot(w_c.x, z_c2) + dot(w_d.x, z_d2),
            dot(w_c.x, z_c3) + dot(w_d.x, z_d3),
        );
        let sums_y = vec4(
            dot(w_c.y, z_c0) + dot(w_d.y, z_d0),
            dot(w_c.y, z_c1) + dot(w_d.y, z_d1),
            dot(w_c.y, z_c2) + dot(w_d.y, z_d2),
            dot(w_c.y, z_c3) + dot(w_d.y, z_d3),
        );
        let sums_z = vec4(
            dot(w_c.z, z_c0) + dot(w_d.z, z_d0),
            dot(w_c.z, z_c1) + dot(w_d.z, z_d1),
            dot(w_c.z, z_c2) + dot(w_d.z, z_d2),
            dot(w_c.z, z_c3) + dot(w_d.z, z_d3),
        );
        let d_0 = rstd * total(sums_x, index, odd);
        let d_1 = rstd * total(sums_y, index, 1u - odd);
        let d_2 = rstd * total(sums_z, index, odd);
        // Each of four lanes stores one row.
        let mine = row + member;
        if (member < 4u && mine <= last) {
            let at = 3u * (of_group + mine);
            put(at, d_0[member]);
            put(at + 1u, d_1[member]);
            put(at + 2u, d_2[member]);
        }
    }
}
