// Prewitt responses (x: right minus left, y: below minus above) at the centre of a 3×3 window; window[column][row].
fn prewitt(window: mat3x3<f32>) -> vec2<f32> {
    let across = window[2] - window[0];
    let down = window[0] + window[1] + window[2];
    return vec2(across.x + across.y + across.z, down.z - down.x) / 3.0;
}

// Weights of R, G and B in the YIQ luma.
const LUMA: vec3<f32> = vec3(0.299, 0.587, 0.114);

// Gradient magnitude similarity of two magnitudes and its constant.
const GMSD_C: f32 = 170.0 / (255.0 * 255.0);

fn gmsd_quality(a: f32, b: f32) -> f32 {
    return (2.0 * a * b + GMSD_C) / (a * a + b * b + GMSD_C);
}

// Index of the neighbour (i, j) of a pixel in images of `size` (width, height), (1, 1) being the pixel itself; OUTSIDE beyond
// the edge.
const OUTSIDE: u32 = 0xffffffffu;

fn neighbour(index: u32, size: vec2<u32>, i: u32, j: u32) -> u32 {
    let x = index % size.x + i;
    let y = (index / size.x) % size.y + j;
    let inside = x >= 1u && x <= size.x && y >= 1u && y <= size.y;
    return select(OUTSIDE, index + j * size.x + i - size.x - 1u, inside);
}
