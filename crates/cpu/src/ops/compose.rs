//! A rigid motion of a start pose, in a given frame: `world_from_camera = frame · motion · start`, all 3×4 row-major.

use srn_shaders::PoseParams;

use crate::Real;

type Rigid = [[f64; 4]; 3];

fn rigid<T: Real>(values: &[T]) -> Rigid {
    [0, 1, 2].map(|row| [0, 1, 2, 3].map(|column| values[4 * row + column].wide()))
}

fn write<T: Real>(out: &mut [T], matrix: Rigid) {
    for (out, &value) in out.iter_mut().zip(matrix.as_flattened()) {
        *out = T::of(value);
    }
}

fn product(a: &Rigid, b: &Rigid) -> Rigid {
    let entry = |row: usize, column: usize| {
        (0..3).map(|k| a[row][k] * b[k][column]).sum::<f64>() + if column == 3 { a[row][3] } else { 0.0 }
    };
    [0, 1, 2].map(|row| [0, 1, 2, 3].map(|column| entry(row, column)))
}

/// The product of the three.
pub fn forward<T: Real>(p: PoseParams, frame: &[T], motion: &[T], start: &[T], world_from_camera: &mut [T]) {
    for (pose, out) in world_from_camera.chunks_exact_mut(12).take(p.poses as usize).enumerate() {
        let [frame, motion, start] = [frame, motion, start].map(|values| rigid(&values[12 * pose..]));
        write(out, product(&frame, &product(&motion, &start)));
    }
}

/// `d = R_fᵀ d_world_from_camera`; `d_motion[r,k] = ⟨d[r], start[k]⟩` for `k < 3`, `d_motion[r,3] = d[r,3]`.
pub fn backward<T: Real>(p: PoseParams, frame: &[T], start: &[T], d_world_from_camera: &[T], d_motion: &mut [T]) {
    for (pose, out) in d_motion.chunks_exact_mut(12).take(p.poses as usize).enumerate() {
        let [frame, start, d] = [frame, start, d_world_from_camera].map(|values| rigid(&values[12 * pose..]));
        let d: Rigid = [0, 1, 2].map(|r| [0, 1, 2, 3].map(|column| (0..3).map(|k| frame[k][r] * d[k][column]).sum()));
        let entry = |r: usize, k: usize| if k == 3 { d[r][3] } else { (0..4).map(|c| d[r][c] * start[k][c]).sum() };
        write(out, [0, 1, 2].map(|r| [0, 1, 2, 3].map(|k| entry(r, k))));
    }
}
