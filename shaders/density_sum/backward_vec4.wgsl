// d_density[r] = ⟨d_phi[r], feature[r]⟩, d_feature[r] = density[r] d_phi[r], d_hidden[r, k] = d_density[r] head[k].
// One invocation computes one row, four values at a time.
// density [rows], feature, d_phi [rows, features], head [in + 1] → d_density [rows], d_feature [rows, features], d_hidden [rows, in]; in and features multiples of 4.
// OVERWRITES d_density, d_feature and d_hidden.

struct Params {
    rows: u32,
    in_features: u32,
    features: u32,
    accumulate: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> density: array<f32>;
@group(0) @binding(2) var<storage, read> feature: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> d_phi: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> head: array<f32>;
@group(0) @binding(5) var<storage, read_write> d_density: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_feature: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> d_hidden: array<vec4<f32>>;

// Four weights of the head.
fn weights(k: u32) -> vec4<f32> {
    return vec4(head[4u * k], head[4u * k + 1u], head[4u * k + 2u], head[4u * k + 3u]);
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
    let m = params.in_features / 4u;
    let n = params.features / 4u;
    let sigma = density[row];
    var sums = vec4(0.0);
    for (var j = row * n; j < (row + 1u) * n; j++) {
        sums += d_phi[j] * feature[j];
        d_feature[j] = sigma * d_phi[j];
    }
    let total = dot(sums, vec4(1.0));
    d_density[row] = total;
    for (var k = 0u; k < m; k++) {
        d_hidden[row * m + k] = total * weights(k);
    }
}
