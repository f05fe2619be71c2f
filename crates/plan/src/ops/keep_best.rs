//! Remembers the best step of a descent.

use srn_shaders::{KEEP_BEST_STEP, KeepBestParams};

use super::{read, size, update};
use crate::{BufferId, Builder, PlanError};

/// Where `loss [poses]` is below `best_loss`, copies it and `pose6 [poses,6]`.
pub fn step(
    b: &mut Builder,
    poses: u32,
    loss: BufferId,
    pose6: BufferId,
    best_loss: BufferId,
    best_pose6: BufferId,
) -> Result<(), PlanError> {
    let args = [
        read(loss, size([poses])),
        read(pose6, size([poses, 6])),
        update(best_loss, size([poses])),
        update(best_pose6, size([poses, 6])),
    ];
    b.step(&KEEP_BEST_STEP, KeepBestParams { poses }, &args, [poses, 1, 1], 6, 0)
}
