// d_density[r] = ⟨d_phi[r], feature[r]⟩, d_feature[r] = density[r] d_phi[r], d_hidden[r, k] = d_density[r] head[k].
// One invocation computes every eighth vector of four values of a row; eight lanes of a subgroup add up what belongs to it.
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
    let sigma = density[row];
    var sums = vec4(0.0);
    for (var j = row * n + member; j < (row + 1u) * n; j += 8u) {
        let gradient = d_phi[j];
        sums += gradient * feature[j];
        d_feature[j] = sigma * gradient;
    }
    var total = dot(sums, vec4(1.0));
    total += subgroupShuffleXor(total, 1u);
    total += subgroupShuffleXor(total, 2u);
    total += subgroupShuffleXor(total, 4u);
    if (member == 0u) {
        d_density[row] = total;
    }
    for (var k = member; k < m; k += 8u) {
        d_hidden[row * m + k] = total * weights(k);
    }
}
