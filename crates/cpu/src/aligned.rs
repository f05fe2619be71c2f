//! Buffers that begin where a line of the processor's caches does.

use std::ops::Range;

use crate::Real;

/// Bytes of a line of the processor's caches.
pub(crate) const LINE: usize = 64;

/// Values that begin where a line does, so that no vector of them lies in two.
#[derive(Debug)]
pub(crate) struct Aligned<T> {
    values: Vec<T>,
    range: Range<usize>,
}

impl<T: Real> Aligned<T> {
    pub fn zeros(len: usize) -> Self {
        let values = vec![T::zero(); len + LINE / size_of::<T>()];
        let start = values.as_ptr().align_offset(LINE);
        Aligned { values, range: start..start + len }
    }

    pub fn values(&self) -> &[T] {
        &self.values[self.range.clone()]
    }

    pub fn values_mut(&mut self) -> &mut [T] {
        &mut self.values[self.range.clone()]
    }
}
