//! Sums of partial sums.

use rayon::prelude::*;
use srn_shaders::SumParams;

use super::BLOCK_VALUES;
use crate::Real;

/// `y[first_group + g, j] (+)= Σ_t x[g, t, j]`.
pub fn forward<T: Real>(p: SumParams, x: &[T], y: &mut [T]) {
    let (terms, count) = (p.terms as usize, p.count as usize);
    let y = &mut y[p.first_group as usize * count..][..p.groups as usize * count];
    for (y, x) in y.chunks_exact_mut(count).zip(x.chunks_exact(terms * count)) {
        y.par_chunks_mut(BLOCK_VALUES).enumerate().for_each(|(block, y)| {
            if p.accumulate == 0 {
                y.fill(T::zero());
            }
            for term in x.chunks_exact(count) {
                y.iter_mut().zip(&term[block * BLOCK_VALUES..]).for_each(|(y, &x)| *y += x);
            }
        });
    }
}
