// d_x[r, i] (+)= Σ_o W[o, i] d_y[r, o] for o in first_out .. end_out, weights at slots[first_group + r / rows_per_group] · weight_stride.
// One invocation computes 4 rows × 4 input features in registers, four output features at a time.
// d_y [groups, rows_per_group, out], weights [.., out·in + out], slots [..] → d_x [groups, rows_per_group, in].
// ACCUMULATES d_x where accumulate is 1, else OVERWRITES it.

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
@group(0) @binding(1) var<storage, read> d_y: array<f32>;
@group(0) @binding(2) var<storage, read> weights: array<f32>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read_write> d_x: array<f32>;

// Where the weights of a group begin, in elements.
fn weights_of(group: u32) -> u32 {
    if (params.weight_stride == 0u) {
        return 0u;
    }
    return slots[params.first_group + group] * params.weight_stride;
}

// The values at four indices.
fn d_y4(at: vec4<u32>) -> vec4<f32> {
    return vec4(d_y[at.x], d_y[at.y], d_y[at.z], d_y[at.w]);
}

fn w4(at: vec4<u32>) -> vec4<f32> {
    return vec4(weights[at.x], weights[at.y], weights[at.z], weights[at.w]);
}

@compute @workgroup_size(8, 8)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_id) local: vec3<u32>) {
    let tile_at = 4u * tile_index(workgroup, local, vec2(params.rows_per_group, params.in_features));
    let row = tile_at.x;
    let in_ = tile_at.y;
    let group = workgroup.z;
    if (row >= params.rows_per_group || in_ >= params.in_features || group >= params.groups) {
        return;
    }
    // Where four rows of d_y and four columns of W begin; the last one stands in for those beyond it, which are not stored.
    let n = params.in_features;
    let lane = vec4(0u, 1u, 2u, 3u);
    let y_row = (group * params.rows_per_group + min(row + lane, vec4(params.rows_per_group - 1u))) * params.out_features;
    let w_column = weights_of(group) + min(in_ + lane, vec4(n - 1u));

    // Columns are rows of d_x. Output features beyond the last one have weight zero.
    var tile: mat4x4<f32>;
    for (var o = params.first_out; o < params.end_out; o += 4u) {
        let at = min(o + lane, vec4(params.end_out - 1u));
        let inside = select(vec4(0.0), vec4(1.0), o + lane < vec4(params.end_out));
        let ys = mat4x4(d_y4(y_row.x + at), d_y4(y_row.y + at), d_y4(y_row.z + at), d_y4(y_row.w + at));
        let ws = mat4x4(
            w4(w_column + at.x * n) * inside.x,
            w4(w_column + at.y * n) * inside.y,
            w4(w_column + at.z * n) * inside.z,
            w4(w_column + at.w * n) * inside.w,
        );
        tile += ws * ys;
    }

    for (var r = 0u; r < min(params.rows_per_group - row, 4u); r++) {
        let values = tile[r];
        let first = (group * params.rows_per_group + row + r) * n + in_;
        for (var i = 0u; i < min(n - in_, 4u); i++) {
            if (params.accumulate == 1u) {
                d_x[first + i] += values[i];
            } else {
                d_x[first + i] = values[i];
            }
        }
    }
}
