//! Training (spec 3): `200 · mean((rgb − target)²) + mean(z²) + 10 · mean(min(depth, 0)²)`, Adam.

use std::collections::HashMap;
use std::path::Path;

use srn_plan::ops::{adam, depth, depth_loss, image_loss, latent_loss, tile as tile_ops};
use srn_plan::{BufferId, Builder, Executor, PlanError, StageId, tiles};

use crate::engine::{Engine, Runner};
use crate::model::{Model, Tensors, read_tensors, write_tensors};
use crate::network::backward::{self, HyperScratch};
use crate::network::{Batch, HyperSaved, Network, Purpose, Saved, Scratch, SourceBuffers, Started, Trainable, forward};
use crate::rays::wanted;
use crate::{Error, Rays};

/// Weight of the image term.
const IMAGE_WEIGHT: f64 = 200.0;
/// Weight of the latent term.
const LATENT_WEIGHT: f64 = 1.0;
/// Weight of the depth term: 1e-3 of the regulariser's 1e4.
const DEPTH_WEIGHT: f64 = 10.0;

/// What is trained.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Train {
    /// Codes and all networks.
    Everything,
    /// The codes alone: the two-shot fit of new instances (spec 4).
    Codes,
}

/// Images of one step: image `k` shows instance `instances[k]` and has `target_rgb.len() / 3 / images` rays.
#[derive(Clone, Debug)]
pub struct TrainingBatch {
    /// Instance of each image.
    pub instances: Vec<u32>,
    /// Rays of the images.
    pub rays: Rays,
    /// Colours in [-1, 1], `[images, rays, 3]`.
    pub target_rgb: Vec<f32>,
}

/// Terms of the loss, without their weights.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Losses {
    /// Mean squared colour error.
    pub image: f64,
    /// Mean squared latent value.
    pub latent: f64,
    /// Mean squared negative depth.
    pub depth: f64,
}

impl Losses {
    /// The weighted sum.
    pub fn total(&self) -> f64 {
        IMAGE_WEIGHT * self.image + LATENT_WEIGHT * self.latent + DEPTH_WEIGHT * self.depth
    }

    /// Peak signal-to-noise ratio in dB, for colours in [-1, 1].
    pub fn psnr(&self) -> f64 {
        10.0 * (4.0 / self.image).log10()
    }
}

/// Buffers and stages of the plan that the host talks to.
struct Handles {
    network: Network,
    target: BufferId,
    schedule: BufferId,
    image_loss: BufferId,
    latent_loss: BufferId,
    depth_loss: BufferId,
    /// Number of the parameter, first and second moment.
    moments: Vec<(usize, [BufferId; 2])>,
    gradients: StageId,
    update: StageId,
}

/// Trains a model, batch by batch.
pub struct Trainer {
    model: Model,
    runner: Runner,
    handles: Handles,
    steps: u64,
}

impl Trainer {
    /// A trainer for batches of `images` with `rays` rays each.
    pub fn new(engine: &Engine, model: Model, train: Train, images: u32, rays: u32) -> Result<Self, Error> {
        let batch = Batch { images, rays, slots: images };
        for (field, value) in [("batch", images), ("rays", rays)] {
            if value == 0 {
                return Err(Error::Setting { field, what: "must be at least 1".into() });
            }
        }
        model.hypernetwork()?;
        let features = model.layout.features();
        let (plan, handles) =
            engine.fit(images * rays, features, Purpose::Train, |b, tile_rows| build(b, &model, train, batch, tile_rows))?;
        let mut runner = engine.prepare(plan)?;
        handles.network.upload(&mut *runner, &model)?;
        let slots: Vec<u32> = (0..images).collect();
        runner.write_u32(handles.network.slots, &slots)?;
        Ok(Trainer { model, runner, handles, steps: 0 })
    }

    /// Steps done.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// What computes, in words.
    pub fn describe(&self) -> String {
        self.runner.describe()
    }

    /// One step of Adam at `learning_rate`; returns at once on a GPU.
    pub fn step(&mut self, batch: &TrainingBatch, learning_rate: f64) -> Result<(), Error> {
        self.gradients(batch)?;
        self.steps += 1;
        self.runner.write_f64(self.handles.schedule, &adam::schedule(learning_rate, self.steps))?;
        self.runner.run(self.handles.update)?;
        Ok(())
    }

    /// Computes losses and gradients of a batch, and changes nothing.
    pub fn gradients(&mut self, batch: &TrainingBatch) -> Result<(), Error> {
        let network = &self.handles.network;
        let images = network.batch.images as usize;
        if let Some(&instance) = batch.instances.iter().find(|&&instance| instance >= network.instances) {
            let what = format!("number {instance}, but the model has {}", network.instances);
            return Err(Error::Input { input: "instance".into(), what });
        }
        if batch.instances.len() != images {
            let what = format!("{} images, this trainer takes {images}", batch.instances.len());
            return Err(Error::Input { input: "batch".into(), what });
        }
        self.runner.write_u32(network.index, &batch.instances)?;
        self.runner.write_f64(network.world_from_camera, batch.rays.world_from_camera.as_flattened())?;
        batch.rays.write(&mut *self.runner, network)?;
        self.runner.write(self.handles.target, &wanted(&batch.target_rgb, None))?;
        self.runner.run(self.handles.gradients)?;
        Ok(())
    }

    /// Losses of the last batch, before its update.
    pub fn losses(&mut self) -> Result<Losses, Error> {
        let images = self.runner.read(self.handles.image_loss)?;
        let losses = Losses {
            image: images.iter().map(|&loss| f64::from(loss)).sum::<f64>() / images.len() as f64,
            latent: self.runner.read(self.handles.latent_loss)?[0].into(),
            depth: self.runner.read(self.handles.depth_loss)?[0].into(),
        };
        if !losses.total().is_finite() {
            return Err(Error::Diverged { step: self.steps });
        }
        Ok(losses)
    }

    /// Gradients of the trained parameters after the last batch, by tensor name.
    pub fn read_gradients(&mut self) -> Result<Vec<(String, Vec<f32>)>, Error> {
        let mut gradients = Vec::new();
        for (parameter, &d) in self.model.parameters.iter().zip(&self.handles.network.d_parameters) {
            let Some(d) = d else { continue };
            let values = self.runner.read(d)?;
            let mut rest = values.as_slice();
            for (name, shape) in &parameter.tensors {
                let (tensor, after) = rest.split_at(shape.iter().product());
                gradients.push((name.clone(), tensor.to_vec()));
                rest = after;
            }
        }
        Ok(gradients)
    }

    /// Rendered colours of the last batch `[images, rays, 3]`.
    pub fn read_rgb(&mut self) -> Result<Vec<f32>, Error> {
        Ok(self.runner.read(self.handles.network.rgb)?)
    }

    /// The executor, whose plan names every buffer: for tests against golden values and lockstep.
    pub fn executor(&mut self) -> &mut dyn Executor {
        &mut *self.runner
    }

    /// Reads the parameters back and returns the model. Fails where one is not finite, so that no such model is ever saved.
    pub fn model(&mut self) -> Result<&Model, Error> {
        for (&buffer, parameter) in self.handles.network.parameters.iter().zip(&mut self.model.parameters) {
            parameter.values = self.runner.read(buffer)?;
            if !parameter.values.iter().all(|value| value.is_finite()) {
                return Err(Error::Diverged { step: self.steps });
            }
        }
        Ok(&self.model)
    }

    /// Model, moments and step count in one file, written atomically.
    pub fn save_checkpoint(&mut self, path: &Path) -> Result<(), Error> {
        self.model()?;
        let mut moments = Vec::new();
        for &(number, buffers) in &self.handles.moments {
            for (kind, buffer) in ["m", "v"].into_iter().zip(buffers) {
                moments.push((format!("adam.{kind}.{}", self.model.parameters[number].tensors[0].0), self.runner.read(buffer)?));
            }
        }
        let mut tensors = self.model.tensors();
        tensors.extend(moments.iter().map(|(name, values)| (name.clone(), vec![values.len()], values.as_slice())));
        let mut metadata = self.model.metadata_text();
        metadata.insert("steps".into(), self.steps.to_string());
        write_tensors(path, &tensors, metadata)
    }

    /// Continues where [`Trainer::save_checkpoint`] stopped.
    pub fn load_checkpoint(&mut self, path: &Path) -> Result<(), Error> {
        let model = Model::load(path)?;
        if model.layout != self.model.layout {
            let what = "a model of other sizes than this run".to_string();
            return Err(Error::Format { path: path.into(), what });
        }
        let (tensors, metadata): (Tensors, HashMap<String, String>) = read_tensors(path)?;
        let steps = metadata.get("steps").and_then(|steps| steps.parse().ok());
        let steps = steps.ok_or_else(|| Error::Format { path: path.into(), what: "no training state in it".into() })?;
        for &(number, buffers) in &self.handles.moments {
            for (kind, buffer) in ["m", "v"].into_iter().zip(buffers) {
                let name = format!("adam.{kind}.{}", model.parameters[number].tensors[0].0);
                let (_, values) = tensors.get(&name).ok_or(Error::MissingTensor { name })?;
                self.runner.write(buffer, values)?;
            }
        }
        self.handles.network.upload(&mut *self.runner, &model)?;
        self.model = model;
        self.steps = steps;
        Ok(())
    }
}

fn build(b: &mut Builder, model: &Model, train: Train, batch: Batch, tile_rows: u32) -> Result<Handles, PlanError> {
    let trainable = if train == Train::Codes { Trainable::Codes } else { Trainable::Everything };
    let network = Network::new(b, model, batch, trainable, true)?;
    let (images, rays) = (batch.images, batch.rays);
    let rows = images * rays;
    let cut = tiles(images, rays, tile_rows);
    let most = cut.iter().map(|tile| tile.rows.count()).max().unwrap_or(1);
    let saved = Saved::new(b, &network, Purpose::Train, most)?;
    let scratch = Scratch::new(b, &network, &saved)?;
    let SourceBuffers::Hypernetwork(hyper) = &network.source else { unreachable!("a trainer takes no baked model") };
    let hyper_saved = HyperSaved::new(b, &network, hyper)?;
    let hyper_scratch = HyperScratch::new(b, &network, hyper)?;
    let codes_count = batch.slots * hyper.latent;
    let partial_len = cut.iter().map(|tile| backward::partial_len(&network, tile.rows)).max().unwrap_or(1);
    let sums =
        image_loss::partial_len(images, rays).max(depth_loss::partial_len(rows)).max(latent_loss::partial_len(codes_count));
    let partial = b.scratch("partial sums", partial_len.max(sums))?;
    let target = b.input("target", 4 * rows as usize)?;
    let tile_target = b.scratch("tile target", 4 * most as usize)?;
    let d_rgb = b.scratch("tile d rgb", 3 * most as usize)?;
    let count = b.input("target count", images as usize)?;
    let (loss_images, loss_latent, loss_depth) =
        (b.scratch("image loss", images as usize)?, b.scratch("latent loss", 1)?, b.scratch("depth loss", 1)?);

    let gradients = b.stage("gradients");
    let mut started = Started::default();
    forward::hypernetwork(b, &network, hyper, &hyper_saved)?;
    for &tile in &cut {
        forward::render(b, &network, &saved, tile)?;
        tile_ops::gather(b, tile, 4, target, tile_target)?;
        let scale = (IMAGE_WEIGHT / f64::from(images)) as f32;
        image_loss::backward(b, image_loss::Kind::Mse, tile.rows, rays, scale, saved.rgb(), tile_target, count, d_rgb)?;
        let scale = (DEPTH_WEIGHT / f64::from(rows)) as f32;
        depth::backward(b, tile.rows, scale, network.world_from_camera, saved.depth, scratch.d_origin)?;
        backward::render(b, &network, &saved, &scratch, partial, tile, d_rgb, true, &mut started)?;
    }
    backward::hypernetwork(b, &network, hyper, &hyper_saved, &hyper_scratch, partial, &mut started)?;
    let scale = (LATENT_WEIGHT / f64::from(codes_count)) as f32;
    latent_loss::backward(b, codes_count, scale, hyper_saved.z, hyper_scratch.d_z)?;
    backward::codes(b, &network, hyper, hyper_scratch.d_z)?;
    image_loss::forward(b, image_loss::Kind::Mse, images, rays, network.rgb, target, count, partial, loss_images)?;
    latent_loss::forward(b, codes_count, 1.0 / codes_count as f32, hyper_saved.z, partial, loss_latent)?;
    depth_loss::forward(b, rows, 1.0 / rows as f32, network.depth, partial, loss_depth)?;

    let update = b.stage("update");
    let schedule = b.input("schedule", 3)?;
    let mut moments = Vec::new();
    for (number, parameter) in model.parameters.iter().enumerate() {
        let Some(d) = network.d_parameters[number] else { continue };
        let (name, len) = (&parameter.tensors[0].0, parameter.values.len());
        let [m, v] = [b.input(format!("m {name}"), len)?, b.input(format!("v {name}"), len)?];
        adam::step(b, len as u32, d, schedule, network.parameters[number], m, v)?;
        moments.push((number, [m, v]));
    }
    Ok(Handles {
        network,
        target,
        schedule,
        image_loss: loss_images,
        latent_loss: loss_latent,
        depth_loss: loss_depth,
        moments,
        gradients,
        update,
    })
}
