use srn_plan::ops::keep_best;
use srn_shaders::KEEP_BEST_STEP;
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static STEP: KernelTest = KernelTest {
    kernel: &KEEP_BEST_STEP,
    // A copy.
    tolerance: 0.0,
    cases,
    faults: &[("step", "loss[pose] < best", "loss[pose] > best"), ("step", "6u * pose + 6u", "6u * pose + 5u")],
};

#[test]
fn step_matches_reference() {
    STEP.matches_reference();
}

fn cases() -> Vec<Case> {
    [1, 7, 129].map(case).into()
}

/// The first pose improves, so that each case changes something.
fn case(poses: u32) -> Case {
    let mut s = Sketch::new(format!("{poses} poses"));
    let n = poses as usize;
    let mut loss = s.numbers(n);
    loss[0] = -2.0;
    let loss = s.input("loss", loss);
    let pose6 = s.random("pose6", 6 * n);
    let best_loss = s.random("best_loss", n);
    let best_pose6 = s.random("best_pose6", 6 * n);
    s.step(|b| keep_best::step(b, poses, loss, pose6, best_loss, best_pose6));
    s.finish()
}
