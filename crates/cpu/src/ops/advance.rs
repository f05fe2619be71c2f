//! `x_next = x + direction · step`.

use srn_shaders::AdvanceParams;

use crate::Real;

/// One step along each ray.
pub fn forward<T: Real>(p: AdvanceParams, x: &[T], direction: &[T], step: &[T], x_next: &mut [T]) {
    for row in 0..p.rows as usize {
        for k in 3 * row..3 * row + 3 {
            x_next[k] = T::of(x[k].wide() + direction[k].wide() * step[row].wide());
        }
    }
}

/// `d_step = d_x_next · direction`, `d_direction (+)= d_x_next step`.
pub fn backward<T: Real>(p: AdvanceParams, direction: &[T], step: &[T], d_x_next: &[T], d_step: &mut [T], d_direction: &mut [T]) {
    for row in 0..p.rows as usize {
        d_step[row] = T::of((3 * row..3 * row + 3).map(|k| d_x_next[k].wide() * direction[k].wide()).sum());
        for k in 3 * row..3 * row + 3 {
            let before = if p.accumulate == 1 { d_direction[k] } else { T::zero() };
            d_direction[k] = before + d_x_next[k] * step[row];
        }
    }
}
