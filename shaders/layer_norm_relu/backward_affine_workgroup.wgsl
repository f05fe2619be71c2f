// partial[g, c] (+)= (Σ d_y x̂, Σ d_y) over the rows of chunk c of group g where y > 0; x̂ = (x - mean) rstd.
// One invocation sums four features over every eighth row of one chunk; the sums of eight are added in workgroup memory.
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

// What eight invocations have of four features of gamma and of beta, for eight such fours.
var<workgroup> d_gammas: array<vec4<f32>, 64>;
var<workgroup> d_betas: array<vec4<f32>, 64>;

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_id) local: vec3<u32>) {
    let part = workgroup.y;
    let group = part / params.chunks;
    let chunk = part % params.chunks;
    let n = params.features / 4u;
    let first = group * params.rows_per_group + chunk * params.chunk_rows;
    let end = min(first + params.chunk_rows, (group + 1u) * params.rows_per_group);
    // The last four stand in for those beyond them.
    let j = min(id.x, n - 1u);
    let gamma = affine[j];
    let beta = affine[n + j];
    var d_gamma = vec4(0.0);
    var d_beta = vec4(0.0);
    for (var row = first + local.y; row < end; row += 32u) {
        // Four rows at once, which a GPU waits for together.
        for (var k = 0u; k < 32u; k += 8u) {
            let here = min(row + k, end - 1u);
            let normalised = (x[here * n + j] - stats[2u * here]) * stats[2u * here + 1u];
            let passes = gamma * normalised + beta > vec4(0.0);
            let e = select(vec4(0.0), d_y[here * n + j], passes & vec4(row + k < end));
            d_gamma += e * normalised;
            d_beta += e;
        }
    }
    let own = 8u * local.y + local.x;
    d_gammas[own] = d_gamma;
    d_betas[own] = d_beta;
    workgroupBarrier();
    if (local.y > 0u || id.x >= n || first >= params.rows) {
        return;
    }
    for (var other = own + 8u; other < 64u; other += 8u) {
        d_gamma += d_gammas[other];
        d_beta += d_betas[other];
    }
    put(part * 2u * n + j, d_gamma);
    put(part * 2u * n + n + j, d_beta);
}
