use srn_plan::ops::latent_loss;
use srn_shaders::{LATENT_LOSS_BACKWARD, LATENT_LOSS_FORWARD};
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static FORWARD: KernelTest = KernelTest {
    kernel: &LATENT_LOSS_FORWARD,
    // Worst 3.0e-7 on llvmpipe.
    tolerance: 2e-6,
    cases: forward,
    faults: &[("forward", "z[i] * z[i]", "z[i]"), ("forward", "params.scale * total", "total")],
};

pub static BACKWARD: KernelTest = KernelTest {
    kernel: &LATENT_LOSS_BACKWARD,
    // Worst 8.3e-8 on llvmpipe.
    tolerance: 5e-7,
    cases: backward,
    faults: &[("backward", "d_z[i] += ", "d_z[i] = "), ("backward", "2.0 * params.scale", "params.scale")],
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
    [1, 7, 129, 1000].map(forward_case).into()
}

fn forward_case(count: u32) -> Case {
    let mut s = Sketch::new(format!("{count} values"));
    let z = s.random("z", count as usize);
    let partial = s.scratch("partial", latent_loss::partial_len(count));
    let loss = s.scratch("loss", 1);
    s.step(|b| latent_loss::forward(b, count, 0.3, z, partial, loss));
    s.finish()
}

/// The last has more workgroups than one dimension of a grid holds.
fn backward() -> Vec<Case> {
    [1, 7, 129, 64 * 65_535 + 65].map(backward_case).into()
}

fn backward_case(count: u32) -> Case {
    let mut s = Sketch::new(format!("{count} values"));
    let [z, d_z] = ["z", "d_z"].map(|name| s.random(name, count as usize));
    s.step(|b| latent_loss::backward(b, count, 0.3, z, d_z));
    s.finish()
}
