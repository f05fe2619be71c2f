//! Adam (spec 3 and 4).

use srn_shaders::{ADAM_STEP, AdamParams};

use super::{read, update};
use crate::{BufferId, Builder, PlanError};

/// Decay of the first moment.
pub const BETA1: f64 = 0.9;
/// Decay of the second moment.
pub const BETA2: f64 = 0.999;
/// Added to the denominator.
pub const EPSILON: f64 = 1e-8;

/// The values of the `schedule` buffer for step `t` (the first step is 1): learning rate and bias corrections.
pub fn schedule(learning_rate: f64, t: u64) -> [f64; 3] {
    let correction = |beta: f64| 1.0 / (1.0 - beta.powf(t as f64));
    [learning_rate, correction(BETA1), correction(BETA2)]
}

/// One step on `count` values with their moments `m`, `v`; `schedule [3]` changes every step.
pub fn step(
    b: &mut Builder,
    count: u32,
    gradient: BufferId,
    schedule: BufferId,
    value: BufferId,
    m: BufferId,
    v: BufferId,
) -> Result<(), PlanError> {
    let n = count as usize;
    let params = AdamParams {
        count,
        beta1: BETA1 as f32,
        beta2: BETA2 as f32,
        one_minus_beta1: (1.0 - BETA1) as f32,
        one_minus_beta2: (1.0 - BETA2) as f32,
        epsilon: EPSILON as f32,
    };
    let args = [read(gradient, n), read(schedule, 3), update(value, n), update(m, n), update(v, n)];
    b.step(&ADAM_STEP, params, &args, [count, 1, 1], 0, 0)
}
