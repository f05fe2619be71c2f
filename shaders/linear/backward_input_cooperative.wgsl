// d_x[r, i] (+)= Σ_o W[o, i] d_y[r, o] for all o, of which there is one chunk, d_y and W as sums of two numbers in f16, weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation copies its part of 64 rows × 128 input features, 16 output features at a time; its subgroup multiplies 2 × 4 matrices of SIDE × SIDE of them.
// d_y [groups, rows_per_group, out], weights [.., out·in + out], slots [..] → d_x [groups, rows_per_group, in]; in and out multiples of 4.
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

// Rows of d_y, 16 features of each, and 16 rows of W, 128 features of each, in vectors of four; two vectors more, so that successive rows begin in
// different banks.
const Y_STRIDE: u32 = 6u;
const W_STRIDE: u32 = 34u;
var<workgroup> y_high: array<vec4<f16>, 384>;
var<workgroup> y_low: array<vec4<f16>, 384>;
var<workgroup> w_high: array<vec4<f16>, 544>;
var<workgroup> w_low: array<vec4<f16>, 544>;
// The largest value of each row of d_y, as the bits of a float, whose order is that of integers.
var<workgroup> largest: array<atomic<u32>, 64>;
// A matrix of sums for each subgroup.
var<workgroup> sums: array<vec4<f32>, 256>;

// Each subgroup has 2 × 4 matrices of the 64 × 128 results.
const INVOCATIONS: u32 = 1024u / (SIDE * SIDE) * LANES;

fn keep_y(at: u32, values: vec4<f32>) {
    y_high[at] = vec4<f16>(high(values));
    y_low[at] = vec4<f16>(values - high(values));
}

fn keep_w(at: u32, values: vec4<f32>) {
    w_high[at] = vec4<f16>(high(values));
    w_low[at] = vec4<f16>(values - high(values));
}

fn put(group: u32, row: u32, in_: u32, sum: vec4<f32>) {
    if (row >= params.rows_per_group || in_ >= params.in_features) {
        return;
    }
    let at = ((group * params.rows_per_group + row) * params.in_features + in_) / 4u;
    var value = sum;
    if (params.accumulate == 1u) {
        value += d_x[at];
    }
    d_x[at] = value;
}

// From the subgroup's matrix of sums; its row and feature within the tile.
fn put_matrix(workgroup: vec3<u32>, own: u32, lane: u32, row: u32, in_: u32) {
    for (var i = lane; i < SIDE * SIDE / 4u; i += LANES) {
        let r = row + i / (SIDE / 4u);
        let scale = bitcast<f32>((254u - exponent(r)) << 23u) / W_SCALE;
        put(workgroup.z, 64u * workgroup.x + r, 128u * workgroup.y + in_ + 4u * (i % (SIDE / 4u)), scale * sums[own + i]);
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
    let first_in = 128u * workgroup.y;
    let n = params.out_features / 4u;
    // The last row and the last feature stand in for those beyond them.
    let d_y_first = workgroup.z * params.rows_per_group * n;
    let last_row = params.rows_per_group - 1u;
    let stride = params.in_features / 4u;
    let w_first = weights_of(workgroup.z) / 4u;
    let own = SIDE * SIDE / 4u * subgroup;

    if (index < 64u) {
        atomicStore(&largest[index], 0u);
    }
    sums[index] = vec4(0.0);
    sums[index + 128u] = vec4(0.0);
    workgroupBarrier();
    {
        // Two invocations look for the largest value of a row; eight vectors at once, which a GPU waits for together.
        let at = d_y_first + min(first_row + index / 2u, last_row) * n;
        var values = vec4(0.0);
        for (var i = index % 2u; i < n; i += 16u) {
            let a = max(abs(d_y[at + min(i + 0u, n - 1u)]), abs(d_y[at + min(i + 2u, n - 1u)]));
            let b = max(abs(d_y[at + min(i + 4u, n - 1u)]), abs(d_y[at + min(i + 6u, n - 1u)]));
            let c = max(abs(d_y[at + min(i + 8u, n - 1u)]), abs(d_y[at + min(i + 10u, n - 1u)]));
            let d = max(abs(d_y[at + min(i + 12u, n - 1u)]), abs(d_y[at + min(i + 14u, n - 1u)]));
            values = max(values, max(max(a, b), max(c, d)));
        }
        atomicMax(&largest[index / 2u], bitcast<u32>(most(values)));
    }
    workgroupBarrier();

    let row = 2u * SIDE * (subgroup / (32u / SIDE));
    let in_ = 4u * SIDE * (subgroup % (32u / SIDE));
    var x_00 = coopLoadT<Sums>(&sums[own], SIDE / 4u);
    var x_01 = x_00;
    var x_02 = x_00;
    var x_03 = x_00;
    var x_10 = x_00;
    var x_11 = x_00;
    var x_12 = x_00;
    var x_13 = x_00;

    // What this invocation copies: a vector of each of two rows of d_y, and of four rows of W.
    let r = index / 4u;
    let feature = index % 4u;
    let y_to = Y_STRIDE * r + feature;
    let y_a = d_y_first + min(first_row + r, last_row) * n;
    let y_b = d_y_first + min(first_row + r + 32u, last_row) * n;
    let w_row = index / 32u;
    let w_to = W_STRIDE * w_row + index % 32u;
    let w_at = w_first + min(first_in / 4u + index % 32u, stride - 1u);
    let scale_a = bitcast<f32>(exponent(r) << 23u);
    let scale_b = bitcast<f32>(exponent(r + 32u) << 23u);
    var first = 0u;
    var o = min(first + feature, n - 1u);
    var w_o = min(4u * first + w_row + vec4(0u, 4u, 8u, 12u), vec4(params.out_features - 1u)) * stride;
    var ya = d_y[y_a + o];
    var yb = d_y[y_b + o];
    var wa = weights[w_at + w_o.x];
    var wb = weights[w_at + w_o.y];
    var wc = weights[w_at + w_o.z];
    var wd = weights[w_at + w_o.w];
    loop {
        // Nothing beyond the last feature.
        let within = select(0.0, 1.0, first + feature < n);
        workgroupBarrier();
        keep_y(y_to, within * scale_a * ya);
        keep_y(y_to + 32u * Y_STRIDE, within * scale_b * yb);
        keep_w(w_to, W_SCALE * wa);
        keep_w(w_to + 4u * W_STRIDE, W_SCALE * wb);
        keep_w(w_to + 8u * W_STRIDE, W_SCALE * wc);
        keep_w(w_to + 12u * W_STRIDE, W_SCALE * wd);
        workgroupBarrier();
        // The next ones are on their way while these are multiplied.
        first += 4u;
        o = min(first + feature, n - 1u);
        w_o = min(4u * first + w_row + vec4(0u, 4u, 8u, 12u), vec4(params.out_features - 1u)) * stride;
        ya = d_y[y_a + o];
        yb = d_y[y_b + o];
        wa = weights[w_at + w_o.x];
        wb = weights[w_at + w_o.y];
        wc = weights[w_at + w_o.z];
        wd = weights[w_at + w_o.w];
        for (var k = 0u; k < 16u; k += SIDE) {
            let y0 = coopLoadT<Left>(&y_high[Y_STRIDE * row + k / 4u], Y_STRIDE);
            let y0_low = coopLoadT<Left>(&y_low[Y_STRIDE * row + k / 4u], Y_STRIDE);
            let y1 = coopLoadT<Left>(&y_high[Y_STRIDE * (row + SIDE) + k / 4u], Y_STRIDE);
            let y1_low = coopLoadT<Left>(&y_low[Y_STRIDE * (row + SIDE) + k / 4u], Y_STRIDE);
            let w0 = coopLoadT<Right>(&w_high[W_STRIDE * k + in_ / 4u], W_STRIDE);
            let w0_low = coopLoadT<Right>(&w_low[W_STRIDE * k + in_ / 4u], W_STRIDE);
            let w1 = coopLoadT<Right>(&w_high[W_STRIDE * k + (in_ + SIDE) / 4u], W_STRIDE);
            let w1_low = coopLoadT<Right>(&w_low[W_STRIDE * k + (in_ + SIDE) / 4u], W_STRIDE);
            let w2 = coopLoadT<Right>(&w_high[W_STRIDE * k + (in_ + 2u * SIDE) / 4u], W_STRIDE);
            let w2_low = coopLoadT<Right>(&w_low[W_STRIDE * k + (in_ + 2u * SIDE) / 4u], W_STRIDE);
            let w3 = coopLoadT<Right>(&w_high[W_STRIDE * k + (in_ + 3u * SIDE) / 4u], W_STRIDE);
            let w3_low = coopLoadT<Right>(&w_low[W_STRIDE * k + (in_ + 3u * SIDE) / 4u], W_STRIDE);
            x_00 = coopMultiplyAdd(y0, w0, coopMultiplyAdd(y0, w0_low, coopMultiplyAdd(y0_low, w0, x_00)));
            x_01 = coopMultiplyAdd(y0, w1, coopMultiplyAdd(y0, w1_low, coopMultiplyAdd(y0_low, w1, x_01)));
            x_02 = coopMultiplyAdd(y0, w2, coopMultiplyAdd(y0, w2_low, coopMultiplyAdd(y0_low, w2, x_02)));
            x_03 = coopMultiplyAdd(y0, w3, coopMultiplyAdd(y0, w3_low, coopMultiplyAdd(y0_low, w3, x_03)));
            x_10 = coopMultiplyAdd(y1, w0, coopMultiplyAdd(y1, w0_low, coopMultiplyAdd(y1_low, w0, x_10)));
            x_11 = coopMultiplyAdd(y1, w1, coopMultiplyAdd(y1, w1_low, coopMultiplyAdd(y1_low, w1, x_11)));
            x_12 = coopMultiplyAdd(y1, w2, coopMultiplyAdd(y1, w2_low, coopMultiplyAdd(y1_low, w2, x_12)));
            x_13 = coopMultiplyAdd(y1, w3, coopMultiplyAdd(y1, w3_low, coopMultiplyAdd(y1_low, w3, x_13)));
        }
        if (first >= n) {
            break;
        }
    }
    workgroupBarrier();
    coopStoreT(x_00, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row, in_);
    workgroupBarrier();
    coopStoreT(x_01, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row, in_ + SIDE);
    workgroupBarrier();
    coopStoreT(x_02, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row, in_ + 2u * SIDE);
    workgroupBarrier();
    coopStoreT(x_03, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row, in_ + 3u * SIDE);
    workgroupBarrier();
    coopStoreT(x_10, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row + SIDE, in_);
    workgroupBarrier();
    coopStoreT(x_11, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row + SIDE, in_ + SIDE);
    workgroupBarrier();
    coopStoreT(x_12, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row + SIDE, in_ + 2u * SIDE);
    workgroupBarrier();
    coopStoreT(x_13, &sums[own], SIDE / 4u);
    workgroupBarrier();
    put_matrix(workgroup, own, lane, row + SIDE, in_ + 3u * SIDE);
}
