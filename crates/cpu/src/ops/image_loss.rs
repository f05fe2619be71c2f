//! MAE, MSE, norm_l1, norm_l2, Charbonnier: sums over an image's values times a normaliser.

use srn_shaders::ImageLossParams;

use super::chunk_of;
use crate::Real;

/// `ρ(e)`: `|e|` (MAE, norm_l1), `e²` (MSE, norm_l2), `√(e² + soft²) - soft` (Charbonnier).
fn rho<T: Real>(p: ImageLossParams, e: T) -> T {
    match p.kind {
        0 | 2 => e.abs(),
        1 | 3 => e * e,
        _ => {
            let soft = T::of_f32(p.soft);
            e * e / ((e * e + soft * soft).sqrt() + soft)
        }
    }
}

/// `ρ'(e)`, 0 where it has a kink.
fn slope<T: Real>(p: ImageLossParams, e: T) -> T {
    match p.kind {
        0 | 2 if e == T::zero() => T::zero(),
        0 | 2 => e.signum(),
        1 | 3 => e + e,
        _ => {
            let soft = T::of_f32(p.soft);
            e / (e * e + soft * soft).sqrt()
        }
    }
}

fn normaliser<T: Real>(p: ImageLossParams, count: T) -> T {
    T::one() / if matches!(p.kind, 2 | 3) { T::one() + count } else { T::of(p.values_per_image.into()) }
}

/// `f` of image, row and channel, times the row's weight, summed over each chunk of each image's rows.
fn sums<T: Real>(p: ImageLossParams, wanted: &[T], partial: &mut [T], f: impl Fn(usize, usize, usize) -> T) {
    for (index, partial) in partial.iter_mut().take((p.groups * p.chunks) as usize).enumerate() {
        let (group, chunk) = (index / p.chunks as usize, index % p.chunks as usize);
        let rows = chunk_of(chunk, p.chunk_rows, p.rows_per_group);
        let first = group * p.rows_per_group as usize;
        let row = |row: usize| (0..3).map(move |channel| (row, channel));
        let values = (first + rows.start..first + rows.end).flat_map(row);
        let sum = values.map(|(row, channel)| (wanted[4 * row + 3] * f(group, row, channel)).wide()).sum::<f64>();
        *partial = T::of(sum);
    }
}

/// Wanted values that are not exactly 1, by their weights.
pub fn count<T: Real>(p: ImageLossParams, wanted: &[T], partial: &mut [T]) {
    sums(p, wanted, partial, |_, row, channel| if wanted[4 * row + channel] == T::one() { T::zero() } else { T::one() });
}

/// Partial sums of the loss.
pub fn forward<T: Real>(p: ImageLossParams, rgb: &[T], wanted: &[T], count: &[T], partial: &mut [T]) {
    sums(p, wanted, partial, |group, row, channel| {
        let e = rgb[3 * row + channel] - wanted[4 * row + channel];
        normaliser(p, count[p.first_group as usize + group]) * rho(p, e)
    });
}

/// `d_rgb = scale · normaliser · w · ρ'(e)`.
pub fn backward<T: Real>(p: ImageLossParams, rgb: &[T], wanted: &[T], count: &[T], d_rgb: &mut [T]) {
    let values_per_group = 3 * p.rows_per_group as usize;
    for value in 0..p.groups as usize * values_per_group {
        let row = value / 3;
        let e = rgb[value] - wanted[value + row];
        let image = p.first_group as usize + value / values_per_group;
        d_rgb[value] = T::of_f32(p.scale) * normaliser(p, count[image]) * wanted[4 * row + 3] * slope(p, e);
    }
}
