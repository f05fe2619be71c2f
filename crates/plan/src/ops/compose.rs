//! A rigid motion of a start pose, in a given frame: the object-centred way to move a camera.

use srn_shaders::{COMPOSE_BACKWARD, COMPOSE_FORWARD, PoseParams};

use super::{overwrite, read, size};
use crate::{BufferId, Builder, PlanError};

/// `frame · motion · start`, all `[poses,12]` → `world_from_camera [poses,12]`.
pub fn forward(
    b: &mut Builder,
    poses: u32,
    frame: BufferId,
    motion: BufferId,
    start: BufferId,
    world_from_camera: BufferId,
) -> Result<(), PlanError> {
    let n = size([poses, 12]);
    let args = [read(frame, n), read(motion, n), read(start, n), overwrite(world_from_camera, n)];
    b.step(&COMPOSE_FORWARD, PoseParams { poses }, &args, [poses, 1, 1], 3, 0)
}

/// Gradient of the pose to the gradient of the motion.
pub fn backward(
    b: &mut Builder,
    poses: u32,
    frame: BufferId,
    start: BufferId,
    d_world_from_camera: BufferId,
    d_motion: BufferId,
) -> Result<(), PlanError> {
    let n = size([poses, 12]);
    let args = [read(frame, n), read(start, n), read(d_world_from_camera, n), overwrite(d_motion, n)];
    b.step(&COMPOSE_BACKWARD, PoseParams { poses }, &args, [poses, 1, 1], 3, 0)
}
