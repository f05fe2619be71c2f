// y[r, o] (+)= Σ_i W[o, i] x[r, i] + b[o], weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation computes 8 rows × 8 output features in registers; a workgroup of 64 × 64 reads what it needs of x and W once, 16 input features at a time.
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

// Sixteen input features of a tile, each of 64 rows and of 64 output features, in vectors of four; a row is one longer than it need be, so
// that successive rows begin in different banks.
var<workgroup> x_tile: array<vec4<f32>, 272>;
var<workgroup> w_tile: array<vec4<f32>, 272>;

// Where the weights of a group begin, in elements.
fn weights_of(group: u32) -> u32 {
    if (params.weight_stride == 0u) {
        return 0u;
    }
    return slots[params.first_group + group] * params.weight_stride;
}

// Columns are rows of y.
fn outer(row: vec4<f32>, column: vec4<f32>) -> mat4x4<f32> {
    return mat4x4(column * row.x, column * row.y, column * row.z, column * row.w);
}

// Columns are rows of y.
fn store(group: u32, row: u32, out: u32, tile: mat4x4<f32>, bias: u32) {
    if (row >= params.rows_per_group || out >= params.out_features) {
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
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) index: u32,
) {
    let first_row = 64u * workgroup.x;
    let first_out = 64u * workgroup.y;
    let group = workgroup.z;
    // What this invocation copies: four rows of x and of W, four features of each; the last row stands in for those beyond it.
    let n = params.in_features / 4u;
    let four = index / 4u;
    let feature = index % 4u;
    let x_row = group * params.rows_per_group + min(first_row + 4u * four + vec4(0u, 1u, 2u, 3u), vec4(params.rows_per_group - 1u));
    let w_first = weights_of(group) / 4u;
    let w_row = min(first_out + 4u * four + vec4(0u, 1u, 2u, 3u), vec4(params.out_features - 1u));
    let to = 17u * 4u * feature + four;

    var y_aa: mat4x4<f32>;
    var y_ab: mat4x4<f32>;
    var y_ba: mat4x4<f32>;
    var y_bb: mat4x4<f32>;
    for (var first = 0u; first < n; first += 4u) {
        let i = min(first + feature, n - 1u);
        let x_at = x_row * n + i;
        let w_at = w_first + w_row * n + i;
        let xs = transpose(mat4x4(x[x_at.x], x[x_at.y], x[x_at.z], x[x_at.w]));
        let ws = transpose(mat4x4(weights[w_at.x], weights[w_at.y], weights[w_at.z], weights[w_at.w]));
        workgroupBarrier();
        x_tile[to] = xs[0];
        x_tile[to + 17u] = xs[1];
        x_tile[to + 34u] = xs[2];
        x_tile[to + 51u] = xs[3];
        w_tile[to] = ws[0];
        w_tile[to + 17u] = ws[1];
        w_tile[to + 34u] = ws[2];
        w_tile[to + 51u] = ws[3];
        workgroupBarrier();
        for (var k = 0u; k < 4u * min(n - first, 4u); k++) {
            let xa = x_tile[17u * k + 2u * local.y];
            let xb = x_tile[17u * k + 2u * local.y + 1u];
            let wa = w_tile[17u * k + 2u * local.x];
            let wb = w_tile[17u * k + 2u * local.x + 1u];
            y_aa += outer(xa, wa);
            y_ab += outer(xa, wb);
            y_ba += outer(xb, wa);
            y_bb += outer(xb, wb);
        }
    }
    let row = first_row + 8u * local.y;
    let out = first_out + 8u * local.x;
    let bias = w_first + params.out_features * n;
    store(group, row, out, y_aa, bias);
    store(group, row, out + 4u, y_ab, bias);
    store(group, row + 4u, out, y_ba, bias);
    store(group, row + 4u, out + 4u, y_bb, bias);
}
