//! A GPU is believed once it has computed what the CPU executor does: faults are planted in its kernels.

use std::fs;

use rayon::prelude::*;
use sigma_srn::{Engine, Error, Gpu, Method, Model, Options, Outline, Phase, Query, Renderer, Train, Trainer, camera, estimate};
use srn_gpu::Choice;
use srn_tests::gpu;

use crate::{SIZE, intrinsics, model};

/// The test's device, its variants measured and nothing kept, with kernels that are called so changed.
fn faulty(is_meant: fn(&str) -> bool, change: fn(String) -> String) -> Gpu {
    let gpu = gpu().with_sources(move |kernel, variant| {
        let text = kernel.source(variant);
        if is_meant(&kernel.label(variant)) { change(text) } else { text }
    });
    gpu.with_choice(Choice::Measured { cache: None })
}

/// Nothing is written to any buffer, as by a driver that leaves all of them zero.
fn does_nothing(text: String) -> String {
    let main = text.find("fn main(").expect("every kernel has one");
    let body = main + text[main..].find('{').expect("a body") + 1;
    format!("{}\n    if true {{ return; }}{}", &text[..body], &text[body..])
}

/// The pose of a view, from a start near it.
fn found(engine: &Engine) -> Result<[f64; 6], Error> {
    let model = &model(true);
    let [width, height] = SIZE;
    let truth = camera::fixed24(1.3)[13];
    let view = Renderer::new(&Engine::cpu(), model, 1, width, height)?.render(&[1], &[(truth, intrinsics())], 0)?;
    let starts = vec![glam::DMat4::from_axis_angle(glam::DVec3::new(0.6, 0.0, 0.8), 0.2) * truth];
    let (intrinsics, rgb) = (intrinsics(), view.rgb);
    let query =
        Query { instance: 1, intrinsics, width, height, rgb, weights: None, coverage: None, outline: Outline::AS_GIVEN, starts };
    let phases = vec![Phase { steps: 4, stride: 1, keep: usize::MAX, light: false, closer_look: false, outlines: false }];
    let options = Options {
        method: Method::Bfgs { soft: 1.0, grain: 0.0 },
        min_starts: 0,
        align: false,
        phases,
        anew: 0,
        settle: 0,
        seed: 0,
    };
    Ok(estimate(engine, model, &[query], &options, |_| Ok(()))?.remove(0).pose.0)
}

fn trained(engine: &Engine, model: Model, train: Train) -> Result<Trainer, Error> {
    Trainer::new(engine, model, train, 1, 8)
}

#[test]
fn an_adapter_that_computes_nothing_is_refused() {
    let engine = Engine::gpu(faulty(|_| true, does_nothing));
    let error = found(&engine).unwrap_err();
    assert!(matches!(&error, Error::Adapter { difference, .. } if *difference > 0.9), "{error}");
    let message = error.to_string();
    let [width, height] = SIZE;
    let error = Renderer::new(&engine, &model(true), 1, width, height).err().expect("refused");
    assert!(matches!(&error, Error::Adapter { work: "views", .. }), "{error}");
    assert!(message.contains(&gpu().adapter().name) && message.contains("gradients of poses"), "{message}");
    for train in [Train::Codes, Train::Everything] {
        let error = trained(&engine, model(true), train).err().expect("refused");
        assert!(matches!(error, Error::Adapter { .. }), "{error}");
    }
}

#[test]
fn the_cpu_goes_on_where_it_may() {
    let engine = Engine::gpu(faulty(|_| true, does_nothing)).or_cpu();
    assert!(engine.as_gpu().is_some());
    assert_eq!(found(&engine).unwrap(), found(&Engine::cpu()).unwrap());
    assert!(engine.as_gpu().is_none() && engine.to_string() == "cpu");
    let shown = |engine: &Engine| {
        let view = [(camera::fixed24(1.3)[2], intrinsics())];
        Renderer::new(engine, &model(true), 1, SIZE[0], SIZE[1]).unwrap().render(&[0], &view, 0).unwrap()
    };
    assert_eq!(shown(&engine), shown(&Engine::cpu()));
    assert_eq!(shown(&Engine::gpu(faulty(|_| true, does_nothing)).or_cpu()), shown(&Engine::cpu()), "views first");
    trained(&engine, model(true), Train::Everything).unwrap();
}

#[test]
fn what_is_wrong_for_training_alone_does_not_keep_poses_from_being_found() {
    let engine = Engine::gpu(faulty(|label| label.starts_with("linear/backward_weight"), does_nothing));
    found(&engine).unwrap();
    assert!(matches!(trained(&engine, model(true), Train::Everything), Err(Error::Adapter { .. })));
}

#[test]
fn plain_forms_replace_faster_ones_that_are_wrong() {
    let is_fast = |label: &str| ["_vec4", "_workgroup", "_subgroup"].iter().any(|form| label.ends_with(form));
    let engine = Engine::gpu(faulty(is_fast, does_nothing));
    let plain = Engine::gpu(gpu().with_choice(Choice::Named("plain".into())));
    assert_eq!(found(&engine).unwrap(), found(&plain).unwrap());
    trained(&engine, model(true), Train::Everything).unwrap();
}

#[test]
fn forms_are_tried_that_the_trial_would_not_choose() {
    // On a GPU that is this machine's processor it is never the fastest.
    let engine = Engine::gpu(faulty(|label| label == "linear/forward_workgroup", does_nothing));
    found(&engine).unwrap();
    assert_eq!(engine.as_gpu().unwrap().choice(), &Choice::Named("plain".into()));
}

#[test]
fn a_form_that_does_not_compile_keeps_no_other_from_being_used() {
    let engine = Engine::gpu(faulty(|label| label == "linear/forward_workgroup", |_| "not WGSL".into()));
    found(&engine).unwrap();
    assert!(matches!(engine.as_gpu().unwrap().choice(), Choice::Measured { .. }));
}

#[test]
fn threads_that_wait_for_the_cpu_do_not_wait_for_each_other() {
    let engine = Engine::gpu(gpu().with_choice(Choice::Measured { cache: None }));
    // Each trial runs on the threads that the searches are on.
    let poses: Vec<_> = (0..4).into_par_iter().map(|_| found(&engine).unwrap()).collect();
    assert!(poses.iter().all(|pose| pose == &poses[0]), "{poses:?}");
}

#[test]
fn an_adapter_is_tried_once() {
    let folder = tempfile::tempdir().unwrap();
    let kept = || fs::read_to_string(folder.path().join("variants.txt")).unwrap_or_default();
    let gpu = gpu().with_choice(Choice::Measured { cache: Some(folder.path().into()) });
    let count = || kept().lines().filter(|line| line.ends_with(" agrees")).count();
    found(&Engine::gpu(gpu.clone())).unwrap();
    assert_eq!(count(), 1);
    trained(&Engine::gpu(gpu.clone()), model(true), Train::Everything).unwrap();
    assert_eq!(count(), 2, "another kind of work");
    // What is kept is believed: told that the plain forms alone are right, the engine takes those.
    fs::write(folder.path().join("variants.txt"), kept().replace(" agrees", " agrees/plain")).unwrap();
    let plain = gpu.with_choice(Choice::Named("plain".into()));
    assert_eq!(found(&Engine::gpu(gpu.clone())).unwrap(), found(&Engine::gpu(plain)).unwrap());
    // Other texts are another matter.
    let zero = gpu.with_sources(|kernel, variant| does_nothing(kernel.source(variant)));
    assert!(matches!(found(&Engine::gpu(zero)), Err(Error::Adapter { .. })));
}
