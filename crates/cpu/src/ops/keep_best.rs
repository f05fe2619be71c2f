//! The best step of a descent.

use srn_shaders::KeepBestParams;

use crate::Real;

/// Copies loss and pose where the loss is the lowest so far.
pub fn step<T: Real>(p: KeepBestParams, loss: &[T], pose6: &[T], best_loss: &mut [T], best_pose6: &mut [T]) {
    for pose in 0..p.poses as usize {
        if loss[pose] < best_loss[pose] {
            best_loss[pose] = loss[pose];
            best_pose6[6 * pose..6 * pose + 6].copy_from_slice(&pose6[6 * pose..6 * pose + 6]);
        }
    }
}
