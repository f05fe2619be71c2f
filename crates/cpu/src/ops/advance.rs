//! The step length, and `x_next = x + direction · step`.

use srn_shaders::AdvanceParams;

use crate::Real;
use crate::simd::{sum, vectorised};

vectorised! {
    /// `step = ⟨head, h⟩ + bias`, and one step along each ray.
    pub fn forward<T: Real>(p: AdvanceParams, x: &[T], direction: &[T], h: &[T], head: &[T], step: &mut [T], x_next: &mut [T]) {
        let (head, bias) = head.split_at(p.hidden as usize);
        for (row, (h, step)) in h.chunks_exact(head.len()).zip(step).enumerate().take(p.rows as usize) {
            *step = sum(h, head, |value, weight| value * weight) + bias[0];
            for k in 3 * row..3 * row + 3 {
                x_next[k] = T::of(x[k].wide() + direction[k].wide() * step.wide());
            }
        }
    }
}

vectorised! {
    /// `d_step = ⟨d_x_next, direction⟩`, `d_direction (+)= d_x_next step`, `d_h (+)= d_step head`.
    pub fn backward<T: Real>(
        p: AdvanceParams,
        direction: &[T],
        step: &[T],
        d_x_next: &[T],
        head: &[T],
        d_step: &mut [T],
        d_direction: &mut [T],
        d_h: &mut [T],
    ) {
        let (hidden, accumulate) = (p.hidden as usize, p.accumulate == 1);
        for (row, d_h) in d_h.chunks_exact_mut(hidden).enumerate().take(p.rows as usize) {
            d_step[row] = T::of((3 * row..3 * row + 3).map(|k| d_x_next[k].wide() * direction[k].wide()).sum());
            for k in 3 * row..3 * row + 3 {
                let before = if accumulate { d_direction[k] } else { T::zero() };
                d_direction[k] = before + d_x_next[k] * step[row];
            }
            for (d_h, &weight) in d_h.iter_mut().zip(head) {
                let before = if accumulate { *d_h } else { T::zero() };
                *d_h = before + d_step[row] * weight;
            }
        }
    }
}
