// d_x[g, c, r, i] (+)= Σ_o W[o, i] d_y[g, r, o] over the output features o of chunk c, weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation computes 32 rows × 8 input features in registers; it loads every eighth of the rows and gets the others from seven lanes beside it.
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

// Four successive rows of W, as columns.
fn w_columns(at: u32, stride: u32) -> mat4x4<f32> {
    return mat4x4(weights[at], weights[at + stride], weights[at + 2u * stride], weights[at + 3u * stride]);
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

fn store(part: u32, row: u32, in_: u32, sum: Eight) {
    put(part, row, in_, sum.r0);
    put(part, row + 1u, in_, sum.r1);
    put(part, row + 2u, in_, sum.r2);
    put(part, row + 3u, in_, sum.r3);
    put(part, row + 4u, in_, sum.r4);
    put(part, row + 5u, in_, sum.r5);
    put(part, row + 6u, in_, sum.r6);
    put(part, row + 7u, in_, sum.r7);
}

@compute @workgroup_size(32)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_size) subgroup_size: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    // Eight lanes compute 32 rows × 64 input features; a workgroup has four such teams, whatever the size of a subgroup.
    let team = (subgroup * subgroup_size + lane) / 8u;
    let member = lane % 8u;
    let first = lane - member;
    let row = 128u * workgroup.x + 32u * team;
    let in_a = 64u * workgroup.y + 8u * member;
    let in_b = in_a + 4u;
    let part = workgroup.z;
    let group = part / params.chunks;
    let begin = part % params.chunks * params.chunk_outs;
    let end = min(begin + params.chunk_outs, params.out_features);
    if (row >= params.rows_per_group) {
        return;
    }
    // Where the rows of d_y and the columns of W begin, in vectors; the last one stands in for those beyond it, which are not stored.
    let n = params.out_features / 4u;
    let stride = params.in_features / 4u;
    let y_row = (group * params.rows_per_group + min(row + member + vec4(0u, 8u, 16u, 24u), vec4(params.rows_per_group - 1u))) * n;
    let w_first = weights_of(group) / 4u;
    let w_a = w_first + min(in_a / 4u, stride - 1u);
    let w_b = w_first + min(in_b / 4u, stride - 1u);

    var x_0a: Eight;
    var x_1a: Eight;
    var x_2a: Eight;
    var x_3a: Eight;
    var x_0b: Eight;
    var x_1b: Eight;
    var x_2b: Eight;
    var x_3b: Eight;
    for (var o = begin / 4u; o < end / 4u; o++) {
        let wa = w_columns(w_a + 4u * o * stride, stride);
        let y0 = d_y[y_row.x + o];
        multiply_add(&x_0a, wa, y0, first);
        let y1 = d_y[y_row.y + o];
        multiply_add(&x_1a, wa, y1, first);
        let y2 = d_y[y_row.z + o];
        multiply_add(&x_2a, wa, y2, first);
        let y3 = d_y[y_row.w + o];
        multiply_add(&x_3a, wa, y3, first);
        let wb = w_columns(w_b + 4u * o * stride, stride);
        multiply_add(&x_0b, wb, y0, first);
        multiply_add(&x_1b, wb, y1, first);
        multiply_add(&x_2b, wb, y2, first);
        multiply_add(&x_3b, wb, y3, first);
    }
    store(part, row, in_a, x_0a);
    store(part, row + 8u, in_a, x_1a);
    store(part, row + 16u, in_a, x_2a);
    store(part, row + 24u, in_a, x_3a);
    store(part, row, in_b, x_0b);
    store(part, row + 8u, in_b, x_1b);
    store(part, row + 16u, in_b, x_2b);
    store(part, row + 24u, in_b, x_3b);
}
