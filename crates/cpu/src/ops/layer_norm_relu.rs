//! `y = relu(gamma x̂ + beta)`, `x̂ = (x - mean) rstd`, `rstd = 1/√(var + 1e-5)`.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;
use srn_shaders::LayerNormParams;

use super::chunk_of;
use crate::Real;
use crate::simd::vectorised;

const EPSILON: f64 = 1e-5;

/// Saves mean and rstd of every row in `stats`.
pub fn forward<T: Real>(p: LayerNormParams, x: &[T], affine: &[T], y: &mut [T], stats: &mut [T]) {
    let (rows, width) = (p.rows as usize, p.features as usize);
    let (x, affine, y, stats) = (&x[..rows * width], &affine[..2 * width], &mut y[..rows * width], &mut stats[..2 * rows]);
    if let [Some(x), Some(affine)] = [x, affine].map(T::singles)
        && let [Some(y), Some(stats)] = [&mut *y, &mut *stats].map(T::singles_mut)
    {
        return Arch::new().dispatch(Forward { width, x, affine, y, stats });
    }
    let (gamma, beta) = affine.split_at(width);
    let count = T::of(width as f64);
    for ((x, y), stats) in x.chunks_exact(width).zip(y.chunks_exact_mut(width)).zip(stats.chunks_exact_mut(2)) {
        let mean = x.iter().copied().sum::<T>() / count;
        let variance = x.iter().map(|&x| (x - mean) * (x - mean)).sum::<T>() / count;
        let rstd = T::one() / (variance + T::of(EPSILON)).sqrt();
        for (((y, &x), &gamma), &beta) in y.iter_mut().zip(x).zip(gamma).zip(beta) {
            let value = (x - mean) * rstd * gamma + beta;
            // A NaN is no number to hide: it goes on.
            *y = if value < T::zero() { T::zero() } else { value };
        }
        stats.copy_from_slice(&[mean, rstd]);
    }
}

/// [`forward`] with the processor's vectors: whole ones of a row, then what is left of it.
struct Forward<'a> {
    width: usize,
    x: &'a [f32],
    affine: &'a [f32],
    y: &'a mut [f32],
    stats: &'a mut [f32],
}

impl WithSimd for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let width = self.width;
        let (gamma, beta) = self.affine.split_at(width);
        let [(gamma, gamma_rest), (beta, beta_rest)] = [gamma, beta].map(S::as_simd_f32s);
        let count = width as f32;
        let zero = simd.splat_f32s(0.0);
        for ((x, y), stats) in self.x.chunks_exact(width).zip(self.y.chunks_exact_mut(width)).zip(self.stats.chunks_exact_mut(2))
        {
            let (x, x_rest) = S::as_simd_f32s(x);
            let (y, y_rest) = S::as_mut_simd_f32s(y);
            let (mut sum, mut squares) = (zero, zero);
            for &x in x {
                sum = simd.add_f32s(sum, x);
            }
            let mean = (simd.reduce_sum_f32s(sum) + x_rest.iter().sum::<f32>()) / count;
            let means = simd.splat_f32s(mean);
            for &x in x {
                let x = simd.sub_f32s(x, means);
                squares = simd.mul_add_e_f32s(x, x, squares);
            }
            let rest = x_rest.iter().map(|&x| (x - mean) * (x - mean)).sum::<f32>();
            let rstd = 1.0 / ((simd.reduce_sum_f32s(squares) + rest) / count + EPSILON as f32).sqrt();
            let rstds = simd.splat_f32s(rstd);
            for (((y, &x), &gamma), &beta) in y.iter_mut().zip(x).zip(gamma).zip(beta) {
                let normalised = simd.mul_f32s(simd.sub_f32s(x, means), rstds);
                let value = simd.mul_add_e_f32s(normalised, gamma, beta);
                *y = simd.select_f32s(simd.less_than_f32s(value, zero), zero, value);
            }
            for (((y, &x), &gamma), &beta) in y_rest.iter_mut().zip(x_rest).zip(gamma_rest).zip(beta_rest) {
                let value = (x - mean) * rstd * gamma + beta;
                *y = if value < 0.0 { 0.0 } else { value };
            }
            stats.copy_from_slice(&[mean, rstd]);
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
    {
        return Arch::new().dispatch(Backward { width, x, stats, affine, d_y, d_x });
    }
    let (gamma, beta) = affine.split_at(width);
    let count = T::of(width as f64);
    let rows = x.chunks_exact(width).zip(stats.chunks_exact(2)).zip(d_y.chunks_exact(width)).zip(d_x.chunks_exact_mut(width));
    for (((x, stats), d_y), d_x) in rows {
        let normalised = |x: T| (x - stats[0]) * stats[1];
        for ((((d_x, &x), &d_y), &gamma), &beta) in d_x.iter_mut().zip(x).zip(d_y).zip(gamma).zip(beta) {
            let live = normalised(x) * gamma + beta > T::zero();
            *d_x = if live { gamma * d_y } else { T::zero() };
        }
        let mean_e = d_x.iter().copied().sum::<T>() / count;
        let mean_ex = d_x.iter().zip(x).map(|(&e, &x)| e * normalised(x)).sum::<T>() / count;
        for (d_x, &x) in d_x.iter_mut().zip(x) {
            *d_x = stats[1] * (*d_x - mean_e - normalised(x) * mean_ex);
        }
    }
}

/// [`backward_input`] with the processor's vectors.
struct Backward<'a> {
    width: usize,
    x: &'a [f32],
    stats: &'a [f32],
    affine: &'a [f32],
    d_y: &'a [f32],
    d_x: &'a mut [f32],
}

impl WithSimd for Backward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let width = self.width;
        let (gamma, beta) = self.affine.split_at(width);
        let [(gamma, gamma_rest), (beta, beta_rest)] = [gamma, beta].map(S::as_simd_f32s);
        let count = width as f32;
        let zero = simd.splat_f32s(0.0);
        let rows = self.x.chunks_exact(width).zip(self.stats.chunks_exact(2));
        for (((x, stats), d_y), d_x) in rows.zip(self.d_y.chunks_exact(width)).zip(self.d_x.chunks_exact_mut(width)) {
            let [(x, x_rest), (d_y, d_y_rest)] = [x, d_y].map(S::as_simd_f32s);
            let (d_x, d_x_rest) = S::as_mut_simd_f32s(d_x);
            let [mean, rstd] = [stats[0], stats[1]];
            let (means, rstds) = (simd.splat_f32s(mean), simd.splat_f32s(rstd));
            let (mut sum, mut sum_x) = (zero, zero);
            for ((((d_x, &x), &d_y), &gamma), &beta) in d_x.iter_mut().zip(x).zip(d_y).zip(gamma).zip(beta) {
                let x = simd.mul_f32s(simd.sub_f32s(x, means), rstds);
                let live = simd.greater_than_f32s(simd.mul_add_e_f32s(x, gamma, beta), zero);
                let e = simd.select_f32s(live, simd.mul_f32s(gamma, d_y), zero);
                sum = simd.add_f32s(sum, e);
                sum_x = simd.mul_add_e_f32s(e, x, sum_x);
                *d_x = e;
            }
            let (mut rest, mut rest_x) = (0.0, 0.0);
            for ((((d_x, &x), &d_y), &gamma), &beta) in
                d_x_rest.iter_mut().zip(x_rest).zip(d_y_rest).zip(gamma_rest).zip(beta_rest)
            {
                let x = (x - mean) * rstd;
                let e = if x * gamma + beta > 0.0 { gamma * d_y } else { 0.0 };
                rest += e;
                rest_x += e * x;
                *d_x = e;
            }
            let mean_e = (simd.reduce_sum_f32s(sum) + rest) / count;
            let mean_ex = (simd.reduce_sum_f32s(sum_x) + rest_x) / count;
            let (means_e, means_ex) = (simd.splat_f32s(mean_e), simd.splat_f32s(mean_ex));
            for (d_x, &x) in d_x.iter_mut().zip(x) {
                let x = simd.mul_f32s(simd.sub_f32s(x, means), rstds);
                let e = simd.negate_mul_add_e_f32s(x, means_ex, simd.sub_f32s(*d_x, means_e));
                *d_x = simd.mul_f32s(rstds, e);
            }
            for (d_x, &x) in d_x_rest.iter_mut().zip(x_rest) {
                *d_x = rstd * (*d_x - mean_e - (x - mean) * rstd * mean_ex);
            }
        }
    }
}

/// Per chunk of rows: sums of `d_y x̂` and of `d_y`, where `y > 0`.
pub fn backward_affine<T: Real>(p: LayerNormParams, x: &[T], stats: &[T], affine: &[T], d_y: &[T], partial: &mut [T]) {
    let width = p.features as usize;
    partial[..2 * width * p.chunks as usize].par_chunks_mut(2 * width).enumerate().for_each(|(chunk, partial)| {
        let rows = chunk_of(chunk, p.chunk_rows, p.rows);
        let values = rows.start * width..rows.end * width;
        affine_rows(&x[values.clone()], &stats[2 * rows.start..2 * rows.end], affine, &d_y[values], partial);
    });
}

vectorised! {
    fn affine_rows<T: Real>(x: &[T], stats: &[T], affine: &[T], d_y: &[T], partial: &mut [T]) {
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
            *partial = T::of(sum);
        }
    }
}
