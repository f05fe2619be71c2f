// d_y[r, i] = Σ_o W[o, i] d_z[r, o], weights at slots[first_group + r / rows_per_group] · weight_stride; e = gamma d_y where y > 0, else 0; x̂ = (x - mean) rstd; d_z = rstd (e - mean(e) - x̂ mean(e x̂)) of the layer before, means over the features; of centred x without mean(e).
// One invocation computes 4 rows × 8 input features in registers; a workgroup of 32 × 64 reads what it needs of d_z and W once, 16 output features at a time, and has whole rows for the norm.
// weights [.., out·in + out], slots [..], x [groups, rows_per_group, in], stats [groups, rows_per_group, 2] = (mean, rstd), affine [2, in] = (gamma, beta), d_z [groups, rows_per_group, out] → d_y, d_z [groups, rows_per_group, in]; in = out, a multiple of 4, at most 64.
// OVERWRITES d_y and d_z.

struct Params {
    groups: u32,
    rows_per_group: u32,
    first_group: u32,
    in_features: u32,
    out_features: u32,
    weight_stride: u32,
    centred: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> weights: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> slots: array<u32>;
@group(0) @binding(3) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> stats: array<f32>;
@group(0) @binding(5) var<storage, read> affine: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> d_y: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> d_z: array<vec4<f32>>;

// Sixteen output features of a tile, each of 32 rows and of 64 input features, in vectors of four. Where a vector of rows stands among those of its
// feature is crossed with the feature's number, so that eight successive invocations write to different banks.
var<workgroup> z_tile: array<array<vec4<f32>, 8>, 16>;
var<workgroup> w_tile: array<array<vec4<f32>, 16>, 16>;
// What each of eight invocations has of the sums over the features of four rows.
var<workgroup> shares: array<array<vec4<f32>, 8>, 8>;

// What an invocation computes: rows 4 ly, input features 4 lx and 32 + 4 lx, a and b; columns are rows of d_y.
struct Rows {
    a: mat4x4<f32>,
    b: mat4x4<f32>,
}

// Adds the products of feature k of the sixteen.
fn multiply_add(rows: ptr<function, Rows>, local: vec2<u32>, k: u32) {
    let zs = z_tile[k][local.y ^ (2u * (k / 4u))];
    let wa = w_tile[k][local.x];
    let wb = w_tile[k][local.x + 8u];
    (*rows).a[0] += wa * zs[0];
    (*rows).b[0] += wb * zs[0];
    (*rows).a[1] += wa * zs[1];
    (*rows).b[1] += wb * zs[1];
    (*rows).a[2] += wa * zs[2];
    (*rows).b[2] += wb * zs[2];
    (*rows).a[3] += wa * zs[3];
    (*rows).b[3] += wb * zs[3];
}

// Sums over the features of four rows, of what each of the eight invocations that share them has; all of them get it.
fn total(local: vec2<u32>, mine: vec4<f32>) -> vec4<f32> {
    shares[local.y][local.x] = mine;
    workgroupBarrier();
    let row = shares[local.y];
    workgroupBarrier();
    return (row[0] + row[1]) + (row[2] + row[3]) + ((row[4] + row[5]) + (row[6] + row[7]));
}

// Of a vector of four features of each row.
fn sums(row0: vec4<f32>, row1: vec4<f32>, row2: vec4<f32>, row3: vec4<f32>) -> vec4<f32> {
    let one = vec4(1.0);
    return vec4(dot(row0, one), dot(row1, one), dot(row2, one), dot(row3, one));
}

// Where a vector of the row stands; the last row and vector stand in for those beyond them.
fn place_of(group: u32, row: u32, column: u32) -> u32 {
    let n = params.in_features / 4u;
    return (group * params.rows_per_group + min(row, params.rows_per_group - 1u)) * n + min(column, n - 1u);
}

// A vector of x, normalised.
fn normalised(group: u32, row: u32, column: u32) -> vec4<f32> {
    let r = group * params.rows_per_group + min(row, params.rows_per_group - 1u);
    return (x[place_of(group, row, column)] - stats[2u * r]) * stats[2u * r + 1u];
}

// The gradient to the normalised values; zero beyond the row.
fn d_normalised(column: u32, normalised: vec4<f32>, gradient: vec4<f32>) -> vec4<f32> {
    let n = params.in_features / 4u;
    let gamma = affine[min(column, n - 1u)];
    let passes = gamma * normalised + affine[n + min(column, n - 1u)] > vec4(0.0);
    return select(vec4(0.0), gamma * gradient, passes & vec4(column < n));
}

// Stores four features of a row.
fn put(group: u32, row: u32, column: u32, of_y: vec4<f32>, of_normalised: vec4<f32>) {
    if (row >= params.rows_per_group || column >= params.in_features / 4u) {
        return;
    }
    let at = place_of(group, row, column);
    d_y[at] = of_y;
    d_z[at] = stats[2u * (group * params.rows_per_group + row) + 1u] * of_normalised;
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) index: u32,
) {
    let local = among_eight(index);
    let first_row = 32u * (workgroup.y * workgroups.x + workgroup.x);
    let group = workgroup.z;
    // What this invocation copies: four input features of four rows of W and, where it is one of the last 32, four output features of four rows of d_z.
    // The last ones stand in for those beyond them.
    let n = params.out_features / 4u;
    let stride = params.in_features / 4u;
    let w_first = weights_of(group) / 4u + min(index % 16u, stride - 1u);
    let w_k = 4u * (index / 16u);
    let z_row = group * params.rows_per_group + min(first_row + 4u * (index / 4u % 8u) + vec4(0u, 1u, 2u, 3u), vec4(params.rows_per_group - 1u));
    let z_k = 4u * (index % 4u);
    let z_to = (index / 4u % 8u) ^ (2u * (index % 4u));

    var rows: Rows;
    for (var first = 0u; first < n; first += 4u) {
        let w_at = w_first + 4u * min(first + index / 16u, n - 1u) * stride;
        let ws = mat4x4(weights[w_at], weights[w_at + stride], weights[w_at + 2u * stride], weights[w_at + 3u * stride]);
        var zs: mat4x4<f32>;
        if (index >= 32u) {
            // Nothing beyond the last feature.
            let within = select(0.0, 1.0, first + index % 4u < n);
            let z_at = z_row * n + min(first + index % 4u, n - 1u);
            zs = transpose(mat4x4(d_z[z_at.x], d_z[z_at.y], d_z[z_at.z], d_z[z_at.w])) * within;
        }
        workgroupBarrier();
        w_tile[w_k][index % 16u] = ws[0];
        w_tile[w_k + 1u][index % 16u] = ws[1];
        w_tile[w_k + 2u][index % 16u] = ws[2];
        w_tile[w_k + 3u][index % 16u] = ws[3];
        if (index >= 32u) {
            z_tile[z_k][z_to] = zs[0];
            z_tile[z_k + 1u][z_to] = zs[1];
            z_tile[z_k + 2u][z_to] = zs[2];
            z_tile[z_k + 3u][z_to] = zs[3];
        }
        workgroupBarrier();
        multiply_add(&rows, local, 0u);
        multiply_add(&rows, local, 1u);
        multiply_add(&rows, local, 2u);
        multiply_add(&rows, local, 3u);
        multiply_add(&rows, local, 4u);
        multiply_add(&rows, local, 5u);
        multiply_add(&rows, local, 6u);
        multiply_add(&rows, local, 7u);
        multiply_add(&rows, local, 8u);
        multiply_add(&rows, local, 9u);
        multiply_add(&rows, local, 10u);
        multiply_add(&rows, local, 11u);
        multiply_add(&rows, local, 12u);
        multiply_add(&rows, local, 13u);
        multiply_add(&rows, local, 14u);
        multiply_add(&rows, local, 15u);
    }
    let row = first_row + 4u * local.y;
    let c = local.x;
    let d = local.x + 8u;
    let c0 = normalised(group, row, c);
    let d0 = normalised(group, row, d);
    let c1 = normalised(group, row + 1u, c);
    let d1 = normalised(group, row + 1u, d);
    let c2 = normalised(group, row + 2u, c);
    let d2 = normalised(group, row + 2u, d);
    let c3 = normalised(group, row + 3u, c);
    let d3 = normalised(group, row + 3u, d);
    let e_c0 = d_normalised(c, c0, rows.a[0]);
    let e_d0 = d_normalised(d, d0, rows.b[0]);
    let e_c1 = d_normalised(c, c1, rows.a[1]);
    let e_d1 = d_normalised(d, d1, rows.b[1]);
    let e_c2 = d_normalised(c, c2, rows.a[2]);
    let e_d2 = d_normalised(d, d2, rows.b[2]);
    let e_c3 = d_normalised(c, c3, rows.a[3]);
    let e_d3 = d_normalised(d, d3, rows.b[3]);
    var mean = vec4(0.0);
    if (params.centred == 0u) {
        mean = total(local, sums(e_c0 + e_d0, e_c1 + e_d1, e_c2 + e_d2, e_c3 + e_d3)) / f32(params.in_features);
    }
    let products = sums(e_c0 * c0 + e_d0 * d0, e_c1 * c1 + e_d1 * d1, e_c2 * c2 + e_d2 * d2, e_c3 * c3 + e_d3 * d3);
    let along = total(local, products) / f32(params.in_features);
    put(group, row, c, rows.a[0], e_c0 - mean[0] - c0 * along[0]);
    put(group, row, d, rows.b[0], e_d0 - mean[0] - d0 * along[0]);
    put(group, row + 1u, c, rows.a[1], e_c1 - mean[1] - c1 * along[1]);
    put(group, row + 1u, d, rows.b[1], e_d1 - mean[1] - d1 * along[1]);
    put(group, row + 2u, c, rows.a[2], e_c2 - mean[2] - c2 * along[2]);
    put(group, row + 2u, d, rows.b[2], e_d2 - mean[2] - d2 * along[2]);
    put(group, row + 3u, c, rows.a[3], e_c3 - mean[3] - c3 * along[3]);
    put(group, row + 3u, d, rows.b[3], e_d3 - mean[3] - d3 * along[3]);
}
