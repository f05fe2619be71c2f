// density[r] = Σ_k head[k] hidden[r, k] + head[in], phi[r, j] (+)= density[r] feature[r, j].
// One invocation computes every eighth vector of four values of a row; eight lanes of a subgroup add up what belongs to it.
// hidden [rows, in], head [in + 1], feature [rows, features] → density [rows], phi [rows, features]; in and features multiples of 4.
// OVERWRITES density; ACCUMULATES phi where accumulate is 1, else OVERWRITES it.

struct Params {
    rows: u32,
    in_features: u32,
    features: u32,
    accumulate: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> hidden: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> head: array<f32>;
@group(0) @binding(3) var<storage, read> feature: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> density: array<f32>;
@group(0) @binding(5) var<storage, read_write> phi: array<vec4<f32>>;

// Four weights of the head.
fn weights(k: u32) -> vec4<f32> {
    return vec4(head[4u * k], head[4u * k + 1u], head[4u * k + 2u], head[4u * k + 3u]);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_size) subgroup_size: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    let m = params.in_features / 4u;
    let n = params.features / 4u;
    let member = lane % 8u;
    let row = 8u * (workgroup.y * workgroups.x + workgroup.x) + (subgroup * subgroup_size + lane) / 8u;
    if (row >= params.rows) {
        return;
    }
    var sums = vec4(0.0);
    for (var k = member; k < m; k += 8u) {
        sums += weights(k) * hidden[row * m + k];
    }
    var sigma = dot(sums, vec4(1.0));
    sigma += subgroupShuffleXor(sigma, 1u);
    sigma += subgroupShuffleXor(sigma, 2u);
    sigma += subgroupShuffleXor(sigma, 4u);
    sigma += head[params.in_features];
    if (member == 0u) {
        density[row] = sigma;
    }
    for (var j = row * n + member; j < (row + 1u) * n; j += 8u) {
        var value = sigma * feature[j];
        if (params.accumulate == 1u) {
            value += phi[j];
        }
        phi[j] = value;
    }
}
