use srn_plan::Rows;
use srn_plan::ops::bfgs::{self, Channel, EQUATIONS as VALUES, Residuals, STATE};
use srn_shaders::{BFGS_BEGIN, BFGS_EQUATIONS, BFGS_GRADIENT, BFGS_SOLVE, BFGS_UPDATE};
use srn_tests::{Case, Sketch};

use crate::{KernelTest, ROWS};

pub static EQUATIONS: KernelTest = KernelTest {
    kernel: &BFGS_EQUATIONS,
    tolerance: 1e-6,
    cases: equations,
    faults: &[
        ("equations", "12u * (params.first_group + group)", "12u * group"),
        ("equations", "rgb[at + params.channel]", "rgb[at]"),
        ("equations", "+ 3u] / root", "+ 3u]"),
        ("equations", "* wanted[pixel + 3u]", ""),
        ("equations", "wanted[pixel + params.channel]", "wanted[pixel]"),
        ("equations", "/ params.seed;", ";"),
        ("equations", "dot(column2, turn)", "dot(column1, turn)"),
        ("equations", "cross(vec3(origin", "-cross(vec3(origin"),
        ("equations", "d_o + dot(d_o, ray)", "d_o - dot(d_o, ray)"),
        ("equations", "weight * e * jacobian[a]", "weight * jacobian[a]"),
        ("equations", "first + params.chunk_rows", "params.chunk_rows"),
        ("equations", "var b = a", "var b = 0u"),
    ],
};

pub static BEGIN: KernelTest = KernelTest {
    kernel: &BFGS_BEGIN,
    tolerance: 1e-6,
    cases: begin,
    faults: &[
        ("begin", "k < 27u", "k < 26u"),
        ("begin", "0.3, k", "0.4, k"),
        ("begin", "*= 1.01", "*= 1.0"),
        ("begin", "k < STATE_GRADIENT", "k <= STATE_GRADIENT"),
        ("begin", "select(NO_LOSS, loss[pose], loss[pose] < NO_LOSS)", "loss[pose]"),
        ("begin", "k < 12u", "k < 11u"),
        ("begin", "] = 0.0;", "] = 1.0;"),
        ("begin", "= 0.1;", "= 0.2;"),
    ],
};

pub static GRADIENT: KernelTest = KernelTest {
    kernel: &BFGS_GRADIENT,
    tolerance: 1e-6,
    cases: gradient,
    faults: &[
        ("gradient", "column < 4u", "column < 3u"),
        ("gradient", "shift = d_p * r", "shift = r * d_p"),
        ("gradient", "cross(p * r, shift)", "cross(shift, p * r)"),
        ("gradient", "6u * pose + 3u + k", "6u * pose + k"),
    ],
};

pub static UPDATE: KernelTest = KernelTest {
    kernel: &BFGS_UPDATE,
    // Differences of products; worst on llvmpipe 1.1e-6.
    tolerance: 1e-5,
    cases: update,
    faults: &[
        ("update", "min(i, j), max(i, j)", "i, j"),
        ("update", "gradient[6u * pose + i] - state[at + STATE_GRADIENT + i]);", "gradient[6u * pose + i]);"),
        ("update", "loss[pose] < NO_LOSS && ", ""),
        ("update", "is_number && sbs > 0.0", "is_number && sbs >= 0.0"),
        ("update", "0.8 * sbs", "0.7 * sbs"),
        ("update", "sy >= 0.2 * sbs", "sy >= 0.0"),
        ("update", "(1.0 - theta) * sbs", "theta * sbs"),
        ("update", "r[i] * (r[j] / sr)", "r[i] * (r[j] / sbs)"),
        ("update", "bs[i] * (bs[j] / sbs)", "0.0"),
        ("update", "loss[pose] < state", "loss[pose] > state"),
        ("update", "k < 12u", "k < 11u"),
        ("update", "min(1.5 *", "min(1.6 *"),
        ("update", "0.2);", "0.3);"),
        ("update", "0.4 * sqrt", "0.5 * sqrt"),
        ("update", "else if (squares > 0.0)", "else if (squares >= 0.0)"),
    ],
};

pub static SOLVE: KernelTest = KernelTest {
    kernel: &BFGS_SOLVE,
    tolerance: 1e-6,
    cases: solve,
    faults: &[
        ("solve", "sum -= lower", "sum += lower"),
        ("solve", "var y = -state", "var y = state"),
        ("solve", "if (!solvable)", "if (false)"),
        ("solve", "min(1.0, state", "max(1.0, state"),
        ("solve", "solvable && sum > 0.0", "true"),
        ("solve", "0.5 * half_sinc", "half_sinc"),
        ("solve", "half < 1e-2", "half > 1e-2"),
        ("solve", "+ shift)", ")"),
        ("solve", "state[at + STATE_STEP + i] = xi[i];", ""),
        (
            "solve",
            "vec3(state[p + 3u], state[p + 7u], state[p + 11u]) * r",
            "r * vec3(state[p + 3u], state[p + 7u], state[p + 11u])",
        ),
        ("solve", "params.grain > 0.0", "false"),
        ("solve", "params.grain * round", "2.0 * params.grain * round"),
        ("solve", "round(", "floor("),
        ("solve", "STATE * number", "12u * number"),
    ],
};

#[test]
fn equations_matches_reference() {
    EQUATIONS.matches_reference();
}

#[test]
fn begin_matches_reference() {
    BEGIN.matches_reference();
}

#[test]
fn gradient_matches_reference() {
    GRADIENT.matches_reference();
}

#[test]
fn update_matches_reference() {
    UPDATE.matches_reference();
}

#[test]
fn solve_matches_reference() {
    SOLVE.matches_reference();
}

fn equations() -> Vec<Case> {
    [0.0, 0.9].into_iter().flat_map(|sphere| ROWS.map(|rows| equations_case(rows, sphere))).collect()
}

/// The blue channel; images before the first of the tile keep their equations.
fn equations_case(rows: Rows, sphere: f32) -> Case {
    let mut s = Sketch::new(format!("{rows:?}, sphere {sphere}"));
    let n = 3 * rows.count() as usize;
    let images = (rows.first_group + rows.groups) as usize;
    // Weights from 0.
    let mut wanted = s.numbers(4 * rows.count() as usize);
    wanted.iter_mut().skip(3).step_by(4).for_each(|weight| *weight = weight.max(0.0));
    let residuals = Residuals {
        world_from_camera: s.random("world_from_camera", 12 * images),
        origin: s.random("origin", n),
        direction: s.random("direction", n),
        d_origin: s.random("d_origin", n),
        d_direction: s.random("d_direction", n),
        sphere,
        rgb: s.random("rgb", n),
        wanted: s.input("wanted", wanted),
    };
    let channel = Channel { number: 2, seed: 0.25, scale: 0.3, soft: 0.2 };
    let partial = s.scratch("partial", bfgs::partial_len(rows));
    let accumulate = rows.first_group > 0;
    let equations = s.output("equations", VALUES as usize * images, accumulate);
    s.step(|b| bfgs::equations(b, rows, residuals, channel, partial, equations, accumulate));
    s.finish()
}

fn begin() -> Vec<Case> {
    [1, 7, 129].map(begin_case).into()
}

/// The last loss of several is not a number.
fn begin_case(poses: u32) -> Case {
    let mut s = Sketch::new(format!("{poses} poses"));
    let n = poses as usize;
    let equations = s.random("equations", VALUES as usize * n);
    let mut losses = s.numbers(n);
    if n > 1 {
        losses[n - 1] = f32::NAN;
    }
    let loss = s.input("loss", losses);
    let world_from_camera = s.random("world_from_camera", 12 * n);
    let state = s.scratch("state", STATE as usize * n);
    s.step(|b| bfgs::begin(b, poses, equations, loss, world_from_camera, state));
    s.finish()
}

fn gradient() -> Vec<Case> {
    [1, 7, 129].map(gradient_case).into()
}

fn gradient_case(poses: u32) -> Case {
    let mut s = Sketch::new(format!("{poses} poses"));
    let n = poses as usize;
    let [world_from_camera, d_world_from_camera] =
        ["world_from_camera", "d_world_from_camera"].map(|name| s.random(name, 12 * n));
    let gradient = s.scratch("gradient", 6 * n);
    s.step(|b| bfgs::gradient(b, poses, world_from_camera, d_world_from_camera, gradient));
    s.finish()
}

/// States with positive matrices.
fn states(s: &mut Sketch, poses: usize) -> Vec<f32> {
    let mut states = Vec::new();
    for pose in 0..poses {
        let rows: Vec<[f32; 6]> = (0..12).map(|_| s.numbers(6).try_into().expect("six")).collect();
        for a in 0..6 {
            for b in a..6 {
                states.push(rows.iter().map(|row| row[a] * row[b]).sum::<f32>());
            }
        }
        states.extend(s.numbers(6));
        states.push(0.1);
        states.extend(s.numbers(12));
        states.extend(s.numbers(6).iter().map(|x| 0.1 * x));
        states.push([0.05, 0.19, 3.0, 0.001][pose % 4]);
    }
    states
}

fn update() -> Vec<Case> {
    [1, 7, 129].map(update_case).into()
}

/// Changes of the gradient that agree with the step and that do not, losses that are lower, higher and no numbers, and one without a
/// step.
fn update_case(poses: u32) -> Case {
    let mut s = Sketch::new(format!("{poses} poses"));
    let n = poses as usize;
    let mut states = states(&mut s, n);
    let mut gradients = Vec::new();
    for (pose, state) in states.chunks_mut(STATE as usize).enumerate() {
        if pose == 6 {
            state[40..46].fill(0.0);
        }
        let factor = [2.0, -1.0, 0.05, 0.1, 1.0][pose % 5];
        let noise = s.numbers(6);
        gradients.extend((0..6).map(|k| state[21 + k] + factor * state[40 + k] + 0.002 * noise[k]));
    }
    let mut losses = s.numbers(n);
    if n > 1 {
        losses[5] = f32::NAN;
        losses[6] = 1.0;
    }
    let gradient = s.input("gradient", gradients);
    let loss = s.input("loss", losses);
    let world_from_camera = s.random("world_from_camera", 12 * n);
    let state = s.input("state", states);
    s.step(|b| bfgs::update(b, poses, gradient, loss, world_from_camera, state));
    s.finish()
}

fn solve() -> Vec<Case> {
    [(1, 0.0), (7, 0.0), (129, 0.0), (7, 1.0 / 4096.0), (7, 0.01)].map(solve_case).into()
}

/// Steps from tiny to too long, of any length or of whole grains; the third matrix is not positive, the fourth gradient is zero.
fn solve_case((poses, grain): (u32, f32)) -> Case {
    let mut s = Sketch::new(format!("{poses} poses, grain {grain}"));
    let n = poses as usize;
    let mut states = states(&mut s, n);
    for (pose, state) in states.chunks_mut(STATE as usize).enumerate() {
        let size = [1e-3, 0.3, 1.0, 1.0, 30.0][pose % 5];
        state[21..27].iter_mut().for_each(|g| *g *= size);
        match pose {
            2 => state[20] = -1.0,
            3 => state[21..27].fill(0.0),
            _ => {}
        }
    }
    let state = s.input("state", states);
    let world_from_camera = s.scratch("world_from_camera", 12 * n);
    s.step(|b| bfgs::solve(b, poses, grain, world_from_camera, state));
    s.finish()
}
