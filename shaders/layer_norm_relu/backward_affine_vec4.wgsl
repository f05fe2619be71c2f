// partial[g, c] (+)= (Σ d_y x̂, Σ d_y) over the rows of chunk c of group g where y > 0; x̂ = (x - mean) rstd.
// One invocation sums four features over one chunk.
// x, d_y [rows, features], stats [rows, 2] = (mean, rstd), affine [2, features] = (gamma, beta) → partial [groups, chunks, 2, features]; features a multiple of 4.
// ACCUMULATES partial where accumulate is 1, else OVERWRITES it.

struct Params {
    rows: u32,
    rows_per_group: u32,
    features: u32,
    accumulate: u32,
    chunk_rows: u32,
    chunks: u32,
    centred: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> stats: array<f32>;
@group(0) @binding(3) var<storage, read> affine: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> d_y: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> partial: array<vec4<f32>>;

fn put(at: u32, sum: vec4<f32>) {
    var value = sum;
    if (params.accumulate == 1u) {
        value += partial[at];
    }
    partial[at] = value;
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let j = id.x;
    let group = id.y / params.chunks;
    let chunk = id.y % params.chunks;
    let n = params.features / 4u;
    let first = group * params.rows_per_group + chunk * params.chunk_rows;
    let end = min(first + params.chunk_rows, (group + 1u) * params.rows_per_group);
    if (j >= n || first >= params.rows) {
        return;
    }
    let gamma = affine[j];
    let beta = affine[n + j];
    var d_gamma = vec4(0.0);
    var d_beta = vec4(0.0);
    for (var row = first; row < end; row++) {
        let normalised = (x[row * n + j] - stats[2u * row]) * stats[2u * row + 1u];
        let e = select(vec4(0.0), d_y[row * n + j], gamma * normalised + beta > vec4(0.0));
        d_gamma += e * normalised;
        d_beta += e;
    }
    put(id.y * 2u * n + j, d_gamma);
    put(id.y * 2u * n + n + j, d_beta);
}
