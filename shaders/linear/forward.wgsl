// y[r, o] (+)= Σ_i W[o, i] x[r, i] + b[o], weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation computes 8 rows × 4 output features in registers, one input feature at a time.
// x [groups, rows_per_group, in], weights [.., out·in + out], slots [..] → y [groups, rows_per_group, out].
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
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read> weights: array<f32>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read_write> y: array<f32>;

// The values at four indices.
fn w4(at: vec4<u32>) -> vec4<f32> {
    return vec4(weights[at.x], weights[at.y], weights[at.z], weights[at.w]);
}

fn store(group: u32, row: u32, out: u32, values: vec4<f32>) {
    if (row >= params.rows_per_group) {
        return;
    }
    let first = (group * params.rows_per_group + row) * params.out_features + out;
    for (var o = 0u; o < min(params.out_features - out, 4u); o++) {
        var value = values[o];
        if (params.accumulate == 1u) {
            value += y[first + o];
        }
        y[first + o] = value;
    }
}

@compute @workgroup_size(8, 8)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_id) local: vec3<u32>) {
    let tile_at = tile_index(workgroup, local, vec2(params.rows_per_group, params.out_features));
    let row = 8u * tile_at.x;
    let out = 4u * tile_at.y;
    let group = workgroup.z;
    if (row >= params.rows_per_group || out >= params.out_features || group >= params.groups) {
        return;
    }
    // Where the rows of x and of W begin; the last one stands in for those beyond it, which are not stored.
    let n = params.in_features;
    let four = vec4(0u, 1u, 2u, 3u);
    let x_first = vec4(group * params.rows_per_group);
    let x_last = vec4(params.rows_per_group - 1u);
    let x_a = (x_first + min(row + four, x_last)) * n;
    let x_b = (x_first + min(row + 4u + four, x_last)) * n;
    let column = min(out + four, vec4(params.out_features - 1u));
    let w_first = weights_of(group);
    let w_row = w_first + column * n;

    let bias = w4(w_first + params.out_features * n + column);
    var y0 = bias;
    var y1 = bias;
    var y2 = bias;
    var y3 = bias;
    var y4 = bias;
    var y5 = bias;
    var y6 = bias;
    var y7 = bias;
    for (var i = 0u; i < n; i++) {
        let w = w4(w_row + i);
        y0 += w * x[x_a.x + i];
        y1 += w * x[x_a.y + i];
        y2 += w * x[x_a.z + i];
        y3 += w * x[x_a.w + i];
        y4 += w * x[x_b.x + i];
        y5 += w * x[x_b.y + i];
        y6 += w * x[x_b.z + i];
        y7 += w * x[x_b.w + i];
    }
    store(group, row, out, y0);
    store(group, row + 1u, out, y1);
    store(group, row + 2u, out, y2);
    store(group, row + 3u, out, y3);
    store(group, row + 4u, out, y4);
    store(group, row + 5u, out, y5);
    store(group, row + 6u, out, y6);
    store(group, row + 7u, out, y7);
}
