use srn_plan::ops::sum::{self, Groups};
use srn_shaders::SUM_FORWARD;
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static FORWARD: KernelTest = KernelTest {
    kernel: &SUM_FORWARD,
    // Worst 3.9e-7 on llvmpipe.
    tolerance: 2e-6,
    cases,
    faults: &[
        ("forward", "t * params.count", "t"),
        ("forward", "group * params.terms", "group"),
        ("forward", "params.first_group * params.count + index", "index"),
        ("forward", "accumulate == 1u", "accumulate == 0u"),
    ],
};

#[test]
fn forward_matches_reference() {
    FORWARD.matches_reference();
}

fn cases() -> Vec<Case> {
    [((1, 0), 1, 1), ((3, 2), 7, 5), ((1, 0), 129, 3), ((5, 1), 2, 130)]
        .iter()
        .flat_map(|&((count, first), terms, values)| {
            [false, true].map(|accumulate| case(Groups { count, first }, terms, values, accumulate))
        })
        .collect()
}

/// Groups before the first one stay.
fn case(groups: Groups, terms: u32, values: u32, accumulate: bool) -> Case {
    let mut s = Sketch::new(format!("{groups:?} of {terms} terms of {values}, accumulate {accumulate}"));
    let x = s.random("x", (groups.count * terms * values) as usize);
    let len = ((groups.first + groups.count) * values) as usize;
    let y = s.output("y", len, accumulate || groups.first > 0);
    s.step(|b| sum::forward(b, groups, terms, values, x, y, accumulate));
    s.finish()
}
