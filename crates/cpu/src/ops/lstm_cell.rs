//! LSTM cell, gates in the order input, forget, cell, output.

use srn_shaders::LstmParams;

use super::for_rows2;
use crate::Real;
use crate::simd::{LANES, load, store, vectorised};

/// Limit of the gradient that reaches a hidden state (spec 3).
const CLAMP: f64 = 10.0;

/// The four gates of a row.
#[inline(always)]
fn four<T>(gates: &[T], hidden: usize) -> [&[T]; 4] {
    [0, 1, 2, 3].map(|gate| &gates[gate * hidden..][..hidden])
}

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
            for start in (0..hidden).step_by(LANES) {
                let [i, f, g, o] = four(gates, hidden).map(|gate| load(gate, start));
                let c_prev = load(c_prev, start);
                let (mut h_lanes, mut c_lanes) = ([T::zero(); LANES], [T::zero(); LANES]);
                for j in 0..LANES {
                    let (i, f, g, o) = (i[j].sigmoid(), f[j].sigmoid(), g[j].hyperbolic_tangent(), o[j].sigmoid());
                    c_lanes[j] = f * c_prev[j] + i * g;
                    h_lanes[j] = o * c_lanes[j].hyperbolic_tangent();
                }
                store(h, start, h_lanes);
                store(c, start, c_lanes);
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
            for start in (0..hidden).step_by(LANES) {
                let [i, f, g, o] = four(gates, hidden).map(|gate| load(gate, start));
                let [c_prev, c, d_h, d_c] = [c_prev, c, d_h, d_c].map(|values| load(values, start));
                let mut d = [[T::zero(); LANES]; 5];
                for j in 0..LANES {
                    let (i, f, g, o) = (i[j].sigmoid(), f[j].sigmoid(), g[j].hyperbolic_tangent(), o[j].sigmoid());
                    let tanh_c = c[j].hyperbolic_tangent();
                    let limit = T::of(CLAMP);
                    let d_h = if d_h[j] > limit { limit } else { d_h[j] };
                    let d_h = if d_h < -limit { -limit } else { d_h };
                    let d_c = d_c[j] + d_h * o * (one - tanh_c * tanh_c);
                    d[0][j] = d_c * g * i * (one - i);
                    d[1][j] = d_c * c_prev[j] * f * (one - f);
                    d[2][j] = d_c * i * (one - g * g);
                    d[3][j] = d_h * tanh_c * o * (one - o);
                    d[4][j] = d_c * f;
                }
                let [d_i, d_f, d_g, d_o, d_c] = d;
                for (gate, lanes) in [d_i, d_f, d_g, d_o].into_iter().enumerate() {
                    store(&mut d_gates[gate * hidden..][..hidden], start, lanes);
                }
                store(d_c_prev, start, d_c);
            }
        }
    }
}
