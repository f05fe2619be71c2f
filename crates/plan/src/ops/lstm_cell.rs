//! The ray marcher's LSTM cell, after the two linear maps that make its gates.

use srn_shaders::{LSTM_CELL_BACKWARD, LSTM_CELL_FORWARD, LstmParams};

use super::{overwrite, read, size};
use crate::{BufferId, Builder, PlanError};

/// `gates [rows, 4·hidden]`, `c_prev` → `h, c [rows, hidden]`.
pub fn forward(
    b: &mut Builder,
    rows: u32,
    hidden: u32,
    gates: BufferId,
    c_prev: BufferId,
    h: BufferId,
    c: BufferId,
) -> Result<(), PlanError> {
    let n = size([rows, hidden]);
    let args = [read(gates, 4 * n), read(c_prev, n), overwrite(h, n), overwrite(c, n)];
    b.step(&LSTM_CELL_FORWARD, LstmParams { rows, hidden }, &args, [rows * hidden, 1, 1], 0, 0)
}

/// `d_h` (clamped to ±10 first, spec 3) and `d_c` → `d_gates`, `d_c_prev`; overwrites.
pub fn backward(
    b: &mut Builder,
    rows: u32,
    hidden: u32,
    gates: BufferId,
    c_prev: BufferId,
    c: BufferId,
    d_h: BufferId,
    d_c: BufferId,
    d_gates: BufferId,
    d_c_prev: BufferId,
) -> Result<(), PlanError> {
    let n = size([rows, hidden]);
    let args = [
        read(gates, 4 * n),
        read(c_prev, n),
        read(c, n),
        read(d_h, n),
        read(d_c, n),
        overwrite(d_gates, 4 * n),
        overwrite(d_c_prev, n),
    ];
    b.step(&LSTM_CELL_BACKWARD, LstmParams { rows, hidden }, &args, [rows * hidden, 1, 1], 0, 0)
}
