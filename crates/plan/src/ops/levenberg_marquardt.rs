//! Poses from residuals of every ray: normal equations, acceptance of a trial, and the next one.

use srn_shaders::{
    EquationsParams, LEVENBERG_MARQUARDT_ACCEPT, LEVENBERG_MARQUARDT_EQUATIONS, LEVENBERG_MARQUARDT_SOLVE, PoseParams,
};

use super::{overwrite, read, size, sum, update};
use crate::{BufferId, Builder, PlanError, Rows};

/// Values of a pose's normal equations: the upper triangle of `A [6,6]`, `g [6]`, the loss.
pub const EQUATIONS: u32 = 28;

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
    /// Factor on the loss.
    pub scale: f32,
    /// `ρ(e) = √(e² + soft²) - soft`.
    pub soft: f32,
}

/// Length of the partial sums of [`equations`].
pub fn partial_len(rows: Rows) -> usize {
    size([rows.groups, rows.rows_per_group.div_ceil(CHUNK_ROWS), EQUATIONS])
}

/// One channel's part of `equations [images,28]`, by way of `partial`.
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
    let params =
        EquationsParams { groups, rows_per_group, first_group, chunk_rows: CHUNK_ROWS, chunks, channel, seed, scale, soft };
    let Residuals { world_from_camera, origin, direction, d_origin, d_direction, rgb, wanted } = residuals;
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
    b.step(&LEVENBERG_MARQUARDT_EQUATIONS, params, &args, [groups * chunks, 1, 1], loops, 0)?;
    sum::forward(b, sum::Groups { count: groups, first: first_group }, chunks, EQUATIONS, partial, equations, accumulate)
}

/// Where the loss in `equations [poses,28]` is below that in `best_equations`, copies them and `world_from_camera [poses,12]`
/// and lowers `damping [poses]`; elsewhere raises it.
pub fn accept(
    b: &mut Builder,
    poses: u32,
    equations: BufferId,
    world_from_camera: BufferId,
    best_equations: BufferId,
    best_pose: BufferId,
    damping: BufferId,
) -> Result<(), PlanError> {
    let (n, matrices) = (size([poses, EQUATIONS]), size([poses, 12]));
    let args = [
        read(equations, n),
        read(world_from_camera, matrices),
        update(best_equations, n),
        update(best_pose, matrices),
        update(damping, size([poses])),
    ];
    b.step(&LEVENBERG_MARQUARDT_ACCEPT, PoseParams { poses }, &args, [poses, 1, 1], 40, 0)
}

/// `equations [poses,28]`, `pose [poses,12]`, `damping [poses]` → the next trial, `world_from_camera [poses,12]`.
pub fn solve(
    b: &mut Builder,
    poses: u32,
    equations: BufferId,
    pose: BufferId,
    damping: BufferId,
    world_from_camera: BufferId,
) -> Result<(), PlanError> {
    let matrices = size([poses, 12]);
    let args = [
        read(equations, size([poses, EQUATIONS])),
        read(pose, matrices),
        read(damping, size([poses])),
        overwrite(world_from_camera, matrices),
    ];
    b.step(&LEVENBERG_MARQUARDT_SOLVE, PoseParams { poses }, &args, [poses, 1, 1], 6 * 6 * 6, 0)
}
