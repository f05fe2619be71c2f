//! One step of pose estimation for many hypotheses at once: render, compare, move. Two ways to move: the paper's (spec 4), Adam
//! on the camera's six numbers; and Levenberg–Marquardt on the residuals of all rays, over motions about the object.

use srn_plan::ops::levenberg_marquardt::{self as lm, Channel, Residuals};
use srn_plan::ops::{adam, gmsd, image_loss, pose, rays, tile as tile_ops};
use srn_plan::{BufferId, Builder, Executor, PlanError, StageId, Tile, tiles};

use crate::camera::{Pose6, from_rows, to_rows};
use crate::engine::{Engine, Runner};
use crate::model::Model;
use crate::network::{Batch, Network, Purpose, Saved, Scratch, Started, Trainable, backward, forward};
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

/// How poses move.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Method {
    /// The paper's: every step changes the camera's own six numbers, whether the loss falls or not.
    Adam {
        /// What falls.
        loss: Loss,
        /// Step size, the same in each step.
        learning_rate: f64,
    },
    /// Levenberg–Marquardt on the residuals of all rays and channels. A step turns and shifts the camera about the object (the
    /// world origin) and is kept where the loss falls, the mean over all values of `ρ(e) = √(e² + soft²) - soft`.
    LevenbergMarquardt {
        /// Residual (colours span 2) at which `ρ` turns from squares to absolute values.
        soft: f32,
    },
}

/// Damping before the first evaluation, which is always the best so far.
const FIRST_DAMPING: f32 = 0.03;
/// What the backward pass of a channel begins with: small, since gradients in the marcher are clamped to ±10 (spec 2), which is
/// meant for those of a mean over an image. A power of two, so that nothing is rounded.
const SEED: f32 = 1.0 / 4096.0;

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
    instances: StageId,
    /// What follows from the targets alone, with the losses that have such a thing.
    targets: Option<StageId>,
    evaluate: StageId,
    descend: StageId,
    moves: Moves,
}

/// Buffers of the poses, by method.
#[derive(Clone, Copy)]
enum Moves {
    Adam {
        learning_rate: f64,
        pose6: BufferId,
        d_pose6: BufferId,
        loss: BufferId,
        schedule: BufferId,
        moments: [BufferId; 2],
    },
    LevenbergMarquardt {
        equations: BufferId,
        best_equations: BufferId,
        best_pose: BufferId,
        damping: BufferId,
        seeds: [BufferId; 3],
    },
}

/// The descent of many hypotheses, the network frozen.
pub struct Descent {
    runner: Runner,
    handles: Handles,
    shape: Shape,
    steps: u64,
}

impl Descent {
    /// Plans and buffers for `shape`.
    pub fn new(engine: &Engine, model: &Model, shape: Shape, method: Method) -> Result<Self, Error> {
        let Shape { hypotheses, width, height, instances } = shape;
        for (field, value) in [("hypotheses", hypotheses), ("width", width), ("height", height), ("instances", instances)] {
            if value == 0 {
                return Err(Error::Setting { field, what: "must be at least 1".into() });
            }
        }
        let gmsd = matches!(method, Method::Adam { loss: Loss::Gmsd, .. });
        if gmsd && (width < 2 || height < 2) {
            return Err(Error::Setting { field: "loss", what: format!("GMSD needs 2 × 2 pixels, got {width} × {height}") });
        }
        let rows = hypotheses * width * height;
        let (plan, handles) =
            engine.fit(rows, model.layout.features(), |b, tile_rows| build(b, model, shape, method, tile_rows))?;
        let mut runner = engine.prepare(plan)?;
        handles.network.upload(&mut *runner, model)?;
        if let Moves::LevenbergMarquardt { seeds, .. } = handles.moves {
            for (channel, seed) in seeds.into_iter().enumerate() {
                let len = runner.plan().buffer(seed).len;
                let values: Vec<f32> = (0..len).map(|k| if k % 3 == channel { SEED } else { 0.0 }).collect();
                runner.write(seed, &values)?;
            }
        }
        Ok(Descent { runner, handles, shape, steps: 0 })
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
        if let Some(targets) = self.handles.targets {
            self.runner.run(targets)?;
        }
        Ok(())
    }

    /// Sets the poses. Forgets momentum, damping and best steps.
    pub fn set_poses(&mut self, poses: &[Pose6]) -> Result<(), Error> {
        let n = poses.len();
        match self.handles.moves {
            Moves::Adam { pose6, moments, .. } => {
                let values: Vec<f64> = poses.iter().flat_map(|pose| pose.0).collect();
                self.runner.write_f64(pose6, &values)?;
                for moment in moments {
                    self.runner.write(moment, &vec![0.0; values.len()])?;
                }
            }
            Moves::LevenbergMarquardt { best_equations, best_pose, damping, .. } => {
                let matrices: Vec<f64> = poses.iter().flat_map(|pose| to_rows(&pose.to_matrix())).collect();
                self.runner.write_f64(self.handles.network.world_from_camera, &matrices)?;
                self.runner.write_f64(best_pose, &matrices)?;
                let mut nothing_yet = [0.0; lm::EQUATIONS as usize];
                nothing_yet[LOSS] = f32::MAX;
                self.runner.write(best_equations, &nothing_yet.repeat(n))?;
                self.runner.write(damping, &vec![FIRST_DAMPING; n])?;
            }
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

    /// One step from what [`Descent::evaluate`] found.
    pub fn descend(&mut self) -> Result<(), Error> {
        self.steps += 1;
        if let Moves::Adam { learning_rate, schedule, .. } = self.handles.moves {
            self.runner.write_f64(schedule, &adam::schedule(learning_rate, self.steps))?;
        }
        Ok(self.runner.run(self.handles.descend)?)
    }

    /// Losses of the last evaluation, one per hypothesis.
    pub fn losses(&mut self) -> Result<Vec<f64>, Error> {
        match self.handles.moves {
            Moves::Adam { loss, .. } => Ok(self.runner.read(loss)?.into_iter().map(f64::from).collect()),
            Moves::LevenbergMarquardt { equations, .. } => Ok(losses(&self.runner.read(equations)?)),
        }
    }

    /// The poses that the next evaluation renders.
    pub fn poses(&mut self) -> Result<Vec<Pose6>, Error> {
        match self.handles.moves {
            Moves::Adam { pose6, .. } => Ok(six_numbers(&self.runner.read(pose6)?).into_iter().map(Pose6).collect()),
            Moves::LevenbergMarquardt { .. } => Ok(poses(&self.runner.read(self.handles.network.world_from_camera)?)),
        }
    }

    /// Gradients of the last evaluation with respect to the six numbers that a step changes: the camera's own for Adam; a turn
    /// about the object and a shift, in the camera's axes, for Levenberg–Marquardt.
    pub fn gradients(&mut self) -> Result<Vec<[f64; 6]>, Error> {
        match self.handles.moves {
            Moves::Adam { d_pose6, .. } => Ok(six_numbers(&self.runner.read(d_pose6)?)),
            Moves::LevenbergMarquardt { equations, .. } => {
                let rows = self.runner.read(equations)?;
                Ok(rows.chunks_exact(lm::EQUATIONS as usize).flat_map(|row| six_numbers(&row[21..LOSS])).collect())
            }
        }
    }

    /// Where each hypothesis stands after [`Descent::evaluate`], with its loss there: Adam at its last step, Levenberg–Marquardt
    /// at its best.
    pub fn standing(&mut self) -> Result<Vec<(f64, Pose6)>, Error> {
        let (losses, poses) = match self.handles.moves {
            Moves::Adam { .. } => (self.losses()?, self.poses()?),
            Moves::LevenbergMarquardt { best_equations, best_pose, .. } => {
                (losses(&self.runner.read(best_equations)?), poses(&self.runner.read(best_pose)?))
            }
        };
        Ok(losses.into_iter().zip(poses).collect())
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

/// Place of the loss in the normal equations.
const LOSS: usize = lm::EQUATIONS as usize - 1;

fn losses(equations: &[f32]) -> Vec<f64> {
    equations.chunks_exact(lm::EQUATIONS as usize).map(|row| row[LOSS].into()).collect()
}

fn poses(matrices: &[f32]) -> Vec<Pose6> {
    matrices.chunks_exact(12).map(|rows| Pose6::from_matrix(&from_rows(rows))).collect()
}

fn six_numbers(values: &[f32]) -> Vec<[f64; 6]> {
    values.chunks_exact(6).map(|six| std::array::from_fn(|k| six[k].into())).collect()
}

fn build(b: &mut Builder, model: &Model, shape: Shape, method: Method, tile_rows: u32) -> Result<Handles, PlanError> {
    let Shape { hypotheses, width, height, instances: slots } = shape;
    let rays_per_image = width * height;
    let batch = Batch { images: hypotheses, rays: rays_per_image, slots };
    // Adam's matrices come from six numbers, those of Levenberg–Marquardt are what it moves.
    let pose_is_input = matches!(method, Method::LevenbergMarquardt { .. });
    let network = Network::new(b, model, batch, Trainable::Nothing, pose_is_input)?;
    let cut = tiles(hypotheses, rays_per_image, tile_rows);
    let most = cut.iter().map(|tile| tile.rows.count()).max().unwrap_or(1);
    let saved = Saved::new(b, &network, Purpose::Pose, most)?;
    let scratch = Scratch::new(b, &network, &saved)?;
    let target = b.input("target rgb", 3 * hypotheses as usize * rays_per_image as usize)?;

    let instances = forward::instances(b, &network)?;

    let parts = Parts { network: &network, saved: &saved, scratch: &scratch, target, cut: &cut, most, shape };
    let (targets, evaluate, descend, moves) = match method {
        Method::Adam { loss, learning_rate } => adam_stages(b, &parts, loss, learning_rate)?,
        Method::LevenbergMarquardt { soft } => levenberg_marquardt_stages(b, &parts, soft)?,
    };
    Ok(Handles { network, target, instances, targets, evaluate, descend, moves })
}

/// What both methods work with.
struct Parts<'a> {
    network: &'a Network,
    saved: &'a Saved,
    scratch: &'a Scratch,
    target: BufferId,
    cut: &'a [Tile],
    /// Rows of the largest tile.
    most: u32,
    shape: Shape,
}

type Stages = (Option<StageId>, StageId, StageId, Moves);

/// Stages "targets", "evaluate" and "descend" of the paper's method.
fn adam_stages(b: &mut Builder, parts: &Parts, loss: Loss, learning_rate: f64) -> Result<Stages, PlanError> {
    let &Parts { network, saved, scratch, target, cut, most, shape: Shape { hypotheses, width, height, .. } } = parts;
    let rays_per_image = width * height;
    let n = hypotheses as usize;
    let images = gmsd::Images { count: hypotheses, width, height };
    let partial_len = cut.iter().map(|tile| backward::partial_len(network, tile.rows)).max().unwrap_or(1);
    let sums = image_loss::partial_len(hypotheses, rays_per_image).max(images.partial_len());
    let partial = b.scratch("partial sums", partial_len.max(sums))?;
    let tile_d_rgb = b.scratch("tile d rgb", 3 * most as usize)?;
    let loss_buffer = b.scratch("loss", n)?;
    let pose6 = b.input("pose6", 6 * n)?;
    let (d_pose6, d_matrix) = (b.scratch("d pose6", 6 * n)?, b.scratch("d world_from_camera", 12 * n)?);

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
            let d_rgb = b.scratch("d rgb", 3 * n * rays_per_image as usize)?;
            Comparison::Gmsd { saved, d_response: b.scratch("d response", 2 * pooled)?, d_rgb }
        }
    };

    let evaluate = b.stage("evaluate");
    let mut started = Started::default();
    pose::forward(b, hypotheses, pose6, network.world_from_camera)?;
    // A loss of whole images needs all tiles before the first gradient; the tiles are rendered once more on the way back.
    if let Comparison::Gmsd { saved: maps, d_response, d_rgb } = comparison {
        for &tile in cut {
            forward::render(b, network, saved, tile)?;
        }
        gmsd::pool(b, images, network.rgb, maps.luma)?;
        gmsd::similarity(b, images, maps)?;
        gmsd::deviation(b, images, maps, partial, loss_buffer)?;
        gmsd::backward(b, images, 1.0, maps, loss_buffer, d_response, d_rgb)?;
    }
    for &tile in cut {
        match comparison {
            Comparison::PerPixel { kind, count, tile_target } => {
                forward::render(b, network, saved, tile)?;
                tile_ops::gather(b, tile, 3, target, tile_target)?;
                image_loss::backward(b, kind, tile.rows, rays_per_image, 1.0, saved.rgb(), tile_target, count, tile_d_rgb)?;
            }
            Comparison::Gmsd { d_rgb, .. } => {
                if cut.len() > 1 {
                    forward::render(b, network, saved, tile)?;
                }
                tile_ops::gather(b, tile, 3, d_rgb, tile_d_rgb)?;
            }
        }
        backward::render(b, network, saved, scratch, partial, tile, tile_d_rgb, false, &mut started)?;
        let accumulate = started.accumulate(d_matrix, tile.rows.first_group);
        let pixels = network.pixels(saved);
        rays::backward(b, tile.rows, pixels, scratch.d_origin, scratch.d_direction, partial, d_matrix, accumulate)?;
    }
    if let Comparison::PerPixel { kind, count, .. } = comparison {
        image_loss::forward(b, kind, hypotheses, rays_per_image, network.rgb, target, count, partial, loss_buffer)?;
    }
    pose::backward(b, hypotheses, pose6, d_matrix, d_pose6)?;

    let descend = b.stage("descend");
    let schedule = b.input("schedule", 3)?;
    let moments = [b.input("m pose6", 6 * n)?, b.input("v pose6", 6 * n)?];
    adam::step(b, 6 * hypotheses, d_pose6, schedule, pose6, moments[0], moments[1])?;
    Ok((Some(targets), evaluate, descend, Moves::Adam { learning_rate, pose6, d_pose6, loss: loss_buffer, schedule, moments }))
}

/// Stages "evaluate" and "descend" of Levenberg–Marquardt. Rays are independent, so one backward pass for each channel, begun with
/// the same number for every ray, gives every ray's derivative of that channel: the rows of the Jacobian.
fn levenberg_marquardt_stages(b: &mut Builder, parts: &Parts, soft: f32) -> Result<Stages, PlanError> {
    let &Parts { network, saved, scratch, target, cut, most, shape: Shape { hypotheses, width, height, .. } } = parts;
    let n = hypotheses as usize;
    let len = |tile: &Tile| backward::partial_len(network, tile.rows).max(lm::partial_len(tile.rows));
    let partial = b.scratch("partial sums", cut.iter().map(len).max().unwrap_or(1))?;
    let tile_target = b.scratch("tile target", 3 * most as usize)?;
    let mut seed = |name: &str| b.input(name, 3 * most as usize);
    let seeds = [seed("seed of red")?, seed("seed of green")?, seed("seed of blue")?];
    let values = n * lm::EQUATIONS as usize;
    let equations = b.scratch("equations", values)?;
    let (best_equations, best_pose) = (b.input("best equations", values)?, b.input("best pose", 12 * n)?);
    let damping = b.input("damping", n)?;

    let evaluate = b.stage("evaluate");
    let mut started = Started::default();
    let residuals = Residuals {
        world_from_camera: network.world_from_camera,
        origin: saved.x[0],
        direction: saved.direction,
        d_origin: scratch.d_origin,
        d_direction: scratch.d_direction,
        rgb: saved.rgb(),
        target_rgb: tile_target,
    };
    let scale = 1.0 / (3 * width * height) as f32;
    for &tile in cut {
        forward::render(b, network, saved, tile)?;
        tile_ops::gather(b, tile, 3, target, tile_target)?;
        for (number, d_rgb) in (0..).zip(seeds) {
            backward::render(b, network, saved, scratch, partial, tile, d_rgb, false, &mut started)?;
            let channel = Channel { number, seed: SEED, scale, soft };
            let accumulate = started.accumulate(equations, tile.rows.first_group);
            lm::equations(b, tile.rows, residuals, channel, partial, equations, accumulate)?;
        }
    }
    lm::accept(b, hypotheses, equations, network.world_from_camera, best_equations, best_pose, damping)?;

    let descend = b.stage("descend");
    lm::solve(b, hypotheses, best_equations, best_pose, damping, network.world_from_camera)?;
    Ok((None, evaluate, descend, Moves::LevenbergMarquardt { equations, best_equations, best_pose, damping, seeds }))
}

/// How renders are compared, with the buffers for it.
#[derive(Clone, Copy)]
enum Comparison {
    PerPixel { kind: image_loss::Kind, count: BufferId, tile_target: BufferId },
    Gmsd { saved: gmsd::Saved, d_response: BufferId, d_rgb: BufferId },
}
