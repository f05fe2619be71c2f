//! `R = Rx(θ1)·Ry(θ2)·Rz(θ3)` (spec 1).

use srn_shaders::PoseParams;

use crate::Real;

/// Sines and cosines of the three angles.
fn angles<T: Real>(pose: &[T]) -> ([T; 3], [T; 3]) {
    ([pose[0].sin(), pose[1].sin(), pose[2].sin()], [pose[0].cos(), pose[1].cos(), pose[2].cos()])
}

/// `pose6` → 3×4 matrix, row-major.
pub fn forward<T: Real>(p: PoseParams, pose6: &[T], world_from_camera: &mut [T]) {
    for (pose, matrix) in pose6.chunks_exact(6).zip(world_from_camera.chunks_exact_mut(12)).take(p.poses as usize) {
        let ([s1, s2, s3], [c1, c2, c3]) = angles(pose);
        let rows = [
            [c2 * c3, -c2 * s3, s2, pose[3]],
            [c1 * s3 + c3 * s1 * s2, c1 * c3 - s1 * s2 * s3, -c2 * s1, pose[4]],
            [s1 * s3 - c1 * c3 * s2, c3 * s1 + c1 * s2 * s3, c1 * c2, pose[5]],
        ];
        matrix.copy_from_slice(rows.as_flattened());
    }
}

/// Contracts `d_world_from_camera` with the derivative of the matrix by each angle.
pub fn backward<T: Real>(p: PoseParams, pose6: &[T], d_world_from_camera: &[T], d_pose6: &mut [T]) {
    let zero = T::zero();
    let poses = pose6.chunks_exact(6).zip(d_world_from_camera.chunks_exact(12)).zip(d_pose6.chunks_exact_mut(6));
    for ((pose, d), d_pose) in poses.take(p.poses as usize) {
        let ([s1, s2, s3], [c1, c2, c3]) = angles(pose);
        let by_angle = [
            [
                [zero, zero, zero],
                [-s1 * s3 + c3 * c1 * s2, -s1 * c3 - c1 * s2 * s3, -c2 * c1],
                [c1 * s3 + s1 * c3 * s2, c3 * c1 - s1 * s2 * s3, -s1 * c2],
            ],
            [[-s2 * c3, s2 * s3, c2], [c3 * s1 * c2, -s1 * c2 * s3, s2 * s1], [-c1 * c3 * c2, c1 * c2 * s3, -c1 * s2]],
            [
                [-c2 * s3, -c2 * c3, zero],
                [c1 * c3 - s3 * s1 * s2, -c1 * s3 - s1 * s2 * c3, zero],
                [s1 * c3 + c1 * s3 * s2, -s3 * s1 + c1 * s2 * c3, zero],
            ],
        ];
        for angle in 0..3 {
            d_pose[angle] = (0..9).map(|k| d[k / 3 * 4 + k % 3] * by_angle[angle][k / 3][k % 3]).sum();
        }
        for axis in 0..3 {
            d_pose[3 + axis] = d[axis * 4 + 3];
        }
    }
}
