// d_h' = clamp(d_h, ±10), d_cell = d_c + d_h' o (1 - tanh²c); d_c_prev = f d_cell; gates i, f, g, o: their share times σ' or tanh'.
// One invocation computes the four gates of four values of the hidden state.
// gates [rows, 4·hidden] before activation, c_prev, c, d_h, d_c [rows, hidden] → d_gates [rows, 4·hidden], d_c_prev [rows, hidden]; hidden a multiple of 4.
// OVERWRITES d_gates and d_c_prev.

struct Params {
    rows: u32,
    hidden: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> gates: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> c_prev: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> c: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> d_h: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> d_c: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> d_gates: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> d_c_prev: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let index = flat_index(workgroup, workgroups, local);
    let n = params.hidden / 4u;
    if (index >= params.rows * n) {
        return;
    }
    let gate = (index / n) * 4u * n + index % n;
    let i = sigmoids(gates[gate]);
    let f = sigmoids(gates[gate + n]);
    let g = tangents(gates[gate + 2u * n]);
    let o = sigmoids(gates[gate + 3u * n]);
    let tanh_c = tangents(c[index]);

    let d_hidden = clamp(d_h[index], vec4(-10.0), vec4(10.0));
    let d_cell = d_c[index] + d_hidden * o * (1.0 - tanh_c * tanh_c);
    d_gates[gate] = d_cell * g * i * (1.0 - i);
    d_gates[gate + n] = d_cell * c_prev[index] * f * (1.0 - f);
    d_gates[gate + 2u * n] = d_cell * i * (1.0 - g * g);
    d_gates[gate + 3u * n] = d_hidden * tanh_c * o * (1.0 - o);
    d_c_prev[index] = d_cell * f;
}
