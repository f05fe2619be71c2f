// y[r, o] (+)= Σ_i W[o, i] x[r, i] + b[o], weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation computes 8 rows × 8 output features in registers; a workgroup of 64 × 64 reads what it needs of x and W once, 16 input features at a time.
// x [groups, rows_per_group, in], weights [.., out·in + out], slots [..] → y [groups, rows_per_group, out]; in and out multiples of 4.
// ACCUMULATES y where accumulate is 1, else OVERWRITES it.

struct Params {
    groups: u32,
    rows_per_group: u32,
    first_group: u32,
    in_features: u32,
    out_features: u32,
    weight_stride: u32,
    accumulate: u32,
    chunk_outs: u32,
    chunk_rows: u32,
    chunks: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> weights: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read_write> y: array<vec4<f32>>;

// Sixteen input features of a tile, each of 64 rows and of 64 output features, in vectors of four. Where a vector stands among the sixteen of its
// feature is crossed with the feature's number, so that eight successive invocations write to different banks. An array for each feature: a first
// index that is known needs no check, and those of the second are the same for all features that are crossed alike.
var<workgroup> x_tile: array<array<vec4<f32>, 16>, 16>;
var<workgroup> w_tile: array<array<vec4<f32>, 16>, 16>;

// What an invocation computes: rows 4 ly and 32 + 4 ly, a and b, output features 4 lx and 32 + 4 lx; columns are rows of y.
struct Sums {
    aa: mat4x4<f32>,
    ab: mat4x4<f32>,
    ba: mat4x4<f32>,
    bb: mat4x4<f32>,
}

// Adds the products of feature k of the sixteen, a row after the other: eight that share a factor, which NVIDIA's GPUs then read once, are faster than four.
fn multiply_add(sums: ptr<function, Sums>, local: vec2<u32>, k: u32) {
    let crossed = 2u * (k / 4u);
    let xa = x_tile[k][local.y ^ crossed];
    let xb = x_tile[k][(local.y + 8u) ^ crossed];
    let wa = w_tile[k][local.x ^ crossed];
    let wb = w_tile[k][(local.x + 8u) ^ crossed];
    (*sums).aa[0] += wa * xa[0];
    (*sums).ab[0] += wb * xa[0];
    (*sums).aa[1] += wa * xa[1];
    (*sums).ab[1] += wb * xa[1];
    (*sums).aa[2] += wa * xa[2];
    (*sums).ab[2] += wb * xa[2];
    (*sums).aa[3] += wa * xa[3];
    (*sums).ab[3] += wb * xa[3];
    (*sums).ba[0] += wa * xb[0];
    (*sums).bb[0] += wb * xb[0];
    (*sums).ba[1] += wa * xb[1];
    (*sums).bb[1] += wb * xb[1];
    (*sums).ba[2] += wa * xb[2];
    (*sums).bb[2] += wb * xb[2];
    (*sums).ba[3] += wa * xb[3];
    (*sums).bb[3] += wb * xb[3];
}

fn put(group: u32, row: u32, out: u32, sum: vec4<f32>) {
    if (row >= params.rows_per_group || out >= params.out_features) {
        return;
    }
    let at = ((group * params.rows_per_group + row) * params.out_features + out) / 4u;
    var value = sum;
    if (params.accumulate == 1u) {
        value += y[at];
    }
    y[at] = value;
}

// Columns are rows of y.
fn store(group: u32, row: u32, out: u32, tile: mat4x4<f32>, first_bias: u32) {
    let bias = weights[first_bias + min(out, params.out_features - 1u) / 4u];
    put(group, row, out, tile[0] + bias);
    put(group, row + 1u, out, tile[1] + bias);
    put(group, row + 2u, out, tile[2] + bias);
    put(group, row + 3u, out, tile[3] + bias);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) index: u32,
) {
    let local = among_eight(index);
    // One after the other those that read the same rows.
    let number = workgroup.y * workgroups.x + workgroup.x;
    let first_row = 64u * (number / workgroups.y);
    let first_out = 64u * (number % workgroups.y);
    let group = workgroup.z;
    // What this invocation copies: four rows of x and of W, four features of each; the last row stands in for those beyond it.
    let n = params.in_features / 4u;
    let four = index / 4u;
    let feature = index % 4u;
    let x_row = group * params.rows_per_group + min(first_row + 4u * four + vec4(0u, 1u, 2u, 3u), vec4(params.rows_per_group - 1u));
    let w_first = weights_of(group) / 4u;
    let w_row = min(first_out + 4u * four + vec4(0u, 1u, 2u, 3u), vec4(params.out_features - 1u));
    let k = 4u * feature;
    let to = four ^ (2u * feature);

    var sums: Sums;
    for (var first = 0u; first < n; first += 4u) {
        // Nothing beyond the last feature.
        let i = min(first + feature, n - 1u);
        let within = select(0.0, 1.0, first + feature < n);
        let x_at = x_row * n + i;
        let w_at = w_row * n + i;
        let xs = transpose(mat4x4(x[x_at.x], x[x_at.y], x[x_at.z], x[x_at.w])) * within;
        let ws = transpose(mat4x4(weights[w_first + w_at.x], weights[w_first + w_at.y], weights[w_first + w_at.z], weights[w_first + w_at.w]));
        workgroupBarrier();
        x_tile[k][to] = xs[0];
        x_tile[k + 1u][to] = xs[1];
        x_tile[k + 2u][to] = xs[2];
        x_tile[k + 3u][to] = xs[3];
        w_tile[k][to] = ws[0];
        w_tile[k + 1u][to] = ws[1];
        w_tile[k + 2u][to] = ws[2];
        w_tile[k + 3u][to] = ws[3];
        workgroupBarrier();
        multiply_add(&sums, local, 0u);
        multiply_add(&sums, local, 1u);
        multiply_add(&sums, local, 2u);
        multiply_add(&sums, local, 3u);
        multiply_add(&sums, local, 4u);
        multiply_add(&sums, local, 5u);
        multiply_add(&sums, local, 6u);
        multiply_add(&sums, local, 7u);
        multiply_add(&sums, local, 8u);
        multiply_add(&sums, local, 9u);
        multiply_add(&sums, local, 10u);
        multiply_add(&sums, local, 11u);
        multiply_add(&sums, local, 12u);
        multiply_add(&sums, local, 13u);
        multiply_add(&sums, local, 14u);
        multiply_add(&sums, local, 15u);
    }
    let row = first_row + 4u * local.y;
    let out = first_out + 4u * local.x;
    let bias = w_first + params.out_features * n;
    store(group, row, out, sums.aa, bias);
    store(group, row, out + 32u, sums.ab, bias);
    store(group, row + 32u, out, sums.ba, bias);
    store(group, row + 32u, out + 32u, sums.bb, bias);
}
