//! `y = relu(gamma x̂ + beta)`, `x̂ = (x - mean) rstd`, `rstd = 1/√(var + 1e-5)`. Where `x` is centred, `mean` is 0, and `mean(e)` counts as 0.

use pulp::{Arch, Simd, WithSimd};
use srn_shaders::LayerNormParams;

use crate::Real;
use crate::simd::{sum, vectorised};

/// Added to the variance.
pub(super) const EPSILON: f64 = 1e-5;

/// Saves mean and rstd of every row in `stats`.
pub fn forward<T: Real>(p: LayerNormParams, x: &[T], affine: &[T], y: &mut [T], stats: &mut [T]) {
    let (rows, width) = (p.rows as usize, p.features as usize);
    let (x, affine, y, stats) = (&x[..rows * width], &affine[..2 * width], &mut y[..rows * width], &mut stats[..2 * rows]);
    if let [Some(x), Some(affine)] = [x, affine].map(T::singles)
        && let [Some(y), Some(stats)] = [&mut *y, &mut *stats].map(T::singles_mut)
        && match p.centred {
            1 => Arch::new().dispatch(InRegisters { width, rows: Forward::<true> { x, affine, y, stats } }),
            _ => Arch::new().dispatch(InRegisters { width, rows: Forward::<false> { x, affine, y, stats } }),
        }
    {
        return;
    }
    forward_rows(p.centred == 1, x, affine, y, stats);
}

vectorised! {
    fn forward_rows<T: Real>(centred: bool, x: &[T], affine: &[T], y: &mut [T], stats: &mut [T]) {
        let width = affine.len() / 2;
        let (gamma, beta) = affine.split_at(width);
        let count = T::of(width as f64);
        for ((x, y), stats) in x.chunks_exact(width).zip(y.chunks_exact_mut(width)).zip(stats.chunks_exact_mut(2)) {
            let mean = if centred { T::zero() } else { sum(x, x, |x, _| x) / count };
            let variance = sum(x, x, |x, _| (x - mean) * (x - mean)) / count;
            let rstd = T::one() / (variance + T::of(EPSILON)).sqrt();
            for (((y, &x), &gamma), &beta) in y.iter_mut().zip(x).zip(gamma).zip(beta) {
                let value = (x - mean) * rstd * gamma + beta;
                // A NaN is no number to hide: it goes on.
                *y = if value < T::zero() { T::zero() } else { value };
            }
            stats.copy_from_slice(&[mean, rstd]);
        }
    }
}

/// Rows that are whole numbers of the processor's vectors, few enough to stay in registers.
trait Rows {
    /// All rows, of `V` vectors each.
    fn run<S: Simd, const V: usize>(self, simd: S);
}

/// Runs `rows` of `width` values, if they are such rows, and says whether they are.
struct InRegisters<R> {
    width: usize,
    rows: R,
}

impl<R: Rows> WithSimd for InRegisters<R> {
    type Output = bool;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> bool {
        match self.width / S::F32_LANES {
            _ if !self.width.is_multiple_of(S::F32_LANES) => return false,
            1 => self.rows.run::<S, 1>(simd),
            2 => self.rows.run::<S, 2>(simd),
            3 => self.rows.run::<S, 3>(simd),
            4 => self.rows.run::<S, 4>(simd),
            6 => self.rows.run::<S, 6>(simd),
            8 => self.rows.run::<S, 8>(simd),
            12 => self.rows.run::<S, 12>(simd),
            16 => self.rows.run::<S, 16>(simd),
            // More than there are registers, where vectors are short; the rest is in the first cache.
            32 => self.rows.run::<S, 32>(simd),
            64 => self.rows.run::<S, 64>(simd),
            _ => return false,
        }
        true
    }
}

fn rows_of<S: Simd, const V: usize>(values: &[f32]) -> &[[S::f32s; V]] {
    S::as_simd_f32s(values).0.as_chunks().0
}

/// Sums that take turns, so that none waits for the one before.
const SUMS: usize = 4;

/// What they add up to.
#[inline(always)]
fn total<S: Simd>(simd: S, [a, b, c, d]: [S::f32s; SUMS]) -> f32 {
    simd.reduce_sum_f32s(simd.add_f32s(simd.add_f32s(a, b), simd.add_f32s(c, d)))
}

/// [`forward`] with the processor's vectors, for rows of so many that they stay in registers.
struct Forward<'a, const CENTRED: bool> {
    x: &'a [f32],
    affine: &'a [f32],
    y: &'a mut [f32],
    stats: &'a mut [f32],
}

impl<const CENTRED: bool> Rows for Forward<'_, CENTRED> {
    #[inline(always)]
    fn run<S: Simd, const V: usize>(self, simd: S) {
        let inverse = 1.0 / (V * S::F32_LANES) as f32;
        let zero = simd.splat_f32s(0.0);
        let [gamma, beta] = rows_of::<S, V>(self.affine) else { unreachable!("two rows") };
        let y = S::as_mut_simd_f32s(self.y).0.as_chunks_mut::<V>().0;
        for ((x, y), stats) in rows_of::<S, V>(self.x).iter().zip(y).zip(self.stats.as_chunks_mut().0) {
            let mut mean = 0.0;
            if !CENTRED {
                let mut sums = [zero; SUMS];
                for first in (0..V).step_by(SUMS) {
                    for (sum, v) in sums.iter_mut().zip(first..V) {
                        *sum = simd.add_f32s(*sum, x[v]);
                    }
                }
                mean = total(simd, sums) * inverse;
            }
            let means = simd.splat_f32s(mean);
            let mut squares = [zero; SUMS];
            for first in (0..V).step_by(SUMS) {
                for (sum, v) in squares.iter_mut().zip(first..V) {
                    let centred = if CENTRED { x[v] } else { simd.sub_f32s(x[v], means) };
                    *sum = simd.mul_add_e_f32s(centred, centred, *sum);
                }
            }
            let rstd = 1.0 / (total(simd, squares) * inverse + EPSILON as f32).sqrt();
            for v in 0..V {
                let centred = if CENTRED { x[v] } else { simd.sub_f32s(x[v], means) };
                let normalised = simd.mul_f32s(centred, simd.splat_f32s(rstd));
                let value = simd.mul_add_e_f32s(normalised, gamma[v], beta[v]);
                // In this order a NaN goes on.
                y[v] = simd.max_f32s(zero, value);
            }
            *stats = [mean, rstd];
        }
    }
}

/// With `e = gamma · d_y` where `y > 0`: `d_x = rstd (e - mean(e) - x̂ mean(e x̂))`.
pub fn backward_input<T: Real>(p: LayerNormParams, x: &[T], stats: &[T], affine: &[T], d_y: &[T], d_x: &mut [T]) {
    let (rows, width) = (p.rows as usize, p.features as usize);
    let [x, d_y] = [x, d_y].map(|values| &values[..rows * width]);
    let (stats, affine, d_x) = (&stats[..2 * rows], &affine[..2 * width], &mut d_x[..rows * width]);
    if let [Some(x), Some(stats), Some(affine), Some(d_y)] = [x, stats, affine, d_y].map(T::singles)
        && let Some(d_x) = T::singles_mut(&mut *d_x)
        && match p.centred {
            1 => Arch::new().dispatch(InRegisters { width, rows: Backward::<true> { x, stats, affine, d_y, d_x } }),
            _ => Arch::new().dispatch(InRegisters { width, rows: Backward::<false> { x, stats, affine, d_y, d_x } }),
        }
    {
        return;
    }
    backward_rows(p.centred == 1, x, stats, affine, d_y, d_x);
}

vectorised! {
    fn backward_rows<T: Real>(centred: bool, x: &[T], stats: &[T], affine: &[T], d_y: &[T], d_x: &mut [T]) {
        let width = affine.len() / 2;
        let (gamma, beta) = affine.split_at(width);
        let count = T::of(width as f64);
        let rows = x.chunks_exact(width).zip(stats.chunks_exact(2)).zip(d_y.chunks_exact(width)).zip(d_x.chunks_exact_mut(width));
        for (((x, stats), d_y), d_x) in rows {
            let normalised = |x: T| (x - stats[0]) * stats[1];
            for ((((d_x, &x), &d_y), &gamma), &beta) in d_x.iter_mut().zip(x).zip(d_y).zip(gamma).zip(beta) {
                let live = normalised(x) * gamma + beta > T::zero();
                *d_x = if live { gamma * d_y } else { T::zero() };
            }
            let mean_e = if centred { T::zero() } else { sum(d_x, d_x, |e, _| e) / count };
            let mean_ex = sum(d_x, x, |e, x| e * normalised(x)) / count;
            for (d_x, &x) in d_x.iter_mut().zip(x) {
                *d_x = stats[1] * (*d_x - mean_e - normalised(x) * mean_ex);
            }
        }
    }
}

/// Vectors of `e` that surely stay in registers.
const FEW: usize = 4;

/// [`backward_input`] with the processor's vectors, as [`Forward`].
struct Backward<'a, const CENTRED: bool> {
    x: &'a [f32],
    stats: &'a [f32],
    affine: &'a [f32],
    d_y: &'a [f32],
    d_x: &'a mut [f32],
}

impl<const CENTRED: bool> Rows for Backward<'_, CENTRED> {
    #[inline(always)]
    fn run<S: Simd, const V: usize>(self, simd: S) {
        let inverse = 1.0 / (V * S::F32_LANES) as f32;
        let zero = simd.splat_f32s(0.0);
        let [gamma, beta] = rows_of::<S, V>(self.affine) else { unreachable!("two rows") };
        let d_x = S::as_mut_simd_f32s(self.d_x).0.as_chunks_mut::<V>().0;
        let rows = rows_of::<S, V>(self.x).iter().zip(self.stats.as_chunks().0).zip(rows_of::<S, V>(self.d_y)).zip(d_x);
        for (((x, &[mean, rstd]), d_y), d_x) in rows {
            let (means, rstds) = (simd.splat_f32s(mean), simd.splat_f32s(rstd));
            let (mut sums, mut along, mut es) = ([zero; SUMS], [zero; SUMS], [zero; FEW]);
            for first in (0..V).step_by(SUMS) {
                for ((sum, along), v) in sums.iter_mut().zip(&mut along).zip(first..V) {
                    let centred = if CENTRED { x[v] } else { simd.sub_f32s(x[v], means) };
                    let normalised = simd.mul_f32s(centred, rstds);
                    let live = simd.greater_than_f32s(simd.mul_add_e_f32s(normalised, gamma[v], beta[v]), zero);
                    let e = simd.select_f32s(live, simd.mul_f32s(gamma[v], d_y[v]), zero);
                    if !CENTRED {
                        *sum = simd.add_f32s(*sum, e);
                    }
                    *along = simd.mul_add_e_f32s(e, centred, *along);
                    if V <= FEW { es[v] = e } else { d_x[v] = e }
                }
            }
            let mean_e = if CENTRED { zero } else { simd.splat_f32s(total(simd, sums) * inverse) };
            // x̂ mean(e x̂) is x - mean times this.
            let along = simd.splat_f32s(total(simd, along) * inverse * rstd * rstd);
            for v in 0..V {
                let centred = if CENTRED { x[v] } else { simd.sub_f32s(x[v], means) };
                let e = if V <= FEW { es[v] } else { d_x[v] };
                let e = if CENTRED { e } else { simd.sub_f32s(e, mean_e) };
                d_x[v] = simd.mul_f32s(rstds, simd.negate_mul_add_e_f32s(centred, along, e));
            }
        }
    }
}

/// Per group and chunk of rows: sums of `d_y x̂` and of `d_y`, where `y > 0`.
pub fn backward_affine<T: Real>(p: LayerNormParams, x: &[T], stats: &[T], affine: &[T], d_y: &[T], partial: &mut [T]) {
    let [rows, width, of_group, chunk] = [p.rows, p.features, p.rows_per_group, p.chunk_rows].map(|size| size as usize);
    let firsts =
        (0..rows).step_by(of_group).flat_map(|group| (group..group + of_group).step_by(chunk).map(move |row| (group, row)));
    for ((group, first), partial) in firsts.zip(partial.chunks_exact_mut(2 * width)) {
        let end = (first + chunk).min(group + of_group);
        let values = first * width..end * width;
        affine_rows(p.accumulate == 1, &x[values.clone()], &stats[2 * first..2 * end], affine, &d_y[values], partial);
    }
}

vectorised! {
    fn affine_rows<T: Real>(accumulate: bool, x: &[T], stats: &[T], affine: &[T], d_y: &[T], partial: &mut [T]) {
        let width = affine.len() / 2;
        let (gamma, beta) = affine.split_at(width);
        let (mut d_gamma, mut d_beta) = (vec![0.0; width], vec![0.0; width]);
        for ((x, d_y), stats) in x.chunks_exact(width).zip(d_y.chunks_exact(width)).zip(stats.chunks_exact(2)) {
            let d_affine = d_gamma.iter_mut().zip(&mut d_beta);
            for ((((d_gamma, d_beta), (&x, &d_y)), &gamma), &beta) in d_affine.zip(x.iter().zip(d_y)).zip(gamma).zip(beta) {
                let normalised = (x - stats[0]) * stats[1];
                let d = if normalised * gamma + beta > T::zero() { d_y } else { T::zero() };
                *d_gamma += (d * normalised).wide();
                *d_beta += d.wide();
            }
        }
        for (partial, &sum) in partial.iter_mut().zip(d_gamma.iter().chain(&d_beta)) {
            *partial = T::of(sum + if accumulate { partial.wide() } else { 0.0 });
        }
    }
}
