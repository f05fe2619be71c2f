// partial[g, c] (+)= (Σ_r d_y[r, o] x[r, i], Σ_r d_y[r, o]) over the rows r of chunk c of group g: weight, then bias.
// One invocation computes 8 output × 8 input features in registers, four rows at a time.
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

// A 4×4 block of four rows, as columns; rows beyond the chunk are those of the last one, times zero for d_y.
fn x_columns(row: vec4<u32>, i: u32) -> mat4x4<f32> {
    let at = row * (params.in_features / 4u) + i;
    return mat4x4(x[at.x], x[at.y], x[at.z], x[at.w]);
}

fn d_y_columns(row: vec4<u32>, o: u32, inside: vec4<f32>) -> mat4x4<f32> {
    let at = row * (params.out_features / 4u) + o;
    return mat4x4(d_y[at.x] * inside.x, d_y[at.y] * inside.y, d_y[at.z] * inside.z, d_y[at.w] * inside.w);
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
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_id) local: vec3<u32>) {
    let tile_at = 8u * tile_index(workgroup, local, vec2(params.out_features, params.in_features));
    let out = tile_at.x;
    let in_ = tile_at.y;
    let group = workgroup.z / params.chunks;
    let chunk = workgroup.z % params.chunks;
    if (out >= params.out_features || in_ >= params.in_features || group >= params.groups) {
        return;
    }
    let first = group * params.rows_per_group + chunk * params.chunk_rows;
    let end = min(first + params.chunk_rows, (group + 1u) * params.rows_per_group);
    let lane = vec4(0u, 1u, 2u, 3u);
    let i_a = in_ / 4u;
    let i_b = min(i_a + 1u, params.in_features / 4u - 1u);
    let o_a = out / 4u;
    let o_b = min(o_a + 1u, params.out_features / 4u - 1u);

    var w_aa: mat4x4<f32>;
    var w_ab: mat4x4<f32>;
    var w_ba: mat4x4<f32>;
    var w_bb: mat4x4<f32>;
    var bias_a = vec4(0.0);
    var bias_b = vec4(0.0);
    for (var r = first; r < end; r += 4u) {
        let row = min(r + lane, vec4(end - 1u));
        let inside = select(vec4(0.0), vec4(1.0), r + lane < vec4(end));
        let xa = x_columns(row, i_a);
        let xb = x_columns(row, i_b);
        let ya = d_y_columns(row, o_a, inside);
        let yb = d_y_columns(row, o_b, inside);
        w_aa += xa * transpose(ya);
        w_ab += xb * transpose(ya);
        w_ba += xa * transpose(yb);
        w_bb += xb * transpose(yb);
        bias_a += ya * vec4(1.0);
        bias_b += yb * vec4(1.0);
    }
    let weight = workgroup.z * (params.out_features * params.in_features + params.out_features) / 4u;
    store(weight, out, in_, w_aa);
    store(weight, out, in_ + 4u, w_ab);
    store(weight, out + 4u, in_, w_ba);
    store(weight, out + 4u, in_ + 4u, w_bb);
    if (in_ == 0u) {
        let bias = weight + params.out_features * params.in_features / 4u;
        put(bias + out / 4u, bias_a);
        if (out + 4u < params.out_features) {
            put(bias + out / 4u + 1u, bias_b);
        }
    }
}
