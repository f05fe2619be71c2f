// d_h' = clamp(d_h, ±10), d_cell = d_c + d_h' o (1 - tanh²c); d_c_prev = f d_cell; gates i, f, g, o: their share times σ' or tanh'.
// One invocation computes the four gates of one value of the hidden state.
// gates [rows, 4·hidden] before activation, c_prev, c, d_h, d_c [rows, hidden] → d_gates [rows, 4·hidden], d_c_prev [rows, hidden].
// OVERWRITES d_gates and d_c_prev.

struct Params {
    rows: u32,
    hidden: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> gates: array<f32>;
@group(0) @binding(2) var<storage, read> c_prev: array<f32>;
@group(0) @binding(3) var<storage, read> c: array<f32>;
@group(0) @binding(4) var<storage, read> d_h: array<f32>;
@group(0) @binding(5) var<storage, read> d_c: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_gates: array<f32>;
@group(0) @binding(7) var<storage, read_write> d_c_prev: array<f32>;

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
    let tanh_c = stable_tanh(c[index]);

    let d_hidden = clamp(d_h[index], -10.0, 10.0);
    let d_cell = d_c[index] + d_hidden * o * (1.0 - tanh_c * tanh_c);
    d_gates[gate] = d_cell * g * i * (1.0 - i);
    d_gates[gate + params.hidden] = d_cell * c_prev[index] * f * (1.0 - f);
    d_gates[gate + 2u * params.hidden] = d_cell * i * (1.0 - g * g);
    d_gates[gate + 3u * params.hidden] = d_hidden * tanh_c * o * (1.0 - o);
    d_c_prev[index] = d_cell * f;
}
