// partial[g, c] (+)= (Σ_r d_y[r, o] x[r, i], Σ_r d_y[r, o]) over the rows r of chunk c of group g: weight, then bias.
// One invocation computes 4 output × 4 input features over four of every 32 rows of a chunk; the sums of eight are added in workgroup memory.
// x [groups, rows_per_group, in], d_y [groups, rows_per_group, out] → partial [groups, chunks, out·in + out].
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
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read> d_y: array<f32>;
@group(0) @binding(3) var<storage, read_write> partial: array<f32>;

// The values at four indices.
fn x4(at: vec4<u32>) -> vec4<f32> {
    return vec4(x[at.x], x[at.y], x[at.z], x[at.w]);
}

fn d_y4(at: vec4<u32>) -> vec4<f32> {
    return vec4(d_y[at.x], d_y[at.y], d_y[at.z], d_y[at.w]);
}

fn put(at: u32, sum: f32) {
    var value = sum;
    if (params.accumulate == 1u) {
        value += partial[at];
    }
    partial[at] = value;
}

// What eight invocations have of a part of the weight, for eight such parts. Columns are rows of the weight.
var<workgroup> tiles: array<mat4x4<f32>, 64>;
var<workgroup> biases: array<vec4<f32>, 64>;

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_id) local: vec3<u32>) {
    let out = 4u * id.x;
    let in_ = 4u * workgroup.y;
    let group = workgroup.z / params.chunks;
    let chunk = workgroup.z % params.chunks;
    let first = group * params.rows_per_group + chunk * params.chunk_rows;
    let end = min(first + params.chunk_rows, (group + 1u) * params.rows_per_group);

    // Columns of x and d_y; the last one stands in for those beyond it, which are not stored.
    let lane = vec4(0u, 1u, 2u, 3u);
    let x_column = min(in_ + lane, vec4(params.in_features - 1u));
    let y_column = min(out + lane, vec4(params.out_features - 1u));

    // Columns are rows of the weight. Rows of d_y beyond the chunk are the last one times zero.
    var tile: mat4x4<f32>;
    var bias = vec4(0.0);
    for (var r = first + 4u * local.y; r < end; r += 32u) {
        let row = min(r + lane, vec4(end - 1u));
        let inside = select(vec4(0.0), vec4(1.0), r + lane < vec4(end));
        let xs = mat4x4(
            x4(row.x * params.in_features + x_column),
            x4(row.y * params.in_features + x_column),
            x4(row.z * params.in_features + x_column),
            x4(row.w * params.in_features + x_column),
        );
        let ys = mat4x4(
            d_y4(row.x * params.out_features + y_column) * inside.x,
            d_y4(row.y * params.out_features + y_column) * inside.y,
            d_y4(row.z * params.out_features + y_column) * inside.z,
            d_y4(row.w * params.out_features + y_column) * inside.w,
        );
        tile += xs * transpose(ys);
        bias += ys * vec4(1.0);
    }

    let own = 8u * local.y + local.x;
    tiles[own] = tile;
    biases[own] = bias;
    workgroupBarrier();
    if (local.y > 0u || out >= params.out_features) {
        return;
    }
    for (var other = own + 8u; other < 64u; other += 8u) {
        tile += tiles[other];
        bias += biases[other];
    }
    let weight = workgroup.z * (params.out_features * params.in_features + params.out_features);
    for (var o = 0u; o < min(params.out_features - out, 4u); o++) {
        for (var i = 0u; i < min(params.in_features - in_, 4u); i++) {
            put(weight + (out + o) * params.in_features + in_ + i, tile[o][i]);
        }
        if (in_ == 0u) {
            put(weight + params.out_features * params.in_features + out + o, bias[o]);
        }
    }
}
