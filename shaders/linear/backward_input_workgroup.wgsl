// d_x[r, i] (+)= Σ_o W[o, i] d_y[r, o] for o in first_out .. end_out, weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation computes 8 rows × 8 input features in registers; a workgroup of 64 × 64 reads what it needs of d_y and W once, 16 output features at a time.
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

// Sixteen output features of a tile, each of 64 rows and of 64 input features, in vectors of four; a row is one longer than it need be, so
// that successive rows begin in different banks.
var<workgroup> y_tile: array<vec4<f32>, 272>;
var<workgroup> w_tile: array<vec4<f32>, 272>;

// Where the weights of a group begin, in elements.
fn weights_of(group: u32) -> u32 {
    if (params.weight_stride == 0u) {
        return 0u;
    }
    return slots[params.first_group + group] * params.weight_stride;
}

// Columns are rows of d_x.
fn outer(row: vec4<f32>, column: vec4<f32>) -> mat4x4<f32> {
    return mat4x4(column * row.x, column * row.y, column * row.z, column * row.w);
}

// Columns are rows of d_x.
fn store(group: u32, row: u32, in_: u32, tile: mat4x4<f32>) {
    if (row >= params.rows_per_group || in_ >= params.in_features) {
        return;
    }
    let stride = params.in_features / 4u;
    let at = (group * params.rows_per_group + row) * stride + in_ / 4u;
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
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) index: u32,
) {
    let first_row = 64u * workgroup.x;
    let first_in = 64u * workgroup.y;
    let group = workgroup.z;
    // What this invocation copies: four output features of four rows of d_y, and four rows of W, four input features of each. The
    // last ones stand in for those beyond them.
    let n = params.out_features / 4u;
    let stride = params.in_features / 4u;
    let y_row = group * params.rows_per_group + min(first_row + 4u * (index / 4u) + vec4(0u, 1u, 2u, 3u), vec4(params.rows_per_group - 1u));
    let y_to = 17u * 4u * (index % 4u) + index / 4u;
    let w_column = weights_of(group) / 4u + min(first_in / 4u + index % 16u, stride - 1u);
    let w_to = 17u * 4u * (index / 16u) + index % 16u;

    var x_aa: mat4x4<f32>;
    var x_ab: mat4x4<f32>;
    var x_ba: mat4x4<f32>;
    var x_bb: mat4x4<f32>;
    let end = params.end_out / 4u;
    for (var first = params.first_out / 4u; first < end; first += 4u) {
        let y_at = y_row * n + min(first + index % 4u, end - 1u);
        let w_at = w_column + 4u * min(first + index / 16u, end - 1u) * stride;
        let ys = transpose(mat4x4(d_y[y_at.x], d_y[y_at.y], d_y[y_at.z], d_y[y_at.w]));
        let ws = mat4x4(weights[w_at], weights[w_at + stride], weights[w_at + 2u * stride], weights[w_at + 3u * stride]);
        workgroupBarrier();
        y_tile[y_to] = ys[0];
        y_tile[y_to + 17u] = ys[1];
        y_tile[y_to + 34u] = ys[2];
        y_tile[y_to + 51u] = ys[3];
        w_tile[w_to] = ws[0];
        w_tile[w_to + 17u] = ws[1];
        w_tile[w_to + 34u] = ws[2];
        w_tile[w_to + 51u] = ws[3];
        workgroupBarrier();
        for (var k = 0u; k < 4u * min(end - first, 4u); k++) {
            let ya = y_tile[17u * k + 2u * local.y];
            let yb = y_tile[17u * k + 2u * local.y + 1u];
            let wa = w_tile[17u * k + 2u * local.x];
            let wb = w_tile[17u * k + 2u * local.x + 1u];
            x_aa += outer(ya, wa);
            x_ab += outer(ya, wb);
            x_ba += outer(yb, wa);
            x_bb += outer(yb, wb);
        }
    }
    let row = first_row + 8u * local.y;
    let in_ = first_in + 8u * local.x;
    store(group, row, in_, x_aa);
    store(group, row, in_ + 4u, x_ab);
    store(group, row + 4u, in_, x_ba);
    store(group, row + 4u, in_ + 4u, x_bb);
}
