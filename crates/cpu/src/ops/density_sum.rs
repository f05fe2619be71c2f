//! The last layer of g, and `phi = Σ_i density_i feature_i`, one point at a time.

use srn_shaders::DensitySumParams;

use crate::Real;
use crate::simd::{sum, vectorised};

vectorised! {
    /// `density = ⟨head, hidden⟩ + bias`, `phi (+)= density · feature`.
    pub fn forward<T: Real>(p: DensitySumParams, hidden: &[T], head: &[T], feature: &[T], density: &mut [T], phi: &mut [T]) {
        let (rows, width, accumulate) = (p.rows as usize, p.features as usize, p.accumulate == 1);
        let (head, bias) = head.split_at(p.in_features as usize);
        let values = hidden.chunks_exact(head.len()).zip(feature.chunks_exact(width));
        for (((hidden, feature), density), phi) in values.zip(density).zip(phi.chunks_exact_mut(width)).take(rows) {
            *density = sum(hidden, head, |value, weight| value * weight) + bias[0];
            for (phi, &feature) in phi.iter_mut().zip(feature) {
                let before = if accumulate { *phi } else { T::zero() };
                *phi = before + *density * feature;
            }
        }
    }
}

vectorised! {
    /// `d_density = ⟨d_phi, feature⟩`, `d_feature = density · d_phi`, `d_hidden = d_density · head`.
    pub fn backward<T: Real>(
        p: DensitySumParams,
        density: &[T],
        feature: &[T],
        d_phi: &[T],
        head: &[T],
        d_density: &mut [T],
        d_feature: &mut [T],
        d_hidden: &mut [T],
    ) {
        let (rows, width, hidden) = (p.rows as usize, p.features as usize, p.in_features as usize);
        let values = density.iter().zip(feature.chunks_exact(width)).zip(d_phi.chunks_exact(width));
        let gradients = d_density.iter_mut().zip(d_feature.chunks_exact_mut(width)).zip(d_hidden.chunks_exact_mut(hidden));
        for (((&density, feature), d_phi), ((d_density, d_feature), d_hidden)) in values.zip(gradients).take(rows) {
            *d_density = sum(d_phi, feature, |d_phi, feature| d_phi * feature);
            for (d_feature, &d_phi) in d_feature.iter_mut().zip(d_phi) {
                *d_feature = density * d_phi;
            }
            for (d_hidden, &weight) in d_hidden.iter_mut().zip(head) {
                *d_hidden = *d_density * weight;
            }
        }
    }
}
