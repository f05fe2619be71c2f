// d_x[r, i] (+)= Σ_o W[o, i] d_y[r, o] for o in first_out .. end_out, d_y and W as sums of two numbers in f16, weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation copies its part of 64 rows × 64 input features, 32 output features at a time; its subgroup multiplies 2 × 2 matrices of SIDE × SIDE of them.
// d_y [groups, rows_per_group, out], weights [.., out·in + out], slots [..] → d_x [groups, rows_per_group, in]; in, out and both ends multiples of 4.
// ACCUMULATES d_x where accumulate is 1, else OVERWRITES it.

struct Params {
    groups: u32,
    rows_per_group: u32,
    first_group: u32,
    in_features: u32,
    out_features: u32,
    weight_stride: u32,
    accumulate: u32,
    first_out: u32,
    end_out: u32,
    chunk_rows: u32,
    chunks: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> d_y: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> weights: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read_write> d_x: array<vec4<f32>>;

// Rows of d_y, 32 features of each, and 32 rows of W, 64 features of each, in vectors of four; two vectors more, so that successive rows begin in
// different banks.
const Y_STRIDE: u32 = 10u;
const W_STRIDE: u32 = 18u;
var<workgroup> y_high: array<vec4<f16>, 640>;
var<workgroup> y_low: array<vec4<f16>, 640>;
var<workgroup> w_high: array<vec4<f16>, 576>;
var<workgroup> w_low: array<vec4<f16>, 576>;
// The largest value of each row of d_y, as the bits of a float, whose order is that of integers.
var<workgroup> largest: array<atomic<u32>, 64>;
// A matrix of sums for each subgroup.
var<workgroup> sums: array<f32, 1024>;

// Each subgroup has 2 × 2 matrices of the 64 × 64 results.
const INVOCATIONS: u32 = 1024u / (SIDE * SIDE) * LANES;

// How many invocations look for the largest value of a row.
const SHARES: u32 = max(INVOCATIONS / 64u, 1u);

// Where the weights of a group begin, in elements.
fn weights_of(group: u32) -> u32 {
    if (params.weight_stride == 0u) {
        return 0u;
    }
    return slots[params.first_group + group] * params.weight_stride;
}

// f16 ends at 2^16 and has all its digits down to 2^-14 only: weights, as good as always below 2^7, are taken times 2^8 ...
const W_SCALE: f32 = 256.0;

// ... and rows times a power of two, here its exponent, that brings their largest value to between 2^14 and 2^15.
fn exponent(row: u32) -> u32 {
    return clamp(268u - (atomicLoad(&largest[row]) >> 23u), 1u, 253u);
}

// The first 11 digits: what f16 holds. By bits, since a driver may take there and back again for the number itself.
fn high(values: vec4<f32>) -> vec4<f32> {
    return bitcast<vec4<f32>>(bitcast<vec4<u32>>(values) & vec4(0xffffe000u));
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

@compute @workgroup_size(INVOCATIONS)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) index: u32,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    let first_row = 64u * workgroup.x;
    let first_in = 64u * workgroup.y;
    let group = workgroup.z;
    let n = params.out_features / 4u;
    let begin = params.first_out / 4u;
    let end = params.end_out / 4u;
    // The last row and the last feature stand in for those beyond them.
    let y_first = group * params.rows_per_group * n;
    let last_row = params.rows_per_group - 1u;
    let stride = params.in_features / 4u;
    let w_first = weights_of(group) / 4u + first_in / 4u;
    let last_in = stride - 1u - first_in / 4u;

    for (var i = index; i < 64u; i += INVOCATIONS) {
        atomicStore(&largest[i], 0u);
    }
    for (var i = index; i < 1024u; i += INVOCATIONS) {
        sums[i] = 0.0;
    }
    workgroupBarrier();
    for (var r = index / SHARES; r < 64u; r += INVOCATIONS / SHARES) {
        let at = y_first + min(first_row + r, last_row) * n;
        var most = vec4(0.0);
        // Eight at once, which a GPU waits for together.
        for (var i = begin + index % SHARES; i < end; i += 8u * SHARES) {
            let a = max(abs(d_y[at + min(i + 0u * SHARES, end - 1u)]), abs(d_y[at + min(i + 1u * SHARES, end - 1u)]));
            let b = max(abs(d_y[at + min(i + 2u * SHARES, end - 1u)]), abs(d_y[at + min(i + 3u * SHARES, end - 1u)]));
            let c = max(abs(d_y[at + min(i + 4u * SHARES, end - 1u)]), abs(d_y[at + min(i + 5u * SHARES, end - 1u)]));
            let d = max(abs(d_y[at + min(i + 6u * SHARES, end - 1u)]), abs(d_y[at + min(i + 7u * SHARES, end - 1u)]));
            most = max(most, max(max(a, b), max(c, d)));
        }
        atomicMax(&largest[r], bitcast<u32>(max(max(most.x, most.y), max(most.z, most.w))));
    }
    workgroupBarrier();

    let row = 2u * SIDE * (subgroup / (32u / SIDE));
    let in_ = 2u * SIDE * (subgroup % (32u / SIDE));
    let own = SIDE * SIDE * subgroup;
    var x_aa = coopLoadT<Sums>(&sums[own], SIDE);
    var x_ab = x_aa;
    var x_ba = x_aa;
    var x_bb = x_aa;
    for (var first = begin; first < end; first += 8u) {
        workgroupBarrier();
        for (var i = index; i < 512u; i += INVOCATIONS) {
            let r = i / 8u;
            let o = first + i % 8u;
            // Nothing beyond the last feature.
            let scale = select(0.0, bitcast<f32>(exponent(r) << 23u), o < end);
            let ys = scale * d_y[y_first + min(first_row + r, last_row) * n + min(o, end - 1u)];
            let to = Y_STRIDE * r + i % 8u;
            let ws = W_SCALE * weights[w_first + min(4u * first + i / 16u, 4u * end - 1u) * stride + min(i % 16u, last_in)];
            let w_to = W_STRIDE * (i / 16u) + i % 16u;
            y_high[to] = vec4<f16>(high(ys));
            y_low[to] = vec4<f16>(ys - high(ys));
            w_high[w_to] = vec4<f16>(high(ws));
            w_low[w_to] = vec4<f16>(ws - high(ws));
        }
        workgroupBarrier();
        for (var k = 0u; k < 32u; k += SIDE) {
            let ya = coopLoadT<Left>(&y_high[Y_STRIDE * row + k / 4u], Y_STRIDE);
            let yb = coopLoadT<Left>(&y_high[Y_STRIDE * (row + SIDE) + k / 4u], Y_STRIDE);
            let wa = coopLoadT<Right>(&w_high[W_STRIDE * k + in_ / 4u], W_STRIDE);
            let wb = coopLoadT<Right>(&w_high[W_STRIDE * k + (in_ + SIDE) / 4u], W_STRIDE);
            let ya_low = coopLoadT<Left>(&y_low[Y_STRIDE * row + k / 4u], Y_STRIDE);
            let yb_low = coopLoadT<Left>(&y_low[Y_STRIDE * (row + SIDE) + k / 4u], Y_STRIDE);
            let wa_low = coopLoadT<Right>(&w_low[W_STRIDE * k + in_ / 4u], W_STRIDE);
            let wb_low = coopLoadT<Right>(&w_low[W_STRIDE * k + (in_ + SIDE) / 4u], W_STRIDE);
            x_aa = coopMultiplyAdd(ya, wa, coopMultiplyAdd(ya, wa_low, coopMultiplyAdd(ya_low, wa, x_aa)));
            x_ab = coopMultiplyAdd(ya, wb, coopMultiplyAdd(ya, wb_low, coopMultiplyAdd(ya_low, wb, x_ab)));
            x_ba = coopMultiplyAdd(yb, wa, coopMultiplyAdd(yb, wa_low, coopMultiplyAdd(yb_low, wa, x_ba)));
            x_bb = coopMultiplyAdd(yb, wb, coopMultiplyAdd(yb, wb_low, coopMultiplyAdd(yb_low, wb, x_bb)));
        }
    }
    for (var part = 0u; part < 4u; part++) {
        workgroupBarrier();
        switch part {
            case 0u: {
                coopStoreT(x_aa, &sums[own], SIDE);
            }
            case 1u: {
                coopStoreT(x_ab, &sums[own], SIDE);
            }
            case 2u: {
                coopStoreT(x_ba, &sums[own], SIDE);
            }
            default: {
                coopStoreT(x_bb, &sums[own], SIDE);
            }
        }
        workgroupBarrier();
        for (var i = 4u * lane; i < SIDE * SIDE; i += 4u * LANES) {
            let r = row + SIDE * (part / 2u) + i / SIDE;
            let column = in_ + SIDE * (part % 2u) + i % SIDE;
            let scale = bitcast<f32>((254u - exponent(r)) << 23u) / W_SCALE;
            let sum = vec4(sums[own + i], sums[own + i + 1u], sums[own + i + 2u], sums[own + i + 3u]);
            put(group, first_row + r, first_in + column, scale * sum);
        }
    }
}
