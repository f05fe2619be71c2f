// d_x[g, c, r, i] (+)= Σ_o W[o, i] d_y[g, r, o] over the output features o of chunk c, weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation computes 8 rows × 8 input features in registers; a workgroup of 64 × 64 reads what it needs of d_y and W once, 16 output features at a time.
// d_y [groups, rows_per_group, out], weights [.., out·in + out], slots [..] → d_x [groups, chunks, rows_per_group, in]; in, out and chunk_outs multiples of 4.
// ACCUMULATES d_x where accumulate is 1, else OVERWRITES it.

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
@group(0) @binding(1) var<storage, read> d_y: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> weights: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read_write> d_x: array<vec4<f32>>;

// Sixteen output features of a tile, each of 64 rows and of 64 input features, in vectors of four. Where the vector of four rows stands among the
// sixteen of its feature is crossed with the feature's number, so that eight successive invocations write to different banks. An array for each
// feature: a first index that is known needs no check, and those of the second are the same for all features that are crossed alike.
var<workgroup> y_tile: array<array<vec4<f32>, 16>, 16>;
var<workgroup> w_tile: array<array<vec4<f32>, 16>, 16>;

// What an invocation computes: rows 4 ly and 32 + 4 ly, a and b, input features 4 lx and 32 + 4 lx; columns are rows of d_x.
struct Sums {
    aa: mat4x4<f32>,
    ab: mat4x4<f32>,
    ba: mat4x4<f32>,
    bb: mat4x4<f32>,
}

// Adds the products of feature k of the sixteen, a row after the other: eight that share a factor, which NVIDIA's GPUs then read once, are faster than four.
fn multiply_add(sums: ptr<function, Sums>, local: vec2<u32>, k: u32) {
    let crossed = 2u * (k / 4u);
    let ya = y_tile[k][local.y ^ crossed];
    let yb = y_tile[k][(local.y + 8u) ^ crossed];
    let wa = w_tile[k][local.x];
    let wb = w_tile[k][local.x + 8u];
    (*sums).aa[0] += wa * ya[0];
    (*sums).ab[0] += wb * ya[0];
    (*sums).aa[1] += wa * ya[1];
    (*sums).ab[1] += wb * ya[1];
    (*sums).aa[2] += wa * ya[2];
    (*sums).ab[2] += wb * ya[2];
    (*sums).aa[3] += wa * ya[3];
    (*sums).ab[3] += wb * ya[3];
    (*sums).ba[0] += wa * yb[0];
    (*sums).bb[0] += wb * yb[0];
    (*sums).ba[1] += wa * yb[1];
    (*sums).bb[1] += wb * yb[1];
    (*sums).ba[2] += wa * yb[2];
    (*sums).bb[2] += wb * yb[2];
    (*sums).ba[3] += wa * yb[3];
    (*sums).bb[3] += wb * yb[3];
}

fn put(part: u32, row: u32, in_: u32, sum: vec4<f32>) {
    if (row >= params.rows_per_group || in_ >= params.in_features) {
        return;
    }
    let at = ((part * params.rows_per_group + row) * params.in_features + in_) / 4u;
    var value = sum;
    if (params.accumulate == 1u) {
        value += d_x[at];
    }
    d_x[at] = value;
}

// Columns are rows of d_x.
fn store(part: u32, row: u32, in_: u32, tile: mat4x4<f32>) {
    put(part, row, in_, tile[0]);
    put(part, row + 1u, in_, tile[1]);
    put(part, row + 2u, in_, tile[2]);
    put(part, row + 3u, in_, tile[3]);
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
    let first_in = 64u * (number % workgroups.y);
    let part = workgroup.z;
    let group = part / params.chunks;
    let begin = part % params.chunks * params.chunk_outs;
    let end = min(begin + params.chunk_outs, params.out_features);
    // What this invocation copies: four output features of four rows of d_y, and four rows of W, four input features of each. The
    // last ones stand in for those beyond them.
    let n = params.out_features / 4u;
    let stride = params.in_features / 4u;
    let y_row = group * params.rows_per_group + min(first_row + 4u * (index / 4u) + vec4(0u, 1u, 2u, 3u), vec4(params.rows_per_group - 1u));
    let y_k = 4u * (index % 4u);
    let y_to = (index / 4u) ^ (2u * (index % 4u));
    let w_column = weights_of(group) / 4u + min(first_in / 4u + index % 16u, stride - 1u);
    let w_k = 4u * (index / 16u);
    let w_to = index % 16u;

    var sums: Sums;
    let last = end / 4u - 1u;
    for (var first = begin / 4u; first <= last; first += 4u) {
        // Nothing beyond the last feature.
        let within = select(0.0, 1.0, first + index % 4u <= last);
        let y_at = y_row * n + min(first + index % 4u, last);
        let w_at = w_column + 4u * min(first + index / 16u, last) * stride;
        let ys = transpose(mat4x4(d_y[y_at.x], d_y[y_at.y], d_y[y_at.z], d_y[y_at.w])) * within;
        let ws = mat4x4(weights[w_at], weights[w_at + stride], weights[w_at + 2u * stride], weights[w_at + 3u * stride]);
        workgroupBarrier();
        y_tile[y_k][y_to] = ys[0];
        y_tile[y_k + 1u][y_to] = ys[1];
        y_tile[y_k + 2u][y_to] = ys[2];
        y_tile[y_k + 3u][y_to] = ys[3];
        w_tile[w_k][w_to] = ws[0];
        w_tile[w_k + 1u][w_to] = ws[1];
        w_tile[w_k + 2u][w_to] = ws[2];
        w_tile[w_k + 3u][w_to] = ws[3];
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
    let in_ = first_in + 4u * local.x;
    store(part, row, in_, sums.aa);
    store(part, row, in_ + 32u, sums.ab);
    store(part, row + 32u, in_, sums.ba);
    store(part, row + 32u, in_ + 32u, sums.bb);
}
