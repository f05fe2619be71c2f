// y[r, o] (+)= Σ_i W[o, i] x[r, i] + b[o], weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation computes 32 rows × 8 output features in registers; it loads every eighth of the rows and gets the others from seven lanes beside it.
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

// Four features of four rows of W: columns are features.
fn w_columns(row: vec4<u32>, i: u32) -> mat4x4<f32> {
    return transpose(mat4x4(weights[row.x + i], weights[row.y + i], weights[row.z + i], weights[row.w + i]));
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

fn store(group: u32, row: u32, out: u32, sum: Eight, bias: vec4<f32>) {
    put(group, row, out, sum.r0 + bias);
    put(group, row + 1u, out, sum.r1 + bias);
    put(group, row + 2u, out, sum.r2 + bias);
    put(group, row + 3u, out, sum.r3 + bias);
    put(group, row + 4u, out, sum.r4 + bias);
    put(group, row + 5u, out, sum.r5 + bias);
    put(group, row + 6u, out, sum.r6 + bias);
    put(group, row + 7u, out, sum.r7 + bias);
}

@compute @workgroup_size(32)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_size) subgroup_size: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    // Eight lanes compute 32 rows × 64 output features; a workgroup has four such teams, whatever the size of a subgroup.
    let team = (subgroup * subgroup_size + lane) / 8u;
    let member = lane % 8u;
    let first = lane - member;
    let row = 128u * workgroup.x + 32u * team;
    let out_a = 64u * workgroup.y + 8u * member;
    let out_b = out_a + 4u;
    let group = workgroup.z;
    if (row >= params.rows_per_group) {
        return;
    }
    // Where the rows of x and W begin, in vectors; the last one stands in for those beyond it, which are not stored.
    let n = params.in_features / 4u;
    let x_row = (group * params.rows_per_group + min(row + member + vec4(0u, 8u, 16u, 24u), vec4(params.rows_per_group - 1u))) * n;
    let w_first = weights_of(group) / 4u;
    let four = vec4(0u, 1u, 2u, 3u);
    let w_a = w_first + min(out_a + four, vec4(params.out_features - 1u)) * n;
    let w_b = w_first + min(out_b + four, vec4(params.out_features - 1u)) * n;

    var y_0a: Eight;
    var y_1a: Eight;
    var y_2a: Eight;
    var y_3a: Eight;
    var y_0b: Eight;
    var y_1b: Eight;
    var y_2b: Eight;
    var y_3b: Eight;
    for (var i = 0u; i < n; i++) {
        let wa = w_columns(w_a, i);
        let x0 = x[x_row.x + i];
        multiply_add(&y_0a, wa, x0, first);
        let x1 = x[x_row.y + i];
        multiply_add(&y_1a, wa, x1, first);
        let x2 = x[x_row.z + i];
        multiply_add(&y_2a, wa, x2, first);
        let x3 = x[x_row.w + i];
        multiply_add(&y_3a, wa, x3, first);
        let wb = w_columns(w_b, i);
        multiply_add(&y_0b, wb, x0, first);
        multiply_add(&y_1b, wb, x1, first);
        multiply_add(&y_2b, wb, x2, first);
        multiply_add(&y_3b, wb, x3, first);
    }
    let bias = w_first + params.out_features * n;
    let bias_a = weights[bias + min(out_a, params.out_features - 1u) / 4u];
    store(group, row, out_a, y_0a, bias_a);
    store(group, row + 8u, out_a, y_1a, bias_a);
    store(group, row + 16u, out_a, y_2a, bias_a);
    store(group, row + 24u, out_a, y_3a, bias_a);
    let bias_b = weights[bias + min(out_b, params.out_features - 1u) / 4u];
    store(group, row, out_b, y_0b, bias_b);
    store(group, row + 8u, out_b, y_1b, bias_b);
    store(group, row + 16u, out_b, y_2b, bias_b);
    store(group, row + 24u, out_b, y_3b, bias_b);
}
