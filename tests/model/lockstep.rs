//! The GPU executor against the `f64` reference, step by step through the plans of the whole model.

use std::collections::BTreeMap;

use sigma_srn::{Engine, Train};
use srn_plan::{Executor, Kernel, StageId};
use srn_tests::{gpu, lockstep};

use crate::{RAYS, batch, descent, methods, model, trainer};

/// Largest difference of one step on equal inputs, relative to the largest value of its output.
fn tolerance(kernel: &Kernel) -> Option<f64> {
    Some(match kernel.name {
        // Parts that cancel: worst on llvmpipe 3.2e-5.
        "sum/forward" => 2e-4,
        // Worst on llvmpipe: 4.6e-6 (`linear/forward`).
        _ => 2e-5,
    })
}

/// Executors that compare alike need plans that are alike: tiles of a part of an image, on both.
pub fn engines() -> [Engine; 2] {
    [Engine::gpu(gpu().clone()), Engine::cpu_f64()].map(|engine| engine.with_tile_rows(RAYS - 20))
}

fn stage(executor: &dyn Executor, name: &str) -> StageId {
    let plan = executor.plan();
    plan.stage_id(plan.stages.iter().position(|stage| stage.name == name).unwrap())
}

pub fn step_by_step(subject: &mut dyn Executor, reference: &mut dyn Executor, name: &str) -> BTreeMap<&'static str, f64> {
    let stage = stage(reference, name);
    let worst = lockstep(subject, reference, stage, tolerance).unwrap_or_else(|divergence| panic!("{name}: {divergence}"));
    let largest = worst.iter().max_by(|a, b| a.1.total_cmp(b.1)).unwrap();
    println!("worst {:.1e}: {} of {} kernels in stage {name}", largest.1, largest.0, worst.len());
    worst
}

#[test]
fn a_training_step() {
    const IMAGES: u32 = 3;
    for density in [true, false] {
        let [mut subject, mut reference] = engines().map(|engine| {
            let mut trainer = trainer(&engine, model(density), Train::Everything, IMAGES);
            trainer.step(&batch(IMAGES), 1e-3).unwrap();
            trainer
        });
        let (subject, reference) = (subject.executor(), reference.executor());
        share_buffers(subject, reference);
        for stage in ["hypernetwork", "render and back", "hypernetwork back", "update"] {
            step_by_step(subject, reference, stage);
        }
    }
}

#[test]
fn a_step_of_every_descent() {
    for method in methods() {
        let [mut subject, mut reference] = engines().map(|engine| {
            let mut descent = descent(&engine, method, 3);
            descent.evaluate().unwrap();
            descent.descend().unwrap();
            descent
        });
        let (subject, reference) = (subject.executor(), reference.executor());
        share_buffers(subject, reference);
        let names: Vec<String> = subject.plan().stages.iter().map(|stage| stage.name.clone()).collect();
        for name in names {
            step_by_step(subject, reference, &name);
        }
    }
}

#[test]
fn a_chain_on_the_cpu_gives_what_its_steps_give() {
    let engine = Engine::cpu();
    let trained = || {
        let mut trainer = trainer(&engine, model(true), Train::Everything, 3);
        trainer.step(&batch(3), 1e-3).unwrap();
        trainer
    };
    let [mut chained, mut stepped] = [trained(), trained()];
    same_in_steps(chained.executor(), stepped.executor());
    for method in methods() {
        let evaluated = || {
            let mut descent = descent(&engine, method, 3);
            descent.evaluate().unwrap();
            descent.descend().unwrap();
            descent
        };
        let [mut chained, mut stepped] = [evaluated(), evaluated()];
        same_in_steps(chained.executor(), stepped.executor());
    }
}

/// Runs every stage, on one executor as a whole and on the other step by step, and compares all buffers bit by bit.
fn same_in_steps(chained: &mut dyn Executor, stepped: &mut dyn Executor) {
    let plan = chained.plan().clone();
    for (number, stage) in plan.stages.iter().enumerate() {
        let id = plan.stage_id(number);
        chained.run(id).unwrap();
        for step in 0..stage.steps.len() {
            stepped.run_step(id, step).unwrap();
        }
        for buffer in plan.buffers.iter().filter(|buffer| buffer.element == srn_plan::Element::F32) {
            let id = plan.find(&buffer.name).unwrap();
            let [got, want] = [chained.read(id), stepped.read(id)].map(|values| values.unwrap());
            let same = got.iter().zip(&want).all(|(got, want)| got.to_bits() == want.to_bits());
            assert!(same, "stage {}: `{}` differs", stage.name, buffer.name);
        }
    }
}

/// After the same calls the buffers hold the same up to rounding: now to the last digit, as a step may leave a part of what it writes to as it was.
pub fn share_buffers(subject: &mut dyn Executor, reference: &mut dyn Executor) {
    let plan = subject.plan().clone();
    for buffer in plan.buffers.iter().filter(|buffer| buffer.element == srn_plan::Element::F32) {
        let id = plan.find(&buffer.name).unwrap();
        reference.write(id, &subject.read(id).unwrap()).unwrap();
    }
}
