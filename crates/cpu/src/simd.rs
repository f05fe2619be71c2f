//! The same loop compiled for several instruction sets, the best one chosen when it runs.

/// Defines a function whose body is also compiled for AVX2 and AVX-512: plain loops inside then use the wide registers.
macro_rules! vectorised {
    ($(#[$doc:meta])* $vis:vis fn $name:ident<T: Real>($($arg:ident: $ty:ty),* $(,)?) $(-> $ret:ty)? $body:block) => {
        $(#[$doc])*
        $vis fn $name<T: Real>($($arg: $ty),*) $(-> $ret)? {
            #[inline(always)]
            fn body<T: Real>($($arg: $ty),*) $(-> $ret)? $body
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,fma")]
                fn avx512<T: Real>($($arg: $ty),*) $(-> $ret)? {
                    body::<T>($($arg),*)
                }
                #[target_feature(enable = "avx2,fma")]
                fn avx2<T: Real>($($arg: $ty),*) $(-> $ret)? {
                    body::<T>($($arg),*)
                }
                if is_x86_feature_detected!("avx512dq") && is_x86_feature_detected!("avx512bw") && is_x86_feature_detected!("avx512vl") {
                    // SAFETY: the features were just found.
                    return unsafe { avx512::<T>($($arg),*) };
                }
                if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                    // SAFETY: the features were just found.
                    return unsafe { avx2::<T>($($arg),*) };
                }
            }
            body::<T>($($arg),*)
        }
    };
}
pub(crate) use vectorised;

use pulp::Simd;

use crate::Real;

/// Values that are summed together.
const LANES: usize = 16;

/// `Σ term(a[i], b[i])`, in sixteen interleaved sums: a fixed order that vectorises. `a` and `b` have the same length.
#[inline(always)]
pub(crate) fn sum<T: Real>(a: &[T], b: &[T], term: impl Fn(T, T) -> T) -> T {
    let mut lanes = [T::zero(); LANES];
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    for (a, b) in a.iter().zip(b) {
        for lane in 0..LANES {
            lanes[lane] += term(a[lane], b[lane]);
        }
    }
    for (lane, (&a, &b)) in a_rest.iter().zip(b_rest).enumerate() {
        lanes[lane] += term(a, b);
    }
    total(lanes)
}

/// The sum of the lanes, in a tree: a chain of sixteen additions would be most of the time of a short row.
#[inline(always)]
pub(crate) fn total<T: Real>(mut lanes: [T; LANES]) -> T {
    for half in [8, 4, 2, 1] {
        let (low, high) = lanes.split_at_mut(half);
        low.iter_mut().zip(high).for_each(|(low, &mut high)| *low += high);
    }
    lanes[0]
}

/// The vector of `values` at `start`, zeros beyond the end.
#[inline(always)]
pub(crate) fn load<S: Simd>(simd: S, values: &[f32], start: usize) -> S::f32s {
    let (whole, rest) = S::as_simd_f32s(&values[start..]);
    if whole.is_empty() { simd.partial_load_f32s(rest) } else { whole[0] }
}

/// The inverse of [`load`]: what lies beyond the end is dropped.
#[inline(always)]
pub(crate) fn store<S: Simd>(simd: S, values: &mut [f32], start: usize, vector: S::f32s) {
    let (whole, rest) = S::as_mut_simd_f32s(&mut values[start..]);
    if whole.is_empty() {
        simd.partial_store_f32s(rest, vector);
    } else {
        whole[0] = vector;
    }
}

/// `coefficients` are those of the highest power first.
#[inline(always)]
fn polynomial<S: Simd, const N: usize>(simd: S, x: S::f32s, coefficients: [f32; N]) -> S::f32s {
    let mut sum = simd.splat_f32s(coefficients[0]);
    for &coefficient in &coefficients[1..] {
        sum = simd.mul_add_e_f32s(sum, x, simd.splat_f32s(coefficient));
    }
    sum
}

/// `2^n` and `e^r - 1`, with `e^x = 2^n · e^r`, `|r| ≤ ln 2 / 2`, and a polynomial of degree 7 for `e^r`: relative error below 2e-7, no branches.
#[inline(always)]
fn exponential<S: Simd>(simd: S, x: S::f32s) -> (S::f32s, S::f32s) {
    // In this order a NaN goes on.
    let x = simd.min_f32s(simd.splat_f32s(88.0), simd.max_f32s(simd.splat_f32s(-87.0), x));
    let magic = simd.splat_f32s(12_582_912.0); // 1.5 · 2^23: adding it rounds to an integer
    let shifted = simd.mul_add_e_f32s(x, simd.splat_f32s(std::f32::consts::LOG2_E), magic);
    let n = simd.sub_f32s(shifted, magic);
    // ln 2 in two parts.
    let r = simd.mul_add_e_f32s(n, simd.splat_f32s(-0.693_359_4), x);
    let r = simd.mul_add_e_f32s(n, simd.splat_f32s(2.121_944_4e-4), r);
    let p = polynomial(simd, r, [1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5]);
    // The low bits of `shifted` are n: no conversion to an integer is needed.
    let power = simd.add_u32s(simd.transmute_u32s_f32s(shifted), simd.splat_u32s(127));
    let power = simd.transmute_f32s_u32s(simd.wrapping_dyn_shl_u32s(power, simd.splat_u32s(23)));
    (power, simd.mul_add_e_f32s(simd.mul_f32s(r, r), p, r))
}

/// `1 / (1 + e^-x)`.
#[inline(always)]
pub(crate) fn sigmoid<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    let one = simd.splat_f32s(1.0);
    let (power, rest) = exponential(simd, simd.neg_f32s(x));
    simd.div_f32s(one, simd.add_f32s(one, simd.mul_add_e_f32s(power, rest, power)))
}

/// `tanh x = (e^2x - 1) / (e^2x + 1)`, `e^2x - 1` without what would cancel near zero.
#[inline(always)]
pub(crate) fn hyperbolic_tangent<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    let (power, rest) = exponential(simd, simd.add_f32s(x, x));
    let less_one = simd.mul_add_e_f32s(power, rest, simd.sub_f32s(power, simd.splat_f32s(1.0)));
    simd.div_f32s(less_one, simd.add_f32s(less_one, simd.splat_f32s(2.0)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use pulp::{Arch, WithSimd};

    struct Both<'a>(&'a [f32], &'a mut [f32], &'a mut [f32]);

    impl WithSimd for Both<'_> {
        type Output = ();

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) {
            let Both(x, sigmoids, tangents) = self;
            for start in (0..x.len()).step_by(S::F32_LANES) {
                let x = load(simd, x, start);
                store(simd, sigmoids, start, sigmoid(simd, x));
                store(simd, tangents, start, hyperbolic_tangent(simd, x));
            }
        }
    }

    #[test]
    fn sigmoid_and_tanh_are_within_a_few_units_in_the_last_place() {
        // The last vector is not full.
        let mut x: Vec<f32> = (-86_000..=90_000).map(|k| k as f32 * 1e-3).collect();
        x.push(f32::NAN);
        let (mut sigmoids, mut tangents) = (vec![0.0; x.len()], vec![0.0; x.len()]);
        Arch::new().dispatch(Both(&x, &mut sigmoids, &mut tangents));
        assert!(sigmoids.pop().unwrap().is_nan() && tangents.pop().unwrap().is_nan(), "NaN must not be hidden");
        let mut worst = [0.0f64; 2];
        for ((&x, &sigmoid), &tangent) in x.iter().zip(&sigmoids).zip(&tangents) {
            let (x, sigmoid, tangent) = (f64::from(x), f64::from(sigmoid), f64::from(tangent));
            let exact = 1.0 / (1.0 + (-x).exp());
            worst[0] = worst[0].max(((sigmoid - exact) / exact).abs());
            worst[1] = worst[1].max(((tangent - x.tanh()) / x.tanh().abs().max(1e-30)).abs());
        }
        println!("{worst:?}");
        assert!(worst[0] < 6e-7 && worst[1] < 3e-7, "{worst:?}");
    }
}
