//! RGB in [-1, 1] to RGBA8.

use srn_shaders::PackParams;

use crate::Real;

/// Clamped, rounded; alpha is 255.
pub fn forward<T: Real>(p: PackParams, rgb: &[T], packed: &mut [u32]) {
    let byte = |value: T| {
        let unit = (value.max(-T::one()).min(T::one()) + T::one()) / T::of(2.0);
        (unit * T::of(255.0) + T::of(0.5)).as_f32() as u32
    };
    for pixel in 0..(p.width * p.height) as usize {
        let value = 3 * (p.first_pixel as usize + pixel);
        let [r, g, b] = [0, 1, 2].map(|channel| byte(rgb[value + channel]));
        let (row, column) = (pixel / p.width as usize, pixel % p.width as usize);
        packed[row * p.stride as usize + column] = r | g << 8 | b << 16 | 255 << 24;
    }
}
