//! Pixels to rays (spec 2, first lines), and every ray's derivative back to its image's pose matrix.

use srn_shaders::{RAYS_BACKWARD, RAYS_FORWARD, RaysParams};

use super::{overwrite, read, size, sum};
use crate::{BufferId, Builder, PlanError, Rows};

/// Rows per partial sum of [`backward`].
const CHUNK_ROWS: u32 = 128;

/// What a ray is made of, per image and per row.
#[derive(Clone, Copy, Debug)]
pub struct Pixels {
    /// `[images,12]`.
    pub world_from_camera: BufferId,
    /// `[images,4]`: fx, fy, cx, cy.
    pub intrinsics: BufferId,
    /// `[rows,2]`.
    pub uv: BufferId,
    /// `[rows]`.
    pub z0: BufferId,
    /// Radius of the sphere around the origin on which rays begin; 0: at the camera.
    pub sphere: f32,
}

/// `origin, direction [rows,3]`.
pub fn forward(b: &mut Builder, rows: Rows, pixels: Pixels, origin: BufferId, direction: BufferId) -> Result<(), PlanError> {
    let n = rows.count();
    let images = rows.first_group + rows.groups;
    let args = [
        read(pixels.world_from_camera, size([images, 12])),
        read(pixels.intrinsics, size([images, 4])),
        read(pixels.uv, size([n, 2])),
        read(pixels.z0, size([n])),
        overwrite(origin, size([n, 3])),
        overwrite(direction, size([n, 3])),
    ];
    b.step(&RAYS_FORWARD, params(rows, 0, 0, pixels.sphere), &args, [n, 1, 1], 0, 0)
}

/// Length of the partial sums of [`backward`].
pub fn partial_len(rows: Rows) -> usize {
    size([rows.groups, rows.rows_per_group.div_ceil(CHUNK_ROWS), 12])
}

/// `d_origin, d_direction [rows,3]` → `d_world_from_camera [images,12]`, by way of `partial`.
pub fn backward(
    b: &mut Builder,
    rows: Rows,
    pixels: Pixels,
    d_origin: BufferId,
    d_direction: BufferId,
    partial: BufferId,
    d_world_from_camera: BufferId,
    accumulate: bool,
) -> Result<(), PlanError> {
    let n = rows.count();
    let images = rows.first_group + rows.groups;
    let chunks = rows.rows_per_group.div_ceil(CHUNK_ROWS);
    let args = [
        read(pixels.world_from_camera, size([images, 12])),
        read(pixels.intrinsics, size([images, 4])),
        read(pixels.uv, size([n, 2])),
        read(pixels.z0, size([n])),
        read(d_origin, size([n, 3])),
        read(d_direction, size([n, 3])),
        overwrite(partial, partial_len(rows)),
    ];
    b.step(
        &RAYS_BACKWARD,
        params(rows, CHUNK_ROWS, chunks, pixels.sphere),
        &args,
        [rows.groups * chunks, 1, 1],
        CHUNK_ROWS.into(),
        0,
    )?;
    let groups = sum::Groups { count: rows.groups, first: rows.first_group };
    sum::forward(b, groups, chunks, 12, partial, d_world_from_camera, accumulate)
}

fn params(rows: Rows, chunk_rows: u32, chunks: u32, sphere: f32) -> RaysParams {
    let Rows { groups, rows_per_group, first_group } = rows;
    RaysParams { groups, rows_per_group, first_group, chunk_rows, chunks, sphere }
}
