use srn_plan::ops::lstm_cell;
use srn_shaders::{LSTM_CELL_BACKWARD, LSTM_CELL_FORWARD};
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static FORWARD: KernelTest = KernelTest {
    kernel: &LSTM_CELL_FORWARD,
    // Worst 1.9e-7 on llvmpipe.
    tolerance: 1e-6,
    cases: forward,
    faults: &[
        ("forward", "gate + 2u * params.hidden", "gate + 1u * params.hidden"),
        ("forward", "f * c_prev[index] + i * g", "i * c_prev[index] + f * g"),
        ("forward", "o * stable_tanh(cell)", "o * cell"),
        ("forward", "4u * params.hidden +", "3u * params.hidden +"),
        ("forward", "1.33314422036e-1", "1.33514422036e-1"),
        ("forward_vec4", "gate + 3u * n", "gate + 2u * n"),
        ("forward_vec4", "sigmoid(x.z)", "sigmoid(x.w)"),
        ("forward_vec4", "o * tangents(cell)", "o * cell"),
        ("forward_vec4", "index % n", "index % 2u"),
    ],
};

pub static BACKWARD: KernelTest = KernelTest {
    kernel: &LSTM_CELL_BACKWARD,
    // Worst 1.9e-7 on llvmpipe.
    tolerance: 1e-6,
    cases: backward,
    faults: &[
        ("backward", "-10.0, 10.0", "-11.0, 11.0"),
        ("backward", "i * (1.0 - g * g)", "i * (1.0 - g)"),
        ("backward", "d_c[index] + ", "0.0 * d_c[index] + "),
        ("backward", "d_cell * f;", "d_cell * i;"),
        ("backward", "d_hidden * tanh_c", "d_cell * tanh_c"),
        ("backward_vec4", "vec4(-10.0), vec4(10.0)", "vec4(-11.0), vec4(11.0)"),
        ("backward_vec4", "stable_tanh(x.y)", "stable_tanh(x.x)"),
        ("backward_vec4", "i * (1.0 - g * g)", "i * (1.0 - g)"),
        ("backward_vec4", "d_cell * f;", "d_cell * i;"),
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

const SIZES: [(u32, u32); 5] = [(1, 3), (7, 17), (129, 16), (33, 30), (70, 12)];

/// Gates from the linear to the saturated range.
fn gates(s: &mut Sketch, len: usize) -> Vec<f32> {
    s.numbers(len).into_iter().map(|gate| 30.0 * gate * gate * gate).collect()
}

fn forward() -> Vec<Case> {
    SIZES.map(|(rows, hidden)| forward_case(rows, hidden)).into()
}

fn forward_case(rows: u32, hidden: u32) -> Case {
    let mut s = Sketch::new(format!("{rows} rows of {hidden}"));
    let n = (rows * hidden) as usize;
    let gates = gates(&mut s, 4 * n);
    let gates = s.input("gates", gates);
    let c_prev = s.random("c_prev", n);
    let [h, c] = ["h", "c"].map(|name| s.scratch(name, n));
    s.step(|b| lstm_cell::forward(b, rows, hidden, gates, c_prev, h, c));
    s.finish()
}

fn backward() -> Vec<Case> {
    SIZES.map(|(rows, hidden)| backward_case(rows, hidden)).into()
}

/// Some gradients of the hidden state lie beyond the clamp.
fn backward_case(rows: u32, hidden: u32) -> Case {
    let mut s = Sketch::new(format!("{rows} rows of {hidden}"));
    let n = (rows * hidden) as usize;
    let gates = gates(&mut s, 4 * n);
    let gates = s.input("gates", gates);
    let [c_prev, c, d_c] = ["c_prev", "c", "d_c"].map(|name| s.random(name, n));
    let d_h = s.numbers(n).into_iter().map(|d_h| 20.0 * d_h).collect();
    let d_h = s.input("d_h", d_h);
    let d_gates = s.scratch("d_gates", 4 * n);
    let d_c_prev = s.scratch("d_c_prev", n);
    s.step(|b| lstm_cell::backward(b, rows, hidden, gates, c_prev, c, d_h, d_c, d_gates, d_c_prev));
    s.finish()
}
