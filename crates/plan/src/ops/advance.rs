//! One step along the ray: `x_{i+1} = x_i + d · step`.

use srn_shaders::{ADVANCE_BACKWARD, ADVANCE_FORWARD, AdvanceParams};

use super::{output, overwrite, read, size};
use crate::{BufferId, Builder, PlanError};

/// `x, direction [rows,3]`, `step [rows]` → `x_next [rows,3]`.
pub fn forward(
    b: &mut Builder,
    rows: u32,
    x: BufferId,
    direction: BufferId,
    step: BufferId,
    x_next: BufferId,
) -> Result<(), PlanError> {
    let n = size([rows, 3]);
    let args = [read(x, n), read(direction, n), read(step, size([rows])), overwrite(x_next, n)];
    b.step(&ADVANCE_FORWARD, AdvanceParams { rows, accumulate: 0 }, &args, [rows, 1, 1], 0, 0)
}

/// `d_x_next` → `d_step` (overwrites), `d_direction` (as `accumulate` says). `d_x` equals `d_x_next`: keep using that buffer.
pub fn backward(
    b: &mut Builder,
    rows: u32,
    direction: BufferId,
    step: BufferId,
    d_x_next: BufferId,
    d_step: BufferId,
    d_direction: BufferId,
    accumulate: bool,
) -> Result<(), PlanError> {
    let n = size([rows, 3]);
    let args = [
        read(direction, n),
        read(step, size([rows])),
        read(d_x_next, n),
        overwrite(d_step, size([rows])),
        output(d_direction, n, accumulate),
    ];
    b.step(&ADVANCE_BACKWARD, AdvanceParams { rows, accumulate: accumulate.into() }, &args, [rows, 1, 1], 0, 0)
}
