//! One step of pose estimation for many hypotheses at once (spec 4): render, loss, gradient to the six numbers, Adam.

use glam::{DMat3, DMat4};
use srn_plan::ops::{adam, compose, gmsd, image_loss, keep_best, pose, rays, tile as tile_ops};
use srn_plan::{BufferId, Builder, Executor, PlanError, StageId, tiles};

use crate::camera::{Pose6, to_rows};
use crate::engine::{Engine, Runner};
use crate::model::Model;
use crate::network::{Batch, HyperSaved, Network, Purpose, Saved, Scratch, Started, Trainable, backward, forward};
use crate::{Error, Rays};

/// How a render is compared with its target (spec 4).
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Loss {
    /// Mean absolute error: the paper's choice.
    Mae,
    /// Mean squared error.
    Mse,
    /// Sum of absolute errors over one plus the number of target values that are not white.
    NormL1,
    /// Sum of squared errors, likewise.
    NormL2,
    /// Gradient magnitude similarity deviation; needs whole images.
    Gmsd,
}

impl Loss {
    /// The per-pixel kinds; `None` for GMSD.
    fn per_pixel(self) -> Option<image_loss::Kind> {
        match self {
            Loss::Mae => Some(image_loss::Kind::Mae),
            Loss::Mse => Some(image_loss::Kind::Mse),
            Loss::NormL1 => Some(image_loss::Kind::NormL1),
            Loss::NormL2 => Some(image_loss::Kind::NormL2),
            Loss::Gmsd => None,
        }
    }
}

/// Sizes of a [`Descent`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Poses that are refined at once: starts × queries.
    pub hypotheses: u32,
    /// Rays per row of the (sub-sampled) image.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Different instances among the hypotheses.
    pub instances: u32,
}

struct Handles {
    network: Network,
    target: BufferId,
    frame: BufferId,
    start: BufferId,
    pose6: BufferId,
    d_pose6: BufferId,
    loss: BufferId,
    schedule: BufferId,
    moments: [BufferId; 2],
    best_loss: BufferId,
    best_pose6: BufferId,
    instances: StageId,
    targets: StageId,
    evaluate: StageId,
    descend: StageId,
}

/// Adam on the poses of many hypotheses, the network frozen.
pub struct Descent {
    runner: Runner,
    handles: Handles,
    shape: Shape,
    /// A pose is frame · motion · start; see [`Descent::set_starts`].
    starts: Vec<(DMat4, DMat4)>,
    steps: u64,
}

impl Descent {
    /// Plans and buffers for `shape`.
    pub fn new(engine: &Engine, model: &Model, shape: Shape, loss: Loss) -> Result<Self, Error> {
        let Shape { hypotheses, width, height, instances } = shape;
        for (field, value) in [("hypotheses", hypotheses), ("width", width), ("height", height), ("instances", instances)] {
            if value == 0 {
                return Err(Error::Setting { field, what: "must be at least 1".into() });
            }
        }
        if loss == Loss::Gmsd && (width < 2 || height < 2) {
            return Err(Error::Setting { field: "loss", what: format!("GMSD needs 2 × 2 pixels, got {width} × {height}") });
        }
        let rows = hypotheses * width * height;
        let (plan, handles) =
            engine.fit(rows, model.layout.features(), |b, tile_rows| build(b, model, shape, loss, tile_rows))?;
        let mut runner = engine.prepare(plan)?;
        handles.network.upload(&mut *runner, model)?;
        Ok(Descent { runner, handles, shape, starts: Vec::new(), steps: 0 })
    }

    /// Bytes of all buffers.
    pub fn bytes(&self) -> u64 {
        self.runner.plan().bytes()
    }

    /// Floating-point operations of one step, matrix products only.
    pub fn flops_per_step(&self) -> u64 {
        self.runner.plan().flops(self.handles.evaluate)
    }

    /// What computes, in words.
    pub fn describe(&self) -> String {
        self.runner.describe()
    }

    /// Time on the device per kernel of one evaluation, longest first; `None` on the CPU.
    pub fn profile(&mut self) -> Result<Option<Vec<srn_gpu::KernelTime>>, Error> {
        match &mut self.runner {
            Runner::Gpu(executor) => Ok(Some(executor.profile(self.handles.evaluate)?)),
            Runner::Cpu(_) | Runner::CpuF64(_) => Ok(None),
        }
    }

    /// Sets what is looked for: hypothesis `k` shows instance `instances[slot[k]]`; `rays` (without poses) and
    /// `target_rgb [hypotheses, rays, 3]` in [-1, 1].
    pub fn set_targets(&mut self, instances: &[u32], slots: &[u32], rays: &Rays, target_rgb: &[f32]) -> Result<(), Error> {
        let network = &self.handles.network;
        if let Some(instance) = instances.iter().find(|&&instance| instance >= network.instances) {
            let what = format!("number {instance}, but the model has {}", network.instances);
            return Err(Error::Input { input: "instances".into(), what });
        }
        if let Some(slot) = slots.iter().find(|&&slot| slot >= self.shape.instances) {
            let what = format!("number {slot}, but there are {} instances", self.shape.instances);
            return Err(Error::Input { input: "slots".into(), what });
        }
        if let Some(value) = target_rgb.iter().find(|value| !value.is_finite()) {
            return Err(Error::Input { input: "target image".into(), what: format!("has the value {value}") });
        }
        self.runner.write_u32(network.index, instances)?;
        self.runner.write_u32(network.slots, slots)?;
        rays.write(&mut *self.runner, network)?;
        self.runner.write(self.handles.target, target_rgb)?;
        self.runner.run(self.handles.instances)?;
        self.runner.run(self.handles.targets)?;
        Ok(())
    }

    /// Sets the poses; the steps change their six numbers themselves, as in the paper. Forgets momentum and best steps.
    pub fn set_poses(&mut self, poses: &[Pose6]) -> Result<(), Error> {
        self.set(poses, vec![(DMat4::IDENTITY, DMat4::IDENTITY); poses.len()])
    }

    /// Sets the poses; the steps change the six numbers of a motion about the object (the world origin), in the axes of the
    /// start's camera, zero at first. The camera orbits when the first two angles change; its distance, which an image shows
    /// least, is a number of its own; and no start is at the Euler angles' singularity.
    pub fn set_starts(&mut self, starts: &[Pose6]) -> Result<(), Error> {
        let split = |start: &Pose6| {
            let start = start.to_matrix();
            let frame = DMat4::from_mat3(DMat3::from_mat4(start));
            (frame, frame.transpose() * start)
        };
        self.set(&vec![Pose6([0.0; 6]); starts.len()], starts.iter().map(split).collect())
    }

    fn set(&mut self, motions: &[Pose6], starts: Vec<(DMat4, DMat4)>) -> Result<(), Error> {
        let frames: Vec<f64> = starts.iter().flat_map(|(frame, _)| to_rows(frame)).collect();
        self.runner.write_f64(self.handles.frame, &frames)?;
        let rows: Vec<f64> = starts.iter().flat_map(|(_, start)| to_rows(start)).collect();
        self.runner.write_f64(self.handles.start, &rows)?;
        self.starts = starts;
        let values: Vec<f64> = motions.iter().flat_map(|motion| motion.0).collect();
        self.runner.write_f64(self.handles.pose6, &values)?;
        self.runner.write_f64(self.handles.best_pose6, &values)?;
        self.runner.write(self.handles.best_loss, &vec![f32::MAX; motions.len()])?;
        for moment in self.handles.moments {
            self.runner.write(moment, &vec![0.0; values.len()])?;
        }
        self.steps = 0;
        Ok(())
    }

    /// Draws new initial depths `[hypotheses, rays]` (spec 2: per ray and per render).
    pub fn set_initial_depths(&mut self, z0: &[f32]) -> Result<(), Error> {
        Ok(self.runner.write(self.handles.network.z0, z0)?)
    }

    /// Renders at the poses; losses and gradients are ready to be read.
    pub fn evaluate(&mut self) -> Result<(), Error> {
        Ok(self.runner.run(self.handles.evaluate)?)
    }

    /// One step of Adam from what [`Descent::evaluate`] found; also remembers the pose if its loss is the best so far.
    pub fn descend(&mut self, learning_rate: f64) -> Result<(), Error> {
        self.steps += 1;
        self.runner.write_f64(self.handles.schedule, &adam::schedule(learning_rate, self.steps))?;
        Ok(self.runner.run(self.handles.descend)?)
    }

    /// Losses of the last evaluation, one per hypothesis.
    pub fn losses(&mut self) -> Result<Vec<f64>, Error> {
        Ok(self.runner.read(self.handles.loss)?.into_iter().map(f64::from).collect())
    }

    /// The poses as they are now.
    pub fn poses(&mut self) -> Result<Vec<Pose6>, Error> {
        let motions = six_numbers(&self.runner.read(self.handles.pose6)?);
        Ok(self.moved(&motions))
    }

    /// Where the motions take the starts.
    fn moved(&self, motions: &[[f64; 6]]) -> Vec<Pose6> {
        let move_start = |(&motion, (frame, start)): (&[f64; 6], &(DMat4, DMat4))| {
            // The camera's own numbers stay as they are, also where the same matrix has others.
            let own = *start == DMat4::IDENTITY;
            if own { Pose6(motion) } else { Pose6::from_matrix(&(*frame * Pose6(motion).to_matrix() * *start)) }
        };
        motions.iter().zip(&self.starts).map(move_start).collect()
    }

    /// Gradients of the last evaluation with respect to the six numbers that the steps change.
    pub fn gradients(&mut self) -> Result<Vec<[f64; 6]>, Error> {
        Ok(six_numbers(&self.runner.read(self.handles.d_pose6)?))
    }

    /// The best pose of each hypothesis that [`Descent::descend`] has seen, with its loss.
    pub fn best(&mut self) -> Result<Vec<(f64, Pose6)>, Error> {
        let losses = self.runner.read(self.handles.best_loss)?;
        let best = six_numbers(&self.runner.read(self.handles.best_pose6)?);
        Ok(losses.into_iter().map(f64::from).zip(self.moved(&best)).collect())
    }

    /// Colours of the last evaluation `[hypotheses, rays, 3]`.
    pub fn rgb(&mut self) -> Result<Vec<f32>, Error> {
        Ok(self.runner.read(self.handles.network.rgb)?)
    }

    /// The executor and, by name, any buffer of the plan: for tests against golden values and lockstep.
    pub fn executor(&mut self) -> &mut dyn Executor {
        &mut *self.runner
    }
}

fn six_numbers(values: &[f32]) -> Vec<[f64; 6]> {
    values.chunks_exact(6).map(|six| std::array::from_fn(|k| six[k].into())).collect()
}

fn build(b: &mut Builder, model: &Model, shape: Shape, loss: Loss, tile_rows: u32) -> Result<Handles, PlanError> {
    let Shape { hypotheses, width, height, instances: slots } = shape;
    let rays_per_image = width * height;
    let values = 3 * hypotheses as usize * rays_per_image as usize;
    let network = Network::new(b, model, Batch { images: hypotheses, rays: rays_per_image, slots }, Trainable::Nothing, false)?;
    let cut = tiles(hypotheses, rays_per_image, tile_rows);
    let most = cut.iter().map(|tile| tile.rows.count()).max().unwrap_or(1);
    let saved = Saved::new(b, &network, Purpose::Pose, most)?;
    let scratch = Scratch::new(b, &network, &saved)?;
    let hyper_saved = HyperSaved::new(b, &network)?;
    let images = gmsd::Images { count: hypotheses, width, height };
    let partial_len = cut.iter().map(|tile| backward::partial_len(&network, tile.rows)).max().unwrap_or(1);
    let sums = image_loss::partial_len(hypotheses, rays_per_image).max(images.partial_len());
    let partial = b.scratch("partial sums", partial_len.max(sums))?;
    let n = hypotheses as usize;
    let target = b.input("target rgb", values)?;
    let loss_buffer = b.scratch("loss", n)?;
    let pose6 = b.input("pose6", 6 * n)?;
    let (frame, start) = (b.input("frame", 12 * n)?, b.input("start", 12 * n)?);
    let (motion, d_motion) = (b.scratch("motion", 12 * n)?, b.scratch("d motion", 12 * n)?);
    let (d_pose6, d_matrix) = (b.scratch("d pose6", 6 * n)?, b.scratch("d world_from_camera", 12 * n)?);

    let instances = b.stage("instances");
    forward::hypernetwork(b, &network, &hyper_saved)?;

    let targets = b.stage("targets");
    // Per-pixel losses need the number of target values that are not white; GMSD needs the target's luma.
    let comparison = match loss.per_pixel() {
        Some(kind) => {
            let count = b.scratch("target count", n)?;
            image_loss::count(b, hypotheses, rays_per_image, target, partial, count)?;
            Comparison::PerPixel { kind, count, tile_target: b.scratch("tile target", 3 * most as usize)? }
        }
        None => {
            let pooled = n * images.pooled() as usize;
            let saved = gmsd::Saved {
                luma: b.scratch("luma", pooled)?,
                target_luma: b.scratch("target luma", pooled)?,
                quality: b.scratch("quality", pooled)?,
                moments: b.scratch("moments", 2 * n)?,
            };
            gmsd::pool(b, images, target, saved.target_luma)?;
            Comparison::Gmsd { saved, d_response: b.scratch("d response", 2 * pooled)?, d_rgb: b.scratch("d rgb", values)? }
        }
    };

    let evaluate = b.stage("evaluate");
    let mut started = Started::default();
    pose::forward(b, hypotheses, pose6, motion)?;
    compose::forward(b, hypotheses, frame, motion, start, network.world_from_camera)?;
    // A loss of whole images needs all tiles before the first gradient; the tiles are rendered once more on the way back.
    if let Comparison::Gmsd { saved: maps, d_response, d_rgb } = comparison {
        for &tile in &cut {
            forward::render(b, &network, &saved, tile)?;
        }
        gmsd::pool(b, images, network.rgb, maps.luma)?;
        gmsd::similarity(b, images, maps)?;
        gmsd::deviation(b, images, maps, partial, loss_buffer)?;
        gmsd::backward(b, images, 1.0, maps, loss_buffer, d_response, d_rgb)?;
    }
    for &tile in &cut {
        match comparison {
            Comparison::PerPixel { kind, count, tile_target } => {
                forward::render(b, &network, &saved, tile)?;
                tile_ops::gather(b, tile, 3, target, tile_target)?;
                image_loss::backward(b, kind, tile.rows, rays_per_image, 1.0, saved.rgb(), tile_target, count, scratch.d_rgb)?;
            }
            Comparison::Gmsd { d_rgb, .. } => {
                if cut.len() > 1 {
                    forward::render(b, &network, &saved, tile)?;
                }
                tile_ops::gather(b, tile, 3, d_rgb, scratch.d_rgb)?;
            }
        }
        backward::render(b, &network, &saved, &scratch, partial, tile, false, &mut started)?;
        let accumulate = started.accumulate(d_matrix, tile.rows.first_group);
        let pixels = network.pixels(&saved);
        rays::backward(b, tile.rows, pixels, scratch.d_origin, scratch.d_direction, partial, d_matrix, accumulate)?;
    }
    if let Comparison::PerPixel { kind, count, .. } = comparison {
        image_loss::forward(b, kind, hypotheses, rays_per_image, network.rgb, target, count, partial, loss_buffer)?;
    }
    compose::backward(b, hypotheses, frame, start, d_matrix, d_motion)?;
    pose::backward(b, hypotheses, pose6, d_motion, d_pose6)?;

    let descend = b.stage("descend");
    let schedule = b.input("schedule", 3)?;
    let moments = [b.input("m pose6", 6 * n)?, b.input("v pose6", 6 * n)?];
    let (best_loss, best_pose6) = (b.input("best loss", n)?, b.input("best pose6", 6 * n)?);
    keep_best::step(b, hypotheses, loss_buffer, pose6, best_loss, best_pose6)?;
    adam::step(b, 6 * hypotheses, d_pose6, schedule, pose6, moments[0], moments[1])?;

    Ok(Handles {
        network,
        target,
        frame,
        start,
        pose6,
        d_pose6,
        loss: loss_buffer,
        schedule,
        moments,
        best_loss,
        best_pose6,
        instances,
        targets,
        evaluate,
        descend,
    })
}

/// How renders are compared, with the buffers for it.
#[derive(Clone, Copy)]
enum Comparison {
    PerPixel { kind: image_loss::Kind, count: BufferId, tile_target: BufferId },
    Gmsd { saved: gmsd::Saved, d_response: BufferId, d_rgb: BufferId },
}
