// e = gamma d_y where y > 0, else 0; x̂ = (x - mean) rstd; d_x = rstd (e - mean(e) - x̂ mean(e x̂)), means over the features; of centred x without mean(e).
// One invocation computes one row, four features at a time.
// x, d_y [rows, features], stats [rows, 2] = (mean, rstd), affine [2, features] = (gamma, beta) → d_x [rows, features].
// OVERWRITES d_x.

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
@group(0) @binding(5) var<storage, read_write> d_x: array<vec4<f32>>;

fn d_normalised(at: u32, j: u32, normalised: vec4<f32>) -> vec4<f32> {
    let gamma = affine[j];
    return select(vec4(0.0), gamma * d_y[at + j], gamma * normalised + affine[params.features / 4u + j] > vec4(0.0));
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let row = flat_index(workgroup, workgroups, local);
    if (row >= params.rows) {
        return;
    }
    let n = params.features / 4u;
    let at = row * n;
    let mean = stats[2u * row];
    let rstd = stats[2u * row + 1u];

    var sum = vec4(0.0);
    var along = vec4(0.0);
    for (var j = 0u; j < n; j++) {
        let normalised = (x[at + j] - mean) * rstd;
        let e = d_normalised(at, j, normalised);
        sum += e;
        along += e * normalised;
    }
    let mean_e = select(0.0, dot(sum, vec4(1.0)) / f32(params.features), params.centred == 0u);
    let mean_along = dot(along, vec4(1.0)) / f32(params.features);

    for (var j = 0u; j < n; j++) {
        let normalised = (x[at + j] - mean) * rstd;
        d_x[at + j] = rstd * (d_normalised(at, j, normalised) - mean_e - normalised * mean_along);
    }
}
