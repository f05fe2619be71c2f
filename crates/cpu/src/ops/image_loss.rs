//! MAE, MSE, norm_l1, norm_l2: sums over an image's values times a normaliser.

use srn_shaders::ImageLossParams;

use super::chunk_of;
use crate::Real;

/// MSE and norm_l2 square the residual.
fn squares(p: ImageLossParams) -> bool {
    p.kind % 2 == 1
}

fn normaliser<T: Real>(p: ImageLossParams, count: T) -> T {
    T::one() / if p.kind < 2 { T::of(p.values_per_image.into()) } else { T::one() + count }
}

/// `f` summed over the values of each chunk of each image's rows.
fn sums<T: Real>(p: ImageLossParams, partial: &mut [T], f: impl Fn(usize, usize) -> T) {
    for (index, partial) in partial.iter_mut().take((p.groups * p.chunks) as usize).enumerate() {
        let (group, chunk) = (index / p.chunks as usize, index % p.chunks as usize);
        let rows = chunk_of(chunk, p.chunk_rows, p.rows_per_group);
        let first = group * p.rows_per_group as usize;
        let sum = (3 * (first + rows.start)..3 * (first + rows.end)).map(|value| f(group, value).wide()).sum::<f64>();
        *partial = T::of(sum);
    }
}

/// Target values that are not exactly 1.
pub fn count<T: Real>(p: ImageLossParams, target_rgb: &[T], partial: &mut [T]) {
    sums(p, partial, |_, value| if target_rgb[value] == T::one() { T::zero() } else { T::one() });
}

/// Partial sums of the loss.
pub fn forward<T: Real>(p: ImageLossParams, rgb: &[T], target_rgb: &[T], count: &[T], partial: &mut [T]) {
    sums(p, partial, |group, value| {
        let e = rgb[value] - target_rgb[value];
        normaliser(p, count[p.first_group as usize + group]) * if squares(p) { e * e } else { e.abs() }
    });
}

/// `d_rgb = scale · normaliser · sign(e)`, or `· 2e`.
pub fn backward<T: Real>(p: ImageLossParams, rgb: &[T], target_rgb: &[T], count: &[T], d_rgb: &mut [T]) {
    let values_per_group = 3 * p.rows_per_group as usize;
    for value in 0..p.groups as usize * values_per_group {
        let e = rgb[value] - target_rgb[value];
        let d = if squares(p) {
            e + e
        } else if e == T::zero() {
            T::zero()
        } else {
            e.signum()
        };
        let image = p.first_group as usize + value / values_per_group;
        d_rgb[value] = T::of_f32(p.scale) * normaliser(p, count[image]) * d;
    }
}
