// loss = √(S2 / n - (S1 / n)²), the standard deviation of the quality over the n = h2 · w2 pooled pixels (biased).
// One invocation computes one image.
// moments [images, 2] = (S1, S2) = (Σ (q - 1), Σ (q - 1)²) → loss [images].
// OVERWRITES loss.

struct Params {
    images: u32,
    width: u32,
    height: u32,
    chunk: u32,
    chunks: u32,
    scale: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> moments: array<f32>;
@group(0) @binding(2) var<storage, read_write> loss: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let image = flat_index(workgroup, workgroups, local);
    if (image >= params.images) {
        return;
    }
    let n = f32((params.width / 2u) * (params.height / 2u));
    let mean = moments[2u * image] / n;
    loss[image] = sqrt(max(moments[2u * image + 1u] / n - mean * mean, 0.0));
}
