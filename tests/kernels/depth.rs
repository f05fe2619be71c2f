use srn_plan::{Rows, ops::depth};
use srn_shaders::{DEPTH_BACKWARD, DEPTH_FORWARD};
use srn_tests::{Case, Sketch};

use crate::{KernelTest, ROWS};

pub static FORWARD: KernelTest = KernelTest {
    kernel: &DEPTH_FORWARD,
    // Worst 9.6e-8 on llvmpipe.
    tolerance: 5e-7,
    cases: forward,
    faults: &[("forward", "w + 6u", "w + 5u"), ("forward", "params.first_group + ", "0u + "), ("forward", ") - t)", ") + t)")],
};

pub static BACKWARD: KernelTest = KernelTest {
    kernel: &DEPTH_BACKWARD,
    // Worst 1.1e-7 on llvmpipe.
    tolerance: 6e-7,
    cases: backward,
    faults: &[
        ("backward", "min(depth[row]", "max(depth[row]"),
        ("backward", "params.first_group + ", "0u + "),
        ("backward", "w + 10u", "w + 9u"),
    ],
};

#[test]
fn forward_matches_reference() {
    FORWARD.matches_reference();
}

#[test]
fn backward_matches_reference() {
    BACKWARD.matches_reference();
}

fn forward() -> Vec<Case> {
    ROWS.map(forward_case).into()
}

fn forward_case(rows: Rows) -> Case {
    let mut s = Sketch::new(format!("{rows:?}"));
    let n = rows.count() as usize;
    let world_from_camera = s.random("world_from_camera", 12 * (rows.first_group + rows.groups) as usize);
    let x = s.random("x", 3 * n);
    let depth = s.scratch("depth", n);
    s.step(|b| depth::forward(b, rows, world_from_camera, x, depth));
    s.finish()
}

fn backward() -> Vec<Case> {
    ROWS.map(backward_case).into()
}

/// The first point is behind the camera, so that no case has a gradient of zeros only.
fn backward_case(rows: Rows) -> Case {
    let mut s = Sketch::new(format!("{rows:?}"));
    let n = rows.count() as usize;
    let world_from_camera = s.random("world_from_camera", 12 * (rows.first_group + rows.groups) as usize);
    let mut depth = s.numbers(n);
    depth[0] = -1.0;
    let depth = s.input("depth", depth);
    let d_x = s.scratch("d_x", 3 * n);
    s.step(|b| depth::backward(b, rows, 0.3, world_from_camera, depth, d_x));
    s.finish()
}
