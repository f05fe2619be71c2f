use srn_plan::ops::density_sum;
use srn_plan::ops::linear::{Layer, Sets};
use srn_shaders::{DENSITY_SUM_BACKWARD, DENSITY_SUM_FORWARD};
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static FORWARD: KernelTest = KernelTest {
    kernel: &DENSITY_SUM_FORWARD,
    // Worst 4.6e-7 on llvmpipe.
    tolerance: 3e-6,
    cases,
    faults: &[
        ("forward", "sigma = head[m]", "sigma = 0.0"),
        ("forward", "hidden[row * m + k]", "hidden[row * n + k]"),
        ("forward", "accumulate == 1u", "accumulate == 0u"),
        ("forward_vec4", "+ head[params.in_features]", "+ head[0]"),
        ("forward_vec4", "head[4u * k + 2u]", "head[4u * k + 1u]"),
        ("forward_vec4", "dot(sums, vec4(1.0))", "sums.x"),
        ("forward_vec4", "accumulate == 1u", "accumulate == 0u"),
        ("forward_subgroup", "subgroupShuffleXor(sigma, 4u)", "subgroupShuffleXor(sigma, 2u)"),
        ("forward_subgroup", "+= head[params.in_features]", "+= head[0]"),
        ("forward_subgroup", "row = 8u *", "row = 4u *"),
        ("forward_subgroup", "accumulate == 1u", "accumulate == 0u"),
    ],
};

pub static BACKWARD: KernelTest = KernelTest {
    kernel: &DENSITY_SUM_BACKWARD,
    // Worst 4.5e-7 on llvmpipe.
    tolerance: 2e-6,
    cases,
    faults: &[
        ("backward", "sigma * d_phi[j]", "sigma * feature[j]"),
        ("backward", "d_phi[j] * feature[j]", "d_phi[j] * d_phi[j]"),
        ("backward", "total * head[k]", "sigma * head[k]"),
        ("backward_vec4", "sigma * d_phi[j]", "sigma * feature[j]"),
        ("backward_vec4", "dot(sums, vec4(1.0))", "sums.x"),
        ("backward_vec4", "total * weights(k)", "sigma * weights(k)"),
        ("backward_vec4", "head[4u * k + 3u]", "head[4u * k]"),
        ("backward_subgroup", "subgroupShuffleXor(total, 1u)", "subgroupShuffleXor(total, 2u)"),
        ("backward_subgroup", "sigma * gradient", "sigma * feature[j]"),
        ("backward_subgroup", "total * weights(k)", "sigma * weights(k)"),
        ("backward_subgroup", "row = 8u *", "row = 4u *"),
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

/// Rows, values before the head, features.
const SIZES: [(u32, u32, u32); 7] = [(1, 1, 1), (7, 3, 5), (129, 17, 8), (33, 64, 64), (70, 12, 36), (2, 36, 4), (301, 256, 100)];

fn cases() -> Vec<Case> {
    SIZES.iter().flat_map(|&size| [false, true].map(|accumulate| case(size, accumulate))).collect()
}

fn case((rows, in_features, features): (u32, u32, u32), accumulate: bool) -> Case {
    let mut s = Sketch::new(format!("{rows} rows of {in_features} and {features}, accumulate {accumulate}"));
    let (n, m, rays) = ((rows * features) as usize, (rows * in_features) as usize, rows as usize);
    let weights = s.random("head", in_features as usize + 1);
    let head = Layer { weights, in_features, out_features: 1, sets: Sets::Shared };
    let hidden = s.random("hidden", m);
    let [feature, d_phi] = ["feature", "d_phi"].map(|name| s.random(name, n));
    let [density, d_density] = ["density", "d_density"].map(|name| s.scratch(name, rays));
    let phi = s.output("phi", n, accumulate);
    let (d_feature, d_hidden) = (s.scratch("d_feature", n), s.scratch("d_hidden", m));
    s.step(|b| density_sum::forward(b, rows, features, head, hidden, feature, density, phi, accumulate));
    s.step(|b| density_sum::backward(b, rows, features, head, density, feature, d_phi, d_density, d_feature, d_hidden));
    s.finish()
}
