//! The density-weighted sum `phi = Σ_i g(x_i) · f(x_i)`, one point of the ray at a time.

use srn_shaders::{DENSITY_SUM_BACKWARD, DENSITY_SUM_FORWARD, PointParams};

use super::{output, overwrite, read, size};
use crate::{BufferId, Builder, PlanError};

/// `phi [rows, features] (+)= density [rows] · feature [rows, features]`.
pub fn forward(
    b: &mut Builder,
    rows: u32,
    features: u32,
    density: BufferId,
    feature: BufferId,
    phi: BufferId,
    accumulate: bool,
) -> Result<(), PlanError> {
    let n = size([rows, features]);
    let args = [read(density, size([rows])), read(feature, n), output(phi, n, accumulate)];
    let params = PointParams { rows, features, accumulate: accumulate.into() };
    b.step(&DENSITY_SUM_FORWARD, params, &args, [n as u32, 1, 1], 0, 0)
}

/// `d_phi` → `d_density`, `d_feature`; overwrites.
pub fn backward(
    b: &mut Builder,
    rows: u32,
    features: u32,
    density: BufferId,
    feature: BufferId,
    d_phi: BufferId,
    d_density: BufferId,
    d_feature: BufferId,
) -> Result<(), PlanError> {
    let n = size([rows, features]);
    let args = [
        read(density, size([rows])),
        read(feature, n),
        read(d_phi, n),
        overwrite(d_density, size([rows])),
        overwrite(d_feature, n),
    ];
    let params = PointParams { rows, features, accumulate: 0 };
    b.step(&DENSITY_SUM_BACKWARD, params, &args, [rows, 1, 1], features.into(), 0)
}
