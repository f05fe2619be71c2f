//! The training term that keeps latent codes small.

use srn_shaders::{LATENT_LOSS_BACKWARD, LATENT_LOSS_FORWARD, TermParams};

use super::{overwrite, read, size, sum, update};
use crate::{BufferId, Builder, PlanError};

/// Values per partial sum.
const CHUNK: u32 = 256;

pub(super) fn chunks(count: u32) -> u32 {
    count.div_ceil(CHUNK)
}

pub(super) fn params(count: u32, scale: f32) -> TermParams {
    TermParams { count, chunk: CHUNK, chunks: chunks(count), scale }
}

/// Length of the partial sums.
pub fn partial_len(count: u32) -> usize {
    chunks(count) as usize
}

/// `loss [1] = scale · Σ z²` over `count` values, by way of `partial`.
pub fn forward(b: &mut Builder, count: u32, scale: f32, z: BufferId, partial: BufferId, loss: BufferId) -> Result<(), PlanError> {
    let params = params(count, scale);
    let args = [read(z, size([count])), overwrite(partial, partial_len(count))];
    b.step(&LATENT_LOSS_FORWARD, params, &args, [params.chunks, 1, 1], params.chunk.into(), 0)?;
    sum::forward(b, sum::Groups::ONE, params.chunks, 1, partial, loss, false)
}

/// `d_z += 2 scale z`: accumulates.
pub fn backward(b: &mut Builder, count: u32, scale: f32, z: BufferId, d_z: BufferId) -> Result<(), PlanError> {
    let args = [read(z, size([count])), update(d_z, size([count]))];
    b.step(&LATENT_LOSS_BACKWARD, params(count, scale), &args, [count, 1, 1], 0, 0)
}
