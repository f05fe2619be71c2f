//! Normal equations of the residuals of all rays over a motion `ξ = (ω, υ)` about the object, in the camera's axes; the
//! damped step, and whether it is kept.

use srn_shaders::{EquationsParams, PoseParams};

use super::chunk_of;
use crate::Real;

/// Upper triangle of `A`, `g`, loss.
const EQUATIONS: usize = 28;

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn three<T: Real>(values: &[T]) -> [f64; 3] {
    [0, 1, 2].map(|axis| values[axis].wide())
}

/// Columns of a 3×4 matrix.
fn columns<T: Real>(m: &[T]) -> [[f64; 3]; 4] {
    [0, 1, 2, 3].map(|column| [0, 1, 2].map(|row| m[4 * row + column].wide()))
}

/// Per chunk of an image's rows: `A = Σ ω J Jᵀ`, `g = Σ ω e J`, `scale Σ w ρ(e)`, of one channel.
pub fn equations<T: Real>(
    p: EquationsParams,
    world_from_camera: &[T],
    origin: &[T],
    direction: &[T],
    d_origin: &[T],
    d_direction: &[T],
    rgb: &[T],
    wanted: &[T],
    partial: &mut [T],
) {
    let [seed, scale, soft] = [p.seed, p.scale, p.soft].map(f64::from);
    for (index, partial) in partial.chunks_exact_mut(EQUATIONS).take((p.groups * p.chunks) as usize).enumerate() {
        let (group, chunk) = (index / p.chunks as usize, index % p.chunks as usize);
        let [x, y, z, _] = columns(&world_from_camera[12 * (p.first_group as usize + group)..]);
        let mut sums = [0.0; EQUATIONS];
        for row in chunk_of(chunk, p.chunk_rows, p.rows_per_group) {
            let at = 3 * (group * p.rows_per_group as usize + row);
            let pixel = at / 3 * 4;
            let e = rgb[at + p.channel as usize].wide() - wanted[pixel + p.channel as usize].wide();
            let root = (e * e + soft * soft).sqrt();
            let counts = scale * wanted[pixel + 3].wide();
            let weight = counts / root;

            let [d_origin, d_direction] = [d_origin, d_direction].map(|values| three(&values[at..]).map(|d| d / seed));
            let (by_origin, by_direction) = (cross(three(&origin[at..]), d_origin), cross(three(&direction[at..]), d_direction));
            let turn = [0, 1, 2].map(|axis| by_origin[axis] + by_direction[axis]);
            let jacobian = [dot(x, turn), dot(y, turn), dot(z, turn), dot(x, d_origin), dot(y, d_origin), dot(z, d_origin)];
            let mut k = 0;
            for (a, &j) in jacobian.iter().enumerate() {
                for &other in &jacobian[a..] {
                    sums[k] += weight * j * other;
                    k += 1;
                }
                sums[21 + a] += weight * e * j;
            }
            sums[27] += counts * (e * e / (root + soft));
        }
        for (partial, sum) in partial.iter_mut().zip(sums) {
            *partial = T::of(sum);
        }
    }
}

/// Keeps the trials with a lower loss.
pub fn accept<T: Real>(
    p: PoseParams,
    equations: &[T],
    world_from_camera: &[T],
    best_equations: &mut [T],
    best_pose: &mut [T],
    damping: &mut [T],
) {
    for pose in 0..p.poses as usize {
        let (of, at) = (EQUATIONS * pose..EQUATIONS * (pose + 1), 12 * pose..12 * (pose + 1));
        if equations[of.end - 1] < best_equations[of.end - 1] {
            best_equations[of.clone()].copy_from_slice(&equations[of]);
            best_pose[at.clone()].copy_from_slice(&world_from_camera[at]);
            damping[pose] = T::of((damping[pose].wide() / 6.0).max(1e-4));
        } else {
            damping[pose] = T::of((damping[pose].wide() * 4.0).min(1e6));
        }
    }
}

/// The damped step from each pose.
pub fn solve<T: Real>(p: PoseParams, equations: &[T], pose: &[T], damping: &[T], world_from_camera: &mut [T]) {
    for (number, out) in world_from_camera.chunks_exact_mut(12).take(p.poses as usize).enumerate() {
        let equations: Vec<f64> =
            equations[EQUATIONS * number..EQUATIONS * (number + 1)].iter().map(|value| value.wide()).collect();
        let xi = damped_step(&equations, damping[number].wide());
        let (turn, shift) = ([xi[0], xi[1], xi[2]], [xi[3], xi[4], xi[5]]);
        let [x, y, z, t] = columns(&pose[12 * number..]);
        let rotate = |v: [f64; 3]| [0, 1, 2].map(|row| x[row] * v[0] + y[row] * v[1] + z[row] * v[2]);
        let centre = exp([dot(x, t), dot(y, t), dot(z, t)], turn);
        let moved = [
            rotate(exp([1.0, 0.0, 0.0], turn)),
            rotate(exp([0.0, 1.0, 0.0], turn)),
            rotate(exp([0.0, 0.0, 1.0], turn)),
            rotate([0, 1, 2].map(|axis| centre[axis] + shift[axis])),
        ];
        for (row, out) in out.chunks_exact_mut(4).enumerate() {
            for (out, column) in out.iter_mut().zip(moved) {
                *out = T::of(column[row]);
            }
        }
    }
}

/// `ξ` of `(A + damping diag A) ξ = -g`, by Cholesky's factors, stretched by `√(0.01 / damping)` where that is more than 1, then
/// shortened to 0.2; zero where `A` is not positive.
fn damped_step(equations: &[f64], damping: f64) -> [f64; 6] {
    let mut lower = [[0.0; 6]; 6];
    let mut xi = [0.0; 6];
    for i in 0..6 {
        for j in 0..=i {
            let entry = equations[j * (11 - j) / 2 + i] * if i == j { 1.0 + damping } else { 1.0 };
            let sum = entry - (0..j).map(|k| lower[i][k] * lower[j][k]).sum::<f64>();
            if i != j {
                lower[i][j] = sum / lower[j][j];
            } else if sum > 0.0 {
                lower[i][i] = sum.sqrt();
            } else {
                return [0.0; 6];
            }
        }
        xi[i] = (-equations[21 + i] - (0..i).map(|j| lower[i][j] * xi[j]).sum::<f64>()) / lower[i][i];
    }
    for i in (0..6).rev() {
        xi[i] = (xi[i] - (i + 1..6).map(|k| lower[k][i] * xi[k]).sum::<f64>()) / lower[i][i];
    }
    let size = xi.iter().map(|x| x * x).sum::<f64>().sqrt();
    let stretch = (0.01 / damping).sqrt().max(1.0);
    if size.is_finite() && size > 0.0 { xi.map(|x| x * (0.2 / size).min(stretch)) } else { [0.0; 6] }
}

/// Rodrigues: `v` turned about `turn` by its length.
fn exp(v: [f64; 3], turn: [f64; 3]) -> [f64; 3] {
    let half = 0.5 * dot(turn, turn).sqrt();
    let sinc = if half < 1e-4 { 1.0 - half * half / 6.0 } else { half.sin() / half };
    let once = cross(turn, v);
    let twice = cross(turn, once);
    [0, 1, 2].map(|axis| v[axis] + sinc * half.cos() * once[axis] + 0.5 * sinc * sinc * twice[axis])
}
