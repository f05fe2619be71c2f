// y = relu(gamma (z - mean) rstd + beta), z = W x + b, rstd = 1 / √(var + 1e-5), var the mean of (z - mean)² over the features, weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation holds the weights of eight vectors of features, less their mean over the features, in registers; eight lanes add up what belongs to a row, and take as many turns as there are rows for each such team.
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

fn put(group: u32, row: u32, end: u32, column: u32, value: vec4<f32>) {
    if (row < end && column < params.features / 4u) {
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
        put(group, row, end, c0, gamma0 * (z0 * rstd.a.x) + beta0);
        put(group, row + 1u / per_row, end, c1, gamma1 * (z1 * rstd.a.y) + beta1);
        put(group, row + 2u / per_row, end, c2, gamma2 * (z2 * rstd.a.z) + beta2);
        put(group, row + 3u / per_row, end, c3, gamma3 * (z3 * rstd.a.w) + beta3);
        put(group, row + 4u / per_row, end, c4, gamma4 * (z4 * rstd.b.x) + beta4);
        put(group, row + 5u / per_row, end, c5, gamma5 * (z5 * rstd.b.y) + beta5);
        put(group, row + 6u / per_row, end, c6, gamma6 * (z6 * rstd.b.z) + beta6);
        put(group, row + 7u / per_row, end, c7, gamma7 * (z7 * rstd.b.w) + beta7);
    }
}
