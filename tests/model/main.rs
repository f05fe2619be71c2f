//! The whole model: against golden values, finite differences and itself (other tiles, other executors), and what it does.

use sigma_srn::{
    Descent, Engine, Error, Intrinsics, Loss, Method, Model, ModelConfig, Pose6, Rays, Shape, Train, Trainer, TrainingBatch,
    camera, pixel_grid, stream,
};
use srn_plan::{BufferId, Executor};

mod baked;
mod behaviour;
mod cooperative;
mod finite_differences;
mod golden;
mod lockstep;
mod photo;
mod proof;
mod streamed;
mod tiles;
mod tracker;

const SIZE: [u32; 2] = [9, 7];
const RAYS: u32 = SIZE[0] * SIZE[1];
const INSTANCES: u32 = 4;
const LOSSES: [Loss; 5] = [Loss::Mae, Loss::Mse, Loss::NormL1, Loss::NormL2, Loss::Gmsd];

/// A small model whose codes are large enough to tell the instances apart, and some of whose rays end behind the camera.
fn model(density: bool) -> Model {
    let config = ModelConfig { hidden: 12, latent: 5, instances: INSTANCES, tracing_steps: 3, density };
    let mut model = Model::init(&config, 5).unwrap();
    let codes = model.hypernetwork().unwrap().codes;
    model.parameters[codes].values.iter_mut().for_each(|value| *value *= 30.0);
    let step_head = model.layout.step_head.linear;
    *model.parameters[step_head].values.last_mut().unwrap() = -0.05;
    model
}

fn intrinsics() -> Intrinsics {
    Intrinsics { fx: 10.0, fy: 11.0, cx: 4.2, cy: 3.1, pixel_center: 0.0 }
}

/// Cameras around the object, none of them on a singularity of the Euler angles.
fn poses(count: u32) -> Vec<Pose6> {
    let around = |k: u32| glam::DVec3::new(1.1 * f64::from(k + 1).cos(), 1.2 * f64::from(k + 1).sin(), 0.3 + 0.05 * f64::from(k));
    (0..count).map(|k| Pose6::from_matrix(&camera::look_at_origin(around(k)))).collect()
}

/// All pixels of an image from each pose; a target of every second value white, as backgrounds are.
fn batch(images: u32) -> TrainingBatch {
    let mut random = stream(3, 0);
    let mut rays = Rays::default();
    for pose in poses(images) {
        rays.push(&pose.to_matrix(), &intrinsics(), pixel_grid(SIZE[0], SIZE[1], 1), &mut random);
    }
    let value = |k: u32| if k.is_multiple_of(2) { 1.0 } else { (k * 7919 % 200) as f32 / 100.0 - 1.0 };
    // Instance 0 does not appear, the last one more than once.
    let instances = (0..images).map(|k| (k + 1).min(INSTANCES - 1)).collect();
    TrainingBatch { instances, rays, target_rgb: (0..images * RAYS * 3).map(value).collect(), weights: None }
}

fn trainer(engine: &Engine, model: Model, train: Train, images: u32) -> Trainer {
    Trainer::new(engine, model, train, images, RAYS).unwrap()
}

/// Every way to move: the paper's with every loss, and BFGS.
fn methods() -> Vec<Method> {
    let adam = |loss| Method::Adam { loss, learning_rate: 0.01 };
    LOSSES.into_iter().map(adam).chain([Method::Bfgs { soft: 0.3, grain: 0.0 }]).collect()
}

/// Rays that count more, less, and not at all; GMSD counts all.
fn weights(method: Method, images: u32) -> Option<Vec<f32>> {
    let gmsd = matches!(method, Method::Adam { loss: Loss::Gmsd, .. });
    (!gmsd).then(|| (0..images * RAYS).map(|k| [1.0, 0.0, 1.75, 0.5][(k * 31 % 97 % 4) as usize]).collect())
}

type NewDescent = fn(&Engine, &Model, Shape, Method) -> Result<Descent, Error>;

/// A descent from [`poses`], ready to be evaluated; all instances but the first are looked for. Rays begin on a sphere, which some of them
/// pass by: that they begin at the camera is tested against golden values.
fn descent(engine: &Engine, method: Method, hypotheses: u32) -> Descent {
    descent_by(Descent::new, engine, method, hypotheses)
}

/// The same by another constructor.
fn descent_by(new: NewDescent, engine: &Engine, method: Method, hypotheses: u32) -> Descent {
    let shape = Shape { hypotheses, width: SIZE[0], height: SIZE[1], instances: INSTANCES - 1 };
    let mut model = model(true);
    model.metadata.ray_sphere = Some(0.6);
    let mut descent = new(engine, &model, shape, method).unwrap();
    let batch = batch(hypotheses);
    let instances: Vec<u32> = (1..INSTANCES).collect();
    let slots: Vec<u32> = batch.instances.iter().map(|instance| instance - 1).collect();
    descent.set_targets(&instances, &slots, &batch.rays, &batch.target_rgb, weights(method, hypotheses).as_deref()).unwrap();
    descent.set_poses(&poses(hypotheses)).unwrap();
    descent
}

/// The buffer called `name` of the running plan.
fn buffer(executor: &dyn Executor, name: &str) -> BufferId {
    executor.plan().find(name).unwrap_or_else(|| panic!("no buffer is called `{name}`"))
}
