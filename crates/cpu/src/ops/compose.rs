//! A rigid motion after a start pose: `world_from_camera = motion · start`.

use srn_shaders::PoseParams;

use crate::Real;

/// `R = R_m R_s`, `t = R_m t_s + t_m`; all 3×4 row-major.
pub fn forward<T: Real>(p: PoseParams, motion: &[T], start: &[T], world_from_camera: &mut [T]) {
    let poses = motion.chunks_exact(12).zip(start.chunks_exact(12)).zip(world_from_camera.chunks_exact_mut(12));
    for ((motion, start), out) in poses.take(p.poses as usize) {
        for k in 0..12 {
            let (row, column) = (k / 4 * 4, k % 4);
            let product: f64 = (0..3).map(|inner| motion[row + inner].wide() * start[4 * inner + column].wide()).sum();
            out[k] = T::of(product + if column == 3 { motion[row + 3].wide() } else { 0.0 });
        }
    }
}

/// `d_R_m = d_R R_sᵀ + d_t t_sᵀ`, `d_t_m = d_t`.
pub fn backward<T: Real>(p: PoseParams, start: &[T], d_world_from_camera: &[T], d_motion: &mut [T]) {
    let poses = start.chunks_exact(12).zip(d_world_from_camera.chunks_exact(12)).zip(d_motion.chunks_exact_mut(12));
    for ((start, d), d_motion) in poses.take(p.poses as usize) {
        for k in 0..12 {
            let (row, column) = (k / 4 * 4, k % 4);
            let product = |inner: usize| d[row + inner].wide() * start[4 * column + inner].wide();
            d_motion[k] = if column == 3 { d[k] } else { T::of((0..4).map(product).sum()) };
        }
    }
}
