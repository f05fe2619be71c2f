// z = W x + b, x̂ = (z - mean) rstd, e = gamma d_y where y > 0, else 0; d_z = rstd (e - mean(e) - x̂ mean(e x̂)), means over the features; d_x[r, i] (+)= Σ_j W[j, i] d_z[r, j], weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation holds the weights of eight vectors of features, less their mean over the features, in registers; eight lanes add up what belongs to a row, and take as many turns as there are rows for each such team.
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

// The gradient to the normalised values.
fn d_normalised(normalised: vec4<f32>, gamma: vec4<f32>, beta: vec4<f32>, gradient: vec4<f32>) -> vec4<f32> {
    return select(vec4(0.0), gamma * gradient, gamma * normalised + beta > vec4(0.0));
}

fn incoming(group: u32, row: u32, end: u32, j: u32) -> vec4<f32> {
    return d_y[(group * params.rows_per_group + min(row, end - 1u)) * (params.features / 4u) + j];
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
    // Slots lanes of a subgroup are a team, whatever its size: 1, 2, 4 or 8 vectors of each make a row.
    let n = params.features / 4u;
    let per_row = select(select(select(1u, 2u, n > 8u), 4u, n > 16u), 8u, n > 32u);
    let member = lane % 8u;
    let octet = lane - member;
    let team = (subgroup * subgroup_size + lane) / 8u;
    // Rows side by side for each team, in whole turns.
    let turn = 8u / per_row;
    let of_all = turn * 4u * workgroups.x * workgroups.y;
    let share = turn * ((params.rows_per_group + of_all - 1u) / of_all);
    let first = share * (4u * (workgroup.y * workgroups.x + workgroup.x) + team);
    let group = workgroup.z;
    if (first >= params.rows_per_group) {
        return;
    }
    let end = min(first + share, params.rows_per_group);
    let first_weight = weights_of(group) / 4u;
    // Columns of the vectors.
    let c0 = member;
    let c1 = member + 8u * (1u % per_row);
    let c2 = member + 8u * (2u % per_row);
    let c3 = member + 8u * (3u % per_row);
    let c4 = member + 8u * (4u % per_row);
    let c5 = member + 8u * (5u % per_row);
    let c6 = member + 8u * (6u % per_row);
    let c7 = member + 8u * (7u % per_row);
    // Those beyond `per_row` are the first ones again, for other rows.
    let raw0 = column(first_weight, c0);
    let raw1 = column(first_weight, c1);
    let raw2 = column(first_weight, c2);
    let raw3 = column(first_weight, c3);
    let raw4 = column(first_weight, c4);
    let raw5 = column(first_weight, c5);
    let raw6 = column(first_weight, c6);
    let raw7 = column(first_weight, c7);
    var mean = sums(raw0, true);
    mean += sums(raw1, 1u < per_row);
    mean += sums(raw2, 2u < per_row);
    mean += sums(raw3, 3u < per_row);
    mean += sums(raw4, 4u < per_row);
    mean += sums(raw5, 5u < per_row);
    mean += sums(raw6, 6u < per_row);
    mean += sums(raw7, 7u < per_row);
    mean += subgroupShuffleXor(mean, 1u);
    mean += subgroupShuffleXor(mean, 2u);
    mean += subgroupShuffleXor(mean, 4u);
    mean /= f32(params.features);
    let w0 = centred(raw0, mean, c0);
    let w1 = centred(raw1, mean, c1);
    let w2 = centred(raw2, mean, c2);
    let w3 = centred(raw3, mean, c3);
    let w4 = centred(raw4, mean, c4);
    let w5 = centred(raw5, mean, c5);
    let w6 = centred(raw6, mean, c6);
    let w7 = centred(raw7, mean, c7);
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
    for (var row = first; row < end; row += turn) {
        // Each lane loads the point of one row.
        let of_mine = 3u * (group * params.rows_per_group + min(row + member, end - 1u));
        let mine = vec3(x[of_mine], x[of_mine + 1u], x[of_mine + 2u]);
        let z0 = linear(w0, subgroupShuffle(mine, octet));
        let z1 = linear(w1, subgroupShuffle(mine, octet + 1u / per_row));
        let z2 = linear(w2, subgroupShuffle(mine, octet + 2u / per_row));
        let z3 = linear(w3, subgroupShuffle(mine, octet + 3u / per_row));
        let z4 = linear(w4, subgroupShuffle(mine, octet + 4u / per_row));
        let z5 = linear(w5, subgroupShuffle(mine, octet + 5u / per_row));
        let z6 = linear(w6, subgroupShuffle(mine, octet + 6u / per_row));
        let z7 = linear(w7, subgroupShuffle(mine, octet + 7u / per_row));
        let squares = total(Slots(
            vec4(dot(z0, z0), dot(z1, z1), dot(z2, z2), dot(z3, z3)),
            vec4(dot(z4, z4), dot(z5, z5), dot(z6, z6), dot(z7, z7)),
        ), per_row);
        let rstd = Slots(
            1.0 / sqrt(squares.a / f32(params.features) + 1e-5),
            1.0 / sqrt(squares.b / f32(params.features) + 1e-5),
        );
        let e0 = d_normalised(z0 * rstd.a.x, gamma0, beta0, incoming(group, row, end, j0));
        let e1 = d_normalised(z1 * rstd.a.y, gamma1, beta1, incoming(group, row + 1u / per_row, end, j1));
        let e2 = d_normalised(z2 * rstd.a.z, gamma2, beta2, incoming(group, row + 2u / per_row, end, j2));
        let e3 = d_normalised(z3 * rstd.a.w, gamma3, beta3, incoming(group, row + 3u / per_row, end, j3));
        let e4 = d_normalised(z4 * rstd.b.x, gamma4, beta4, incoming(group, row + 4u / per_row, end, j4));
        let e5 = d_normalised(z5 * rstd.b.y, gamma5, beta5, incoming(group, row + 5u / per_row, end, j5));
        let e6 = d_normalised(z6 * rstd.b.z, gamma6, beta6, incoming(group, row + 6u / per_row, end, j6));
        let e7 = d_normalised(z7 * rstd.b.w, gamma7, beta7, incoming(group, row + 7u / per_row, end, j7));
        let along = total(Slots(
            vec4(dot(e0, z0), dot(e1, z1), dot(e2, z2), dot(e3, z3)),
            vec4(dot(e4, z4), dot(e5, z5), dot(e6, z6), dot(e7, z7)),
        ), per_row);
        // d_z / rstd but for mean(e), which the centred weights take to nothing.
        let factor = Slots(
            along.a * rstd.a * rstd.a / f32(params.features),
            along.b * rstd.b * rstd.b / f32(params.features),
        );
        let d0 = e0 - z0 * factor.a.x;
        let d1 = e1 - z1 * factor.a.y;
        let d2 = e2 - z2 * factor.a.z;
        let d3 = e3 - z3 * factor.a.w;
        let d4 = e4 - z4 * factor.b.x;
        let d5 = e5 - z5 * factor.b.y;
        let d6 = e6 - z6 * factor.b.z;
        let d7 = e7 - z7 * factor.b.w;
        let d_x0 = total(Slots(
            vec4(dot(w0.x, d0), dot(w1.x, d1), dot(w2.x, d2), dot(w3.x, d3)),
            vec4(dot(w4.x, d4), dot(w5.x, d5), dot(w6.x, d6), dot(w7.x, d7)),
        ), per_row);
        let d_x1 = total(Slots(
            vec4(dot(w0.y, d0), dot(w1.y, d1), dot(w2.y, d2), dot(w3.y, d3)),
            vec4(dot(w4.y, d4), dot(w5.y, d5), dot(w6.y, d6), dot(w7.y, d7)),
        ), per_row);
        let d_x2 = total(Slots(
            vec4(dot(w0.z, d0), dot(w1.z, d1), dot(w2.z, d2), dot(w3.z, d3)),
            vec4(dot(w4.z, d4), dot(w5.z, d5), dot(w6.z, d6), dot(w7.z, d7)),
        ), per_row);
        // Each lane stores one row.
        if (member < 8u / per_row && row + member < end) {
            let k = member * per_row;
            let scale = pick(rstd, k);
            put(of_mine, scale * pick(d_x0, k));
            put(of_mine + 1u, scale * pick(d_x1, k));
            put(of_mine + 2u, scale * pick(d_x2, k));
        }
    }
}
