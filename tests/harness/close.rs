/// The largest `|got - want|`, relative to the largest `|want|`.
///
/// Fails, naming the element, where lengths differ or a value on either side is not finite. Where `want` is zero all over,
/// anything but zeros is infinitely far.
pub fn difference(got: &[f32], want: &[f32]) -> Result<f64, String> {
    if got.len() != want.len() {
        return Err(format!("has {} values, expected {}", got.len(), want.len()));
    }
    if let Some(at) = got.iter().zip(want).position(|(got, want)| !got.is_finite() || !want.is_finite()) {
        return Err(format!("is {} at element {at}, expected {}", got[at], want[at]));
    }
    let largest = |values: &mut dyn Iterator<Item = f64>| values.fold(0.0, f64::max);
    let scale = largest(&mut want.iter().map(|&want| f64::from(want).abs()));
    let error = largest(&mut got.iter().zip(want).map(|(&got, &want)| (f64::from(got) - f64::from(want)).abs()));
    Ok(if error == 0.0 { 0.0 } else { error / scale })
}

/// Panics where [`difference`] fails or exceeds `tolerance`.
#[track_caller]
pub fn assert_close(name: &str, got: &[f32], want: &[f32], tolerance: f64) {
    match difference(got, want) {
        Ok(error) if error <= tolerance => {}
        Ok(error) => panic!("{name}: differs by {error:.2e} of the largest value, allowed {tolerance:.0e}"),
        Err(what) => panic!("{name}: {what}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WANT: [f32; 4] = [1.0, -2.0, 0.5, 0.0];

    fn rejects(got: &[f32], want: &[f32]) -> bool {
        std::panic::catch_unwind(|| assert_close("x", got, want, 1e-3)).is_err()
    }

    #[test]
    fn accepts_what_is_close() {
        assert_close("x", &WANT, &WANT, 0.0);
        assert_close("x", &[1.001, -2.0, 0.5, 0.001], &WANT, 1e-3);
        assert_close("zeros", &[0.0; 3], &[0.0; 3], 0.0);
        assert_eq!(difference(&[1.0, -2.5, 0.5, 0.0], &WANT), Ok(0.25));
    }

    #[test]
    fn rejects_a_nan_on_either_side() {
        let mut broken = WANT;
        broken[2] = f32::NAN;
        assert!(rejects(&broken, &WANT) && rejects(&WANT, &broken) && rejects(&broken, &broken));
        broken[2] = f32::INFINITY;
        assert!(rejects(&broken, &broken));
    }

    #[test]
    fn rejects_a_slice_of_another_length() {
        assert!(rejects(&WANT[..3], &WANT) && rejects(&WANT, &WANT[..3]) && rejects(&[], &WANT));
    }

    #[test]
    fn rejects_zeros_for_values_and_values_for_zeros() {
        assert!(rejects(&[0.0; 4], &WANT) && rejects(&WANT, &[0.0; 4]));
    }

    #[test]
    fn rejects_one_element_off() {
        for at in 0..4 {
            let mut off = WANT;
            off[at] += 0.01;
            assert!(rejects(&off, &WANT), "element {at}");
        }
    }

    #[test]
    fn rejects_shifted_elements() {
        assert!(rejects(&[-2.0, 0.5, 0.0, 1.0], &WANT));
    }
}
