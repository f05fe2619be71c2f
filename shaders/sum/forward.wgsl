// y[first_group + g, j] (+)= Σ_t x[g, t, j].
// One invocation computes one value of y.
// x [groups, terms, count] → y [.., count].
// ACCUMULATES y where accumulate is 1, else OVERWRITES it.

struct Params {
    groups: u32,
    first_group: u32,
    terms: u32,
    count: u32,
    accumulate: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read_write> y: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let index = flat_index(workgroup, workgroups, local);
    if (index >= params.groups * params.count) {
        return;
    }
    let group = index / params.count;
    let first = group * params.terms * params.count + index % params.count;
    var total = 0.0;
    for (var t = 0u; t < params.terms; t++) {
        total += x[first + t * params.count];
    }
    let at = params.first_group * params.count + index;
    if (params.accumulate == 1u) {
        total += y[at];
    }
    y[at] = total;
}
