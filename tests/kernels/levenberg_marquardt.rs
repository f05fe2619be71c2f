use srn_plan::Rows;
use srn_plan::ops::levenberg_marquardt::{self, Channel, EQUATIONS as VALUES, Residuals};
use srn_shaders::{LEVENBERG_MARQUARDT_ACCEPT, LEVENBERG_MARQUARDT_EQUATIONS, LEVENBERG_MARQUARDT_SOLVE};
use srn_tests::{Case, Sketch};

use crate::{KernelTest, ROWS};

pub static EQUATIONS: KernelTest = KernelTest {
    kernel: &LEVENBERG_MARQUARDT_EQUATIONS,
    tolerance: 1e-6,
    cases: equations,
    faults: &[
        ("equations", "12u * (params.first_group + group)", "12u * group"),
        ("equations", "rgb[at + params.channel]", "rgb[at]"),
        ("equations", "counts / root", "counts"),
        ("equations", "* wanted[pixel + 3u]", ""),
        ("equations", "wanted[pixel + params.channel]", "wanted[pixel]"),
        ("equations", "/ params.seed;", ";"),
        ("equations", "dot(column2, turn)", "dot(column1, turn)"),
        ("equations", "cross(vec3(origin", "-cross(vec3(origin"),
        ("equations", "weight * e * jacobian[a]", "weight * jacobian[a]"),
        ("equations", "(root + params.soft)", "root"),
        ("equations", "first + params.chunk_rows", "params.chunk_rows"),
        ("equations", "var b = a", "var b = 0u"),
    ],
};

pub static ACCEPT: KernelTest = KernelTest {
    kernel: &LEVENBERG_MARQUARDT_ACCEPT,
    tolerance: 1e-6,
    cases: accept,
    faults: &[
        ("accept", "27u] < best", "27u] > best"),
        ("accept", "best_pose[i] = world_from_camera[i]", "best_pose[i] = best_pose[i]"),
        ("accept", "28u * pose + 28u;", "28u * pose + 27u;"),
        ("accept", "/ 6.0, 1e-4", "/ 6.0, 1e-3"),
        ("accept", "min(4.0 *", "min(5.0 *"),
        ("accept", "1e6)", "1e7)"),
    ],
};

pub static SOLVE: KernelTest = KernelTest {
    kernel: &LEVENBERG_MARQUARDT_SOLVE,
    tolerance: 1e-6,
    cases: solve,
    faults: &[
        ("solve", "(11u - a)", "(10u - a)"),
        ("solve", "1.0 + damping[number]", "1.0"),
        ("solve", "sum -= lower", "sum += lower"),
        ("solve", "= -equations", "= equations"),
        ("solve", "0.2 / size", "0.3 / size"),
        ("solve", "sqrt(0.01 / damping[number])", "1.0"),
        ("solve", "solvable && sum > 0.0", "true"),
        ("solve", "0.5 * half_sinc", "half_sinc"),
        ("solve", "half < 1e-2", "half > 1e-2"),
        ("solve", "+ shift)", ")"),
        ("solve", "vec3(pose[w + 3u], pose[w + 7u], pose[w + 11u]) * r", "r * vec3(pose[w + 3u], pose[w + 7u], pose[w + 11u])"),
        ("solve", "28u * number", "27u * number"),
    ],
};

#[test]
fn equations_matches_reference() {
    EQUATIONS.matches_reference();
}

#[test]
fn accept_matches_reference() {
    ACCEPT.matches_reference();
}

#[test]
fn solve_matches_reference() {
    SOLVE.matches_reference();
}

fn equations() -> Vec<Case> {
    ROWS.map(equations_case).into()
}

/// The blue channel; images before the first of the tile keep their equations.
fn equations_case(rows: Rows) -> Case {
    let mut s = Sketch::new(format!("{rows:?}"));
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
        rgb: s.random("rgb", n),
        wanted: s.input("wanted", wanted),
    };
    let channel = Channel { number: 2, seed: 0.25, scale: 0.3, soft: 0.2 };
    let partial = s.scratch("partial", levenberg_marquardt::partial_len(rows));
    let accumulate = rows.first_group > 0;
    let equations = s.output("equations", VALUES as usize * images, accumulate);
    s.step(|b| levenberg_marquardt::equations(b, rows, residuals, channel, partial, equations, accumulate));
    s.finish()
}

fn accept() -> Vec<Case> {
    [1, 7, 129].map(accept_case).into()
}

/// Random losses, so that about half improve; the first does, and reaches the least damping. The last is not a number; of 7 poses,
/// it reaches the most damping.
fn accept_case(poses: u32) -> Case {
    let mut s = Sketch::new(format!("{poses} poses"));
    let n = poses as usize;
    let values = n * VALUES as usize;
    let mut losses = s.numbers(values);
    losses[27] = -2.0;
    if n > 1 {
        losses[values - 1] = f32::NAN;
    }
    let mut damping: Vec<f32> = s.numbers(n).iter().map(|x| x.abs()).collect();
    if n == 7 {
        damping[6] = 5e5;
    }
    damping[0] = 3e-4;
    let equations = s.input("equations", losses);
    let world_from_camera = s.random("world_from_camera", 12 * n);
    let best_equations = s.random("best_equations", values);
    let best_pose = s.random("best_pose", 12 * n);
    let damping = s.input("damping", damping);
    s.step(|b| levenberg_marquardt::accept(b, poses, equations, world_from_camera, best_equations, best_pose, damping));
    s.finish()
}

fn solve() -> Vec<Case> {
    [1, 7, 129].map(solve_case).into()
}

/// Positive matrices, but for the third, which is not, and the fourth, which is zero; steps from tiny to too long.
fn solve_case(poses: u32) -> Case {
    let mut s = Sketch::new(format!("{poses} poses"));
    let n = poses as usize;
    let mut equations = Vec::new();
    for pose in 0..n {
        let rows: Vec<[f32; 6]> = (0..12).map(|_| s.numbers(6).try_into().expect("six")).collect();
        for a in 0..6 {
            for b in a..6 {
                equations.push(rows.iter().map(|row| row[a] * row[b]).sum::<f32>());
            }
        }
        let size = [1e-3, 0.3, 1.0, 1.0, 30.0][pose % 5];
        equations.extend(s.numbers(6).iter().map(|x| size * x));
        equations.push(0.0);
        let own = &mut equations[VALUES as usize * pose..];
        match pose {
            2 => own[20] = -1.0,
            3 => own.fill(0.0),
            _ => {}
        }
    }
    let equations = s.input("equations", equations);
    let pose = s.random("pose", 12 * n);
    // From 0.0001 to 1.
    let damping = s.numbers(n).iter().map(|x| 0.01 * 100f32.powf(*x)).collect();
    let damping = s.input("damping", damping);
    let world_from_camera = s.scratch("world_from_camera", 12 * n);
    s.step(|b| levenberg_marquardt::solve(b, poses, equations, pose, damping, world_from_camera));
    s.finish()
}
