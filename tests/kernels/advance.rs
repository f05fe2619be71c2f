use srn_plan::ops::advance;
use srn_shaders::{ADVANCE_BACKWARD, ADVANCE_FORWARD};
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static FORWARD: KernelTest = KernelTest {
    kernel: &ADVANCE_FORWARD,
    // Worst 6.6e-8 on llvmpipe.
    tolerance: 4e-7,
    cases: forward,
    faults: &[("forward", "x[a] + direction", "x[a] - direction"), ("forward", "step[row]", "step[a]")],
};

pub static BACKWARD: KernelTest = KernelTest {
    kernel: &ADVANCE_BACKWARD,
    // Worst 9.0e-8 on llvmpipe.
    tolerance: 5e-7,
    cases: backward,
    faults: &[
        ("backward", "d_x_next[a] * step[row]", "direction[a] * step[row]"),
        ("backward", "along += ", "along = "),
        ("backward", "accumulate == 1u", "accumulate == 0u"),
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
    [1, 7, 129].map(forward_case).into()
}

fn forward_case(rows: u32) -> Case {
    let mut s = Sketch::new(format!("{rows} rows"));
    let n = rows as usize;
    let [x, direction] = ["x", "direction"].map(|name| s.random(name, 3 * n));
    let step = s.random("step", n);
    let x_next = s.scratch("x_next", 3 * n);
    s.step(|b| advance::forward(b, rows, x, direction, step, x_next));
    s.finish()
}

fn backward() -> Vec<Case> {
    [(1, false), (7, true), (129, false)].map(|(rows, accumulate)| backward_case(rows, accumulate)).into()
}

fn backward_case(rows: u32, accumulate: bool) -> Case {
    let mut s = Sketch::new(format!("{rows} rows, accumulate {accumulate}"));
    let n = rows as usize;
    let [direction, d_x_next] = ["direction", "d_x_next"].map(|name| s.random(name, 3 * n));
    let step = s.random("step", n);
    let d_step = s.scratch("d_step", n);
    let d_direction = s.output("d_direction", 3 * n, accumulate);
    s.step(|b| advance::backward(b, rows, direction, step, d_x_next, d_step, d_direction, accumulate));
    s.finish()
}
