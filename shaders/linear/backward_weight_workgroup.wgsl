// partial[g, c] (+)= (Σ_r d_y[r, o] x[r, i], Σ_r d_y[r, o]) over the rows r of chunk c of group g: weight, then bias.
// One invocation computes 8 output × 8 input features in registers; a workgroup of 64 × 64 reads what it needs of x and d_y once, 16 rows at a time.
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
    first_out: u32,
    end_out: u32,
    chunk_rows: u32,
    chunks: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> d_y: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> partial: array<vec4<f32>>;

// Sixteen rows of a tile, each of 64 output features and of 64 input features, in vectors of four; a row is one longer than it need be, so
// that successive rows begin in different banks.
var<workgroup> y_tile: array<vec4<f32>, 272>;
var<workgroup> x_tile: array<vec4<f32>, 272>;

// Columns are rows of the weight.
fn outer(row: vec4<f32>, column: vec4<f32>) -> mat4x4<f32> {
    return mat4x4(column * row.x, column * row.y, column * row.z, column * row.w);
}

fn put(at: u32, sum: vec4<f32>) {
    var value = sum;
    if (params.accumulate == 1u) {
        value += partial[at];
    }
    partial[at] = value;
}

// Columns are rows of the weight.
fn store(first: u32, out: u32, in_: u32, tile: mat4x4<f32>) {
    if (out >= params.out_features || in_ >= params.in_features) {
        return;
    }
    let stride = params.in_features / 4u;
    let at = first + out * stride + in_ / 4u;
    put(at, tile[0]);
    put(at + stride, tile[1]);
    put(at + 2u * stride, tile[2]);
    put(at + 3u * stride, tile[3]);
}

@compute @workgroup_size(8, 8)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) index: u32,
) {
    let first_out = 64u * workgroup.x;
    let first_in = 64u * workgroup.y;
    let group = workgroup.z / params.chunks;
    let chunk = workgroup.z % params.chunks;
    let begin = group * params.rows_per_group + chunk * params.chunk_rows;
    let end = min(begin + params.chunk_rows, (group + 1u) * params.rows_per_group);
    // What this invocation copies: four rows of x and of d_y, four features of each. The last ones stand in for those beyond them.
    let x_stride = params.in_features / 4u;
    let y_stride = params.out_features / 4u;
    let x_column = min(first_in / 4u + index % 16u, x_stride - 1u);
    let y_column = min(first_out / 4u + index % 16u, y_stride - 1u);
    let to = 17u * 4u * (index / 16u) + index % 16u;

    var w_aa: mat4x4<f32>;
    var w_ab: mat4x4<f32>;
    var w_ba: mat4x4<f32>;
    var w_bb: mat4x4<f32>;
    var bias_a = vec4(0.0);
    var bias_b = vec4(0.0);
    for (var first = begin; first < end; first += 16u) {
        let row = min(first + 4u * (index / 16u) + vec4(0u, 1u, 2u, 3u), vec4(end - 1u));
        let x_at = row * x_stride + x_column;
        let y_at = row * y_stride + y_column;
        let xs = mat4x4(x[x_at.x], x[x_at.y], x[x_at.z], x[x_at.w]);
        let ys = mat4x4(d_y[y_at.x], d_y[y_at.y], d_y[y_at.z], d_y[y_at.w]);
        workgroupBarrier();
        x_tile[to] = xs[0];
        x_tile[to + 17u] = xs[1];
        x_tile[to + 34u] = xs[2];
        x_tile[to + 51u] = xs[3];
        y_tile[to] = ys[0];
        y_tile[to + 17u] = ys[1];
        y_tile[to + 34u] = ys[2];
        y_tile[to + 51u] = ys[3];
        workgroupBarrier();
        for (var k = 0u; k < min(end - first, 16u); k++) {
            let ya = y_tile[17u * k + 2u * local.y];
            let yb = y_tile[17u * k + 2u * local.y + 1u];
            let xa = x_tile[17u * k + 2u * local.x];
            let xb = x_tile[17u * k + 2u * local.x + 1u];
            w_aa += outer(ya, xa);
            w_ab += outer(ya, xb);
            w_ba += outer(yb, xa);
            w_bb += outer(yb, xb);
            bias_a += ya;
            bias_b += yb;
        }
    }
    let out = first_out + 8u * local.y;
    let in_ = first_in + 8u * local.x;
    let weight = workgroup.z * (params.out_features * params.in_features + params.out_features) / 4u;
    store(weight, out, in_, w_aa);
    store(weight, out, in_ + 4u, w_ab);
    store(weight, out + 4u, in_, w_ba);
    store(weight, out + 4u, in_ + 4u, w_bb);
    if (in_ == 0u && out < params.out_features) {
        let bias = weight + (params.out_features * params.in_features + out) / 4u;
        put(bias, bias_a);
        if (out + 4u < params.out_features) {
            put(bias + 1u, bias_b);
        }
    }
}
