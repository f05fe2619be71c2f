use std::f32::consts::PI;

use srn_plan::ops::pose;
use srn_shaders::{POSE_BACKWARD, POSE_FORWARD};
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static FORWARD: KernelTest = KernelTest {
    kernel: &POSE_FORWARD,
    // Worst 6.2e-8 on llvmpipe; the sines of other drivers are coarser.
    tolerance: 1e-5,
    cases: forward,
    faults: &[
        ("forward", "-c.y * s.z", "c.y * s.z"),
        ("forward", "pose6[p + 5u]", "pose6[p + 4u]"),
        ("forward", "12u *", "11u *"),
    ],
};

pub static BACKWARD: KernelTest = KernelTest {
    kernel: &POSE_BACKWARD,
    // Worst 7.3e-8 on llvmpipe; the sines of other drivers are coarser.
    tolerance: 1e-5,
    cases: backward,
    faults: &[
        ("backward", "dot(d_row2, row1) -", "dot(d_row2, row1) +"),
        ("backward", "-s.y * c.z", "s.y * c.z"),
        ("backward", "d_world_from_camera[w + 11u]", "d_world_from_camera[w + 10u]"),
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

/// Angles in [-π, π].
fn poses(s: &mut Sketch, poses: u32) -> Vec<f32> {
    s.numbers(6 * poses as usize).into_iter().map(|value| PI * value).collect()
}

fn forward() -> Vec<Case> {
    [1, 7, 129].map(forward_case).into()
}

fn forward_case(count: u32) -> Case {
    let mut s = Sketch::new(format!("{count} poses"));
    let pose6 = poses(&mut s, count);
    let pose6 = s.input("pose6", pose6);
    let world_from_camera = s.scratch("world_from_camera", 12 * count as usize);
    s.step(|b| pose::forward(b, count, pose6, world_from_camera));
    s.finish()
}

fn backward() -> Vec<Case> {
    [1, 7, 129].map(backward_case).into()
}

fn backward_case(count: u32) -> Case {
    let mut s = Sketch::new(format!("{count} poses"));
    let pose6 = poses(&mut s, count);
    let pose6 = s.input("pose6", pose6);
    let d_world_from_camera = s.random("d_world_from_camera", 12 * count as usize);
    let d_pose6 = s.scratch("d_pose6", 6 * count as usize);
    s.step(|b| pose::backward(b, count, pose6, d_world_from_camera, d_pose6));
    s.finish()
}
