// c = σ(f) c_prev + σ(i) tanh(g), h = σ(o) tanh(c).
// One invocation computes one value of the hidden state.
// gates [rows, 4·hidden] in the order i, f, g, o before activation, c_prev [rows, hidden] → h, c [rows, hidden].
// OVERWRITES h and c.

struct Params {
    rows: u32,
    hidden: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> gates: array<f32>;
@group(0) @binding(2) var<storage, read> c_prev: array<f32>;
@group(0) @binding(3) var<storage, read_write> h: array<f32>;
@group(0) @binding(4) var<storage, read_write> c: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let index = flat_index(workgroup, workgroups, local);
    if (index >= params.rows * params.hidden) {
        return;
    }
    let gate = (index / params.hidden) * 4u * params.hidden + index % params.hidden;
    let i = sigmoid(gates[gate]);
    let f = sigmoid(gates[gate + params.hidden]);
    let g = stable_tanh(gates[gate + 2u * params.hidden]);
    let o = sigmoid(gates[gate + 3u * params.hidden]);
    let cell = f * c_prev[index] + i * g;
    c[index] = cell;
    h[index] = o * stable_tanh(cell);
}
