//! Layer normalisation with gamma and beta, then ReLU. Without affine, the caller binds gamma = 1, beta = 0.

use srn_shaders::{LAYER_NORM_RELU_BACKWARD_AFFINE, LAYER_NORM_RELU_BACKWARD_INPUT, LAYER_NORM_RELU_FORWARD, LayerNormParams};

use super::{output, overwrite, read, size, sum};
use crate::{BufferId, Builder, Parts, PlanError};

/// What [`forward`] saved for the way back.
#[derive(Clone, Copy, Debug)]
pub struct Saved {
    /// Input `[rows, features]`.
    pub x: BufferId,
    /// `[rows, 2]`: mean and 1 / standard deviation.
    pub stats: BufferId,
    /// `[2, features]`: gamma, beta.
    pub affine: BufferId,
    /// The rows of `x` have no mean, since the weights of the linear map before have none over its outputs. Then none is looked for, and on
    /// the way back what is the same for all features of a row is left in `d_x`: that map takes it to nothing.
    pub centred: bool,
}

/// `x [rows, features]` → `y [rows, features]`; overwrites `saved.stats`.
pub fn forward(b: &mut Builder, rows: u32, features: u32, saved: Saved, y: BufferId) -> Result<(), PlanError> {
    let n = size([rows, features]);
    let args =
        [read(saved.x, n), read(saved.affine, size([2, features])), overwrite(y, n), overwrite(saved.stats, size([rows, 2]))];
    b.step(&LAYER_NORM_RELU_FORWARD, params(rows, features, saved), &args, [rows, 1, 1], 3 * u64::from(features), 0)
}

/// `d_y` → `d_x`, both `[rows, features]`; overwrites.
pub fn backward_input(
    b: &mut Builder,
    rows: u32,
    features: u32,
    saved: Saved,
    d_y: BufferId,
    d_x: BufferId,
) -> Result<(), PlanError> {
    let n = size([rows, features]);
    let args = [
        read(saved.x, n),
        read(saved.stats, size([rows, 2])),
        read(saved.affine, size([2, features])),
        read(d_y, n),
        overwrite(d_x, n),
    ];
    b.step(&LAYER_NORM_RELU_BACKWARD_INPUT, params(rows, features, saved), &args, [rows, 1, 1], 2 * u64::from(features), 0)
}

/// Length of the sums of [`backward_affine`].
pub fn sums_len(parts: Parts, features: u32) -> usize {
    size([parts.count(), 2, features])
}

/// Gradient of gamma and beta over each part of the rows, `sums [groups · chunks, 2, features]`; where all rows are one part, that is the
/// gradient.
pub fn backward_affine(
    b: &mut Builder,
    parts: Parts,
    features: u32,
    saved: Saved,
    d_y: BufferId,
    sums: BufferId,
    accumulate: bool,
) -> Result<(), PlanError> {
    let Parts { rows, chunk_rows, chunks } = parts;
    let n = size([rows.count(), features]);
    let args = [
        read(saved.x, n),
        read(saved.stats, size([rows.count(), 2])),
        read(saved.affine, size([2, features])),
        read(d_y, n),
        output(sums, sums_len(parts, features), accumulate),
    ];
    let rows_per_group = rows.rows_per_group;
    let params = params(rows.count(), features, saved);
    let params = LayerNormParams { rows_per_group, chunk_rows, chunks, accumulate: accumulate.into(), ..params };
    b.step(&LAYER_NORM_RELU_BACKWARD_AFFINE, params, &args, [features, parts.count(), 1], chunk_rows.into(), 0)
}

/// From the sums of [`backward_affine`] to the gradient, `d_affine [2, features]`.
pub fn sum_of_parts(
    b: &mut Builder,
    parts: Parts,
    features: u32,
    sums: BufferId,
    d_affine: BufferId,
    accumulate: bool,
) -> Result<(), PlanError> {
    sum::forward(b, sum::Groups::ONE, parts.count(), 2 * features, sums, d_affine, accumulate)
}

fn params(rows: u32, features: u32, saved: Saved) -> LayerNormParams {
    LayerNormParams { rows, features, centred: saved.centred.into(), ..Default::default() }
}
