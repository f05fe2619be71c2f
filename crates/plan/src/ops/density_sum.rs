//! The density-weighted sum `phi = Σ_i g(x_i) · f(x_i)`, one point of the ray at a time, with the last layer of g: apart, each would read
//! again what the other has just had.

use srn_shaders::{DENSITY_SUM_BACKWARD, DENSITY_SUM_FORWARD, DensitySumParams};

use super::linear::Layer;
use super::{output, overwrite, read, size};
use crate::{BufferId, Builder, PlanError};

/// `density [rows] = head · hidden [rows, in]`, `phi [rows, features] (+)= density · feature [rows, features]`; `head` has one output.
pub fn forward(
    b: &mut Builder,
    rows: u32,
    features: u32,
    head: Layer,
    hidden: BufferId,
    feature: BufferId,
    density: BufferId,
    phi: BufferId,
    accumulate: bool,
) -> Result<(), PlanError> {
    let n = size([rows, features]);
    let args = [
        read(hidden, size([rows, head.in_features])),
        read(head.weights, size([head.parameters()])),
        read(feature, n),
        overwrite(density, size([rows])),
        output(phi, n, accumulate),
    ];
    let loops = u64::from(head.in_features + features);
    b.step(&DENSITY_SUM_FORWARD, params(rows, features, head, accumulate), &args, [rows, 1, 1], loops, flops(rows, head))
}

/// `d_phi` → `d_density`, `d_feature`, `d_hidden`; overwrites.
pub fn backward(
    b: &mut Builder,
    rows: u32,
    features: u32,
    head: Layer,
    density: BufferId,
    feature: BufferId,
    d_phi: BufferId,
    d_density: BufferId,
    d_feature: BufferId,
    d_hidden: BufferId,
) -> Result<(), PlanError> {
    let n = size([rows, features]);
    let args = [
        read(density, size([rows])),
        read(feature, n),
        read(d_phi, n),
        read(head.weights, size([head.parameters()])),
        overwrite(d_density, size([rows])),
        overwrite(d_feature, n),
        overwrite(d_hidden, size([rows, head.in_features])),
    ];
    let loops = u64::from(head.in_features + features);
    b.step(&DENSITY_SUM_BACKWARD, params(rows, features, head, false), &args, [rows, 1, 1], loops, flops(rows, head))
}

fn params(rows: u32, features: u32, head: Layer, accumulate: bool) -> DensitySumParams {
    DensitySumParams { rows, in_features: head.in_features, features, accumulate: accumulate.into() }
}

fn flops(rows: u32, head: Layer) -> u64 {
    2 * u64::from(rows) * u64::from(head.in_features)
}
