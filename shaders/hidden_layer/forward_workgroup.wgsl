// z[r, o] = Σ_i W[o, i] x[r, i] + b[o], weights at slots[first_group + r / rows_per_group] · weight_stride; y = relu(gamma (z - mean) rstd + beta), rstd = 1 / √(var + 1e-5), var the mean of (z - mean)² over the features; of centred z mean = 0.
// One invocation computes 4 rows × 8 output features in registers; a workgroup of 32 × 64 reads what it needs of x and W once, 16 input features at a time, and has whole rows for the norm.
// x [groups, rows_per_group, in], weights [.., out·in + out], slots [..], affine [2, out] = (gamma, beta) → z, y [groups, rows_per_group, out], stats [groups, rows_per_group, 2] = (mean, rstd); in and out multiples of 4, at most 64.
// OVERWRITES z, y and stats.

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
@group(0) @binding(1) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> weights: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read> affine: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> z: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> y: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> stats: array<f32>;

// Sixteen input features of a tile, each of 32 rows and of 64 output features, in vectors of four. Where a vector stands among those of its feature is
// crossed with the feature's number, so that eight successive invocations write to different banks.
var<workgroup> x_tile: array<array<vec4<f32>, 8>, 16>;
var<workgroup> w_tile: array<array<vec4<f32>, 16>, 16>;
// What each of eight invocations has of the sums over the features of four rows.
var<workgroup> shares: array<array<vec4<f32>, 8>, 8>;

// What an invocation computes: rows 4 ly, output features 4 lx and 32 + 4 lx, a and b; columns are rows of z.
struct Rows {
    a: mat4x4<f32>,
    b: mat4x4<f32>,
}

// Adds the products of feature k of the sixteen.
fn multiply_add(rows: ptr<function, Rows>, local: vec2<u32>, k: u32) {
    let crossed = 2u * (k / 4u);
    let xs = x_tile[k][local.y ^ crossed];
    let wa = w_tile[k][local.x ^ crossed];
    let wb = w_tile[k][(local.x + 8u) ^ crossed];
    (*rows).a[0] += wa * xs[0];
    (*rows).b[0] += wb * xs[0];
    (*rows).a[1] += wa * xs[1];
    (*rows).b[1] += wb * xs[1];
    (*rows).a[2] += wa * xs[2];
    (*rows).b[2] += wb * xs[2];
    (*rows).a[3] += wa * xs[3];
    (*rows).b[3] += wb * xs[3];
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

// Stores four features of a row.
fn put(group: u32, row: u32, out: u32, from_mean: vec4<f32>, mean: f32, rstd: f32) {
    if (row >= params.rows_per_group || out >= params.out_features) {
        return;
    }
    let n = params.out_features / 4u;
    let at = (group * params.rows_per_group + row) * n + out / 4u;
    z[at] = from_mean + mean;
    y[at] = max(affine[out / 4u] * (from_mean * rstd) + affine[n + out / 4u], vec4(0.0));
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
    // What this invocation copies: four rows of W and, where it is one of the last 32, of x, four features of each; the last row stands in for those
    // beyond it.
    let n = params.in_features / 4u;
    let four = index / 4u;
    let feature = index % 4u;
    let w_first = weights_of(group) / 4u;
    let w_row = min(4u * four + vec4(0u, 1u, 2u, 3u), vec4(params.out_features - 1u));
    let x_row = group * params.rows_per_group + min(first_row + 4u * (four % 8u) + vec4(0u, 1u, 2u, 3u), vec4(params.rows_per_group - 1u));
    let k = 4u * feature;
    let w_to = four ^ (2u * feature);
    let x_to = (four % 8u) ^ (2u * feature);

    var rows: Rows;
    for (var first = 0u; first < n; first += 4u) {
        // Nothing beyond the last feature.
        let i = min(first + feature, n - 1u);
        let within = select(0.0, 1.0, first + feature < n);
        let w_at = w_first + w_row * n + i;
        let ws = transpose(mat4x4(weights[w_at.x], weights[w_at.y], weights[w_at.z], weights[w_at.w]));
        var xs: mat4x4<f32>;
        if (four >= 8u) {
            let x_at = x_row * n + i;
            xs = transpose(mat4x4(x[x_at.x], x[x_at.y], x[x_at.z], x[x_at.w])) * within;
        }
        workgroupBarrier();
        w_tile[k][w_to] = ws[0];
        w_tile[k + 1u][w_to] = ws[1];
        w_tile[k + 2u][w_to] = ws[2];
        w_tile[k + 3u][w_to] = ws[3];
        if (four >= 8u) {
            x_tile[k][x_to] = xs[0];
            x_tile[k + 1u][x_to] = xs[1];
            x_tile[k + 2u][x_to] = xs[2];
            x_tile[k + 3u][x_to] = xs[3];
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
    // Features beyond the last one count as zero and are not stored.
    let out = 4u * local.x;
    let bias = w_first + params.out_features * n;
    let last = params.out_features / 4u - 1u;
    let in_a = select(0.0, 1.0, local.x <= last);
    let in_b = select(0.0, 1.0, local.x + 8u <= last);
    let bias_a = weights[bias + min(local.x, last)];
    let bias_b = weights[bias + min(local.x + 8u, last)];
    var a = mat4x4(rows.a[0] + bias_a, rows.a[1] + bias_a, rows.a[2] + bias_a, rows.a[3] + bias_a) * in_a;
    var b = mat4x4(rows.b[0] + bias_b, rows.b[1] + bias_b, rows.b[2] + bias_b, rows.b[3] + bias_b) * in_b;
    var mean = vec4(0.0);
    if (params.centred == 0u) {
        mean = total(local, sums(a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3])) / f32(params.out_features);
        a -= mat4x4(vec4(mean.x), vec4(mean.y), vec4(mean.z), vec4(mean.w)) * in_a;
        b -= mat4x4(vec4(mean.x), vec4(mean.y), vec4(mean.z), vec4(mean.w)) * in_b;
    }
    let squares = sums(a[0] * a[0] + b[0] * b[0], a[1] * a[1] + b[1] * b[1], a[2] * a[2] + b[2] * b[2], a[3] * a[3] + b[3] * b[3]);
    let rstd = 1.0 / sqrt(total(local, squares) / f32(params.out_features) + 1e-5);
    let row = first_row + 4u * local.y;
    put(group, row, out, a[0], mean[0], rstd[0]);
    put(group, row, out + 32u, b[0], mean[0], rstd[0]);
    put(group, row + 1u, out, a[1], mean[1], rstd[1]);
    put(group, row + 1u, out + 32u, b[1], mean[1], rstd[1]);
    put(group, row + 2u, out, a[2], mean[2], rstd[2]);
    put(group, row + 2u, out + 32u, b[2], mean[2], rstd[2]);
    put(group, row + 3u, out, a[3], mean[3], rstd[3]);
    put(group, row + 3u, out + 32u, b[3], mean[3], rstd[3]);
    // Each of four invocations stores what belongs to one row.
    if (local.x < 4u && row + local.x < params.rows_per_group) {
        let at = group * params.rows_per_group + row + local.x;
        stats[2u * at] = mean[local.x];
        stats[2u * at + 1u] = rstd[local.x];
    }
}
