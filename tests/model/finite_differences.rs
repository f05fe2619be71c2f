//! The reference in `f64` against central differences: every parameter of a training step, every number of a pose.

use glam::{DMat3, DMat4, DVec3};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use sigma_srn::{Engine, Method, Model, Pose6, Train, Trainer, TrainingBatch};

use crate::{RAYS, batch, buffer, descent, methods, model, poses, trainer};

/// Far above the rounding of `f64`, and so small that hardly a hidden unit changes sides of its ReLU on the way.
const STEP: f64 = 1e-6;

/// Largest difference, relative to the largest gradient of the tensor. Worst 1.6e-7 measured.
const TOLERANCE: f64 = 1e-6;

/// The weighted sum of the three terms, with all digits.
fn total(trainer: &mut Trainer, batch: &TrainingBatch) -> f64 {
    trainer.gradients(batch).unwrap();
    let executor = trainer.executor();
    let mut mean = |name: &str| {
        let values = executor.read_f64(buffer(executor, name)).unwrap();
        values.iter().sum::<f64>() / values.len() as f64
    };
    200.0 * mean("image loss") + mean("latent loss") + 10.0 * mean("depth loss")
}

fn parameters(model: Model) {
    const IMAGES: u32 = 3;
    let names: Vec<String> = model.parameters.iter().map(|parameter| parameter.tensors[0].0.clone()).collect();
    let mut trainer = trainer(&Engine::cpu_f64(), model, Train::Everything, IMAGES);
    let batch = batch(IMAGES);
    total(&mut trainer, &batch);
    let depth = buffer(trainer.executor(), "depth loss");
    assert!(trainer.executor().read(depth).unwrap()[0] > 0.0, "no ray ends behind its camera: the depth term is not tested");
    let mut worst = (0.0, String::new());
    for name in names {
        total(&mut trainer, &batch);
        let executor = trainer.executor();
        let (parameter, gradient) = (buffer(executor, &name), buffer(executor, &format!("d {name}")));
        let gradient = executor.read_f64(gradient).unwrap();
        let values = executor.read_f64(parameter).unwrap();
        assert!(gradient.iter().all(|d| d.is_finite()), "{gradient:?}");
        let scale = gradient.iter().fold(0.0, |most: f64, d| most.max(d.abs()));
        assert!(scale > 0.0, "{name} has no gradient");
        // The first and the last element (of the bias), the one with the largest gradient, and some between.
        let largest = gradient.iter().position(|d| d.abs() == scale).unwrap();
        let between = (1..6).map(|k| k * 7919 % values.len());
        for at in [0, values.len() - 1, largest].into_iter().chain(between) {
            let mut losses_at = |by: f64| {
                let mut values = values.clone();
                values[at] += by;
                trainer.executor().write_f64(parameter, &values).unwrap();
                total(&mut trainer, &batch)
            };
            let difference = (losses_at(STEP) - losses_at(-STEP)) / (2.0 * STEP);
            let error = (difference - gradient[at]).abs() / scale;
            let what = format!("{name}[{at}]: gradient {}, difference {difference}", gradient[at]);
            assert!(error < TOLERANCE, "{error:.1e}: {what}");
            if error > worst.0 {
                worst = (error, what);
            }
        }
        trainer.executor().write_f64(parameter, &values).unwrap();
    }
    println!("worst {:.1e}: {}", worst.0, worst.1);
}

#[test]
fn of_every_parameter() {
    parameters(model(true));
}

#[test]
fn of_every_parameter_of_plain_srn() {
    parameters(model(false));
}

/// The head of g then reads the points themselves.
#[test]
fn of_every_parameter_where_g_has_one_layer() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("model.safetensors");
    model(true).save(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let metadata = SafeTensors::read_metadata(&bytes).unwrap().1.metadata().clone();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let numbers: Vec<u8> = [0.3f32, -0.2, 0.5, 0.1].iter().flat_map(|number| number.to_le_bytes()).collect();
    let mut tensors: Vec<_> = file.tensors().into_iter().filter(|(name, _)| !name.starts_with("sigma.")).collect();
    let tensor = |shape: &[usize], bytes| TensorView::new(Dtype::F32, shape.into(), bytes).unwrap();
    tensors.push(("sigma.net.0.weight".into(), tensor(&[1, 3], &numbers[..12])));
    tensors.push(("sigma.net.0.bias".into(), tensor(&[1], &numbers[12..])));
    let bytes = safetensors::serialize(tensors, metadata).unwrap();
    parameters(Model::from_bytes(&bytes, "", &path).unwrap());
}

#[test]
fn codes_alone_get_the_same_gradient() {
    const IMAGES: u32 = 3;
    let gradients = |train| {
        let mut trainer = trainer(&Engine::cpu_f64(), model(true), train, IMAGES);
        trainer.gradients(&batch(IMAGES)).unwrap();
        trainer.read_gradients().unwrap()
    };
    let alone = gradients(Train::Codes);
    assert_eq!(alone.len(), 1);
    assert_eq!(alone[0], gradients(Train::Everything)[0]);
    let (first, others) = alone[0].1.split_at(alone[0].1.len() / crate::INSTANCES as usize);
    assert!(first.iter().all(|&d| d == 0.0), "instance 0 is not in the batch");
    assert!(others.iter().all(|&d| d != 0.0));
}

#[test]
fn of_every_number_of_a_pose_in_every_method() {
    const HYPOTHESES: u32 = 4;
    for method in methods() {
        let mut descent = descent(&Engine::cpu_f64(), method, HYPOTHESES);
        let start = poses(HYPOTHESES);
        descent.evaluate().unwrap();
        let gradients = descent.gradients().unwrap();
        let mut worst = 0.0f64;
        for number in 0..6 {
            // Every hypothesis has a loss of its own: all move at once, each in its own direction.
            let mut losses_at = |by: f64| {
                let mut poses = start.clone();
                for (k, pose) in poses.iter_mut().enumerate() {
                    *pose = moved(pose, method, number, if k % 2 == 0 { by } else { -by });
                }
                descent.set_poses(&poses).unwrap();
                descent.evaluate().unwrap();
                let losses = buffer(descent.executor(), "loss");
                descent.executor().read_f64(losses).unwrap()
            };
            let (ahead, behind) = (losses_at(STEP), losses_at(-STEP));
            for (k, gradient) in gradients.iter().enumerate() {
                let difference = (ahead[k] - behind[k]) / (2.0 * STEP) * if k % 2 == 0 { 1.0 } else { -1.0 };
                assert!(gradient.iter().all(|d| d.is_finite()), "{gradient:?}");
                let scale = gradient.iter().fold(0.0, |most: f64, d| most.max(d.abs()));
                let error = (difference - gradient[number]).abs() / scale;
                assert!(error < TOLERANCE, "{method:?}, hypothesis {k}, number {number}: {} and {difference}", gradient[number]);
                worst = worst.max(error);
            }
        }
        println!("worst {worst:.1e}: {method:?} over {RAYS} rays");
    }
}

/// A pose with one of the numbers changed that a step of the method changes.
fn moved(pose: &Pose6, method: Method, number: usize, by: f64) -> Pose6 {
    if matches!(method, Method::Adam { .. }) {
        let mut numbers = pose.0;
        numbers[number] += by;
        return Pose6(numbers);
    }
    // A motion about the world's origin, in the axes of the camera.
    let axes = DMat4::from_mat3(DMat3::from_mat4(pose.to_matrix()));
    let axis = DVec3::AXES[number % 3];
    let motion = if number < 3 { DMat4::from_axis_angle(axis, by) } else { DMat4::from_translation(by * axis) };
    Pose6::from_matrix(&(axes * motion * axes.transpose() * pose.to_matrix()))
}
