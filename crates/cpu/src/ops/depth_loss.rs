//! Sums of `scale · min(depth, 0)²`.

use srn_shaders::TermParams;

use super::chunk_of;
use crate::Real;

/// One partial sum per chunk.
pub fn forward<T: Real>(p: TermParams, depth: &[T], partial: &mut [T]) {
    for (chunk, partial) in partial.iter_mut().take(p.chunks as usize).enumerate() {
        let values = &depth[chunk_of(chunk, p.chunk, p.count)];
        *partial = T::of_f32(p.scale) * values.iter().map(|depth| depth.min(T::zero()).powi(2)).sum();
    }
}
