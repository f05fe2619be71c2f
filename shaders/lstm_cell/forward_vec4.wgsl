// c = σ(f) c_prev + σ(i) tanh(g), h = σ(o) tanh(c).
// One invocation computes four values of the hidden state.
// gates [rows, 4·hidden] in the order i, f, g, o before activation, c_prev [rows, hidden] → h, c [rows, hidden]; hidden a multiple of 4.
// OVERWRITES h and c.

struct Params {
    rows: u32,
    hidden: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> gates: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> c_prev: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> h: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> c: array<vec4<f32>>;

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
    let cell = f * c_prev[index] + i * g;
    c[index] = cell;
    h[index] = o * tangents(cell);
}
