//! One step along the ray, `x_{i+1} = x_i + d · step`, with the linear map from the hidden state that says how far.

use srn_shaders::{ADVANCE_BACKWARD, ADVANCE_FORWARD, AdvanceParams};

use super::linear::Layer;
use super::{output, overwrite, read, size};
use crate::{BufferId, Builder, PlanError};

/// `step [rows] = head · h [rows, hidden]`, `x, direction [rows,3]` → `x_next [rows,3]`; `head` has one output.
pub fn forward(
    b: &mut Builder,
    rows: u32,
    head: Layer,
    x: BufferId,
    direction: BufferId,
    h: BufferId,
    step: BufferId,
    x_next: BufferId,
) -> Result<(), PlanError> {
    let n = size([rows, 3]);
    let args = [
        read(x, n),
        read(direction, n),
        read(h, size([rows, head.in_features])),
        read(head.weights, size([head.parameters()])),
        overwrite(step, size([rows])),
        overwrite(x_next, n),
    ];
    b.step(&ADVANCE_FORWARD, params(rows, head, false), &args, [rows, 1, 1], head.in_features.into(), flops(rows, head))
}

/// `d_x_next` → `d_step` (overwrites), `d_direction` and `d_h` (as `accumulate` says). `d_x` equals `d_x_next`: keep using that buffer.
pub fn backward(
    b: &mut Builder,
    rows: u32,
    head: Layer,
    direction: BufferId,
    step: BufferId,
    d_x_next: BufferId,
    d_step: BufferId,
    d_direction: BufferId,
    d_h: BufferId,
    accumulate: bool,
) -> Result<(), PlanError> {
    let n = size([rows, 3]);
    let args = [
        read(direction, n),
        read(step, size([rows])),
        read(d_x_next, n),
        read(head.weights, size([head.parameters()])),
        overwrite(d_step, size([rows])),
        output(d_direction, n, accumulate),
        output(d_h, size([rows, head.in_features]), accumulate),
    ];
    b.step(&ADVANCE_BACKWARD, params(rows, head, accumulate), &args, [rows, 1, 1], head.in_features.into(), flops(rows, head))
}

fn params(rows: u32, head: Layer, accumulate: bool) -> AdvanceParams {
    AdvanceParams { rows, hidden: head.in_features, accumulate: accumulate.into() }
}

fn flops(rows: u32, head: Layer) -> u64 {
    2 * u64::from(rows) * u64::from(head.in_features)
}
