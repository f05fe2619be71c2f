// Weights of four features for each coordinate of the point, and their bias.
struct Weights {
    x: vec4<f32>,
    y: vec4<f32>,
    z: vec4<f32>,
    bias: vec4<f32>,
}

// Those of column `c`; zero beyond the row.
fn column(first: u32, c: u32) -> Weights {
    let n = params.features / 4u;
    let j = min(c, n - 1u);
    let p = weights[first + 3u * j];
    let q = weights[first + 3u * j + 1u];
    let r = weights[first + 3u * j + 2u];
    let inside = f32(c < n);
    return Weights(
        inside * vec4(p.x, p.w, q.z, r.y),
        inside * vec4(p.y, q.x, q.w, r.z),
        inside * vec4(p.z, q.y, r.x, r.w),
        inside * weights[first + 3u * n + j],
    );
}

// Sums over four features, if the vector is one of its own.
fn sums(w: Weights, counts: bool) -> vec4<f32> {
    let one = vec4(f32(counts));
    return vec4(dot(w.x, one), dot(w.y, one), dot(w.z, one), dot(w.bias, one));
}

// Weights less their mean: what they make has no mean. Zero beyond the row.
fn centred(w: Weights, mean: vec4<f32>, c: u32) -> Weights {
    let m = mean * f32(c < params.features / 4u);
    return Weights(w.x - m.x, w.y - m.y, w.z - m.z, w.bias - m.w);
}

fn linear(w: Weights, point: vec3<f32>) -> vec4<f32> {
    return w.x * point.x + w.y * point.y + w.z * point.z + w.bias;
}
