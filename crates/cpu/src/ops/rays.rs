//! Pixels to rays: `q = ((u-cx)/fx, (v-cy)/fy, 1)`, `direction = normalize(R q)`, `origin = t + s direction + R (z0 q)`, where `s` is how far
//! a ray's beginning lies from the camera.

use rayon::prelude::*;
use srn_shaders::RaysParams;

use super::chunk_of;
use crate::Real;

fn lift<T: Real>(intrinsics: &[T], uv: &[T]) -> [f64; 3] {
    let [fx, fy, cx, cy] = [0, 1, 2, 3].map(|k| intrinsics[k].wide());
    [(uv[0].wide() - cx) / fx, (uv[1].wide() - cy) / fy, 1.0]
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Where the camera is.
fn eye<T: Real>(m: &[T]) -> [f64; 3] {
    [0, 1, 2].map(|row| m[4 * row + 3].wide())
}

/// `R q`, for a 3×4 matrix.
fn rotate<T: Real>(m: &[T], q: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|row| dot([0, 1, 2].map(|column| m[4 * row + column].wide()), q))
}

/// How far a ray's beginning lies from the eye, along the ray, and the derivatives of that.
pub(super) struct Beginning {
    pub distance: f64,
    pub d_eye: [f64; 3],
    pub d_direction: [f64; 3],
}

/// On a sphere around the origin, or where the line is nearest to it, half a radius earlier; without a sphere at the eye.
pub(super) fn beginning(eye: [f64; 3], direction: [f64; 3], radius: f32) -> Beginning {
    let radius = f64::from(radius);
    if radius == 0.0 {
        return Beginning { distance: 0.0, d_eye: [0.0; 3], d_direction: [0.0; 3] };
    }
    let along = dot(eye, direction);
    let nearest = [0, 1, 2].map(|axis| eye[axis] - along * direction[axis]);
    let inside = radius * radius - dot(nearest, nearest);
    if inside > radius * radius / 4.0 {
        let half = inside.sqrt();
        Beginning {
            distance: -along - half,
            d_eye: [0, 1, 2].map(|axis| nearest[axis] / half - direction[axis]),
            d_direction: eye.map(|eye| -eye - along / half * eye),
        }
    } else {
        Beginning { distance: -along - radius / 2.0, d_eye: direction.map(|d| -d), d_direction: eye.map(|eye| -eye) }
    }
}

/// Rows to `origin, direction`.
pub fn forward<T: Real>(
    p: RaysParams,
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
        let (eye, unit) = (eye(m), world.map(|value| value / length));
        let s = beginning(eye, unit, p.sphere).distance;
        for axis in 0..3 {
            origin[axis] = T::of(eye[axis] + s * unit[axis] + z0[row].wide() * world[axis]);
            direction[axis] = T::of(unit[axis]);
        }
    }
}

/// Per chunk of an image's rows: `d_R = Σ (z0 d_origin + d_(R q)) qᵀ`, `d_t = Σ d_origin + d_s ∂s/∂t`.
pub fn backward<T: Real>(
    p: RaysParams,
    world_from_camera: &[T],
    intrinsics: &[T],
    uv: &[T],
    z0: &[T],
    d_origin: &[T],
    d_direction: &[T],
    partial: &mut [T],
) {
    let partials = partial.par_chunks_exact_mut(12).take((p.groups * p.chunks) as usize);
    partials.enumerate().for_each(|(index, partial)| {
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
            let begins = beginning(eye(m), direction, p.sphere);
            let d_s = dot(d_origin, direction);
            let d_direction =
                [0, 1, 2].map(|axis| d_direction[axis] + begins.distance * d_origin[axis] + d_s * begins.d_direction[axis]);
            let along = dot(d_direction, direction);
            for axis in 0..3 {
                let d_world = z0[row].wide() * d_origin[axis] + (d_direction[axis] - along * direction[axis]) / length;
                for (k, q) in q.into_iter().enumerate() {
                    sums[4 * axis + k] += d_world * q;
                }
                sums[4 * axis + 3] += d_origin[axis] + d_s * begins.d_eye[axis];
            }
        }
        for (partial, sum) in partial.iter_mut().zip(sums) {
            *partial = T::of(sum);
        }
    });
}
