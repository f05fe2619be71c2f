//! Training (spec 3): `200 · mean((rgb − target)²) + mean(z²) + 10 · mean(min(depth, 0)²)`, Adam.

use std::borrow::Cow;
use std::collections::HashMap;
use std::path::Path;

use rand::RngExt;
use srn_plan::ops::{adam, depth, depth_loss, image_loss, latent_loss, tile as tile_ops};
use srn_plan::{BufferId, Builder, Executor, PlanError, StageId, Tile, tiles};

use crate::camera::{Intrinsics, fixed24};
use crate::engine::{Engine, Runner, proof};
use crate::model::{Model, Tensors, read_tensors, write_tensors};
use crate::network::backward::{self, HyperScratch};
use crate::network::streamed::{OnHost, Streamed};
use crate::network::{Batch, HyperSaved, Network, Purpose, Saved, Scratch, SourceBuffers, Started, Sums, Trainable, forward};
use crate::random::stream;
use crate::rays::wanted;
use crate::{Error, Rays, pixel_grid};

/// Weight of the image term.
const IMAGE_WEIGHT: f64 = 200.0;
/// Weight of the latent term.
const LATENT_WEIGHT: f64 = 1.0;
/// Weight of the depth term: 1e-3 of the regulariser's 1e4.
const DEPTH_WEIGHT: f64 = 10.0;

/// Images that a GPU is tried on, one at a time, and most numbers of a tensor that are looked at.
const PROOFS: u32 = 3;
const PROOF_VALUES: usize = 4096;

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
    /// How much each ray counts `[images, rays]`, with a mean of 1; `None`: all the same.
    pub weights: Option<Vec<f32>>,
}

impl TrainingBatch {
    /// One image of pixels of any colours: another camera, as far away as the model was trained from, and another instance for each `number`.
    fn noise(model: &Model, number: u32) -> Self {
        let mut random = stream(0, number.into());
        let mut rays = Rays::default();
        let side = f64::from(proof::SIDE);
        let intrinsics = Intrinsics { fx: side, fy: side, cx: side / 2.0, cy: side / 2.0, pixel_center: 0.5 };
        let camera = fixed24(model.metadata.orbit_radius.unwrap_or(1.3))[7 * number as usize];
        rays.push(&camera, &intrinsics, pixel_grid(proof::SIDE, proof::SIDE, 1), &mut random);
        let target_rgb = (0..3 * rays.z0.len()).map(|_| random.random_range(-1.0..1.0)).collect();
        TrainingBatch { instances: vec![number % model.layout.instances], rays, target_rgb, weights: None }
    }
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
    /// Losses and gradients: the hypernetwork, all rays forward and back, the hypernetwork back. Streamed layers come in between.
    before: StageId,
    render: StageId,
    after: StageId,
    update: StageId,
    streamed: Option<Streamed>,
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
    ///
    /// Where the parameters with their gradients and moments would take more than half of the engine's memory budget, the large layers of
    /// the hypernetwork stay on the host, and the device has a part of one at a time.
    ///
    /// A GPU that has not trained before is compared with the CPU executor first, and refused where gradients are wrong ([`Error::Adapter`]).
    pub fn new(engine: &Engine, model: Model, train: Train, images: u32, rays: u32) -> Result<Self, Error> {
        for (field, value) in [("batch", images), ("rays", rays)] {
            if value == 0 {
                return Err(Error::Setting { field, what: "must be at least 1".into() });
            }
        }
        model.hypernetwork()?;
        let work = if train == Train::Codes { "gradients of codes" } else { "gradients of all parameters" };
        engine.prove(work, &model, |engine| {
            let mut trainer = Self::unproven(engine, model.clone(), train, 1, proof::SIDE * proof::SIDE)?;
            let few = |(_, values): (String, Vec<f32>)| {
                let every = values.len().div_ceil(PROOF_VALUES).max(1);
                values.into_iter().step_by(every).map(f64::from).collect()
            };
            let mut gradients = |number| {
                trainer.gradients(&TrainingBatch::noise(&model, number))?;
                Ok(trainer.read_gradients()?.into_iter().map(few).collect())
            };
            (0..PROOFS).map(&mut gradients).collect()
        })?;
        Self::unproven(engine, model, train, images, rays)
    }

    fn unproven(engine: &Engine, model: Model, train: Train, images: u32, rays: u32) -> Result<Self, Error> {
        let batch = Batch { images, rays, slots: images };
        let features = model.layout.features();
        // Value, gradient and two moments.
        let on_host = OnHost::of(engine, &model, if train == Train::Everything { 4 } else { 1 });
        let (plan, handles) = engine.fit(Engine::rows([images, rays])?, features, |b, tile_rows| {
            let cut = tiles(images, rays, tile_rows);
            build(b, &model, train, batch, &cut, engine.part_rows(tile_rows, features), &on_host)
        })?;
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

    /// Bytes of the parameters that stay on the host, without their moments; 0 where the memory budget holds all of them.
    pub fn bytes_on_host(&self) -> u64 {
        let parameters = self.model.parameters.iter().zip(&self.handles.network.parameters);
        parameters.filter(|(_, buffer)| buffer.is_none()).map(|(parameter, _)| 4 * parameter.values.len() as u64).sum()
    }

    /// One step of Adam at `learning_rate`; returns at once on a GPU, but waits for it where layers stay on the host.
    pub fn step(&mut self, batch: &TrainingBatch, learning_rate: f64) -> Result<(), Error> {
        self.gradients(batch)?;
        self.steps += 1;
        self.runner.write_f64(self.handles.schedule, &adam::schedule(learning_rate, self.steps))?;
        self.runner.run(self.handles.update)?;
        if let Some(streamed) = &mut self.handles.streamed {
            streamed.run_update(&mut *self.runner, &mut self.model)?;
        }
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
        if let Some(weights) = batch.weights.as_ref().filter(|weights| 3 * weights.len() != batch.target_rgb.len()) {
            let what = format!("{} weights for {} values of colour", weights.len(), batch.target_rgb.len());
            return Err(Error::Input { input: "batch".into(), what });
        }
        self.runner.write_u32(network.index, &batch.instances)?;
        self.runner.write_f64(network.world_from_camera, batch.rays.world_from_camera.as_flattened())?;
        batch.rays.write(&mut *self.runner, network)?;
        self.runner.write(self.handles.target, &wanted(&batch.target_rgb, batch.weights.as_deref()))?;
        let Handles { streamed, before, render, after, .. } = &mut self.handles;
        self.runner.run(*before)?;
        if let Some(streamed) = streamed {
            streamed.run_forward(&mut *self.runner, |number| &self.model.parameters[number].values)?;
        }
        self.runner.run(*render)?;
        if let Some(streamed) = streamed {
            streamed.run_backward(&mut *self.runner, |number| &self.model.parameters[number].values)?;
        }
        self.runner.run(*after)?;
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
        for (number, parameter) in self.model.parameters.iter().enumerate() {
            let streamed = match &self.handles.streamed {
                Some(streamed) => streamed.read_gradient(&mut *self.runner, number, parameter.values.len())?,
                None => None,
            };
            let values = match (self.handles.network.d_parameters[number], streamed) {
                (Some(d), _) => self.runner.read(d)?,
                (None, Some(values)) => values,
                (None, None) => continue,
            };
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

    /// Time on the device per kernel of one step on the last batch, longest first; the parameters change as by a step. `None` on the CPU, and
    /// without what stays on the host.
    pub fn profile(&mut self) -> Result<Option<Vec<srn_gpu::KernelTime>>, Error> {
        let Handles { before, render, after, update, .. } = self.handles;
        match &mut self.runner {
            Runner::Gpu(executor) => Ok(Some(executor.profile(&[before, render, after, update])?)),
            Runner::Cpu(_) => Ok(None),
        }
    }

    /// The executor, whose plan names every buffer: for tests against golden values and lockstep.
    pub fn executor(&mut self) -> &mut dyn Executor {
        &mut *self.runner
    }

    /// Reads the parameters back and returns the model. Fails where one is not finite, so that no such model is ever saved.
    pub fn model(&mut self) -> Result<&Model, Error> {
        for (buffer, parameter) in self.handles.network.parameters.iter().zip(&mut self.model.parameters) {
            if let Some(buffer) = *buffer {
                parameter.values = self.runner.read(buffer)?;
            }
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
        for &(number, [m, v]) in &self.handles.moments {
            moments.push((number, [Cow::from(self.runner.read(m)?), Cow::from(self.runner.read(v)?)]));
        }
        let streamed = self.handles.streamed.iter().flat_map(Streamed::moments);
        moments.extend(streamed.map(|(number, [m, v])| (number, [m.into(), v.into()])));
        let mut tensors = self.model.tensors();
        for (number, both) in &moments {
            for (name, values) in moment_names(&self.model, *number).into_iter().zip(both) {
                tensors.push((name, vec![values.len()], values));
            }
        }
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
        let stored = |name: String, len: usize| match tensors.get(&name) {
            Some((_, values)) if values.len() == len => Ok(values),
            Some((shape, _)) => Err(Error::Tensor { name, expected: format!("[{len}]"), got: format!("{shape:?}") }),
            None => Err(Error::MissingTensor { name }),
        };
        let stored = |number: usize| {
            let [m, v] = moment_names(&model, number).map(|name| stored(name, model.parameters[number].values.len()));
            Ok::<_, Error>([m?, v?])
        };
        // What is wrong with any of them is known before the first is overwritten.
        let streamed = self.handles.streamed.iter_mut().flat_map(Streamed::moments_mut).map(|(number, _)| number);
        for number in self.handles.moments.iter().map(|&(number, _)| number).chain(streamed) {
            stored(number)?;
        }
        for &(number, buffers) in &self.handles.moments {
            for (buffer, values) in buffers.into_iter().zip(stored(number)?) {
                self.runner.write(buffer, values)?;
            }
        }
        for (number, home) in self.handles.streamed.iter_mut().flat_map(Streamed::moments_mut) {
            *home = stored(number)?.map(Clone::clone);
        }
        self.handles.network.upload(&mut *self.runner, &model)?;
        self.model = model;
        self.steps = steps;
        Ok(())
    }
}

/// Names of a parameter's moments in a checkpoint.
fn moment_names(model: &Model, number: usize) -> [String; 2] {
    ["m", "v"].map(|kind| format!("adam.{kind}.{}", model.parameters[number].tensors[0].0))
}

fn build(
    b: &mut Builder,
    model: &Model,
    train: Train,
    batch: Batch,
    cut: &[Tile],
    part_rows: u32,
    on_host: &OnHost,
) -> Result<Handles, PlanError> {
    let trainable = if train == Train::Codes { Trainable::Codes } else { Trainable::Everything };
    let network = Network::new(b, model, batch, trainable, true, &on_host.parameters)?;
    let mut streamed = Streamed::new(b, model, batch, on_host, train == Train::Everything)?;
    let (images, rays) = (batch.images, batch.rays);
    let rows = images * rays;
    let most = cut.iter().map(|tile| tile.rows.count()).max().unwrap_or(1);
    let saved = Saved::new(b, &network, Purpose::Train, most)?;
    let sums = Sums::new(b, &network, cut, part_rows)?;
    let scratch = Scratch::new(b, &network, &saved, sums)?;
    let SourceBuffers::Hypernetwork(hyper) = &network.source else { unreachable!("a trainer takes no baked model") };
    let hyper_saved = HyperSaved::new(b, &network, hyper)?;
    let hyper_scratch = HyperScratch::new(b, &network, hyper)?;
    let codes_count = batch.slots * hyper.latent;
    let of_losses =
        image_loss::partial_len(images, rays).max(depth_loss::partial_len(rows)).max(latent_loss::partial_len(codes_count));
    let partial = b.scratch("partial sums", of_losses)?;
    let target = b.input("target", 4 * rows as usize)?;
    let tile_target = b.scratch("tile target", 4 * most as usize)?;
    let d_rgb = b.scratch("tile d rgb", 3 * most as usize)?;
    let count = b.input("target count", images as usize)?;
    let (loss_images, loss_latent, loss_depth) =
        (b.scratch("image loss", images as usize)?, b.scratch("latent loss", 1)?, b.scratch("depth loss", 1)?);

    let before = b.stage("hypernetwork");
    let mut started = Started::default();
    forward::hypernetwork(b, &network, hyper, &hyper_saved)?;
    if let Some(streamed) = &mut streamed {
        streamed.forward(b, &network, &hyper_saved)?;
    }

    let render = b.stage("render and back");
    for &tile in cut {
        forward::render(b, &network, &saved, tile)?;
        tile_ops::gather(b, tile, 4, target, tile_target)?;
        let scale = (IMAGE_WEIGHT / f64::from(images)) as f32;
        image_loss::backward(b, image_loss::Kind::Mse, tile.rows, rays, scale, saved.rgb(), tile_target, count, d_rgb)?;
        let scale = (DEPTH_WEIGHT / f64::from(rows)) as f32;
        depth::backward(b, tile.rows, scale, network.world_from_camera, saved.depth, scratch.d_origin)?;
        backward::render(b, &network, &saved, &scratch, tile, d_rgb, true, &mut started)?;
    }
    if let Some(streamed) = &mut streamed {
        streamed.backward(b, &network, &hyper_scratch, &mut started)?;
    }

    let after = b.stage("hypernetwork back");
    backward::hypernetwork(b, &network, hyper, &hyper_saved, &hyper_scratch, &mut started)?;
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
        let (Some(d), Some(value)) = (network.d_parameters[number], network.parameters[number]) else { continue };
        let (name, len) = (&parameter.tensors[0].0, parameter.values.len());
        let [m, v] = [b.input(format!("m {name}"), len)?, b.input(format!("v {name}"), len)?];
        adam::step(b, len as u32, d, schedule, value, m, v)?;
        moments.push((number, [m, v]));
    }
    if let Some(streamed) = &mut streamed {
        streamed.update(b, &network, &hyper_saved, schedule)?;
    }
    Ok(Handles {
        network,
        target,
        schedule,
        image_loss: loss_images,
        latent_loss: loss_latent,
        depth_loss: loss_depth,
        moments,
        before,
        render,
        after,
        update,
        streamed,
    })
}
