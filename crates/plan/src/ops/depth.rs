//! Depth of a point: its z in the camera frame (spec 2, last line).

use srn_shaders::{DEPTH_BACKWARD, DEPTH_FORWARD, DepthParams};

use super::{overwrite, read, size};
use crate::{BufferId, Builder, PlanError, Rows};

/// `x [rows,3]` → `depth [rows]`.
pub fn forward(b: &mut Builder, rows: Rows, world_from_camera: BufferId, x: BufferId, depth: BufferId) -> Result<(), PlanError> {
    let n = rows.count();
    let args =
        [read(world_from_camera, size([rows.first_group + rows.groups, 12])), read(x, size([n, 3])), overwrite(depth, size([n]))];
    b.step(&DEPTH_FORWARD, params(rows, 0.0), &args, [n, 1, 1], 0, 0)
}

/// Gradient of `scale · Σ min(depth, 0)²` to the points.
pub fn backward(
    b: &mut Builder,
    rows: Rows,
    scale: f32,
    world_from_camera: BufferId,
    depth: BufferId,
    d_x: BufferId,
) -> Result<(), PlanError> {
    let n = rows.count();
    let args = [
        read(world_from_camera, size([rows.first_group + rows.groups, 12])),
        read(depth, size([n])),
        overwrite(d_x, size([n, 3])),
    ];
    b.step(&DEPTH_BACKWARD, params(rows, scale), &args, [n, 1, 1], 0, 0)
}

fn params(rows: Rows, scale: f32) -> DepthParams {
    let Rows { groups, rows_per_group, first_group } = rows;
    DepthParams { groups, rows_per_group, first_group, scale }
}
