// y[r, o] (+)= Σ_i W[o, i] x[r, i] + b[o], weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation computes 4 rows × 4 output features in registers, four input features at a time.
// x [groups, rows_per_group, in], weights [.., out·in + out], slots [..] → y [groups, rows_per_group, out].
// ACCUMULATES y where accumulate is 1, else OVERWRITES it.

struct Params {
    groups: u32,
    rows_per_group: u32,
    first_group: u32,
    in_features: u32,
    out_features: u32,
    weight_stride: u32,
    accumulate: u32,
    first_out: u32,
    end_out: u32,
    chunk_rows: u32,
    chunks: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read> weights: array<f32>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read_write> y: array<f32>;

// Where the weights of a group begin, in elements.
fn weights_of(group: u32) -> u32 {
    if (params.weight_stride == 0u) {
        return 0u;
    }
    return slots[params.first_group + group] * params.weight_stride;
}

// The values at four indices.
fn x4(at: vec4<u32>) -> vec4<f32> {
    return vec4(x[at.x], x[at.y], x[at.z], x[at.w]);
}

fn w4(at: vec4<u32>) -> vec4<f32> {
    return vec4(weights[at.x], weights[at.y], weights[at.z], weights[at.w]);
}

@compute @workgroup_size(8, 8)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_id) local: vec3<u32>) {
    let tile_at = 4u * tile_index(workgroup, local, vec2(params.rows_per_group, params.out_features));
    let row = tile_at.x;
    let out = tile_at.y;
    let group = workgroup.z;
    if (row >= params.rows_per_group || out >= params.out_features || group >= params.groups) {
        return;
    }
    // Where four rows of x and of W begin; the last one stands in for those beyond it, which are not stored.
    let n = params.in_features;
    let lane = vec4(0u, 1u, 2u, 3u);
    let x_row = (group * params.rows_per_group + min(row + lane, vec4(params.rows_per_group - 1u))) * n;
    let w_first = weights_of(group);
    let w_row = w_first + min(out + lane, vec4(params.out_features - 1u)) * n;

    // Columns are rows of y. Input features beyond the last one have weight zero.
    var tile: mat4x4<f32>;
    for (var i = 0u; i < n; i += 4u) {
        let at = min(i + lane, vec4(n - 1u));
        let inside = select(vec4(0.0), vec4(1.0), i + lane < vec4(n));
        let xs = mat4x4(x4(x_row.x + at), x4(x_row.y + at), x4(x_row.z + at), x4(x_row.w + at));
        let ws = mat4x4(w4(w_row.x + at) * inside, w4(w_row.y + at) * inside, w4(w_row.z + at) * inside, w4(w_row.w + at) * inside);
        tile += transpose(ws) * xs;
    }

    let bias = w4(w_first + params.out_features * n + min(out + lane, vec4(params.out_features - 1u)));
    for (var r = 0u; r < min(params.rows_per_group - row, 4u); r++) {
        let values = tile[r] + bias;
        let first = (group * params.rows_per_group + row + r) * params.out_features + out;
        for (var o = 0u; o < min(params.out_features - out, 4u); o++) {
            if (params.accumulate == 1u) {
                y[first + o] += values[o];
            } else {
                y[first + o] = values[o];
            }
        }
    }
}
