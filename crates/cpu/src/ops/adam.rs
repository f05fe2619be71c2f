//! Adam.

use rayon::prelude::*;
use srn_shaders::AdamParams;

use super::BLOCK_VALUES;
use crate::Real;
use crate::simd::vectorised;

/// One step; `schedule = [lr, 1/(1-β1ᵗ), 1/(1-β2ᵗ)]`.
pub fn step<T: Real>(p: AdamParams, gradient: &[T], schedule: &[T], value: &mut [T], m: &mut [T], v: &mut [T]) {
    let count = p.count as usize;
    // 0.999 rounded to f32 would shift the f64 oracle by 1e-5 of a step.
    let [beta1, beta2, rest1, rest2, epsilon] =
        [p.beta1, p.beta2, p.one_minus_beta1, p.one_minus_beta2, p.epsilon].map(decimal::<T>);
    let constants = [beta1, beta2, rest1, rest2, epsilon, schedule[0], schedule[1], schedule[2]];
    value[..count]
        .par_chunks_mut(BLOCK_VALUES)
        .zip(m[..count].par_chunks_mut(BLOCK_VALUES))
        .zip(v[..count].par_chunks_mut(BLOCK_VALUES))
        .zip(gradient[..count].par_chunks(BLOCK_VALUES))
        .for_each(|(((value, m), v), gradient)| step_values(constants, gradient, value, m, v));
}

vectorised! {
    fn step_values<T: Real>(constants: [T; 8], gradient: &[T], value: &mut [T], m: &mut [T], v: &mut [T]) {
        let [beta1, beta2, rest1, rest2, epsilon, rate, correct_m, correct_v] = constants;
        for i in 0..value.len().min(m.len()).min(v.len()).min(gradient.len()) {
            let g = gradient[i];
            m[i] = beta1 * m[i] + rest1 * g;
            v[i] = beta2 * v[i] + rest2 * g * g;
            value[i] = value[i] - rate * (m[i] * correct_m) / ((v[i] * correct_v).sqrt() + epsilon);
        }
    }
}

/// The short decimal number that `value` was written as.
fn decimal<T: Real>(value: f32) -> T {
    T::of(value.to_string().parse().expect("a number prints as a number"))
}
