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
    chunk_outs: u32,
    chunk_rows: u32,
    chunks: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> d_y: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> partial: array<vec4<f32>>;

// Sixteen rows of a tile, each of 64 output features and of 64 input features, in vectors of four.
var<workgroup> y_tile: array<vec4<f32>, 256>;
var<workgroup> x_tile: array<vec4<f32>, 256>;
// What an invocation computes: output features 4 ly and 32 + 4 ly, a and b, input features 4 lx and 32 + 4 lx, and the sums over rows of d_y.
struct Sums {
    aa: mat4x4<f32>,
    ab: mat4x4<f32>,
    ba: mat4x4<f32>,
    bb: mat4x4<f32>,
    a: vec4<f32>,
    b: vec4<f32>,
}

// Adds the products of row k of the sixteen.
fn multiply_add(sums: ptr<function, Sums>, local: vec3<u32>, k: u32) {
    let ya = y_tile[16u * k + local.y];
    let yb = y_tile[16u * k + local.y + 8u];
    let xa = x_tile[16u * k + local.x];
    let xb = x_tile[16u * k + local.x + 8u];
    (*sums).aa[0] += xa * ya[0];
    (*sums).ab[0] += xb * ya[0];
    (*sums).aa[1] += xa * ya[1];
    (*sums).ab[1] += xb * ya[1];
    (*sums).aa[2] += xa * ya[2];
    (*sums).ab[2] += xb * ya[2];
    (*sums).aa[3] += xa * ya[3];
    (*sums).ab[3] += xb * ya[3];
    (*sums).ba[0] += xa * yb[0];
    (*sums).bb[0] += xb * yb[0];
    (*sums).ba[1] += xa * yb[1];
    (*sums).bb[1] += xb * yb[1];
    (*sums).ba[2] += xa * yb[2];
    (*sums).bb[2] += xb * yb[2];
    (*sums).ba[3] += xa * yb[3];
    (*sums).bb[3] += xb * yb[3];
    (*sums).a += ya;
    (*sums).b += yb;
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
    let to = 64u * (index / 16u) + index % 16u;

    var sums: Sums;
    for (var first = begin; first < end; first += 16u) {
        let row = first + 4u * (index / 16u) + vec4(0u, 1u, 2u, 3u);
        let x_at = min(row, vec4(end - 1u)) * x_stride + x_column;
        let y_at = min(row, vec4(end - 1u)) * y_stride + y_column;
        // Nothing beyond the last row.
        let within = select(vec4(0.0), vec4(1.0), row < vec4(end));
        workgroupBarrier();
        x_tile[to] = x[x_at.x];
        x_tile[to + 16u] = x[x_at.y];
        x_tile[to + 32u] = x[x_at.z];
        x_tile[to + 48u] = x[x_at.w];
        y_tile[to] = d_y[y_at.x] * within.x;
        y_tile[to + 16u] = d_y[y_at.y] * within.y;
        y_tile[to + 32u] = d_y[y_at.z] * within.z;
        y_tile[to + 48u] = d_y[y_at.w] * within.w;
        workgroupBarrier();
        multiply_add(&sums, local, 0u);
        multiply_add(&sums, local, 1u);
        multiply_add(&sums, local, 2u);
        multiply_add(&sums, local, 3u);
        multiply_add(&sums, local, 4u);
        multiply_add(&sums, local, 5u);
        multiply_add(&sums, local, 6u);
        multiply_add(&sums, local, 7u);
        multiply_add(&sums, local, 8u);
        multiply_add(&sums, local, 9u);
        multiply_add(&sums, local, 10u);
        multiply_add(&sums, local, 11u);
        multiply_add(&sums, local, 12u);
        multiply_add(&sums, local, 13u);
        multiply_add(&sums, local, 14u);
        multiply_add(&sums, local, 15u);
    }
    let out = first_out + 4u * local.y;
    let in_ = first_in + 4u * local.x;
    let weight = workgroup.z * (params.out_features * params.in_features + params.out_features) / 4u;
    store(weight, out, in_, sums.aa);
    store(weight, out, in_ + 32u, sums.ab);
    store(weight, out + 32u, in_, sums.ba);
    store(weight, out + 32u, in_ + 32u, sums.bb);
    if (in_ == 0u && out < params.out_features) {
        let bias = weight + (params.out_features * params.in_features + out) / 4u;
        put(bias, sums.a);
        if (out + 32u < params.out_features) {
            put(bias + 8u, sums.b);
        }
    }
}
