//! Small positive matrices.

/// `L` of `L Lᵀ = m`; `None` if that is not positive.
pub(crate) fn cholesky<const N: usize>(m: &[[f64; N]; N]) -> Option<[[f64; N]; N]> {
    let mut lower = [[0.0; N]; N];
    for i in 0..N {
        for j in 0..=i {
            let sum = m[i][j] - (0..j).map(|k| lower[i][k] * lower[j][k]).sum::<f64>();
            // Also where it is no number.
            if i == j && !(sum > 0.0 && sum.is_finite()) {
                return None;
            }
            lower[i][j] = if i == j { sum.sqrt() } else { sum / lower[j][j] };
        }
    }
    Some(lower)
}

/// `L⁻¹ x`.
pub(crate) fn forward<const N: usize>(lower: &[[f64; N]; N], mut x: [f64; N]) -> [f64; N] {
    for i in 0..N {
        let known: f64 = (0..i).map(|k| lower[i][k] * x[k]).sum();
        x[i] = (x[i] - known) / lower[i][i];
    }
    x
}

/// `L⁻ᵀ x`.
pub(crate) fn backward<const N: usize>(lower: &[[f64; N]; N], mut x: [f64; N]) -> [f64; N] {
    for i in (0..N).rev() {
        let known: f64 = (i + 1..N).map(|k| lower[k][i] * x[k]).sum();
        x[i] = (x[i] - known) / lower[i][i];
    }
    x
}

/// `m⁻¹ x`, from the `L` of `m`.
pub(crate) fn solve<const N: usize>(lower: &[[f64; N]; N], x: [f64; N]) -> [f64; N] {
    backward(lower, forward(lower, x))
}

#[cfg(test)]
mod tests {
    use std::array;

    use super::*;

    #[test]
    fn factors_solve_what_they_are_of() {
        let m: [[f64; 7]; 7] =
            array::from_fn(|i| array::from_fn(|j| if i == j { 3.0 + i as f64 } else { 1.0 / (1.0 + (i + j) as f64) }));
        let x: [f64; 7] = array::from_fn(|i| i as f64 - 2.5);
        let product = m.map(|row| row.iter().zip(&x).map(|(a, b)| a * b).sum::<f64>());
        let found = solve(&cholesky(&m).unwrap(), product);
        assert!(found.iter().zip(&x).all(|(a, b)| (a - b).abs() < 1e-12), "{found:?}");
        assert_eq!([[[1.0, 2.0], [2.0, 1.0]], [[1.0, 0.0], [0.0, f64::NAN]]].map(|m| cholesky(&m)), [None; 2]);
    }
}
