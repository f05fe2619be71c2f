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

use crate::Real;

/// Values that are worked on together.
pub(crate) const LANES: usize = 16;

/// The values at `start..start + LANES`, zeros beyond the end: short rows vectorise too.
#[inline(always)]
pub(crate) fn load<T: Real>(values: &[T], start: usize) -> [T; LANES] {
    match values.get(start..start + LANES) {
        Some(whole) => whole.try_into().expect("a slice of this length"),
        None => std::array::from_fn(|lane| values.get(start + lane).copied().unwrap_or(T::zero())),
    }
}

/// The inverse of [`load`]: what lies beyond the end is dropped.
#[inline(always)]
pub(crate) fn store<T: Real>(values: &mut [T], start: usize, lanes: [T; LANES]) {
    match values.get_mut(start..start + LANES) {
        Some(whole) => whole.copy_from_slice(&lanes),
        None => values[start..].iter_mut().zip(lanes).for_each(|(value, lane)| *value = lane),
    }
}

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
