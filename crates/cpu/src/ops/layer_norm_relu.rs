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
            let mean = sum(x, x, |x, _| x) / count;
            let variance = sum(x, x, |x, _| (x - mean) * (x - mean)) / count;
            let rstd = T::one() / (variance + T::of(EPSILON)).sqrt();
            for (((y, &x), &gamma), &beta) in y.iter_mut().zip(x).zip(gamma).zip(beta) {
                let value = (x - mean) * rstd * gamma + beta;
                // A NaN is no number to hide: it goes on.
                *y = if value < T::zero() { T::zero() } else { value };
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
            let normalised = |x: T| (x - mean) * rstd;
            for ((((d_x, &x), &d_y), &gamma), &beta) in d_x.iter_mut().zip(x).zip(d_y).zip(gamma).zip(beta) {
                let live = normalised(x) * gamma + beta > T::zero();
                *d_x = if live { gamma * d_y } else { T::zero() };
            }
            let mean_e = sum(d_x, d_x, |e, _| e) / count;
            let mean_ex = sum(d_x, x, |e, x| e * normalised(x)) / count;
            for (d_x, &x) in d_x.iter_mut().zip(x) {
                *d_x = rstd * (*d_x - mean_e - normalised(x) * mean_ex);
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
