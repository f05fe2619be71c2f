use srn_plan::ops::depth_loss;
use srn_shaders::DEPTH_LOSS_FORWARD;
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static FORWARD: KernelTest = KernelTest {
    kernel: &DEPTH_LOSS_FORWARD,
    // Worst 1.3e-7 on llvmpipe.
    tolerance: 7e-7,
    cases,
    faults: &[
        ("forward", "min(depth[i]", "max(depth[i]"),
        ("forward", "behind * behind", "behind"),
        ("forward", "params.scale * total", "total"),
    ],
};

#[test]
fn forward_matches_reference() {
    FORWARD.matches_reference();
}

fn cases() -> Vec<Case> {
    [1, 7, 129, 1000].map(case).into()
}

fn case(count: u32) -> Case {
    let mut s = Sketch::new(format!("{count} values"));
    let mut depth = s.numbers(count as usize);
    depth[0] = -1.0;
    let depth = s.input("depth", depth);
    let partial = s.scratch("partial", depth_loss::partial_len(count));
    let loss = s.scratch("loss", 1);
    s.step(|b| depth_loss::forward(b, count, 0.3, depth, partial, loss));
    s.finish()
}
