//! What colours a thing has.

use glam::{DMat3, DVec3};

/// Colours as a sum of Gaussians.
pub(crate) struct Mixture(Vec<Gaussian>);

struct Gaussian {
    /// Logarithm of what it has of all, over its width.
    height: f64,
    mean: DVec3,
    precision: DMat3,
}

/// Gaussians of each side.
const PARTS: usize = 5;
/// Fewer colours say nothing, and more than so many say nothing new.
const FEWEST: usize = 16;
const MOST: usize = 4096;
/// Variance that every colour has, of [-1, 1]: four or five steps of 255.
const NOISE: f64 = 1.2e-3;

impl Mixture {
    /// Of the colours of a side; `None` of too few.
    pub fn of(colours: &[DVec3]) -> Option<Self> {
        const TURNS: usize = 8;
        if colours.len() < FEWEST {
            return None;
        }
        let own: Vec<DVec3> = colours.iter().copied().step_by(colours.len().div_ceil(MOST)).collect();
        let first = split(&own);
        let mut mixture = Mixture::with(&own, |i, part| f64::from(u8::from(first[i] == part)));
        for _ in 0..TURNS {
            let parts: Vec<[f64; PARTS]> = own.iter().map(|&colour| mixture.parts(colour)).collect();
            mixture = Mixture::with(&own, |i, part| parts[i][part]);
        }
        Some(mixture)
    }

    /// Of colours that belong to each part as far as it says.
    fn with(own: &[DVec3], belongs: impl Fn(usize, usize) -> f64) -> Self {
        let gaussian = |part: usize| {
            let weighted = || own.iter().enumerate().map(|(i, &colour)| (colour, belongs(i, part)));
            let weight = weighted().map(|(_, weight)| weight).sum::<f64>().max(1e-9);
            let mean = weighted().map(|(colour, weight)| weight * colour).sum::<DVec3>() / weight;
            let outer = |(colour, weight): (DVec3, f64)| {
                let off = colour - mean;
                DMat3::from_cols(off.x * off, off.y * off, off.z * off) * weight
            };
            let spread = weighted().map(outer).fold(DMat3::ZERO, |sum, next| sum + next);
            let covariance = spread * weight.recip() + DMat3::from_diagonal(DVec3::splat(NOISE));
            let height = (weight / own.len() as f64).ln() - 0.5 * covariance.determinant().ln();
            Gaussian { height, mean, precision: covariance.inverse() }
        };
        Mixture((0..PARTS).map(gaussian).collect())
    }

    fn exponents(&self, colour: DVec3) -> impl Iterator<Item = f64> {
        self.0.iter().map(move |Gaussian { height, mean, precision }| {
            let off = colour - *mean;
            height - 0.5 * off.dot(*precision * off)
        })
    }

    /// How far a colour belongs to each part.
    fn parts(&self, colour: DVec3) -> [f64; PARTS] {
        let density = self.log_density(colour);
        let mut parts = [0.0; PARTS];
        parts.iter_mut().zip(self.exponents(colour)).for_each(|(part, exponent)| *part = (exponent - density).exp());
        parts
    }

    /// But for a constant.
    pub fn log_density(&self, colour: DVec3) -> f64 {
        let most = self.exponents(colour).fold(f64::NEG_INFINITY, f64::max);
        most + self.exponents(colour).map(|exponent| (exponent - most).exp()).sum::<f64>().ln()
    }
}

/// To which of the [`PARTS`] each colour belongs at first: again and again the one that is most spread is cut through its mean.
fn split(own: &[DVec3]) -> Vec<usize> {
    let mut parts = vec![0; own.len()];
    for new in 1..PARTS {
        let spread = |part: usize| {
            let in_part = || own.iter().zip(&parts).filter(move |(_, of)| **of == part).map(|(colour, _)| *colour);
            let mean = in_part().sum::<DVec3>() / in_part().count().max(1) as f64;
            (in_part().map(|colour| (colour - mean) * (colour - mean)).sum::<DVec3>(), mean, part)
        };
        let most = (0..new).map(spread).max_by(|a, b| a.0.max_element().total_cmp(&b.0.max_element()));
        let Some((spread, mean, part)) = most else { break };
        let channel = (0..3).max_by(|&a, &b| spread[a].total_cmp(&spread[b])).unwrap_or(0);
        for (colour, of) in own.iter().zip(&mut parts) {
            if *of == part && colour[channel] > mean[channel] {
                *of = new;
            }
        }
    }
    parts
}
