//! `phi = Σ_i density_i feature_i`, one point at a time.

use srn_shaders::PointParams;

use crate::Real;
use crate::simd::{sum, vectorised};

vectorised! {
    /// `phi (+)= density · feature`.
    pub fn forward<T: Real>(p: PointParams, density: &[T], feature: &[T], phi: &mut [T]) {
        let (rows, width, accumulate) = (p.rows as usize, p.features as usize, p.accumulate == 1);
        for ((phi, feature), &density) in phi.chunks_exact_mut(width).zip(feature.chunks_exact(width)).zip(density).take(rows) {
            for (phi, &feature) in phi.iter_mut().zip(feature) {
                let before = if accumulate { *phi } else { T::zero() };
                *phi = before + density * feature;
            }
        }
    }
}

vectorised! {
    /// `d_density = ⟨d_phi, feature⟩`, `d_feature = density · d_phi`.
    pub fn backward<T: Real>(p: PointParams, density: &[T], feature: &[T], d_phi: &[T], d_density: &mut [T], d_feature: &mut [T]) {
        let (rows, width) = (p.rows as usize, p.features as usize);
        for (row, (d_feature, d_density)) in d_feature.chunks_exact_mut(width).zip(d_density).enumerate().take(rows) {
            let (feature, d_phi) = (&feature[row * width..][..width], &d_phi[row * width..][..width]);
            *d_density = sum(d_phi, feature, |d_phi, feature| d_phi * feature);
            for (d_feature, &d_phi) in d_feature.iter_mut().zip(d_phi) {
                *d_feature = density[row] * d_phi;
            }
        }
    }
}
