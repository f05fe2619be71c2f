//! The six numbers of a pose and its matrix (spec 1).

use srn_shaders::{POSE_BACKWARD, POSE_FORWARD, PoseParams};

use super::{overwrite, read, size};
use crate::{BufferId, Builder, PlanError};

/// `pose6 [poses,6]` → `world_from_camera [poses,12]`.
pub fn forward(b: &mut Builder, poses: u32, pose6: BufferId, world_from_camera: BufferId) -> Result<(), PlanError> {
    let args = [read(pose6, size([poses, 6])), overwrite(world_from_camera, size([poses, 12]))];
    b.step(&POSE_FORWARD, PoseParams { poses }, &args, [poses, 1, 1], 0, 0)
}

/// Gradient of the matrix to the gradient of the six numbers.
pub fn backward(
    b: &mut Builder,
    poses: u32,
    pose6: BufferId,
    d_world_from_camera: BufferId,
    d_pose6: BufferId,
) -> Result<(), PlanError> {
    let args =
        [read(pose6, size([poses, 6])), read(d_world_from_camera, size([poses, 12])), overwrite(d_pose6, size([poses, 6]))];
    b.step(&POSE_BACKWARD, PoseParams { poses }, &args, [poses, 1, 1], 12, 0)
}
