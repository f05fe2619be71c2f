//! The training term that keeps end points in front of the camera.

use srn_shaders::DEPTH_LOSS_FORWARD;

use super::{overwrite, read, size, sum};
use crate::{BufferId, Builder, PlanError};

/// Length of the partial sums.
pub fn partial_len(count: u32) -> usize {
    super::latent_loss::chunks(count) as usize
}

/// `loss [1] = scale · Σ min(depth, 0)²` over `count` values, by way of `partial`.
pub fn forward(
    b: &mut Builder,
    count: u32,
    scale: f32,
    depth: BufferId,
    partial: BufferId,
    loss: BufferId,
) -> Result<(), PlanError> {
    let params = super::latent_loss::params(count, scale);
    let args = [read(depth, size([count])), overwrite(partial, partial_len(count))];
    b.step(&DEPTH_LOSS_FORWARD, params, &args, [params.chunks, 1, 1], params.chunk.into(), 0)?;
    sum::forward(b, sum::Groups::ONE, params.chunks, 1, partial, loss, false)
}
