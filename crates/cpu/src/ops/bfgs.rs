//! Descent over a motion `ξ = (ω, υ)` about the object, in the camera's axes: second derivatives `B` from the residuals of all rays at first,
//! from the change of gradients after (Broyden, Fletcher, Goldfarb, Shanno); the steps, and whether they are kept.

use srn_shaders::{EquationsParams, PoseParams, SolveParams};

use super::chunk_of;
use super::rays::beginning;
use crate::Real;

/// Upper triangle of `A`, `g`.
const EQUATIONS: usize = 27;

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

/// Per chunk of an image's rows: `A = Σ ω J Jᵀ`, `g = Σ ω e J`, of one channel.
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
        let [x, y, z, eye] = columns(&world_from_camera[12 * (p.first_group as usize + group)..]);
        let mut sums = [0.0; EQUATIONS];
        for row in chunk_of(chunk, p.chunk_rows, p.rows_per_group) {
            let at = 3 * (group * p.rows_per_group as usize + row);
            let pixel = at / 3 * 4;
            let e = rgb[at + p.channel as usize].wide() - wanted[pixel + p.channel as usize].wide();
            let root = (e * e + soft * soft).sqrt();
            let weight = scale * wanted[pixel + 3].wide() / root;

            let [d_origin, d_direction] = [d_origin, d_direction].map(|values| three(&values[at..]).map(|d| d / seed));
            let direction = three(&direction[at..]);
            let (by_origin, by_direction) = (cross(three(&origin[at..]), d_origin), cross(direction, d_direction));
            let turn = [0, 1, 2].map(|axis| by_origin[axis] + by_direction[axis]);
            let (d_s, begins) = (dot(d_origin, direction), beginning(eye, direction, p.sphere));
            let shift = [0, 1, 2].map(|axis| d_origin[axis] + d_s * begins.d_eye[axis]);
            let jacobian = [dot(x, turn), dot(y, turn), dot(z, turn), dot(x, shift), dot(y, shift), dot(z, shift)];
            let mut k = 0;
            for (a, &j) in jacobian.iter().enumerate() {
                for &other in &jacobian[a..] {
                    sums[k] += weight * j * other;
                    k += 1;
                }
                sums[21 + a] += weight * e * j;
            }
        }
        for (partial, sum) in partial.iter_mut().zip(sums) {
            *partial = T::of(sum);
        }
    }
}

/// Places in the state of a search: the upper triangle of `B`, then these.
const GRADIENT: usize = 21;
const LOSS: usize = 27;
const POSE: usize = 28;
const STEP: usize = 40;
const RADIUS: usize = 46;
const STATE: usize = 47;
/// More than any loss that is a number.
const NO_LOSS: f32 = 3.4e38;

/// Entry of a symmetric matrix in its upper triangle.
fn entry(a: usize, b: usize) -> usize {
    let (a, b) = (a.min(b), a.max(b));
    a * (11 - a) / 2 + b
}

/// The state at the first pose.
pub fn begin<T: Real>(p: PoseParams, equations: &[T], loss: &[T], world_from_camera: &[T], state: &mut [T]) {
    let none = T::of_f32(NO_LOSS);
    for (pose, state) in state.chunks_exact_mut(STATE).take(p.poses as usize).enumerate() {
        let equations = &equations[EQUATIONS * pose..];
        for (state, &a) in state[..GRADIENT].iter_mut().zip(equations) {
            *state = T::of_f32(0.3) * a;
        }
        for k in 0..6 {
            state[entry(k, k)] = state[entry(k, k)] * T::of_f32(1.01);
        }
        state[GRADIENT..LOSS].copy_from_slice(&equations[GRADIENT..EQUATIONS]);
        state[LOSS] = if loss[pose] < none { loss[pose] } else { none };
        state[POSE..STEP].copy_from_slice(&world_from_camera[12 * pose..12 * (pose + 1)]);
        state[STEP..RADIUS].fill(T::zero());
        state[RADIUS] = T::of_f32(0.1);
    }
}

/// The gradient over `ξ` from that over the matrix.
pub fn gradient<T: Real>(p: PoseParams, world_from_camera: &[T], d_world_from_camera: &[T], gradient: &mut [T]) {
    for (pose, out) in gradient.chunks_exact_mut(6).take(p.poses as usize).enumerate() {
        let [at, d] = [world_from_camera, d_world_from_camera].map(|values| columns(&values[12 * pose..]));
        let to_camera = |v: [f64; 3]| [dot(at[0], v), dot(at[1], v), dot(at[2], v)];
        let mut sum = [0.0; 6];
        for (&point, &d_point) in at.iter().zip(&d) {
            let turn = cross(to_camera(point), to_camera(d_point));
            (0..3).for_each(|axis| sum[axis] += turn[axis]);
        }
        sum[3..].copy_from_slice(&to_camera(d[3]));
        out.iter_mut().zip(sum).for_each(|(out, sum)| *out = T::of(sum));
    }
}

/// What a trial says.
pub fn update<T: Real>(p: PoseParams, gradient: &[T], loss: &[T], world_from_camera: &[T], state: &mut [T]) {
    for (pose, state) in state.chunks_exact_mut(STATE).take(p.poses as usize).enumerate() {
        let was: Vec<f64> = state.iter().map(|value| value.wide()).collect();
        let trial: [f64; 6] = std::array::from_fn(|k| gradient[6 * pose + k].wide());
        let (step, loss_here) = (&was[STEP..RADIUS], loss[pose].wide());
        let y: [f64; 6] = std::array::from_fn(|k| trial[k] - was[GRADIENT + k]);
        let bs: [f64; 6] = std::array::from_fn(|i| (0..6).map(|j| was[entry(i, j)] * step[j]).sum());
        let with_step = |v: &[f64]| step.iter().zip(v).map(|(s, v)| s * v).sum::<f64>();
        let (sbs, sy) = (with_step(&bs), with_step(&y));
        let is_number = loss_here < NO_LOSS.into() && sy.abs() < 1e30;
        if is_number && sbs > 0.0 {
            let theta = if sy >= 0.2 * sbs { 1.0 } else { 0.8 * sbs / (sbs - sy) };
            let r: [f64; 6] = std::array::from_fn(|k| theta * y[k] + (1.0 - theta) * bs[k]);
            let sr = with_step(&r);
            for i in 0..6 {
                for j in i..6 {
                    state[entry(i, j)] = T::of(was[entry(i, j)] + (r[i] * r[j] / sr - bs[i] * bs[j] / sbs));
                }
            }
        }
        let size = step.iter().map(|s| s * s).sum::<f64>().sqrt();
        if is_number && loss_here < was[LOSS] {
            state[GRADIENT..LOSS].copy_from_slice(&gradient[6 * pose..6 * (pose + 1)]);
            state[LOSS] = loss[pose];
            state[POSE..STEP].copy_from_slice(&world_from_camera[12 * pose..12 * (pose + 1)]);
            state[RADIUS] = T::of((1.5 * was[RADIUS]).min(0.2));
        } else if size > 0.0 {
            state[RADIUS] = T::of(0.4 * size);
        }
    }
}

/// The step from each best pose.
pub fn solve<T: Real>(p: SolveParams, world_from_camera: &mut [T], state: &mut [T]) {
    for (number, out) in world_from_camera.chunks_exact_mut(12).take(p.poses as usize).enumerate() {
        let state = &mut state[STATE * number..STATE * (number + 1)];
        let values: Vec<f64> = state.iter().map(|value| value.wide()).collect();
        let whole = |x: f64| if p.grain > 0.0 { f64::from(p.grain) * (x / f64::from(p.grain)).round_ties_even() } else { x };
        let xi = next_step(&values).map(whole);
        state[STEP..RADIUS].iter_mut().zip(xi).for_each(|(state, xi)| *state = T::of(xi));
        let (turn, shift) = ([xi[0], xi[1], xi[2]], [xi[3], xi[4], xi[5]]);
        let [x, y, z, t] = columns(&state[POSE..STEP]);
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

/// `ξ` of `B ξ = -g`, by Cholesky's factors, or `-g` where `B` is not positive; shortened to the radius.
fn next_step(state: &[f64]) -> [f64; 6] {
    let downhill: [f64; 6] = std::array::from_fn(|k| -state[GRADIENT + k]);
    let xi = solution(state, downhill).unwrap_or(downhill);
    let size = xi.iter().map(|x| x * x).sum::<f64>().sqrt();
    if size.is_finite() && size > 0.0 { xi.map(|x| x * (state[RADIUS] / size).min(1.0)) } else { [0.0; 6] }
}

fn solution(triangle: &[f64], right: [f64; 6]) -> Option<[f64; 6]> {
    let mut lower = [[0.0; 6]; 6];
    let mut xi = [0.0; 6];
    for i in 0..6 {
        for j in 0..=i {
            let sum = triangle[entry(j, i)] - (0..j).map(|k| lower[i][k] * lower[j][k]).sum::<f64>();
            if i != j {
                lower[i][j] = sum / lower[j][j];
            } else if sum > 0.0 {
                lower[i][i] = sum.sqrt();
            } else {
                return None;
            }
        }
        xi[i] = (right[i] - (0..i).map(|j| lower[i][j] * xi[j]).sum::<f64>()) / lower[i][i];
    }
    for i in (0..6).rev() {
        xi[i] = (xi[i] - (i + 1..6).map(|k| lower[k][i] * xi[k]).sum::<f64>()) / lower[i][i];
    }
    Some(xi)
}

/// Rodrigues: `v` turned about `turn` by its length.
fn exp(v: [f64; 3], turn: [f64; 3]) -> [f64; 3] {
    let half = 0.5 * dot(turn, turn).sqrt();
    let sinc = if half < 1e-4 { 1.0 - half * half / 6.0 } else { half.sin() / half };
    let once = cross(turn, v);
    let twice = cross(turn, once);
    [0, 1, 2].map(|axis| v[axis] + sinc * half.cos() * once[axis] + 0.5 * sinc * sinc * twice[axis])
}
