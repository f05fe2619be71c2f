//! Pixels to rays: `q = ((u-cx)/fx, (v-cy)/fy, 1)`, `direction = normalize(R q)`, `origin = t + R (z0 q)`.

use srn_shaders::RowsParams;

use super::chunk_of;
use crate::Real;

fn lift<T: Real>(intrinsics: &[T], uv: &[T]) -> [f64; 3] {
    let [fx, fy, cx, cy] = [0, 1, 2, 3].map(|k| intrinsics[k].wide());
    [(uv[0].wide() - cx) / fx, (uv[1].wide() - cy) / fy, 1.0]
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// `R q`, for a 3×4 matrix.
fn rotate<T: Real>(m: &[T], q: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|row| dot([0, 1, 2].map(|column| m[4 * row + column].wide()), q))
}

/// Rows to `origin, direction`.
pub fn forward<T: Real>(
    p: RowsParams,
    world_from_camera: &[T],
    intrinsics: &[T],
    uv: &[T],
    z0: &[T],
    origin: &mut [T],
    direction: &mut [T],
) {
    let rows = origin.chunks_exact_mut(3).zip(direction.chunks_exact_mut(3));
    for (row, (origin, direction)) in rows.enumerate().take((p.groups * p.rows_per_group) as usize) {
        let image = p.first_group as usize + row / p.rows_per_group as usize;
        let m = &world_from_camera[12 * image..12 * image + 12];
        let world = rotate(m, lift(&intrinsics[4 * image..4 * image + 4], &uv[2 * row..2 * row + 2]));
        let length = dot(world, world).sqrt();
        for axis in 0..3 {
            origin[axis] = T::of(m[4 * axis + 3].wide() + z0[row].wide() * world[axis]);
            direction[axis] = T::of(world[axis] / length);
        }
    }
}

/// Per chunk of an image's rows: `d_R = Σ (z0 d_origin + d_(R q)) qᵀ`, `d_t = Σ d_origin`.
pub fn backward<T: Real>(
    p: RowsParams,
    world_from_camera: &[T],
    intrinsics: &[T],
    uv: &[T],
    z0: &[T],
    d_origin: &[T],
    d_direction: &[T],
    partial: &mut [T],
) {
    for (index, partial) in partial.chunks_exact_mut(12).take((p.groups * p.chunks) as usize).enumerate() {
        let (group, chunk) = (index / p.chunks as usize, index % p.chunks as usize);
        let image = p.first_group as usize + group;
        let m = &world_from_camera[12 * image..12 * image + 12];
        let mut sums = [0.0; 12];
        for row in chunk_of(chunk, p.chunk_rows, p.rows_per_group) {
            let row = group * p.rows_per_group as usize + row;
            let three = |values: &[T]| [0, 1, 2].map(|axis| values[3 * row + axis].wide());
            let (d_origin, d_direction) = (three(d_origin), three(d_direction));
            let q = lift(&intrinsics[4 * image..4 * image + 4], &uv[2 * row..2 * row + 2]);
            let world = rotate(m, q);
            let length = dot(world, world).sqrt();
            let direction = world.map(|value| value / length);
            let along = dot(d_direction, direction);
            for axis in 0..3 {
                let d_world = z0[row].wide() * d_origin[axis] + (d_direction[axis] - along * direction[axis]) / length;
                for (k, q) in q.into_iter().enumerate() {
                    sums[4 * axis + k] += d_world * q;
                }
                sums[4 * axis + 3] += d_origin[axis];
            }
        }
        for (partial, sum) in partial.iter_mut().zip(sums) {
            *partial = T::of(sum);
        }
    }
}
