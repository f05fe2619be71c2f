//! `depth = R[:,2] · (x - t)`: z in the camera frame.

use srn_shaders::DepthParams;

use crate::Real;

fn image(p: DepthParams, row: usize) -> usize {
    p.first_group as usize + row / p.rows_per_group as usize
}

/// Points to depths.
pub fn forward<T: Real>(p: DepthParams, world_from_camera: &[T], x: &[T], depth: &mut [T]) {
    for (row, (x, depth)) in x.chunks_exact(3).zip(depth).take((p.groups * p.rows_per_group) as usize).enumerate() {
        let m = &world_from_camera[12 * image(p, row)..];
        *depth = T::of((0..3).map(|axis| m[4 * axis + 2].wide() * (x[axis].wide() - m[4 * axis + 3].wide())).sum());
    }
}

/// Gradient of `scale · Σ min(depth, 0)²`.
pub fn backward<T: Real>(p: DepthParams, world_from_camera: &[T], depth: &[T], d_x: &mut [T]) {
    let scale = T::of_f32(p.scale);
    for (row, (d_x, &depth)) in d_x.chunks_exact_mut(3).zip(depth).take((p.groups * p.rows_per_group) as usize).enumerate() {
        let m = &world_from_camera[12 * image(p, row)..];
        let d_depth = scale * T::of(2.0) * depth.min(T::zero());
        for axis in 0..3 {
            d_x[axis] = d_depth * m[4 * axis + 2];
        }
    }
}
