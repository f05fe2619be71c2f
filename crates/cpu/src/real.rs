use std::iter::Sum;
use std::ops::AddAssign;

use num_traits::Float;

/// `f32` or `f64`.
pub trait Real: Float + AddAssign + Sum + Default + Send + Sync + std::fmt::Debug + 'static {
    /// Name of the type.
    const NAME: &'static str;
    /// From a literal.
    fn of(value: f64) -> Self;
    /// From a device value.
    fn of_f32(value: f32) -> Self;
    /// To a device value.
    fn as_f32(self) -> f32;
    /// To `f64`: cheap ops with three values per ray, and sums over rows, compute there and round once.
    fn wide(self) -> f64;
    /// The same values, if they are `f32`: for these, some ops have code for the processor's vectors.
    fn singles(_values: &[Self]) -> Option<&[f32]> {
        None
    }
    /// The same, to be written.
    fn singles_mut(_values: &mut [Self]) -> Option<&mut [f32]> {
        None
    }
}

impl Real for f64 {
    const NAME: &'static str = "f64";
    #[inline(always)]
    fn of(value: f64) -> Self {
        value
    }
    fn of_f32(value: f32) -> Self {
        value.into()
    }
    fn as_f32(self) -> f32 {
        self as f32
    }
    #[inline(always)]
    fn wide(self) -> f64 {
        self
    }
}

impl Real for f32 {
    const NAME: &'static str = "f32";
    #[inline(always)]
    fn of(value: f64) -> Self {
        value as f32
    }
    #[inline(always)]
    fn of_f32(value: f32) -> Self {
        value
    }
    #[inline(always)]
    fn as_f32(self) -> f32 {
        self
    }
    #[inline(always)]
    fn wide(self) -> f64 {
        self.into()
    }

    fn singles(values: &[f32]) -> Option<&[f32]> {
        Some(values)
    }
    fn singles_mut(values: &mut [f32]) -> Option<&mut [f32]> {
        Some(values)
    }
}
