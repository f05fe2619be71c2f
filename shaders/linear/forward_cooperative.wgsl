// y[r, o] (+)= Σ_i W[o, i] x[r, i] + b[o], x and W as sums of two numbers in f16, weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation copies its part of 64 rows × 64 output features, 32 input features at a time; its subgroup multiplies 2 × 2 matrices of SIDE × SIDE of them.
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
    first_out: u32,
    end_out: u32,
    chunk_rows: u32,
    chunks: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> weights: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read_write> y: array<vec4<f32>>;

// Rows of x and rows of W, 32 features of each, in vectors of four; two vectors more, so that successive rows begin in different banks.
const STRIDE: u32 = 10u;
var<workgroup> x_high: array<vec4<f16>, 640>;
var<workgroup> x_low: array<vec4<f16>, 640>;
var<workgroup> w_high: array<vec4<f16>, 640>;
var<workgroup> w_low: array<vec4<f16>, 640>;
// The largest value of each row of x, as the bits of a float, whose order is that of integers.
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

fn put(group: u32, row: u32, out: u32, sum: vec4<f32>, bias: u32) {
    if (row >= params.rows_per_group || out >= params.out_features) {
        return;
    }
    let at = ((group * params.rows_per_group + row) * params.out_features + out) / 4u;
    var value = sum + weights[bias + out / 4u];
    if (params.accumulate == 1u) {
        value += y[at];
    }
    y[at] = value;
}

@compute @workgroup_size(INVOCATIONS)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) index: u32,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    let first_row = 64u * workgroup.x;
    let first_out = 64u * workgroup.y;
    let group = workgroup.z;
    let n = params.in_features / 4u;
    // The last row stands in for those beyond it, of x and of W.
    let x_first = group * params.rows_per_group * n;
    let last_row = params.rows_per_group - 1u;
    let w_first = weights_of(group) / 4u;
    let last_out = params.out_features - 1u;

    for (var i = index; i < 64u; i += INVOCATIONS) {
        atomicStore(&largest[i], 0u);
    }
    for (var i = index; i < 1024u; i += INVOCATIONS) {
        sums[i] = 0.0;
    }
    workgroupBarrier();
    for (var r = index / SHARES; r < 64u; r += INVOCATIONS / SHARES) {
        let at = x_first + min(first_row + r, last_row) * n;
        var most = vec4(0.0);
        // Eight at once, which a GPU waits for together.
        for (var i = index % SHARES; i < n; i += 8u * SHARES) {
            let a = max(abs(x[at + min(i + 0u * SHARES, n - 1u)]), abs(x[at + min(i + 1u * SHARES, n - 1u)]));
            let b = max(abs(x[at + min(i + 2u * SHARES, n - 1u)]), abs(x[at + min(i + 3u * SHARES, n - 1u)]));
            let c = max(abs(x[at + min(i + 4u * SHARES, n - 1u)]), abs(x[at + min(i + 5u * SHARES, n - 1u)]));
            let d = max(abs(x[at + min(i + 6u * SHARES, n - 1u)]), abs(x[at + min(i + 7u * SHARES, n - 1u)]));
            most = max(most, max(max(a, b), max(c, d)));
        }
        atomicMax(&largest[r], bitcast<u32>(max(max(most.x, most.y), max(most.z, most.w))));
    }
    workgroupBarrier();

    let row = 2u * SIDE * (subgroup / (32u / SIDE));
    let out = 2u * SIDE * (subgroup % (32u / SIDE));
    let own = SIDE * SIDE * subgroup;
    var y_aa = coopLoadT<Sums>(&sums[own], SIDE);
    var y_ab = y_aa;
    var y_ba = y_aa;
    var y_bb = y_aa;
    for (var first = 0u; first < n; first += 8u) {
        workgroupBarrier();
        for (var i = index; i < 512u; i += INVOCATIONS) {
            let r = i / 8u;
            let k = first + i % 8u;
            let at = min(k, n - 1u);
            // Nothing beyond the last feature.
            let scale = select(0.0, bitcast<f32>(exponent(r) << 23u), k < n);
            let xs = scale * x[x_first + min(first_row + r, last_row) * n + at];
            let ws = W_SCALE * weights[w_first + min(first_out + r, last_out) * n + at];
            let to = STRIDE * r + i % 8u;
            x_high[to] = vec4<f16>(high(xs));
            x_low[to] = vec4<f16>(xs - high(xs));
            w_high[to] = vec4<f16>(high(ws));
            w_low[to] = vec4<f16>(ws - high(ws));
        }
        workgroupBarrier();
        for (var k = 0u; k < 32u; k += SIDE) {
            let xa = coopLoadT<Left>(&x_high[STRIDE * row + k / 4u], STRIDE);
            let xb = coopLoadT<Left>(&x_high[STRIDE * (row + SIDE) + k / 4u], STRIDE);
            let wa = coopLoad<Right>(&w_high[STRIDE * out + k / 4u], STRIDE);
            let wb = coopLoad<Right>(&w_high[STRIDE * (out + SIDE) + k / 4u], STRIDE);
            let xa_low = coopLoadT<Left>(&x_low[STRIDE * row + k / 4u], STRIDE);
            let xb_low = coopLoadT<Left>(&x_low[STRIDE * (row + SIDE) + k / 4u], STRIDE);
            let wa_low = coopLoad<Right>(&w_low[STRIDE * out + k / 4u], STRIDE);
            let wb_low = coopLoad<Right>(&w_low[STRIDE * (out + SIDE) + k / 4u], STRIDE);
            y_aa = coopMultiplyAdd(xa, wa, coopMultiplyAdd(xa, wa_low, coopMultiplyAdd(xa_low, wa, y_aa)));
            y_ab = coopMultiplyAdd(xa, wb, coopMultiplyAdd(xa, wb_low, coopMultiplyAdd(xa_low, wb, y_ab)));
            y_ba = coopMultiplyAdd(xb, wa, coopMultiplyAdd(xb, wa_low, coopMultiplyAdd(xb_low, wa, y_ba)));
            y_bb = coopMultiplyAdd(xb, wb, coopMultiplyAdd(xb, wb_low, coopMultiplyAdd(xb_low, wb, y_bb)));
        }
    }
    let bias = w_first + params.out_features * n;
    for (var part = 0u; part < 4u; part++) {
        workgroupBarrier();
        switch part {
            case 0u: {
                coopStoreT(y_aa, &sums[own], SIDE);
            }
            case 1u: {
                coopStoreT(y_ab, &sums[own], SIDE);
            }
            case 2u: {
                coopStoreT(y_ba, &sums[own], SIDE);
            }
            default: {
                coopStoreT(y_bb, &sums[own], SIDE);
            }
        }
        workgroupBarrier();
        for (var i = 4u * lane; i < SIDE * SIDE; i += 4u * LANES) {
            let r = row + SIDE * (part / 2u) + i / SIDE;
            let o = out + SIDE * (part % 2u) + i % SIDE;
            let scale = bitcast<f32>((254u - exponent(r)) << 23u) / W_SCALE;
            let sum = vec4(sums[own + i], sums[own + i + 1u], sums[own + i + 2u], sums[own + i + 3u]);
            put(group, first_row + r, first_out + o, scale * sum, bias);
        }
    }
}
