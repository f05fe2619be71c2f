use srn_plan::ops::adam;
use srn_shaders::ADAM_STEP;
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static STEP: KernelTest = KernelTest {
    kernel: &ADAM_STEP,
    // Worst 1.0e-7 on llvmpipe.
    tolerance: 5e-7,
    cases,
    faults: &[
        ("step", "first * schedule[1]", "first * schedule[2]"),
        ("step", "sqrt(second", "(second"),
        ("step", "params.beta2 * v[i]", "params.beta1 * v[i]"),
        ("step", "value[i] -=", "value[i] +="),
        ("step", "+ params.epsilon", "+ 0.0"),
    ],
};

#[test]
fn step_matches_reference() {
    STEP.matches_reference();
}

fn cases() -> Vec<Case> {
    [(1, 1), (7, 2), (129, 50), (1000, 100_000)].map(|(count, t)| case(count, t)).into()
}

/// The first value has met no gradient yet: its update is 0 / ε.
fn case(count: u32, t: u64) -> Case {
    let mut s = Sketch::new(format!("{count} values, step {t}"));
    let n = count as usize;
    let [mut gradient, mut m, mut v] = [(); 3].map(|()| s.numbers(n));
    v.iter_mut().for_each(|v| *v = *v * *v);
    [gradient[0], m[0], v[0]] = [0.0; 3];
    let gradient = s.input("gradient", gradient);
    let schedule = s.input("schedule", adam::schedule(0.5, t).map(|value| value as f32).into());
    let value = s.random("value", n);
    let m = s.input("m", m);
    let v = s.input("v", v);
    s.step(|b| adam::step(b, count, gradient, schedule, value, m, v));
    s.finish()
}
