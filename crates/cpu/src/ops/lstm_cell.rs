//! LSTM cell, gates in the order input, forget, cell, output.

use pulp::{Arch, Simd, WithSimd};
use srn_shaders::LstmParams;

use crate::Real;
use crate::simd::{hyperbolic_tangent, load, sigmoid, store};

/// Limit of the gradient that reaches a hidden state (spec 3).
const CLAMP: f64 = 10.0;

/// `c = σ(f) c_prev + σ(i) tanh(g)`, `h = σ(o) tanh(c)`.
pub fn forward<T: Real>(p: LstmParams, gates: &[T], c_prev: &[T], h: &mut [T], c: &mut [T]) {
    let (hidden, values) = (p.hidden as usize, (p.rows * p.hidden) as usize);
    let (gates, c_prev, h, c) = (&gates[..4 * values], &c_prev[..values], &mut h[..values], &mut c[..values]);
    if let [Some(gates), Some(c_prev)] = [gates, c_prev].map(T::singles)
        && let [Some(h), Some(c)] = [&mut *h, &mut *c].map(T::singles_mut)
    {
        return Arch::new().dispatch(Forward { hidden, gates, c_prev, h, c });
    }
    for value in 0..values {
        let [i, f, g, o] = activated(gates, hidden, value);
        c[value] = f * c_prev[value] + i * g;
        h[value] = o * c[value].tanh();
    }
}

/// `σ(i), σ(f), tanh(g), σ(o)` of a value of the state.
fn activated<T: Real>(gates: &[T], hidden: usize, value: usize) -> [T; 4] {
    let sigmoid = |x: T| T::one() / (T::one() + (-x).exp());
    let [i, f, g, o] = [0, 1, 2, 3].map(|gate| gates[(4 * (value / hidden) + gate) * hidden + value % hidden]);
    [sigmoid(i), sigmoid(f), g.tanh(), sigmoid(o)]
}

/// [`forward`] with the processor's vectors.
struct Forward<'a> {
    hidden: usize,
    gates: &'a [f32],
    c_prev: &'a [f32],
    h: &'a mut [f32],
    c: &'a mut [f32],
}

impl WithSimd for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let hidden = self.hidden;
        let states = self.c_prev.chunks_exact(hidden).zip(self.h.chunks_exact_mut(hidden)).zip(self.c.chunks_exact_mut(hidden));
        for (gates, ((c_prev, h), c)) in self.gates.chunks_exact(4 * hidden).zip(states) {
            for start in (0..hidden).step_by(S::F32_LANES) {
                let [i, f, g, o] = activated_vectors(simd, gates, hidden, start);
                let new = simd.mul_add_e_f32s(f, load(simd, c_prev, start), simd.mul_f32s(i, g));
                store(simd, c, start, new);
                store(simd, h, start, simd.mul_f32s(o, hyperbolic_tangent(simd, new)));
            }
        }
    }
}

/// [`activated`], of the values from `start` of a row.
#[inline(always)]
fn activated_vectors<S: Simd>(simd: S, gates: &[f32], hidden: usize, start: usize) -> [S::f32s; 4] {
    let [i, f, g, o] = loads(simd, [0, 1, 2, 3].map(|gate| &gates[gate * hidden..][..hidden]), start);
    [sigmoid(simd, i), sigmoid(simd, f), hyperbolic_tangent(simd, g), sigmoid(simd, o)]
}

/// No closures where there are vectors: the compiler would call them.
#[inline(always)]
fn loads<S: Simd>(simd: S, [a, b, c, d]: [&[f32]; 4], start: usize) -> [S::f32s; 4] {
    [load(simd, a, start), load(simd, b, start), load(simd, c, start), load(simd, d, start)]
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
    let (hidden, values) = (p.hidden as usize, (p.rows * p.hidden) as usize);
    let [c_prev, c, d_h, d_c] = [c_prev, c, d_h, d_c].map(|state| &state[..values]);
    let (gates, d_gates, d_c_prev) = (&gates[..4 * values], &mut d_gates[..4 * values], &mut d_c_prev[..values]);
    if let [Some(gates), Some(c_prev), Some(c), Some(d_h), Some(d_c)] = [gates, c_prev, c, d_h, d_c].map(T::singles)
        && let [Some(d_gates), Some(d_c_prev)] = [&mut *d_gates, &mut *d_c_prev].map(T::singles_mut)
    {
        return Arch::new().dispatch(Backward { hidden, gates, c_prev, c, d_h, d_c, d_gates, d_c_prev });
    }
    let (one, limit) = (T::one(), T::of(CLAMP));
    for value in 0..values {
        let [i, f, g, o] = activated(gates, hidden, value);
        let tanh_c = c[value].tanh();
        let d_h = if d_h[value] > limit { limit } else { d_h[value] };
        let d_h = if d_h < -limit { -limit } else { d_h };
        let d_c = d_c[value] + d_h * o * (one - tanh_c * tanh_c);
        let d =
            [d_c * g * i * (one - i), d_c * c_prev[value] * f * (one - f), d_c * i * (one - g * g), d_h * tanh_c * o * (one - o)];
        for (gate, d) in d.into_iter().enumerate() {
            d_gates[(4 * (value / hidden) + gate) * hidden + value % hidden] = d;
        }
        d_c_prev[value] = d_c * f;
    }
}

/// [`backward`] with the processor's vectors.
struct Backward<'a> {
    hidden: usize,
    gates: &'a [f32],
    c_prev: &'a [f32],
    c: &'a [f32],
    d_h: &'a [f32],
    d_c: &'a [f32],
    d_gates: &'a mut [f32],
    d_c_prev: &'a mut [f32],
}

impl WithSimd for Backward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let hidden = self.hidden;
        let (one, low, high) = (simd.splat_f32s(1.0), simd.splat_f32s(-CLAMP as f32), simd.splat_f32s(CLAMP as f32));
        let outputs = self.d_gates.chunks_exact_mut(4 * hidden).zip(self.d_c_prev.chunks_exact_mut(hidden));
        for (row, (d_gates, d_c_prev)) in outputs.enumerate() {
            let gates = &self.gates[row * 4 * hidden..][..4 * hidden];
            let states = [self.c_prev, self.c, self.d_h, self.d_c].map(|state| &state[row * hidden..][..hidden]);
            for start in (0..hidden).step_by(S::F32_LANES) {
                let [i, f, g, o] = activated_vectors(simd, gates, hidden, start);
                let [c_prev, c, d_h, d_c] = loads(simd, states, start);
                let tanh_c = hyperbolic_tangent(simd, c);
                let d_h = simd.select_f32s(simd.greater_than_f32s(d_h, high), high, d_h);
                let d_h = simd.select_f32s(simd.less_than_f32s(d_h, low), low, d_h);
                // 1 - tanh².
                let slope = simd.negate_mul_add_e_f32s(tanh_c, tanh_c, one);
                let d_c = simd.mul_add_e_f32s(simd.mul_f32s(d_h, o), slope, d_c);
                // σ' = σ - σ².
                let slope_i = simd.negate_mul_add_e_f32s(i, i, i);
                let slope_f = simd.negate_mul_add_e_f32s(f, f, f);
                let slope_g = simd.negate_mul_add_e_f32s(g, g, one);
                let slope_o = simd.negate_mul_add_e_f32s(o, o, o);
                let d = [
                    simd.mul_f32s(simd.mul_f32s(d_c, g), slope_i),
                    simd.mul_f32s(simd.mul_f32s(d_c, c_prev), slope_f),
                    simd.mul_f32s(simd.mul_f32s(d_c, i), slope_g),
                    simd.mul_f32s(simd.mul_f32s(d_h, tanh_c), slope_o),
                ];
                for (gate, d) in d.into_iter().enumerate() {
                    store(simd, &mut d_gates[gate * hidden..][..hidden], start, d);
                }
                store(simd, d_c_prev, start, simd.mul_f32s(d_c, f));
            }
        }
    }
}
