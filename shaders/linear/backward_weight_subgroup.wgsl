// partial[g, c] (+)= (Σ_r d_y[r, o] x[r, i], Σ_r d_y[r, o]) over the rows r of chunk c of group g: weight, then bias.
// One invocation computes 32 output × 8 input features in registers, four rows at a time; it loads d_y of 4 outputs and gets the others from seven lanes beside it.
// x [groups, rows_per_group, in], d_y [groups, rows_per_group, out] → partial [groups, chunks, out·in + out]; in and out multiples of 4.
// ACCUMULATES partial where accumulate is 1, else OVERWRITES it.

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
@group(0) @binding(2) var<storage, read> d_y: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> partial: array<vec4<f32>>;

// Four rows, as columns.
fn x_columns(row: vec4<u32>, i: u32) -> mat4x4<f32> {
    return mat4x4(x[row.x + i], x[row.y + i], x[row.z + i], x[row.w + i]);
}

// Four rows, as rows; those beyond the chunk are the last one times zero.
fn d_y_rows(row: vec4<u32>, o: u32, inside: vec4<f32>) -> mat4x4<f32> {
    return transpose(mat4x4(
        d_y[row.x + o] * inside.x,
        d_y[row.y + o] * inside.y,
        d_y[row.z + o] * inside.z,
        d_y[row.w + o] * inside.w,
    ));
}

fn put(at: u32, sum: vec4<f32>) {
    var value = sum;
    if (params.accumulate == 1u) {
        value += partial[at];
    }
    partial[at] = value;
}

fn put_weight(weight: u32, out: u32, in_: u32, sum: vec4<f32>) {
    if (out < params.out_features && in_ < params.in_features) {
        put(weight + (out * params.in_features + in_) / 4u, sum);
    }
}

fn store(weight: u32, out: u32, in_: u32, sum: Eight) {
    put_weight(weight, out, in_, sum.r0);
    put_weight(weight, out + 4u, in_, sum.r1);
    put_weight(weight, out + 8u, in_, sum.r2);
    put_weight(weight, out + 12u, in_, sum.r3);
    put_weight(weight, out + 16u, in_, sum.r4);
    put_weight(weight, out + 20u, in_, sum.r5);
    put_weight(weight, out + 24u, in_, sum.r6);
    put_weight(weight, out + 28u, in_, sum.r7);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_size) subgroup_size: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    // Eight lanes compute 32 output × 64 input features; a workgroup has eight such teams, whatever the size of a subgroup.
    let team = (subgroup * subgroup_size + lane) / 8u;
    let member = lane % 8u;
    let first = lane - member;
    let out = 128u * workgroup.x + 32u * (team % 4u);
    let in_ = 128u * workgroup.y + 64u * (team / 4u);
    let group = workgroup.z / params.chunks;
    let chunk = workgroup.z % params.chunks;
    if (out >= params.out_features || in_ >= params.in_features) {
        return;
    }
    let first_row = group * params.rows_per_group + chunk * params.chunk_rows;
    let end = min(first_row + params.chunk_rows, (group + 1u) * params.rows_per_group);
    let four = vec4(0u, 1u, 2u, 3u);
    // Columns of x and d_y, in vectors; the last one stands in for those beyond it, which are not stored.
    let x_stride = params.in_features / 4u;
    let y_stride = params.out_features / 4u;
    let in_a = in_ + 8u * member;
    let in_b = in_a + 4u;
    let x_a = min(in_a / 4u, x_stride - 1u);
    let x_b = min(in_b / 4u, x_stride - 1u);
    let o = min(out / 4u + member, y_stride - 1u);

    var w_0a: Eight;
    var w_1a: Eight;
    var w_2a: Eight;
    var w_3a: Eight;
    var w_0b: Eight;
    var w_1b: Eight;
    var w_2b: Eight;
    var w_3b: Eight;
    var bias = vec4(0.0);
    for (var r = first_row; r < end; r += 4u) {
        let row = min(r + four, vec4(end - 1u));
        let inside = select(vec4(0.0), vec4(1.0), r + four < vec4(end));
        let xa = x_columns(row * x_stride, x_a);
        let ys = d_y_rows(row * y_stride, o, inside);
        multiply_add(&w_0a, xa, ys[0], first);
        multiply_add(&w_1a, xa, ys[1], first);
        multiply_add(&w_2a, xa, ys[2], first);
        multiply_add(&w_3a, xa, ys[3], first);
        let xb = x_columns(row * x_stride, x_b);
        multiply_add(&w_0b, xb, ys[0], first);
        multiply_add(&w_1b, xb, ys[1], first);
        multiply_add(&w_2b, xb, ys[2], first);
        multiply_add(&w_3b, xb, ys[3], first);
        bias += vec4(1.0) * ys;
    }
    let weight = workgroup.z * (params.out_features * params.in_features + params.out_features) / 4u;
    store(weight, out, in_a, w_0a);
    store(weight, out + 1u, in_a, w_1a);
    store(weight, out + 2u, in_a, w_2a);
    store(weight, out + 3u, in_a, w_3a);
    store(weight, out, in_b, w_0b);
    store(weight, out + 1u, in_b, w_1b);
    store(weight, out + 2u, in_b, w_2b);
    store(weight, out + 3u, in_b, w_3b);
    if (in_ == 0u && out + 4u * member < params.out_features) {
        put(weight + (params.out_features * params.in_features + out) / 4u + member, bias);
    }
}
