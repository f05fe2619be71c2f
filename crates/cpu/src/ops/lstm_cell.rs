//! LSTM cell, gates in the order input, forget, cell, output.

use srn_shaders::LstmParams;

use super::for_rows2;
use crate::Real;
use crate::simd::vectorised;

/// Limit of the gradient that reaches a hidden state (spec 3).
const CLAMP: f64 = 10.0;

/// `c = σ(f) c_prev + σ(i) tanh(g)`, `h = σ(o) tanh(c)`.
pub fn forward<T: Real>(p: LstmParams, gates: &[T], c_prev: &[T], h: &mut [T], c: &mut [T]) {
    let hidden = p.hidden as usize;
    let values = p.rows as usize * hidden;
    for_rows2((&mut h[..values], hidden), (&mut c[..values], hidden), |first, h, c| {
        forward_rows(hidden, &gates[first * 4 * hidden..], &c_prev[first * hidden..], h, c);
    });
}

vectorised! {
    fn forward_rows<T: Real>(hidden: usize, gates: &[T], c_prev: &[T], h: &mut [T], c: &mut [T]) {
        let states = c_prev.chunks_exact(hidden).zip(h.chunks_exact_mut(hidden)).zip(c.chunks_exact_mut(hidden));
        for (gates, ((c_prev, h), c)) in gates.chunks_exact(4 * hidden).zip(states) {
            for j in 0..hidden {
                let [i, f] = [gates[j].sigmoid(), gates[hidden + j].sigmoid()];
                let [g, o] = [gates[2 * hidden + j].hyperbolic_tangent(), gates[3 * hidden + j].sigmoid()];
                c[j] = f * c_prev[j] + i * g;
                h[j] = o * c[j].hyperbolic_tangent();
            }
        }
    }
}

/// `d_h` clamped, `d_c` → `d_gates`, `d_c_prev`.
pub fn backward<T: Real>(
    p: LstmParams,
    gates: &[T],
    c_prev: &[T],
    c: &[T],
    d_h: &[T],
    d_c: &[T],
    d_gates: &mut [T],
    d_c_prev: &mut [T],
) {
    let (rows, hidden) = (p.rows as usize, p.hidden as usize);
    let outputs = ((&mut d_gates[..rows * 4 * hidden], 4 * hidden), (&mut d_c_prev[..rows * hidden], hidden));
    for_rows2(outputs.0, outputs.1, |first, d_gates, d_c_prev| {
        let gates = &gates[first * 4 * hidden..];
        let [c_prev, c, d_h, d_c] = [c_prev, c, d_h, d_c].map(|values| &values[first * hidden..]);
        backward_rows(hidden, gates, c_prev, c, d_h, d_c, d_gates, d_c_prev);
    });
}

vectorised! {
    fn backward_rows<T: Real>(
        hidden: usize,
        gates: &[T],
        c_prev: &[T],
        c: &[T],
        d_h: &[T],
        d_c: &[T],
        d_gates: &mut [T],
        d_c_prev: &mut [T],
    ) {
        let one = T::one();
        for (row, (d_gates, d_c_prev)) in d_gates.chunks_exact_mut(4 * hidden).zip(d_c_prev.chunks_exact_mut(hidden)).enumerate() {
            let gates = &gates[row * 4 * hidden..][..4 * hidden];
            let (c_prev, c) = (&c_prev[row * hidden..][..hidden], &c[row * hidden..][..hidden]);
            let (d_h, d_c) = (&d_h[row * hidden..][..hidden], &d_c[row * hidden..][..hidden]);
            for j in 0..hidden {
                let [i, f] = [gates[j].sigmoid(), gates[hidden + j].sigmoid()];
                let [g, o] = [gates[2 * hidden + j].hyperbolic_tangent(), gates[3 * hidden + j].sigmoid()];
                let tanh_c = c[j].hyperbolic_tangent();
                let d_h = d_h[j].max(T::of(-CLAMP)).min(T::of(CLAMP));
                let d_c = d_c[j] + d_h * o * (one - tanh_c * tanh_c);
                d_gates[j] = d_c * g * i * (one - i);
                d_gates[hidden + j] = d_c * c_prev[j] * f * (one - f);
                d_gates[2 * hidden + j] = d_c * i * (one - g * g);
                d_gates[3 * hidden + j] = d_h * tanh_c * o * (one - o);
                d_c_prev[j] = d_c * f;
            }
        }
    }
}
