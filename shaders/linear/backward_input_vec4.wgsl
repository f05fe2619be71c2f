// d_x[g, c, r, i] (+)= Σ_o W[o, i] d_y[g, r, o] over the output features o of chunk c, weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation computes 8 rows × 8 input features in registers, four output features at a time.
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

// Rows of d_y, as columns.
fn d_y_columns(at: vec4<u32>, o: u32) -> mat4x4<f32> {
    return mat4x4(d_y[at.x + o], d_y[at.y + o], d_y[at.z + o], d_y[at.w + o]);
}

// Four successive rows of W, as columns.
fn w_columns(at: u32, stride: u32) -> mat4x4<f32> {
    return mat4x4(weights[at], weights[at + stride], weights[at + 2u * stride], weights[at + 3u * stride]);
}

// Columns are rows of d_x.
fn store(part: u32, row: u32, in_: u32, tile: mat4x4<f32>) {
    if (in_ >= params.in_features) {
        return;
    }
    let stride = params.in_features / 4u;
    let at = (part * params.rows_per_group + row) * stride + in_ / 4u;
    let count = min(params.rows_per_group - min(row, params.rows_per_group), 4u);
    var columns = tile;
    for (var r = 0u; r < count; r++) {
        var value = columns[r];
        if (params.accumulate == 1u) {
            value += d_x[at + r * stride];
        }
        d_x[at + r * stride] = value;
    }
}

@compute @workgroup_size(8, 8)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_id) local: vec3<u32>) {
    let tile_at = 8u * tile_index(workgroup, local, vec2(params.rows_per_group, params.in_features));
    let row = tile_at.x;
    let in_ = tile_at.y;
    let part = workgroup.z;
    let group = part / params.chunks;
    let begin = part % params.chunks * params.chunk_outs;
    let end = min(begin + params.chunk_outs, params.out_features);
    if (row >= params.rows_per_group || in_ >= params.in_features || group >= params.groups) {
        return;
    }
    // Where the rows of d_y and the columns of W begin, in vectors; the last one stands in for those beyond it, which are not stored.
    let n = params.out_features / 4u;
    let stride = params.in_features / 4u;
    let lane = vec4(0u, 1u, 2u, 3u);
    let last = vec4(params.rows_per_group - 1u);
    let first = vec4(group * params.rows_per_group);
    let y_a = (first + min(row + lane, last)) * n;
    let y_b = (first + min(row + 4u + lane, last)) * n;
    let w_first = weights_of(group) / 4u;
    let w_a = w_first + in_ / 4u;
    let w_b = w_first + min(in_ / 4u + 1u, stride - 1u);

    var x_aa: mat4x4<f32>;
    var x_ab: mat4x4<f32>;
    var x_ba: mat4x4<f32>;
    var x_bb: mat4x4<f32>;
    for (var o = begin / 4u; o < end / 4u; o++) {
        let ya = d_y_columns(y_a, o);
        let yb = d_y_columns(y_b, o);
        let wa = w_columns(w_a + 4u * o * stride, stride);
        let wb = w_columns(w_b + 4u * o * stride, stride);
        x_aa += wa * ya;
        x_ab += wb * ya;
        x_ba += wa * yb;
        x_bb += wb * yb;
    }
    store(part, row, in_, x_aa);
    store(part, row, in_ + 4u, x_ab);
    store(part, row + 4u, in_, x_ba);
    store(part, row + 4u, in_ + 4u, x_bb);
}
