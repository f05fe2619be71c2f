//! Random numbers that are the same on every machine: a stream per (seed, step), so that nothing about them must be saved.

use rand::{RngExt, SeedableRng};

/// The generator.
pub type Random = rand_pcg::Pcg64;

/// Mean and standard deviation of the initial depth along z (spec 2).
const Z0: (f64, f64) = (0.05, 5e-4);
/// The mean alone.
pub(crate) const MEAN_DEPTH: f32 = Z0.0 as f32;

/// The stream of a seed and a step: same arguments, same numbers.
pub fn stream(seed: u64, step: u64) -> Random {
    let mut bytes = [0; 32];
    bytes[..8].copy_from_slice(&seed.to_le_bytes());
    bytes[8..16].copy_from_slice(&step.to_le_bytes());
    bytes[16] = 1;
    Random::from_seed(bytes)
}

/// A standard normal number (Box–Muller).
pub(crate) fn normal(random: &mut Random) -> f64 {
    let radius = (-2.0 * (1.0 - random.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * random.random::<f64>()).cos()
}

/// Initial depths of `rows` rays.
pub(crate) fn initial_depths(random: &mut Random, rows: usize) -> Vec<f32> {
    (0..rows).map(|_| (Z0.0 + Z0.1 * normal(random)) as f32).collect()
}
