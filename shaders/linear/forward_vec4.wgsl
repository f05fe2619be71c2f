// y[r, o] (+)= Σ_i W[o, i] x[r, i] + b[o], weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation computes 8 rows × 8 output features in registers, four input features at a time.
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

// Four rows of x, as columns.
fn x_columns(row: vec4<u32>, i: u32) -> mat4x4<f32> {
    return mat4x4(x[row.x + i], x[row.y + i], x[row.z + i], x[row.w + i]);
}

// Four rows of W, as columns.
fn w_columns(row: vec4<u32>, i: u32) -> mat4x4<f32> {
    return mat4x4(weights[row.x + i], weights[row.y + i], weights[row.z + i], weights[row.w + i]);
}

// Columns are rows of y.
fn store(group: u32, row: u32, out: u32, tile: mat4x4<f32>, bias: u32) {
    if (out >= params.out_features) {
        return;
    }
    let b = weights[bias + out / 4u];
    let at = ((group * params.rows_per_group + row) * params.out_features + out) / 4u;
    let stride = params.out_features / 4u;
    let count = min(params.rows_per_group - min(row, params.rows_per_group), 4u);
    var columns = tile;
    for (var r = 0u; r < count; r++) {
        var value = columns[r] + b;
        if (params.accumulate == 1u) {
            value += y[at + r * stride];
        }
        y[at + r * stride] = value;
    }
}

@compute @workgroup_size(8, 8)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_id) local: vec3<u32>) {
    let tile_at = 8u * tile_index(workgroup, local, vec2(params.rows_per_group, params.out_features));
    let row = tile_at.x;
    let out = tile_at.y;
    let group = workgroup.z;
    if (row >= params.rows_per_group || out >= params.out_features || group >= params.groups) {
        return;
    }
    // Where the rows of x and W begin, in vectors; the last one stands in for those beyond it, which are not stored.
    let n = params.in_features / 4u;
    let lane = vec4(0u, 1u, 2u, 3u);
    let x_last = vec4(params.rows_per_group - 1u);
    let x_first = vec4(group * params.rows_per_group);
    let x_a = (x_first + min(row + lane, x_last)) * n;
    let x_b = (x_first + min(row + 4u + lane, x_last)) * n;
    let w_last = vec4(params.out_features - 1u);
    let w_first = weights_of(group) / 4u;
    let w_a = w_first + min(out + lane, w_last) * n;
    let w_b = w_first + min(out + 4u + lane, w_last) * n;

    var y_aa: mat4x4<f32>;
    var y_ab: mat4x4<f32>;
    var y_ba: mat4x4<f32>;
    var y_bb: mat4x4<f32>;
    for (var i = 0u; i < n; i++) {
        let xa = x_columns(x_a, i);
        let xb = x_columns(x_b, i);
        let wa = transpose(w_columns(w_a, i));
        let wb = transpose(w_columns(w_b, i));
        y_aa += wa * xa;
        y_ab += wb * xa;
        y_ba += wa * xb;
        y_bb += wb * xb;
    }
    let bias = w_first + params.out_features * n;
    store(group, row, out, y_aa, bias);
    store(group, row, out + 4u, y_ab, bias);
    store(group, row + 4u, out, y_ba, bias);
    store(group, row + 4u, out + 4u, y_bb, bias);
}
