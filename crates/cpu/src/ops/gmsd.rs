//! Gradient magnitude similarity deviation.

use srn_shaders::GmsdParams;

use super::chunk_of;
use crate::Real;

/// Luma weights of R, G, B.
const LUMA: [f64; 3] = [0.299, 0.587, 0.114];
/// Stabilises the quotient: `170 / 255²` for images in [0, 1].
const C: f64 = 170.0 / (255.0 * 255.0);

/// Sizes after pooling.
fn pooled(p: GmsdParams) -> (usize, usize) {
    ((p.width / 2) as usize, (p.height / 2) as usize)
}

/// To [0, 1], luma, 2×2 average.
pub fn pool<T: Real>(p: GmsdParams, rgb: &[T], luma: &mut [T]) {
    let (width, height) = pooled(p);
    for (index, luma) in luma.iter_mut().take(p.images as usize * width * height).enumerate() {
        let (image, y, x) = (index / (width * height), index / width % height, index % width);
        let pixel = |dy: usize, dx: usize| {
            let first = 3 * ((image * p.height as usize + 2 * y + dy) * p.width as usize + 2 * x + dx);
            (0..3).map(|channel| T::of(LUMA[channel]) * (rgb[first + channel] + T::one()) / T::of(2.0)).sum::<T>()
        };
        *luma = (pixel(0, 0) + pixel(0, 1) + pixel(1, 0) + pixel(1, 1)) / T::of(4.0);
    }
}

/// Value at `(x + dx, y + dy)`, zero outside.
fn at<T: Real>(map: &[T], (width, height): (usize, usize), (x, y): (usize, usize), dx: isize, dy: isize) -> T {
    match (x.checked_add_signed(dx), y.checked_add_signed(dy)) {
        (Some(x), Some(y)) if x < width && y < height => map[y * width + x],
        _ => T::zero(),
    }
}

/// Prewitt responses: right minus left, below minus above.
fn prewitt<T: Real>(map: &[T], size: (usize, usize), place: (usize, usize)) -> [T; 2] {
    let at = |dx, dy| at(map, size, place, dx, dy);
    let across = |along: fn(isize, isize) -> (isize, isize)| {
        let side = |sign: isize| -> T {
            (-1..=1)
                .map(|k| {
                    let (dx, dy) = along(sign, k);
                    at(dx, dy)
                })
                .sum()
        };
        (side(1) - side(-1)) / T::of(3.0)
    };
    [across(|sign, k| (sign, k)), across(|sign, k| (k, sign))]
}

fn magnitude<T: Real>([x, y]: [T; 2]) -> T {
    (x * x + y * y).sqrt()
}

fn denominator<T: Real>(a: T, b: T) -> T {
    a * a + b * b + T::of(C)
}

/// The image's part of a map, and the place in it.
fn locate<T>(map: &[T], (width, height): (usize, usize), index: usize) -> (&[T], (usize, usize)) {
    let pixels = width * height;
    (&map[index / pixels * pixels..][..pixels], (index % width, index / width % height))
}

/// `(2ab + c) / (a² + b² + c)`.
pub fn similarity<T: Real>(p: GmsdParams, luma: &[T], target_luma: &[T], quality: &mut [T]) {
    let size = pooled(p);
    for (index, quality) in quality.iter_mut().take(p.images as usize * size.0 * size.1).enumerate() {
        let [a, b] = [luma, target_luma].map(|map| {
            let (map, place) = locate(map, size, index);
            magnitude(prewitt(map, size, place))
        });
        *quality = (T::of(2.0) * a * b + T::of(C)) / denominator(a, b);
    }
}

/// Sums of `q - 1` and its square: `q` is near 1, the differences keep their digits.
pub fn moments<T: Real>(p: GmsdParams, quality: &[T], partial: &mut [T]) {
    let (width, height) = pooled(p);
    let pixels = width * height;
    for (index, partial) in partial.chunks_exact_mut(2).take((p.images * p.chunks) as usize).enumerate() {
        let (image, chunk) = (index / p.chunks as usize, index % p.chunks as usize);
        let values = &quality[image * pixels..][chunk_of(chunk, p.chunk, pixels as u32)];
        partial[0] = values.iter().map(|&q| q - T::one()).sum();
        partial[1] = values.iter().map(|&q| (q - T::one()).powi(2)).sum();
    }
}

/// Standard deviation of the quality map (population).
pub fn deviation<T: Real>(p: GmsdParams, moments: &[T], loss: &mut [T]) {
    let (width, height) = pooled(p);
    let n = T::of((width * height) as f64);
    for (moments, loss) in moments.chunks_exact(2).zip(loss).take(p.images as usize) {
        let mean = moments[0] / n;
        *loss = (moments[1] / n - mean * mean).max(T::zero()).sqrt();
    }
}

/// Gradient of `scale · loss` to the render's Prewitt responses.
pub fn backward_similarity<T: Real>(
    p: GmsdParams,
    luma: &[T],
    target_luma: &[T],
    quality: &[T],
    moments: &[T],
    loss: &[T],
    d_response: &mut [T],
) {
    let size = pooled(p);
    let pixels = size.0 * size.1;
    let n = T::of(pixels as f64);
    for index in 0..p.images as usize * pixels {
        let (image, pixel) = (index / pixels, index % pixels);
        let (map, place) = locate(luma, size, index);
        let response = prewitt(map, size, place);
        let (target_map, _) = locate(target_luma, size, index);
        let (a, b) = (magnitude(response), magnitude(prewitt(target_map, size, place)));
        let q = quality[index];
        let factor = if loss[image] > T::zero() && a > T::zero() {
            let d_q = T::of_f32(p.scale) * (q - T::one() - moments[2 * image] / n) / (n * loss[image]);
            d_q * T::of(2.0) * (b - a * q) / denominator(a, b) / a
        } else {
            T::zero()
        };
        for (axis, response) in response.into_iter().enumerate() {
            d_response[(2 * image + axis) * pixels + pixel] = factor * response;
        }
    }
}

/// Prewitt transposed, then pooling and luma.
pub fn backward_pool<T: Real>(p: GmsdParams, d_response: &[T], d_rgb: &mut [T]) {
    let size = pooled(p);
    let pixels = size.0 * size.1;
    let whole = (p.width * p.height) as usize;
    for (index, d_rgb) in d_rgb.chunks_exact_mut(3).take(p.images as usize * whole).enumerate() {
        let (image, y, x) = (index / whole, index / p.width as usize % p.height as usize, index % p.width as usize);
        let place = (x / 2, y / 2);
        let inside = place.0 < size.0 && place.1 < size.1;
        let d_luma = if inside {
            let map = |axis: usize| &d_response[(2 * image + axis) * pixels..][..pixels];
            // The stencil is odd: its transpose is its negative.
            -(prewitt(map(0), size, place)[0] + prewitt(map(1), size, place)[1])
        } else {
            T::zero()
        };
        for (d_rgb, weight) in d_rgb.iter_mut().zip(LUMA) {
            *d_rgb = d_luma * T::of(weight / 8.0);
        }
    }
}
