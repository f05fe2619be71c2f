//! Layers that stay on the host do as those on the device do.

use sigma_srn::{Descent, Engine, Model, ModelConfig, Renderer, Shape, Train, Trainer};
use srn_tests::{assert_close, difference, gpu};

use crate::{INSTANCES, SIZE, batch, intrinsics, methods, poses, trainer, weights};

const IMAGES: u32 = 5;
/// Less than twice the parameters, with their gradients and moments where they are trained: three layers of the hypernetwork are streamed, in
/// parts of different sizes.
fn budget(engine: &Engine, train: Train) -> u64 {
    let bytes = if train == Train::Everything { 600_000 } else { 280_000 };
    // The budget counts the executor's own bytes, eight per element in f64.
    if engine.to_string() == "cpu64" { 2 * bytes } else { bytes }
}

/// Engines with the largest difference that passes, relative to the largest value of a tensor: sums over parts, in another order.
fn engines() -> [(Engine, f64); 3] {
    // Worst, after three steps of Adam: 1.9e-6 on cpu64 (what is streamed is f32 on the host), 1.5e-5 on cpu, 1.6e-5 on llvmpipe.
    [(Engine::cpu_f64(), 1e-5), (Engine::cpu(), 1e-4), (Engine::gpu(gpu().clone()), 1e-4)]
}

fn model() -> Model {
    let config = ModelConfig { hidden: 23, latent: 32, instances: INSTANCES, tracing_steps: 3, density: true };
    let mut model = Model::init(&config, 5).unwrap();
    let codes = model.hypernetwork().unwrap().codes;
    model.parameters[codes].values.iter_mut().for_each(|value| *value *= 30.0);
    model
}

/// The engine, and one whose budget is too small for the parameters of a network that is not trained.
fn roomy_and_small(engine: &Engine) -> [Engine; 2] {
    [engine.clone(), engine.clone().with_budget(budget(engine, Train::Codes))]
}

/// On the device, and streamed.
fn both(engine: &Engine, train: Train) -> [Trainer; 2] {
    let [resident, streamed] = [engine.clone(), engine.clone().with_budget(budget(engine, train))];
    let trainers = [resident, streamed].map(|engine| trainer(&engine, model(), train, IMAGES));
    let on_host = trainers.each_ref().map(Trainer::bytes_on_host);
    assert_eq!(on_host, [0, 3 * 4 * 23 * (23 + 1) * (32 + 1)]);
    trainers
}

/// Compares tensors, and prints the worst difference.
fn assert_same<'a>(
    what: &str,
    got: impl IntoIterator<Item = (String, &'a [f32])>,
    want: impl IntoIterator<Item = (String, &'a [f32])>,
    tolerance: f64,
) {
    let mut worst = 0.0f64;
    for ((name, got), (_, want)) in got.into_iter().zip(want) {
        assert_close(&format!("{what}, {name}"), got, want, tolerance);
        worst = worst.max(difference(got, want).unwrap());
    }
    println!("{worst:.1e}: {what}");
}

fn tensors(model: &Model) -> Vec<(String, &[f32])> {
    model.tensors().into_iter().map(|(name, _, values)| (name, values)).collect()
}

#[test]
fn gradients_are_the_same() {
    for (engine, tolerance) in engines() {
        let [want, got] = both(&engine, Train::Everything).map(|mut trainer| {
            trainer.gradients(&batch(IMAGES)).unwrap();
            (trainer.losses().unwrap().total(), trainer.read_gradients().unwrap())
        });
        assert!((got.0 / want.0 - 1.0).abs() < tolerance, "{} and {}", got.0, want.0);
        let named = |gradients: &[(String, Vec<f32>)]| gradients.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>();
        assert_eq!(named(&got.1), named(&want.1));
        let slices =
            |gradients| Vec::into_iter(gradients).map(|(name, values): &(String, Vec<f32>)| (name.clone(), values.as_slice()));
        assert_same(&format!("{engine}, gradients"), slices(got.1.iter().collect()), slices(want.1.iter().collect()), tolerance);
    }
}

#[test]
fn training_is_the_same() {
    for (engine, tolerance) in engines() {
        for train in [Train::Everything, Train::Codes] {
            let [want, got] = both(&engine, train).map(|mut trainer| {
                for _ in 0..3 {
                    trainer.step(&batch(IMAGES), 1e-3).unwrap();
                }
                trainer.model().unwrap().clone()
            });
            assert_ne!(want, model());
            assert_same(&format!("{engine}, {train:?}"), tensors(&got), tensors(&want), tolerance);
        }
    }
}

#[test]
fn a_checkpoint_continues_on_the_host_and_on_the_device() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint.safetensors");
    for (engine, tolerance) in engines() {
        let [_, mut uninterrupted] = both(&engine, Train::Everything);
        let [mut resident, mut streamed] = both(&engine, Train::Everything);
        for _ in 0..2 {
            uninterrupted.step(&batch(IMAGES), 1e-3).unwrap();
        }
        uninterrupted.save_checkpoint(&path).unwrap();
        let models = [&mut uninterrupted, &mut streamed, &mut resident].map(|trainer| {
            if trainer.steps() == 0 {
                trainer.load_checkpoint(&path).unwrap();
            }
            trainer.step(&batch(IMAGES), 1e-3).unwrap();
            trainer.model().unwrap().clone()
        });
        let [want, streamed, resident] = &models;
        // A checkpoint holds f32.
        assert!(streamed == want || engine.to_string() == "cpu64", "{engine}: not the same bits");
        assert_same(&format!("{engine}, on from a checkpoint"), tensors(streamed), tensors(want), tolerance);
        assert_same(&format!("{engine}, on from a checkpoint on the device"), tensors(resident), tensors(want), tolerance);
    }
}

#[test]
fn pictures_are_the_same() {
    for (engine, tolerance) in engines() {
        let [want, got] = roomy_and_small(&engine).map(|engine| {
            let cameras: Vec<_> = poses(3).into_iter().map(|pose| (pose.to_matrix(), intrinsics())).collect();
            let mut renderer = Renderer::new(&engine, &model(), 3, SIZE[0], SIZE[1]).unwrap();
            // Other instances after the first ones.
            [[0, 1, 2], [2, 0, 2]].map(|instances| renderer.render(&instances, &cameras, 7).unwrap())
        });
        for (got, want) in got.iter().zip(&want) {
            println!("{:.1e}: {engine}, colours", difference(&got.rgb, &want.rgb).unwrap());
            assert_close(&format!("{engine}, colours"), &got.rgb, &want.rgb, tolerance);
            assert_close(&format!("{engine}, depths"), &got.depth, &want.depth, tolerance);
        }
    }
}

#[test]
fn gradients_of_poses_are_the_same() {
    const HYPOTHESES: u32 = 2;
    let batch = batch(HYPOTHESES);
    for ((engine, tolerance), method) in
        engines().into_iter().flat_map(|case| methods().into_iter().map(move |m| (case.clone(), m)))
    {
        let [want, got] = roomy_and_small(&engine).map(|engine| {
            let shape = Shape { hypotheses: HYPOTHESES, width: SIZE[0], height: SIZE[1], instances: 2 };
            let mut descent = Descent::new(&engine, &model(), shape, method).unwrap();
            assert!(descent.bytes() <= engine.budget());
            let weights = weights(method, HYPOTHESES);
            descent.set_targets(&[3, 1], &[1, 0], &batch.rays, &batch.target_rgb, weights.as_deref()).unwrap();
            descent.set_poses(&poses(HYPOTHESES)).unwrap();
            descent.evaluate().unwrap();
            descent.gradients().unwrap().as_flattened().iter().map(|&d| d as f32).collect::<Vec<_>>()
        });
        let what = format!("{engine}, {method:?}");
        println!("{:.1e}: {what}", difference(&got, &want).unwrap());
        assert_close(&what, &got, &want, tolerance);
    }
}
