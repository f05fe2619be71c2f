use srn_plan::ops::density_sum;
use srn_shaders::{DENSITY_SUM_BACKWARD, DENSITY_SUM_FORWARD};
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static FORWARD: KernelTest = KernelTest {
    kernel: &DENSITY_SUM_FORWARD,
    // Worst 5.5e-7 on llvmpipe.
    tolerance: 3e-6,
    cases: forward,
    faults: &[
        ("forward", "index / params.features", "index % params.features"),
        ("forward", "accumulate == 1u", "accumulate == 0u"),
        ("forward_vec4", "index / n", "index % n"),
        ("forward_vec4", "accumulate == 1u", "accumulate == 0u"),
    ],
};

pub static BACKWARD: KernelTest = KernelTest {
    kernel: &DENSITY_SUM_BACKWARD,
    // Worst 1.7e-7 on llvmpipe.
    tolerance: 9e-7,
    cases: backward,
    faults: &[
        ("backward", "sigma * d_phi[j]", "sigma * feature[j]"),
        ("backward", "d_phi[j] * feature[j]", "d_phi[j] * d_phi[j]"),
        ("backward_vec4", "sigma * d_phi[j]", "sigma * feature[j]"),
        ("backward_vec4", "dot(total, vec4(1.0))", "total.x"),
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

const SIZES: [(u32, u32); 5] = [(1, 1), (7, 3), (129, 17), (33, 64), (70, 12)];

fn forward() -> Vec<Case> {
    SIZES.iter().flat_map(|&(rows, features)| [false, true].map(|accumulate| forward_case(rows, features, accumulate))).collect()
}

fn forward_case(rows: u32, features: u32, accumulate: bool) -> Case {
    let mut s = Sketch::new(format!("{rows} rows of {features}, accumulate {accumulate}"));
    let n = (rows * features) as usize;
    let density = s.random("density", rows as usize);
    let feature = s.random("feature", n);
    let phi = s.output("phi", n, accumulate);
    s.step(|b| density_sum::forward(b, rows, features, density, feature, phi, accumulate));
    s.finish()
}

fn backward() -> Vec<Case> {
    SIZES.map(|(rows, features)| backward_case(rows, features)).into()
}

fn backward_case(rows: u32, features: u32) -> Case {
    let mut s = Sketch::new(format!("{rows} rows of {features}"));
    let n = (rows * features) as usize;
    let density = s.random("density", rows as usize);
    let [feature, d_phi] = ["feature", "d_phi"].map(|name| s.random(name, n));
    let d_density = s.scratch("d_density", rows as usize);
    let d_feature = s.scratch("d_feature", n);
    s.step(|b| density_sum::backward(b, rows, features, density, feature, d_phi, d_density, d_feature));
    s.finish()
}
