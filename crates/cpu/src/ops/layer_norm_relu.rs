//! `y = relu(gamma x̂ + beta)`, `x̂ = (x - mean) rstd`, `rstd = 1/√(var + 1e-5)`.

use rayon::prelude::*;
use srn_shaders::LayerNormParams;

use super::{chunk_of, for_rows, for_rows2};
use crate::Real;
use crate::simd::{sum, vectorised};

const EPSILON: f64 = 1e-5;

/// Saves mean and rstd of every row in `stats`.
pub fn forward<T: Real>(p: LayerNormParams, x: &[T], affine: &[T], y: &mut [T], stats: &mut [T]) {
    let (rows, width) = (p.rows as usize, p.features as usize);
    for_rows2((&mut y[..rows * width], width), (&mut stats[..2 * rows], 2), |first, y, stats| {
        forward_rows(&x[first * width..], affine, y, stats);
    });
}

vectorised! {
    fn forward_rows<T: Real>(x: &[T], affine: &[T], y: &mut [T], stats: &mut [T]) {
        let width = affine.len() / 2;
        let (gamma, beta) = affine.split_at(width);
        let count = T::of(width as f64);
        for ((x, y), stats) in x.chunks_exact(width).zip(y.chunks_exact_mut(width)).zip(stats.chunks_exact_mut(2)) {
            let mean = sum(width, |i| x[i]) / count;
            let variance = sum(width, |i| (x[i] - mean) * (x[i] - mean)) / count;
            let rstd = T::one() / (variance + T::of(EPSILON)).sqrt();
            for i in 0..width {
                y[i] = ((x[i] - mean) * rstd * gamma[i] + beta[i]).max(T::zero());
            }
            stats[0] = mean;
            stats[1] = rstd;
        }
    }
}

/// With `e = gamma · d_y` where `y > 0`: `d_x = rstd (e - mean(e) - x̂ mean(e x̂))`.
pub fn backward_input<T: Real>(p: LayerNormParams, x: &[T], stats: &[T], affine: &[T], d_y: &[T], d_x: &mut [T]) {
    let (rows, width) = (p.rows as usize, p.features as usize);
    for_rows(&mut d_x[..rows * width], width, |first, d_x| {
        backward_rows(&x[first * width..], &stats[2 * first..], affine, &d_y[first * width..], d_x);
    });
}

vectorised! {
    fn backward_rows<T: Real>(x: &[T], stats: &[T], affine: &[T], d_y: &[T], d_x: &mut [T]) {
        let width = affine.len() / 2;
        let (gamma, beta) = affine.split_at(width);
        let count = T::of(width as f64);
        for (row, d_x) in d_x.chunks_exact_mut(width).enumerate() {
            let (x, d_y) = (&x[row * width..][..width], &d_y[row * width..][..width]);
            let [mean, rstd] = [stats[2 * row], stats[2 * row + 1]];
            let normalised = |i: usize| (x[i] - mean) * rstd;
            for i in 0..width {
                let live = normalised(i) * gamma[i] + beta[i] > T::zero();
                d_x[i] = if live { gamma[i] * d_y[i] } else { T::zero() };
            }
            let mean_e = sum(width, |i| d_x[i]) / count;
            let mean_ex = sum(width, |i| d_x[i] * normalised(i)) / count;
            for i in 0..width {
                d_x[i] = rstd * (d_x[i] - mean_e - normalised(i) * mean_ex);
            }
        }
    }
}

/// Per chunk of rows: sums of `d_y x̂` and of `d_y`, where `y > 0`.
pub fn backward_affine<T: Real>(p: LayerNormParams, x: &[T], stats: &[T], affine: &[T], d_y: &[T], partial: &mut [T]) {
    let width = p.features as usize;
    partial[..2 * width * p.chunks as usize].par_chunks_mut(2 * width).enumerate().for_each(|(chunk, partial)| {
        let rows = chunk_of(chunk, p.chunk_rows, p.rows);
        partial.fill(T::zero());
        let values = rows.start * width..rows.end * width;
        affine_rows(&x[values.clone()], &stats[2 * rows.start..2 * rows.end], affine, &d_y[values], partial);
    });
}

vectorised! {
    fn affine_rows<T: Real>(x: &[T], stats: &[T], affine: &[T], d_y: &[T], partial: &mut [T]) {
        let width = affine.len() / 2;
        let (gamma, beta) = affine.split_at(width);
        let (d_gamma, d_beta) = partial.split_at_mut(width);
        for ((x, d_y), stats) in x.chunks_exact(width).zip(d_y.chunks_exact(width)).zip(stats.chunks_exact(2)) {
            for i in 0..width {
                let normalised = (x[i] - stats[0]) * stats[1];
                let d = if normalised * gamma[i] + beta[i] > T::zero() { d_y[i] } else { T::zero() };
                d_gamma[i] += d * normalised;
                d_beta[i] += d;
            }
        }
    }
}
