//! Poses by descent with second derivatives: from the residuals of every ray at first, then from the change of the gradient.

use srn_shaders::{BFGS_BEGIN, BFGS_EQUATIONS, BFGS_GRADIENT, BFGS_SOLVE, BFGS_UPDATE, EquationsParams, PoseParams, SolveParams};

use super::{overwrite, read, size, sum, update as update_of};
use crate::{BufferId, Builder, PlanError, Rows};

/// Values of a pose's normal equations: the upper triangle of `A [6,6]`, `g [6]`.
pub const EQUATIONS: u32 = 27;

/// Values of a search's state, for each pose: the upper triangle of the second derivatives, and what has the places below.
pub const STATE: u32 = 47;
/// Place of the best loss.
pub const STATE_LOSS: usize = 27;
/// Place of the best pose, 12 values.
pub const STATE_POSE: usize = 28;

/// The second derivatives in a state.
pub fn curvature(state: &[f32]) -> [[f64; 6]; 6] {
    let place = |a: usize, b: usize| a * (11 - a) / 2 + b;
    std::array::from_fn(|a| std::array::from_fn(|b| state[place(a.min(b), a.max(b))].into()))
}

/// Rows per partial sum of [`equations`].
const CHUNK_ROWS: u32 = 128;

/// What the equations are made of, per image and per row of a tile.
#[derive(Clone, Copy, Debug)]
pub struct Residuals {
    /// `[images,12]`.
    pub world_from_camera: BufferId,
    /// Rays `[rows,3]`.
    pub origin: BufferId,
    /// `[rows,3]`.
    pub direction: BufferId,
    /// Gradients of `seed · rgb[channel]` to them `[rows,3]`.
    pub d_origin: BufferId,
    /// `[rows,3]`.
    pub d_direction: BufferId,
    /// Radius of the sphere on which they begin; 0: at the camera.
    pub sphere: f32,
    /// Colours `[rows,3]`.
    pub rgb: BufferId,
    /// Colours wanted, and how much a pixel counts `[rows,4]`.
    pub wanted: BufferId,
}

/// How residuals of a channel count.
#[derive(Clone, Copy, Debug)]
pub struct Channel {
    /// 0 red, 1 green, 2 blue.
    pub number: u32,
    /// What the backward pass began with.
    pub seed: f32,
    /// Factor on the equations.
    pub scale: f32,
    /// Of the loss [`super::image_loss::Kind::Charbonnier`].
    pub soft: f32,
}

/// Length of the partial sums of [`equations`].
pub fn partial_len(rows: Rows) -> usize {
    size([rows.groups, rows.rows_per_group.div_ceil(CHUNK_ROWS), EQUATIONS])
}

/// One channel's part of `equations [images,27]`, by way of `partial`.
pub fn equations(
    b: &mut Builder,
    rows: Rows,
    residuals: Residuals,
    channel: Channel,
    partial: BufferId,
    equations: BufferId,
    accumulate: bool,
) -> Result<(), PlanError> {
    let n = size([rows.count(), 3]);
    let chunks = rows.rows_per_group.div_ceil(CHUNK_ROWS);
    let Rows { groups, rows_per_group, first_group } = rows;
    let Channel { number: channel, seed, scale, soft } = channel;
    let Residuals { world_from_camera, origin, direction, d_origin, d_direction, sphere, rgb, wanted } = residuals;
    let params = EquationsParams {
        groups,
        rows_per_group,
        first_group,
        chunk_rows: CHUNK_ROWS,
        chunks,
        channel,
        seed,
        scale,
        soft,
        sphere,
    };
    let args = [
        read(world_from_camera, size([first_group + groups, 12])),
        read(origin, n),
        read(direction, n),
        read(d_origin, n),
        read(d_direction, n),
        read(rgb, n),
        read(wanted, size([rows.count(), 4])),
        overwrite(partial, partial_len(rows)),
    ];
    let loops = u64::from(CHUNK_ROWS) * (1 + 6 + 21) + u64::from(EQUATIONS);
    b.step(&BFGS_EQUATIONS, params, &args, [groups * chunks, 1, 1], loops, 0)?;
    sum::forward(b, sum::Groups { count: groups, first: first_group }, chunks, EQUATIONS, partial, equations, accumulate)
}

/// `state [poses,47]` at the first pose, from the equations there.
pub fn begin(
    b: &mut Builder,
    poses: u32,
    equations: BufferId,
    loss: BufferId,
    world_from_camera: BufferId,
    state: BufferId,
) -> Result<(), PlanError> {
    let args = [
        read(equations, size([poses, EQUATIONS])),
        read(loss, size([poses])),
        read(world_from_camera, size([poses, 12])),
        overwrite(state, size([poses, STATE])),
    ];
    b.step(&BFGS_BEGIN, PoseParams { poses }, &args, [poses, 1, 1], STATE.into(), 0)
}

/// `gradient [poses,6]` over the motion of [`solve`], from that over the matrix, `d_world_from_camera [poses,12]`.
pub fn gradient(
    b: &mut Builder,
    poses: u32,
    world_from_camera: BufferId,
    d_world_from_camera: BufferId,
    gradient: BufferId,
) -> Result<(), PlanError> {
    let matrices = size([poses, 12]);
    let args = [read(world_from_camera, matrices), read(d_world_from_camera, matrices), overwrite(gradient, size([poses, 6]))];
    b.step(&BFGS_GRADIENT, PoseParams { poses }, &args, [poses, 1, 1], 10, 0)
}

/// What the trial `world_from_camera [poses,12]` says: its loss and `gradient [poses,6]`.
pub fn update(
    b: &mut Builder,
    poses: u32,
    gradient: BufferId,
    loss: BufferId,
    world_from_camera: BufferId,
    state: BufferId,
) -> Result<(), PlanError> {
    let args = [
        read(gradient, size([poses, 6])),
        read(loss, size([poses])),
        read(world_from_camera, size([poses, 12])),
        update_of(state, size([poses, STATE])),
    ];
    b.step(&BFGS_UPDATE, PoseParams { poses }, &args, [poses, 1, 1], 100, 0)
}

/// The next trial, `world_from_camera [poses,12]`. Steps are multiples of `grain`; 0: of any length.
pub fn solve(b: &mut Builder, poses: u32, grain: f32, world_from_camera: BufferId, state: BufferId) -> Result<(), PlanError> {
    let args = [overwrite(world_from_camera, size([poses, 12])), update_of(state, size([poses, STATE]))];
    b.step(&BFGS_SOLVE, SolveParams { poses, grain }, &args, [poses, 1, 1], 6 * 6 * 6, 0)
}
