// m = β1 m + (1 - β1) g, v = β2 v + (1 - β2) g², value -= lr (m · schedule[1]) / (√(v · schedule[2]) + ε).
// One invocation updates one value.
// gradient [count], schedule [3] = (lr, 1 / (1 - β1ᵗ), 1 / (1 - β2ᵗ)) → value, m, v [count].
// ACCUMULATES value, m and v: they are updated in place.

struct Params {
    count: u32,
    beta1: f32,
    beta2: f32,
    one_minus_beta1: f32,
    one_minus_beta2: f32,
    epsilon: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> gradient: array<f32>;
@group(0) @binding(2) var<storage, read> schedule: array<f32>;
@group(0) @binding(3) var<storage, read_write> value: array<f32>;
@group(0) @binding(4) var<storage, read_write> m: array<f32>;
@group(0) @binding(5) var<storage, read_write> v: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let i = flat_index(workgroup, workgroups, local);
    if (i >= params.count) {
        return;
    }
    let g = gradient[i];
    let first = params.beta1 * m[i] + params.one_minus_beta1 * g;
    let second = params.beta2 * v[i] + params.one_minus_beta2 * g * g;
    m[i] = first;
    v[i] = second;
    value[i] -= schedule[0] * (first * schedule[1]) / (sqrt(second * schedule[2]) + params.epsilon);
}
