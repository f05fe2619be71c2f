// y[r, o] (+)= Σ_i W[o, i] x[r, i] + b[o], x and W as sums of two numbers in f16, weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation copies its part of 64 rows × 128 output features, 16 input features at a time; its subgroup multiplies 2 × 4 matrices of SIDE × SIDE of them.
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

// Rows of x and rows of W, 16 features of each, in vectors of four; two vectors more, so that successive rows begin in different banks.
const X_STRIDE: u32 = 6u;
const W_STRIDE: u32 = 6u;
var<workgroup> x_high: array<vec4<f16>, 384>;
var<workgroup> x_low: array<vec4<f16>, 384>;
var<workgroup> w_high: array<vec4<f16>, 768>;
var<workgroup> w_low: array<vec4<f16>, 768>;
// The largest value of each row of x, as the bits of a float, whose order is that of integers.
var<workgroup> largest: array<atomic<u32>, 64>;
// A matrix of sums for each subgroup.
var<workgroup> sums: array<vec4<f32>, 256>;

// Each subgroup has 2 × 4 matrices of the 64 × 128 results.
const INVOCATIONS: u32 = 1024u / (SIDE * SIDE) * LANES;

fn keep_x(at: u32, values: vec4<f32>) {
    x_high[at] = vec4<f16>(high(values));
    x_low[at] = vec4<f16>(values - high(values));
}

fn keep_w(at: u32, values: vec4<f32>) {
    w_high[at] = vec4<f16>(high(values));
    w_low[at] = vec4<f16>(values - high(values));
}

fn put(group: u32, row: u32, out: u32, sum: vec4<f32>) {
    if (row >= params.rows_per_group || out >= params.out_features) {
        return;
    }
    let at = ((group * params.rows_per_group + row) * params.out_features + out) / 4u;
    let bias = (weights_of(group) + params.out_features * params.in_features + out) / 4u;
    var value = sum + weights[bias];
    if (params.accumulate == 1u) {
        value += y[at];
    }
    y[at] = value;
}

// From the subgroup's matrix of sums; its row and feature within the tile.
fn put_matrix(workgroup: vec3<u32>, own: u32, lane: u32, row: u32, out: u32) {
    for (var i = lane; i < SIDE * SIDE / 4u; i += LANES) {
        let r = row + i / (SIDE / 4u);
        let scale = bitcast<f32>((254u - exponent(r)) << 23u) / W_SCALE;
        put(workgroup.z, 64u * workgroup.x + r, 128u * workgroup.y + out + 4u * (i % (SIDE / 4u)), scale * sums[own + i]);
    }
}

@compute @workgroup_size(INVOCATIONS)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) index: u32,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    let first_row = 64u * workgroup.x;
    let first_out = 128u * workgroup.y;
    let n = params.in_features / 4u;
    // The last row stands in for those beyond it, of x and of W.
    let x_first = workgroup.z * params.rows_per_group * n;
    let last_row = params.rows_per_group - 1u;
    let w_first = weights_of(workgroup.z) / 4u;
    let last_out = params.out_features - 1u;
    let own = SIDE * SIDE / 4u * subgroup;

    if (index < 64u) {
        atomicStore(&largest[index], 0u);
    }
    sums[index] = vec4(0.0);
    sums[index + 128u] = vec4(0.0);
    workgroupBarrier();
    {
        // Two invocations look for the largest value of a row; eight vectors at once, which a GPU waits for together.
        let at = x_first + min(first_row + index / 2u, last_row) * n;
        var values = vec4(0.0);
        for (var i = index % 2u; i < n; i += 16u) {
            let a = max(abs(x[at + min(i + 0u, n - 1u)]), abs(x[at + min(i + 2u, n - 1u)]));
            let b = max(abs(x[at + min(i + 4u, n - 1u)]), abs(x[at + min(i + 6u, n - 1u)]));
            let c = max(abs(x[at + min(i + 8u, n - 1u)]), abs(x[at + min(i + 10u, n - 1u)]));
            let d = max(abs(x[at + min(i + 12u, n - 1u)]), abs(x[at + min(i + 14u, n - 1u)]));
            values = max(values, max(max(a, b), max(c, d)));
        }
        atomicMax(&largest[index / 2u], bitcast<u32>(most(values)));
    }
    workgroupBarrier();

    let row = 2u * SIDE * (subgroup / (32u / SIDE));
    let out = 4u * SIDE * (subgroup % (32u / SIDE));
    var y_00 = coopLoadT<Sums>(&sums[own], SIDE / 4u);
    var y_01 = y_00;
    var y_02 = y_00;
    var y_03 = y_00;
    var y_10 = y_00;
    var y_11 = y_00;
    var y_12 = y_00;
    var y_13 = y_00;

    // What this invocation copies: a vector of each of two rows of x and of four of W.
    let r = index / 4u;
    let feature = index % 4u;
    let to = X_STRIDE * r + feature;
    let x_a = x_first + min(first_row + r, last_row) * n;
    let x_b = x_first + min(first_row + r + 32u, last_row) * n;
    let w_a = w_first + min(first_out + r, last_out) * n;
    let w_b = w_first + min(first_out + r + 32u, last_out) * n;
    let w_c = w_first + min(first_out + r + 64u, last_out) * n;
    let w_d = w_first + min(first_out + r + 96u, last_out) * n;
    let scale_a = bitcast<f32>(exponent(r) << 23u);
    let scale_b = bitcast<f32>(exponent(r + 32u) << 23u);
    var first = 0u;
    var i = min(feature, n - 1u);
    var xa = x[x_a + i];
    var xb = x[x_b + i];
    var wa = weights[w_a + i];
    var wb = weights[w_b + i];
    var wc = weights[w_c + i];
    var wd = weights[w_d + i];
    loop {
        // Nothing beyond the last feature.
        let within = select(0.0, 1.0, first + feature < n);
        workgroupBarrier();
        keep_x(to, within * scale_a * xa);
        keep_x(to + 32u * X_STRIDE, within * scale_b * xb);
        keep_w(to, W_SCALE * wa);
        keep_w(to + 32u * W_STRIDE, W_SCALE * wb);
        keep_w(to + 64u * W_STRIDE, W_SCALE * wc);
        keep_w(to + 96u * W_STRIDE, W_SCALE * wd);
        workgroupBarrier();
        // The next ones are on their way while these are multiplied.
        first += 4u;
        i = min(first + feature, n - 1u);
        xa = x[x_a + i];
        xb = x[x_b + i];
        wa = weights[w_a + i];
        wb = weights[w_b + i];
        wc = weights[w_c + i];
        wd = weights[w_d + i];
        for (var k = 0u; k < 16u; k += SIDE) {
            let x0 = coopLoadT<Left>(&x_high[X_STRIDE * row + k / 4u], X_STRIDE);
            let x0_low = coopLoadT<Left>(&x_low[X_STRIDE * row + k / 4u], X_STRIDE);
            let x1 = coopLoadT<Left>(&x_high[X_STRIDE * (row + SIDE) + k / 4u], X_STRIDE);
            let x1_low = coopLoadT<Left>(&x_low[X_STRIDE * (row + SIDE) + k / 4u], X_STRIDE);
            let w0 = coopLoad<Right>(&w_high[W_STRIDE * out + k / 4u], W_STRIDE);
            let w0_low = coopLoad<Right>(&w_low[W_STRIDE * out + k / 4u], W_STRIDE);
            let w1 = coopLoad<Right>(&w_high[W_STRIDE * (out + SIDE) + k / 4u], W_STRIDE);
            let w1_low = coopLoad<Right>(&w_low[W_STRIDE * (out + SIDE) + k / 4u], W_STRIDE);
            let w2 = coopLoad<Right>(&w_high[W_STRIDE * (out + 2u * SIDE) + k / 4u], W_STRIDE);
            let w2_low = coopLoad<Right>(&w_low[W_STRIDE * (out + 2u * SIDE) + k / 4u], W_STRIDE);
            let w3 = coopLoad<Right>(&w_high[W_STRIDE * (out + 3u * SIDE) + k / 4u], W_STRIDE);
            let w3_low = coopLoad<Right>(&w_low[W_STRIDE * (out + 3u * SIDE) + k / 4u], W_STRIDE);
            y_00 = coopMultiplyAdd(x0, w0, coopMultiplyAdd(x0, w0_low, coopMultiplyAdd(x0_low, w0, y_00)));
            y_01 = coopMultiplyAdd(x0, w1, coopMultiplyAdd(x0, w1_low, coopMultiplyAdd(x0_low, w1, y_01)));
            y_02 = coopMultiplyAdd(x0, w2, coopMultiplyAdd(x0, w2_low, coopMultiplyAdd(x0_low, w2, y_02)));
            y_03 = coopMultiplyAdd(x0, w3, coopMultiplyAdd(x0, w3_low, coopMultiplyAdd(x0_low, w3, y_03)));
            y_10 = coopMultiplyAdd(x1, w0, coopMultiplyAdd(x1, w0_low, coopMultiplyAdd(x1_low, w0, y_10)));
            y_11 = coopMultiplyAdd(x1, w1, coopMultiplyAdd(x1, w1_low, coopMultiplyAdd(x1_low, w1, y_11)));
            y_12 = coopMultiplyAdd(x1, w2, coopMultiplyAdd(x1, w2_low, coopMultiplyAdd(x1_low, w2, y_12)));
            y_13 = coopMultiplyAdd(x1, w3, coopMultiplyAdd(x1, w3_low, coopMultiplyAdd(x1_low, w3, y_13)));
        }
        if (first >= n) {
            break;
        }
    }
    workgroupBarrier();
    coopStoreT(y_00, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row, out);
    workgroupBarrier();
    coopStoreT(y_01, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row, out + SIDE);
    workgroupBarrier();
    coopStoreT(y_02, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row, out + 2u * SIDE);
    workgroupBarrier();
    coopStoreT(y_03, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row, out + 3u * SIDE);
    workgroupBarrier();
    coopStoreT(y_10, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row + SIDE, out);
    workgroupBarrier();
    coopStoreT(y_11, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row + SIDE, out + SIDE);
    workgroupBarrier();
    coopStoreT(y_12, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row + SIDE, out + 2u * SIDE);
    workgroupBarrier();
    coopStoreT(y_13, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row + SIDE, out + 3u * SIDE);
}
