use srn_plan::ops::compose;
use srn_shaders::{COMPOSE_BACKWARD, COMPOSE_FORWARD};
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static FORWARD: KernelTest = KernelTest {
    kernel: &COMPOSE_FORWARD,
    // Worst 8.5e-8 on llvmpipe.
    tolerance: 5e-7,
    cases: forward,
    faults: &[
        ("forward", "product.w + frame[row + 3u]", "product.w - frame[row + 3u]"),
        ("forward", "motion[m + 2u] * start_row(at + 8u)", "motion[m + 2u] * start_row(at + 4u)"),
        ("forward", "frame[row + 2u] * moved[2]", "frame[row + 2u] * moved[1]"),
        ("forward", "12u * pose", "11u * pose"),
    ],
};

pub static BACKWARD: KernelTest = KernelTest {
    kernel: &COMPOSE_BACKWARD,
    // Worst 8.9e-8 on llvmpipe.
    tolerance: 5e-7,
    cases: backward,
    faults: &[
        ("backward", "dot(d, start_row(at + 4u))", "dot(d.xyz, start_row(at + 4u).xyz)"),
        ("backward", "= d.w", "= d.z"),
        ("backward", "frame[at + 4u + r]", "frame[at + 5u + r]"),
        ("backward", "12u * pose", "11u * pose"),
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

fn forward_case(count: u32) -> Case {
    let mut s = Sketch::new(format!("{count} poses"));
    let frame = s.random("frame", 12 * count as usize);
    let motion = s.random("motion", 12 * count as usize);
    let start = s.random("start", 12 * count as usize);
    let world_from_camera = s.scratch("world_from_camera", 12 * count as usize);
    s.step(|b| compose::forward(b, count, frame, motion, start, world_from_camera));
    s.finish()
}

fn backward() -> Vec<Case> {
    [1, 7, 129].map(backward_case).into()
}

fn backward_case(count: u32) -> Case {
    let mut s = Sketch::new(format!("{count} poses"));
    let frame = s.random("frame", 12 * count as usize);
    let start = s.random("start", 12 * count as usize);
    let d_world_from_camera = s.random("d_world_from_camera", 12 * count as usize);
    let d_motion = s.scratch("d_motion", 12 * count as usize);
    s.step(|b| compose::backward(b, count, frame, start, d_world_from_camera, d_motion));
    s.finish()
}
