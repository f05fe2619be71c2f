// density[r] = Σ_k head[k] hidden[r, k] + head[in], phi[r, j] (+)= density[r] feature[r, j].
// One invocation computes one row.
// hidden [rows, in], head [in + 1], feature [rows, features] → density [rows], phi [rows, features].
// OVERWRITES density; ACCUMULATES phi where accumulate is 1, else OVERWRITES it.

struct Params {
    rows: u32,
    in_features: u32,
    features: u32,
    accumulate: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> hidden: array<f32>;
@group(0) @binding(2) var<storage, read> head: array<f32>;
@group(0) @binding(3) var<storage, read> feature: array<f32>;
@group(0) @binding(4) var<storage, read_write> density: array<f32>;
@group(0) @binding(5) var<storage, read_write> phi: array<f32>;

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
    let m = params.in_features;
    let n = params.features;
    var sigma = head[m];
    for (var k = 0u; k < m; k++) {
        sigma += head[k] * hidden[row * m + k];
    }
    density[row] = sigma;
    for (var j = row * n; j < (row + 1u) * n; j++) {
        var value = sigma * feature[j];
        if (params.accumulate == 1u) {
            value += phi[j];
        }
        phi[j] = value;
    }
}
