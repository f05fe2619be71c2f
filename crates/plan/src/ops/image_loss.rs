//! Losses that are a sum over pixels: MAE, MSE, norm_l1, norm_l2 (spec 4), Charbonnier. `wanted [rows,4]` is a pixel's colour and how much it counts.

use srn_shaders::{IMAGE_LOSS_BACKWARD, IMAGE_LOSS_COUNT, IMAGE_LOSS_FORWARD, ImageLossParams};

use super::{overwrite, read, size, sum};
use crate::{BufferId, Builder, PlanError, Rows};

/// Rows per partial sum.
const CHUNK_ROWS: u32 = 64;

/// Which sum, and divided by what.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Kind {
    /// Mean of `|e|` over an image's values.
    Mae,
    /// Mean of `e²`.
    Mse,
    /// Sum of `|e|`, divided by one plus the number of wanted values that are not exactly 1.
    NormL1,
    /// Sum of `e²`, divided likewise.
    NormL2,
    /// Mean of `√(e² + soft²) - soft`.
    Charbonnier {
        /// Residual at which it turns from squares to absolute values.
        soft: f32,
    },
}

/// Length of the partial sums, for `images` of `pixels`.
pub fn partial_len(images: u32, pixels: u32) -> usize {
    size([images, pixels.div_ceil(CHUNK_ROWS)])
}

/// `count [images]`: wanted values that are not exactly 1, by their weights. Once per target.
pub fn count(
    b: &mut Builder,
    images: u32,
    pixels: u32,
    wanted: BufferId,
    partial: BufferId,
    count: BufferId,
) -> Result<(), PlanError> {
    let params = params(Kind::Mae, whole(images, pixels), pixels, 0.0);
    let args = [read(wanted, size([images, pixels, 4])), overwrite(partial, partial_len(images, pixels))];
    b.step(&IMAGE_LOSS_COUNT, params, &args, [images * params.chunks, 1, 1], loops(), 0)?;
    sum::forward(b, sum::Groups::all(images), params.chunks, 1, partial, count, false)
}

/// `loss [images]` of whole images.
pub fn forward(
    b: &mut Builder,
    kind: Kind,
    images: u32,
    pixels: u32,
    rgb: BufferId,
    wanted: BufferId,
    count: BufferId,
    partial: BufferId,
    loss: BufferId,
) -> Result<(), PlanError> {
    let params = params(kind, whole(images, pixels), pixels, 0.0);
    let args = [
        read(rgb, size([images, pixels, 3])),
        read(wanted, size([images, pixels, 4])),
        read(count, size([images])),
        overwrite(partial, partial_len(images, pixels)),
    ];
    b.step(&IMAGE_LOSS_FORWARD, params, &args, [images * params.chunks, 1, 1], loops(), 0)?;
    sum::forward(b, sum::Groups::all(images), params.chunks, 1, partial, loss, false)
}

/// `d_rgb [rows,3]` of `scale · Σ_images loss`, for the rows of a tile; `pixels` of a whole image are the divisor.
pub fn backward(
    b: &mut Builder,
    kind: Kind,
    rows: Rows,
    pixels: u32,
    scale: f32,
    rgb: BufferId,
    wanted: BufferId,
    count: BufferId,
    d_rgb: BufferId,
) -> Result<(), PlanError> {
    let values = size([rows.count(), 3]);
    let args = [
        read(rgb, values),
        read(wanted, size([rows.count(), 4])),
        read(count, size([rows.first_group + rows.groups])),
        overwrite(d_rgb, values),
    ];
    b.step(&IMAGE_LOSS_BACKWARD, params(kind, rows, pixels, scale), &args, [values as u32, 1, 1], 0, 0)
}

fn whole(images: u32, pixels: u32) -> Rows {
    Rows { groups: images, rows_per_group: pixels, first_group: 0 }
}

fn loops() -> u64 {
    3 * u64::from(CHUNK_ROWS) + u64::from(CHUNK_ROWS)
}

fn params(kind: Kind, rows: Rows, pixels: u32, scale: f32) -> ImageLossParams {
    let (number, soft) = match kind {
        Kind::Mae => (0, 0.0),
        Kind::Mse => (1, 0.0),
        Kind::NormL1 => (2, 0.0),
        Kind::NormL2 => (3, 0.0),
        Kind::Charbonnier { soft } => (4, soft),
    };
    ImageLossParams {
        kind: number,
        groups: rows.groups,
        rows_per_group: rows.rows_per_group,
        first_group: rows.first_group,
        values_per_image: 3 * pixels,
        chunk_rows: CHUNK_ROWS,
        chunks: rows.rows_per_group.div_ceil(CHUNK_ROWS),
        scale,
        soft,
    }
}
