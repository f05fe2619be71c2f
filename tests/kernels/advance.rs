use srn_plan::ops::advance;
use srn_plan::ops::linear::{Layer, Sets};
use srn_shaders::{ADVANCE_BACKWARD, ADVANCE_FORWARD};
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static FORWARD: KernelTest = KernelTest {
    kernel: &ADVANCE_FORWARD,
    // Worst 6.6e-8 on llvmpipe.
    tolerance: 4e-7,
    cases: forward,
    faults: &[
        ("forward", "x[a] + direction", "x[a] - direction"),
        ("forward", "along = head[n]", "along = 0.0"),
        ("forward", "h[row * n + k]", "h[row + k]"),
        ("forward", "step[row] = along", "step[row] = head[n]"),
    ],
};

pub static BACKWARD: KernelTest = KernelTest {
    kernel: &ADVANCE_BACKWARD,
    // Worst 9.0e-8 on llvmpipe.
    tolerance: 5e-7,
    cases: backward,
    faults: &[
        ("backward", "d_x_next[a] * step[row]", "direction[a] * step[row]"),
        ("backward", "along += ", "along = "),
        ("backward", "along * head[k]", "step[row] * head[k]"),
        ("backward", "d += d_h[row * n + k]", "d += d_h[row * n]"),
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

const SIZES: [(u32, u32); 4] = [(1, 1), (7, 3), (129, 16), (33, 37)];

fn head(s: &mut Sketch, hidden: u32) -> Layer {
    Layer { weights: s.random("head", hidden as usize + 1), in_features: hidden, out_features: 1, sets: Sets::Shared }
}

fn forward() -> Vec<Case> {
    SIZES.map(|(rows, hidden)| forward_case(rows, hidden)).into()
}

fn forward_case(rows: u32, hidden: u32) -> Case {
    let mut s = Sketch::new(format!("{rows} rows of {hidden}"));
    let n = rows as usize;
    let [x, direction] = ["x", "direction"].map(|name| s.random(name, 3 * n));
    let h = s.random("h", n * hidden as usize);
    let head = head(&mut s, hidden);
    let (step, x_next) = (s.scratch("step", n), s.scratch("x_next", 3 * n));
    s.step(|b| advance::forward(b, rows, head, x, direction, h, step, x_next));
    s.finish()
}

fn backward() -> Vec<Case> {
    SIZES.iter().flat_map(|&(rows, hidden)| [false, true].map(|accumulate| backward_case(rows, hidden, accumulate))).collect()
}

fn backward_case(rows: u32, hidden: u32, accumulate: bool) -> Case {
    let mut s = Sketch::new(format!("{rows} rows of {hidden}, accumulate {accumulate}"));
    let n = rows as usize;
    let [direction, d_x_next] = ["direction", "d_x_next"].map(|name| s.random(name, 3 * n));
    let step = s.random("step", n);
    let head = head(&mut s, hidden);
    let d_step = s.scratch("d_step", n);
    let d_direction = s.output("d_direction", 3 * n, accumulate);
    let d_h = s.output("d_h", n * hidden as usize, accumulate);
    s.step(|b| advance::backward(b, rows, head, direction, step, d_x_next, d_step, d_direction, d_h, accumulate));
    s.finish()
}
