//! Sums of `scale · z²`, and its gradient.

use srn_shaders::TermParams;

use super::chunk_of;
use crate::Real;

/// One partial sum per chunk.
pub fn forward<T: Real>(p: TermParams, z: &[T], partial: &mut [T]) {
    for (chunk, partial) in partial.iter_mut().take(p.chunks as usize).enumerate() {
        let values = &z[chunk_of(chunk, p.chunk, p.count)];
        *partial = T::of_f32(p.scale) * values.iter().map(|&z| z * z).sum();
    }
}

/// `d_z += 2 scale z`.
pub fn backward<T: Real>(p: TermParams, z: &[T], d_z: &mut [T]) {
    let factor = T::of(2.0) * T::of_f32(p.scale);
    for (d_z, &z) in d_z.iter_mut().zip(z).take(p.count as usize) {
        *d_z += factor * z;
    }
}
