//! `phi = Σ_i density_i feature_i`, one point at a time.

use srn_shaders::PointParams;

use super::{for_rows, for_rows2};
use crate::Real;
use crate::simd::{sum, vectorised};

/// `phi (+)= density · feature`.
pub fn forward<T: Real>(p: PointParams, density: &[T], feature: &[T], phi: &mut [T]) {
    let (rows, width) = (p.rows as usize, p.features as usize);
    for_rows(&mut phi[..rows * width], width, |first, phi| {
        forward_rows(p.accumulate == 1, width, &density[first..], &feature[first * width..], phi);
    });
}

vectorised! {
    fn forward_rows<T: Real>(accumulate: bool, width: usize, density: &[T], feature: &[T], phi: &mut [T]) {
        for ((phi, feature), &density) in phi.chunks_exact_mut(width).zip(feature.chunks_exact(width)).zip(density) {
            for (phi, &feature) in phi.iter_mut().zip(feature) {
                let before = if accumulate { *phi } else { T::zero() };
                *phi = before + density * feature;
            }
        }
    }
}

/// `d_density = ⟨d_phi, feature⟩`, `d_feature = density · d_phi`.
pub fn backward<T: Real>(p: PointParams, density: &[T], feature: &[T], d_phi: &[T], d_density: &mut [T], d_feature: &mut [T]) {
    let (rows, width) = (p.rows as usize, p.features as usize);
    for_rows2((&mut d_feature[..rows * width], width), (&mut d_density[..rows], 1), |first, d_feature, d_density| {
        backward_rows(width, &density[first..], &feature[first * width..], &d_phi[first * width..], d_density, d_feature);
    });
}

vectorised! {
    fn backward_rows<T: Real>(width: usize, density: &[T], feature: &[T], d_phi: &[T], d_density: &mut [T], d_feature: &mut [T]) {
        for (row, (d_feature, d_density)) in d_feature.chunks_exact_mut(width).zip(d_density).enumerate() {
            let (feature, d_phi) = (&feature[row * width..][..width], &d_phi[row * width..][..width]);
            *d_density = sum(d_phi, feature, |d_phi, feature| d_phi * feature);
            for (d_feature, &d_phi) in d_feature.iter_mut().zip(d_phi) {
                *d_feature = density[row] * d_phi;
            }
        }
    }
}
