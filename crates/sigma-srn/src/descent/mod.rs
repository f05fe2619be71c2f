//! One step of pose estimation for many hypotheses at once: render, compare, move. Two ways to move: the paper's (spec 4), Adam
//! on the camera's six numbers; and BFGS over motions about the object, begun from the residuals of all rays.

use std::iter::zip;

use srn_plan::ops::bfgs::{self, Channel, Residuals};
use srn_plan::ops::rays::Pixels;
use srn_plan::ops::{adam, gmsd, image_loss, pose, rays, tile as tile_ops};
use srn_plan::{BufferId, Builder, Executor, PlanError, Rows, StageId, Tile, tiles};

use crate::camera::{Pose6, from_rows, to_rows};
use crate::engine::{Engine, Runner};
use crate::model::Model;
use crate::network::forward::{self, Instances};
use crate::network::streamed::OnHost;
use crate::network::{Batch, Network, Purpose, Saved, Scratch, Started, Sums, Trainable, backward};
use crate::rays::wanted;
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
    /// Broyden, Fletcher, Goldfarb, Shanno. A step turns and shifts the camera about the object (the world origin) and is kept where
    /// the loss falls, the mean over all values of `ρ(e) = √(e² + soft²) - soft`. Second derivatives are at first those of least
    /// squares, from the residuals of all rays and channels; each step then corrects them by the change of the gradient.
    Bfgs {
        /// Residual (colours span 2) at which `ρ` turns from squares to absolute values.
        soft: f32,
        /// Turns (rad) and shifts (object units) of a step are multiples of this, in a search of it times the stride of a phase; 0: they have any
        /// length. Without it rounding parts two descents by a factor in each step; with it they mostly stay together to the last digit.
        grain: f32,
    },
}

impl Method {
    /// The same for every `stride`-th pixel: steps of as many grains.
    pub(crate) fn with_stride(self, stride: u32) -> Self {
        match self {
            Method::Bfgs { soft, grain } => Method::Bfgs { soft, grain: grain * stride as f32 },
            adam => adam,
        }
    }
}

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
    /// See [`wanted`] `[hypotheses, rays, 4]`; for GMSD, which knows no weights, colours `[hypotheses, rays, 3]`.
    target: BufferId,
    gmsd: bool,
    instances: Instances,
    /// What follows from the targets alone.
    targets: StageId,
    compare: StageId,
    loss: BufferId,
    /// `None`: poses are only compared.
    moves: Option<Moves>,
}

/// How poses move: two stages, and what they have by method.
#[derive(Clone, Copy)]
struct Moves {
    evaluate: StageId,
    descend: StageId,
    by: By,
}

/// Buffers of the poses, by method.
#[derive(Clone, Copy)]
enum By {
    Adam { learning_rate: f64, pose6: BufferId, d_pose6: BufferId, schedule: BufferId, moments: [BufferId; 2] },
    Bfgs { begin: StageId, equations: BufferId, gradient: BufferId, state: BufferId, seeds: [BufferId; 3] },
}

/// The descent of many hypotheses, the network frozen.
pub struct Descent {
    runner: Runner,
    handles: Handles,
    shape: Shape,
    steps: u64,
    /// Whether gradients were evaluated since the poses were set.
    begun: bool,
}

impl Descent {
    /// Plans and buffers for `shape`.
    pub fn new(engine: &Engine, model: &Model, shape: Shape, method: Method) -> Result<Self, Error> {
        Self::make(engine, model, shape, method, true)
    }

    /// One whose poses are only compared, with little memory: evaluations have losses and no gradients, and steps do nothing.
    pub fn still(engine: &Engine, model: &Model, shape: Shape, method: Method) -> Result<Self, Error> {
        Self::make(engine, model, shape, method, false)
    }

    fn make(engine: &Engine, model: &Model, shape: Shape, method: Method, is_moving: bool) -> Result<Self, Error> {
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
        let on_host = OnHost::of(engine, model, 1);
        let (plan, mut handles) = engine
            .fit(rows, model.layout.features(), |b, tile_rows| build(b, model, shape, method, is_moving, tile_rows, &on_host))?;
        let mut runner = engine.prepare_descent(plan)?;
        handles.instances.upload(&mut *runner, &handles.network, model)?;
        if let Some(By::Bfgs { seeds, .. }) = handles.moves.map(|moves| moves.by) {
            for (channel, seed) in seeds.into_iter().enumerate() {
                let len = runner.plan().buffer(seed).len;
                let values: Vec<f32> = (0..len).map(|k| if k % 3 == channel { SEED } else { 0.0 }).collect();
                runner.write(seed, &values)?;
            }
        }
        Ok(Descent { runner, handles, shape, steps: 0, begun: false })
    }

    /// Bytes of all buffers.
    pub fn bytes(&self) -> u64 {
        self.runner.plan().bytes()
    }

    /// Floating-point operations of one step, matrix products only; not of the first after [`Descent::set_poses`], which may take more.
    pub fn flops_per_step(&self) -> u64 {
        self.runner.plan().flops(self.evaluation())
    }

    /// What computes, in words.
    pub fn describe(&self) -> String {
        self.runner.describe()
    }

    /// Time on the device per kernel of one evaluation, longest first; `None` on the CPU.
    pub fn profile(&mut self) -> Result<Option<Vec<srn_gpu::KernelTime>>, Error> {
        let stage = self.evaluation();
        match &mut self.runner {
            Runner::Gpu(executor) => Ok(Some(executor.profile(stage)?)),
            Runner::Cpu(_) => Ok(None),
        }
    }

    /// The stage of an evaluation after the first.
    fn evaluation(&self) -> StageId {
        self.handles.moves.map_or(self.handles.compare, |moves| moves.evaluate)
    }

    fn by(&self) -> Option<By> {
        self.handles.moves.map(|moves| moves.by)
    }

    /// Sets what is looked for: hypothesis `k` shows instance `instances[slot[k]]`; `rays` (without poses), `target_rgb
    /// [hypotheses, rays, 3]` in [-1, 1], and how much each ray counts, `weights [hypotheses, rays]`: 1 where none are given. A ray
    /// of weight 0 has no part in losses and steps. Losses are means where the weights' mean is 1.
    pub fn set_targets(
        &mut self,
        instances: &[u32],
        slots: &[u32],
        rays: &Rays,
        target_rgb: &[f32],
        weights: Option<&[f32]>,
    ) -> Result<(), Error> {
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
        let Shape { hypotheses, width, height, .. } = self.shape;
        let n = hypotheses as usize * width as usize * height as usize;
        if let Some(weights) = weights {
            let what = match weights.iter().find(|weight| !(0.0..f32::INFINITY).contains(*weight)) {
                Some(weight) => Some(format!("has the value {weight}")),
                None if self.handles.gmsd => Some("GMSD compares whole images: it takes none".into()),
                None => (weights.len() != n).then(|| format!("{} for {n} rays", weights.len())),
            };
            if let Some(what) = what {
                return Err(Error::Input { input: "weights".into(), what });
            }
        }
        self.runner.write_u32(network.index, instances)?;
        self.runner.write_u32(network.slots, slots)?;
        rays.write(&mut *self.runner, network)?;
        match self.handles.gmsd {
            true => self.runner.write(self.handles.target, target_rgb)?,
            false => self.runner.write(self.handles.target, &wanted(target_rgb, weights))?,
        }
        self.handles.instances.run(&mut *self.runner)?;
        Ok(self.runner.run(self.handles.targets)?)
    }

    /// Sets the poses. Forgets momentum, second derivatives and best steps.
    pub fn set_poses(&mut self, poses: &[Pose6]) -> Result<(), Error> {
        match self.by() {
            Some(By::Adam { pose6, moments, .. }) => {
                let values: Vec<f64> = poses.iter().flat_map(|pose| pose.0).collect();
                self.runner.write_f64(pose6, &values)?;
                for moment in moments {
                    self.runner.write(moment, &vec![0.0; values.len()])?;
                }
            }
            Some(By::Bfgs { .. }) | None => {
                let matrices: Vec<f64> = poses.iter().flat_map(|pose| to_rows(&pose.to_matrix())).collect();
                self.runner.write_f64(self.handles.network.world_from_camera, &matrices)?;
            }
        }
        (self.steps, self.begun) = (0, false);
        Ok(())
    }

    /// Draws new initial depths `[hypotheses, rays]` (spec 2: per ray and per render).
    pub fn set_initial_depths(&mut self, z0: &[f32]) -> Result<(), Error> {
        Ok(self.runner.write(self.handles.network.z0, z0)?)
    }

    /// Renders at the poses; losses are ready to be read.
    pub fn compare(&mut self) -> Result<(), Error> {
        Ok(self.runner.run(self.handles.compare)?)
    }

    /// Renders at the poses; losses and gradients are ready to be read.
    pub fn evaluate(&mut self) -> Result<(), Error> {
        let stage = match self.by() {
            Some(By::Bfgs { begin, .. }) if !self.begun => begin,
            _ => self.evaluation(),
        };
        self.begun = true;
        Ok(self.runner.run(stage)?)
    }

    /// One step from what [`Descent::evaluate`] found.
    pub fn descend(&mut self) -> Result<(), Error> {
        let Some(moves) = self.handles.moves else { return Ok(()) };
        self.steps += 1;
        if let By::Adam { learning_rate, schedule, .. } = moves.by {
            self.runner.write_f64(schedule, &adam::schedule(learning_rate, self.steps))?;
        }
        Ok(self.runner.run(moves.descend)?)
    }

    /// Losses of the last comparison or evaluation, one per hypothesis.
    pub fn losses(&mut self) -> Result<Vec<f64>, Error> {
        Ok(self.runner.read(self.handles.loss)?.into_iter().map(f64::from).collect())
    }

    /// The poses that the next evaluation renders.
    pub fn poses(&mut self) -> Result<Vec<Pose6>, Error> {
        match self.by() {
            Some(By::Adam { pose6, .. }) => Ok(six_numbers(&self.runner.read(pose6)?).into_iter().map(Pose6).collect()),
            Some(By::Bfgs { .. }) | None => Ok(poses(&self.runner.read(self.handles.network.world_from_camera)?)),
        }
    }

    /// Gradients of the last evaluation with respect to the six numbers that a step changes: the camera's own for Adam; a turn
    /// about the object and a shift, in the camera's axes, for BFGS; none where poses are only compared.
    pub fn gradients(&mut self) -> Result<Vec<[f64; 6]>, Error> {
        match self.by() {
            None => Ok(vec![]),
            Some(By::Adam { d_pose6, .. }) => Ok(six_numbers(&self.runner.read(d_pose6)?)),
            // The first evaluation has them from the residuals.
            Some(By::Bfgs { equations, .. }) if self.steps == 0 => {
                let rows = self.runner.read(equations)?;
                Ok(rows.chunks_exact(bfgs::EQUATIONS as usize).flat_map(|row| six_numbers(&row[21..])).collect())
            }
            Some(By::Bfgs { gradient, .. }) => Ok(six_numbers(&self.runner.read(gradient)?)),
        }
    }

    /// Where each hypothesis stands, with its loss there: Adam at its last step, BFGS at its best.
    pub fn standing(&mut self) -> Result<Vec<(f64, Pose6)>, Error> {
        let Some(states) = self.states()? else { return Ok(zip(self.losses()?, self.poses()?).collect()) };
        let standing = states.chunks_exact(bfgs::STATE as usize).map(|state| {
            let rows = &state[bfgs::STATE_POSE..bfgs::STATE_POSE + 12];
            (state[bfgs::STATE_LOSS].into(), Pose6::from_matrix(&from_rows(rows)))
        });
        Ok(standing.collect())
    }

    /// Second derivatives of each hypothesis's loss at its best pose, over a turn about the object and a shift, in the camera's axes, as
    /// BFGS knows them so far; nothing for Adam, nor before the first evaluation.
    pub fn curvatures(&mut self) -> Result<Vec<[[f64; 6]; 6]>, Error> {
        let states = self.states()?.unwrap_or_default();
        Ok(states.chunks_exact(bfgs::STATE as usize).map(bfgs::curvature).collect())
    }

    /// States of BFGS, once it has begun.
    fn states(&mut self) -> Result<Option<Vec<f32>>, Error> {
        match self.by() {
            Some(By::Bfgs { state, .. }) if self.begun => Ok(Some(self.runner.read(state)?)),
            _ => Ok(None),
        }
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

fn poses(matrices: &[f32]) -> Vec<Pose6> {
    matrices.chunks_exact(12).map(|rows| Pose6::from_matrix(&from_rows(rows))).collect()
}

fn six_numbers(values: &[f32]) -> Vec<[f64; 6]> {
    values.chunks_exact(6).map(|six| std::array::from_fn(|k| six[k].into())).collect()
}

fn build(
    b: &mut Builder,
    model: &Model,
    shape: Shape,
    method: Method,
    is_moving: bool,
    tile_rows: u32,
    on_host: &OnHost,
) -> Result<Handles, PlanError> {
    let Shape { hypotheses, width, height, instances: slots } = shape;
    let rays_per_image = width * height;
    let batch = Batch { images: hypotheses, rays: rays_per_image, slots };
    // Adam's matrices come from six numbers, those of BFGS are what it moves.
    let pose_is_input = matches!(method, Method::Bfgs { .. }) || !is_moving;
    let network = Network::new(b, model, batch, Trainable::Nothing, pose_is_input, &on_host.parameters)?;
    let cut = tiles(hypotheses, rays_per_image, tile_rows);
    let most = cut.iter().map(|tile| tile.rows.count()).max().unwrap_or(1);
    let saved = Saved::new(b, &network, if is_moving { Purpose::Pose } else { Purpose::Render }, most)?;
    let gmsd = matches!(method, Method::Adam { loss: Loss::Gmsd, .. });
    let target = b.input("target", if gmsd { 3 } else { 4 } * hypotheses as usize * rays_per_image as usize)?;

    let instances = Instances::new(b, &network, model, on_host)?;

    let loss = match method {
        Method::Adam { loss, .. } => loss.per_pixel(),
        Method::Bfgs { soft, .. } => Some(image_loss::Kind::Charbonnier { soft }),
    };
    let comparison = Comparison::new(b, &cut, shape, loss)?;
    let parts = Parts { network: &network, saved: &saved, target, cut: &cut, comparison: &comparison, shape };

    let targets = b.stage("targets");
    parts.look_at_targets(b)?;

    let (compare, moves) = match method {
        _ if !is_moving => (parts.still(b)?, None),
        Method::Adam { learning_rate, .. } => parts.adam(b, learning_rate)?,
        Method::Bfgs { soft, grain } => parts.bfgs(b, soft, grain)?,
    };
    let loss = comparison.loss;
    Ok(Handles { network, target, gmsd, instances, targets, compare, loss, moves })
}

/// How renders are compared, with the buffers for it.
struct Comparison {
    kind: Kind,
    partial: BufferId,
    loss: BufferId,
}

#[derive(Clone, Copy)]
enum Kind {
    /// `count`: of target values that are not white.
    PerPixel {
        kind: image_loss::Kind,
        count: BufferId,
    },
    Gmsd {
        images: gmsd::Images,
        saved: gmsd::Saved,
    },
}

impl Comparison {
    fn new(b: &mut Builder, cut: &[Tile], shape: Shape, loss: Option<image_loss::Kind>) -> Result<Self, PlanError> {
        let Shape { hypotheses, width, height, .. } = shape;
        let n = hypotheses as usize;
        let images = gmsd::Images { count: hypotheses, width, height };
        let of_tile = |tile: &Tile| bfgs::partial_len(tile.rows);
        let of_rays = rays::partial_len(Rows { groups: hypotheses, rows_per_group: width * height, first_group: 0 });
        let of_images = image_loss::partial_len(hypotheses, width * height).max(images.partial_len());
        let partial = b.scratch("partial sums", cut.iter().map(of_tile).max().unwrap_or(1).max(of_images).max(of_rays))?;
        let kind = match loss {
            Some(kind) => Kind::PerPixel { kind, count: b.scratch("target count", n)? },
            None => {
                let pooled = n * images.pooled() as usize;
                let saved = gmsd::Saved {
                    luma: b.scratch("luma", pooled)?,
                    target_luma: b.scratch("target luma", pooled)?,
                    quality: b.scratch("quality", pooled)?,
                    moments: b.scratch("moments", 2 * n)?,
                };
                Kind::Gmsd { images, saved }
            }
        };
        Ok(Comparison { kind, partial, loss: b.scratch("loss", n)? })
    }
}

/// What the way back begins with.
#[derive(Clone, Copy)]
enum Back {
    /// `tile_target`: the tile's part of [`Handles::target`].
    PerPixel {
        kind: image_loss::Kind,
        count: BufferId,
        tile_target: BufferId,
    },
    Gmsd {
        images: gmsd::Images,
        saved: gmsd::Saved,
        d_response: BufferId,
        d_rgb: BufferId,
    },
}

/// What both methods work with.
struct Parts<'a> {
    network: &'a Network,
    saved: &'a Saved,
    target: BufferId,
    cut: &'a [Tile],
    comparison: &'a Comparison,
    shape: Shape,
}

/// The stage "compare", and how poses move.
type Stages = (StageId, Option<Moves>);

impl Parts<'_> {
    /// Per-pixel losses need the number of target values that are not white; GMSD needs the target's luma.
    fn look_at_targets(&self, b: &mut Builder) -> Result<(), PlanError> {
        let Shape { hypotheses, width, height, .. } = self.shape;
        match self.comparison.kind {
            Kind::PerPixel { count, .. } => {
                image_loss::count(b, hypotheses, width * height, self.target, self.comparison.partial, count)
            }
            Kind::Gmsd { images, saved } => gmsd::pool(b, images, self.target, saved.target_luma),
        }
    }

    /// Losses of the whole images in `network.rgb`.
    fn losses(&self, b: &mut Builder) -> Result<(), PlanError> {
        let Shape { hypotheses, width, height, .. } = self.shape;
        let &Comparison { kind, partial, loss, .. } = self.comparison;
        match kind {
            Kind::PerPixel { kind, count } => {
                let pixels = width * height;
                image_loss::forward(b, kind, hypotheses, pixels, self.network.rgb, self.target, count, partial, loss)
            }
            Kind::Gmsd { images, saved } => {
                gmsd::pool(b, images, self.network.rgb, saved.luma)?;
                gmsd::similarity(b, images, saved)?;
                gmsd::deviation(b, images, saved, partial, loss)
            }
        }
    }

    /// Renders and compares.
    fn compare(&self, b: &mut Builder) -> Result<(), PlanError> {
        for &tile in self.cut {
            forward::render(b, self.network, self.saved, tile)?;
        }
        self.losses(b)
    }

    /// The poses are given, and stay.
    fn still(&self, b: &mut Builder) -> Result<StageId, PlanError> {
        let compare = b.stage("compare");
        self.compare(b)?;
        Ok(compare)
    }

    /// Buffers for the way back.
    fn back(&self, b: &mut Builder) -> Result<Back, PlanError> {
        Ok(match self.comparison.kind {
            Kind::PerPixel { kind, count } => {
                Back::PerPixel { kind, count, tile_target: b.scratch("tile target", 4 * self.saved.rows as usize)? }
            }
            Kind::Gmsd { images, saved } => {
                let Shape { hypotheses, width, height, .. } = self.shape;
                let d_rgb = b.scratch("d rgb", 3 * (hypotheses * width * height) as usize)?;
                let d_response = b.scratch("d response", 2 * (hypotheses * images.pooled()) as usize)?;
                Back::Gmsd { images, saved, d_response, d_rgb }
            }
        })
    }

    /// Renders, compares, and goes back to the poses: losses, and `d_matrix [hypotheses, 12]`. Every tile takes the same steps, one after the other, so that
    /// on the CPU no thread waits for another until all are done.
    fn differentiate(&self, b: &mut Builder, scratch: &Scratch, back: Back, d_matrix: BufferId) -> Result<(), PlanError> {
        let &Parts { network, saved, target, cut, comparison, shape: Shape { hypotheses, width, height, .. } } = self;
        let &Comparison { partial, loss, .. } = comparison;
        let mut of_rays = |name: &str| b.scratch(name, 3 * (hypotheses * width * height) as usize);
        let (d_origin, d_direction) = (of_rays("d origins")?, of_rays("d directions")?);
        let tile_d_rgb = b.scratch("tile d rgb", 3 * saved.rows as usize)?;
        let mut started = Started::default();
        // A loss of whole images needs all tiles before the first gradient; the tiles are rendered once more on the way back.
        if let Back::Gmsd { images, saved: maps, d_response, d_rgb } = back {
            self.compare(b)?;
            gmsd::backward(b, images, 1.0, maps, loss, d_response, d_rgb)?;
        }
        for &tile in cut {
            match back {
                Back::PerPixel { kind, count, tile_target } => {
                    forward::render(b, network, saved, tile)?;
                    tile_ops::gather(b, tile, 4, target, tile_target)?;
                    let pixels = width * height;
                    image_loss::backward(b, kind, tile.rows, pixels, 1.0, saved.rgb(), tile_target, count, tile_d_rgb)?;
                }
                Back::Gmsd { d_rgb, .. } => {
                    if cut.len() > 1 {
                        forward::render(b, network, saved, tile)?;
                    }
                    tile_ops::gather(b, tile, 3, d_rgb, tile_d_rgb)?;
                }
            }
            backward::render(b, network, saved, scratch, tile, tile_d_rgb, false, &mut started)?;
            tile_ops::scatter(b, tile, 3, scratch.d_origin, d_origin)?;
            tile_ops::scatter(b, tile, 3, scratch.d_direction, d_direction)?;
        }
        let all = Rows { groups: hypotheses, rows_per_group: width * height, first_group: 0 };
        let pixels = Pixels { uv: network.uv, z0: network.z0, ..network.pixels(saved) };
        rays::backward(b, all, pixels, d_origin, d_direction, partial, d_matrix, false)?;
        if matches!(back, Back::PerPixel { .. }) {
            self.losses(b)?;
        }
        Ok(())
    }

    /// The paper's method.
    fn adam(&self, b: &mut Builder, learning_rate: f64) -> Result<Stages, PlanError> {
        let (poses, n) = (self.shape.hypotheses, self.shape.hypotheses as usize);
        let (scratch, back) = (Scratch::new(b, self.network, self.saved, Sums::default())?, self.back(b)?);
        let pose6 = b.input("pose6", 6 * n)?;
        let (d_pose6, d_matrix) = (b.scratch("d pose6", 6 * n)?, b.scratch("d world_from_camera", 12 * n)?);

        let compare = b.stage("compare");
        pose::forward(b, poses, pose6, self.network.world_from_camera)?;
        self.compare(b)?;

        let evaluate = b.stage("evaluate");
        pose::forward(b, poses, pose6, self.network.world_from_camera)?;
        self.differentiate(b, &scratch, back, d_matrix)?;
        pose::backward(b, poses, pose6, d_matrix, d_pose6)?;

        let descend = b.stage("descend");
        let schedule = b.input("schedule", 3)?;
        let moments = [b.input("m pose6", 6 * n)?, b.input("v pose6", 6 * n)?];
        adam::step(b, 6 * poses, d_pose6, schedule, pose6, moments[0], moments[1])?;
        let by = By::Adam { learning_rate, pose6, d_pose6, schedule, moments };
        Ok((compare, Some(Moves { evaluate, descend, by })))
    }

    /// BFGS. Its first evaluation is another stage, "begin": rays are independent, so one backward pass for each channel, begun with the
    /// same number for every ray, gives every ray's derivative of that channel, the rows of the Jacobian.
    fn bfgs(&self, b: &mut Builder, soft: f32, grain: f32) -> Result<Stages, PlanError> {
        let &Parts { network, saved, target, cut, comparison, shape: Shape { hypotheses, width, height, .. } } = self;
        let &Comparison { partial, loss, .. } = comparison;
        let (scratch, back) = (Scratch::new(b, network, saved, Sums::default())?, self.back(b)?);
        let Back::PerPixel { tile_target, .. } = back else { unreachable!("BFGS compares pixel by pixel") };
        let n = hypotheses as usize;
        let mut seed = |name: &str| b.input(name, 3 * saved.rows as usize);
        let seeds = [seed("seed of red")?, seed("seed of green")?, seed("seed of blue")?];
        let equations = b.scratch("equations", n * bfgs::EQUATIONS as usize)?;
        let (state, gradient) = (b.scratch("state", n * bfgs::STATE as usize)?, b.scratch("gradient", 6 * n)?);
        let d_matrix = b.scratch("d world_from_camera", 12 * n)?;

        let compare = b.stage("compare");
        self.compare(b)?;

        let begin = b.stage("begin");
        let mut started = Started::default();
        let residuals = Residuals {
            world_from_camera: network.world_from_camera,
            origin: saved.x[0],
            direction: saved.direction,
            d_origin: scratch.d_origin,
            d_direction: scratch.d_direction,
            sphere: network.ray_sphere,
            rgb: saved.rgb(),
            wanted: tile_target,
        };
        let scale = 1.0 / (3 * width * height) as f32;
        for &tile in cut {
            forward::render(b, network, saved, tile)?;
            tile_ops::gather(b, tile, 4, target, tile_target)?;
            for (number, d_rgb) in (0..).zip(seeds) {
                backward::render(b, network, saved, &scratch, tile, d_rgb, false, &mut started)?;
                let channel = Channel { number, seed: SEED, scale, soft };
                let accumulate = started.accumulate(equations, tile.rows.first_group);
                bfgs::equations(b, tile.rows, residuals, channel, partial, equations, accumulate)?;
            }
        }
        self.losses(b)?;
        bfgs::begin(b, hypotheses, equations, loss, network.world_from_camera, state)?;

        let evaluate = b.stage("evaluate");
        self.differentiate(b, &scratch, back, d_matrix)?;
        bfgs::gradient(b, hypotheses, network.world_from_camera, d_matrix, gradient)?;
        bfgs::update(b, hypotheses, gradient, loss, network.world_from_camera, state)?;

        let descend = b.stage("descend");
        bfgs::solve(b, hypotheses, grain, network.world_from_camera, state)?;
        let by = By::Bfgs { begin, equations, gradient, state, seeds };
        Ok((compare, Some(Moves { evaluate, descend, by })))
    }
}
