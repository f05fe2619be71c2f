// d_x[g, c, r, i] (+)= Σ_o W[o, i] d_y[g, r, o] over the output features o of chunk c, weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation computes 8 rows × 4 input features in registers, one output feature at a time.
// d_y [groups, rows_per_group, out], weights [.., out·in + out], slots [..] → d_x [groups, chunks, rows_per_group, in].
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
@group(0) @binding(1) var<storage, read> d_y: array<f32>;
@group(0) @binding(2) var<storage, read> weights: array<f32>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read_write> d_x: array<f32>;

fn store(part: u32, row: u32, in_: u32, values: vec4<f32>) {
    if (row >= params.rows_per_group) {
        return;
    }
    let first = (part * params.rows_per_group + row) * params.in_features + in_;
    for (var i = 0u; i < min(params.in_features - in_, 4u); i++) {
        var value = values[i];
        if (params.accumulate == 1u) {
            value += d_x[first + i];
        }
        d_x[first + i] = value;
    }
}

@compute @workgroup_size(8, 8)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_id) local: vec3<u32>) {
    let tile_at = tile_index(workgroup, local, vec2(params.rows_per_group, params.in_features));
    let row = 8u * tile_at.x;
    let in_ = 4u * tile_at.y;
    let part = workgroup.z;
    let group = part / params.chunks;
    let begin = part % params.chunks * params.chunk_outs;
    let end = min(begin + params.chunk_outs, params.out_features);
    if (row >= params.rows_per_group || in_ >= params.in_features || group >= params.groups) {
        return;
    }
    // Where the rows of d_y and the columns of W begin; the last one stands in for those beyond it, which are not stored.
    let n = params.out_features;
    let four = vec4(0u, 1u, 2u, 3u);
    let y_first = vec4(group * params.rows_per_group);
    let y_last = vec4(params.rows_per_group - 1u);
    let y_a = (y_first + min(row + four, y_last)) * n;
    let y_b = (y_first + min(row + 4u + four, y_last)) * n;
    let column = weights_of(group) + min(in_ + four, vec4(params.in_features - 1u));

    var x0: vec4<f32>;
    var x1: vec4<f32>;
    var x2: vec4<f32>;
    var x3: vec4<f32>;
    var x4: vec4<f32>;
    var x5: vec4<f32>;
    var x6: vec4<f32>;
    var x7: vec4<f32>;
    for (var o = begin; o < end; o++) {
        let at = column + o * params.in_features;
        let w = vec4(weights[at.x], weights[at.y], weights[at.z], weights[at.w]);
        x0 += w * d_y[y_a.x + o];
        x1 += w * d_y[y_a.y + o];
        x2 += w * d_y[y_a.z + o];
        x3 += w * d_y[y_a.w + o];
        x4 += w * d_y[y_b.x + o];
        x5 += w * d_y[y_b.y + o];
        x6 += w * d_y[y_b.z + o];
        x7 += w * d_y[y_b.w + o];
    }
    store(part, row, in_, x0);
    store(part, row + 1u, in_, x1);
    store(part, row + 2u, in_, x2);
    store(part, row + 3u, in_, x3);
    store(part, row + 4u, in_, x4);
    store(part, row + 5u, in_, x5);
    store(part, row + 6u, in_, x6);
    store(part, row + 7u, in_, x7);
}
