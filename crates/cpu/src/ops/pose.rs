//! `R = Rx(θ1)·Ry(θ2)·Rz(θ3)` (spec 1).

use srn_shaders::PoseParams;

use crate::Real;

/// Sines and cosines of the three angles.
fn angles<T: Real>(pose: &[T]) -> ([f64; 3], [f64; 3]) {
    let angle = |k: usize| pose[k].wide();
    ([0, 1, 2].map(|k| angle(k).sin()), [0, 1, 2].map(|k| angle(k).cos()))
}

/// `pose6` → 3×4 matrix, row-major.
pub fn forward<T: Real>(p: PoseParams, pose6: &[T], world_from_camera: &mut [T]) {
    for (pose, matrix) in pose6.chunks_exact(6).zip(world_from_camera.chunks_exact_mut(12)).take(p.poses as usize) {
        let ([s1, s2, s3], [c1, c2, c3]) = angles(pose);
        let rows = [
            [c2 * c3, -c2 * s3, s2, pose[3].wide()],
            [c1 * s3 + c3 * s1 * s2, c1 * c3 - s1 * s2 * s3, -c2 * s1, pose[4].wide()],
            [s1 * s3 - c1 * c3 * s2, c3 * s1 + c1 * s2 * s3, c1 * c2, pose[5].wide()],
        ];
        for (value, &row) in matrix.iter_mut().zip(rows.as_flattened()) {
            *value = T::of(row);
        }
    }
}

/// Contracts `d_world_from_camera` with the derivative of the matrix by each angle.
pub fn backward<T: Real>(p: PoseParams, pose6: &[T], d_world_from_camera: &[T], d_pose6: &mut [T]) {
    let poses = pose6.chunks_exact(6).zip(d_world_from_camera.chunks_exact(12)).zip(d_pose6.chunks_exact_mut(6));
    for ((pose, d), d_pose) in poses.take(p.poses as usize) {
        let ([s1, s2, s3], [c1, c2, c3]) = angles(pose);
        let by_angle = [
            [
                [0.0, 0.0, 0.0],
                [-s1 * s3 + c3 * c1 * s2, -s1 * c3 - c1 * s2 * s3, -c2 * c1],
                [c1 * s3 + s1 * c3 * s2, c3 * c1 - s1 * s2 * s3, -s1 * c2],
            ],
            [[-s2 * c3, s2 * s3, c2], [c3 * s1 * c2, -s1 * c2 * s3, s2 * s1], [-c1 * c3 * c2, c1 * c2 * s3, -c1 * s2]],
            [
                [-c2 * s3, -c2 * c3, 0.0],
                [c1 * c3 - s3 * s1 * s2, -c1 * s3 - s1 * s2 * c3, 0.0],
                [s1 * c3 + c1 * s3 * s2, -s3 * s1 + c1 * s2 * c3, 0.0],
            ],
        ];
        for angle in 0..3 {
            d_pose[angle] = T::of((0..9).map(|k| d[k / 3 * 4 + k % 3].wide() * by_angle[angle][k / 3][k % 3]).sum());
        }
        for axis in 0..3 {
            d_pose[3 + axis] = d[axis * 4 + 3];
        }
    }
}
