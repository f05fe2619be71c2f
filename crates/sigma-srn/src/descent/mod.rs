//! One step of pose estimation for many hypotheses at once: render, compare, move. Two ways to move: the paper's (spec 4), Adam
//! on the camera's six numbers; and BFGS over motions about the object, begun from the residuals of all rays.

mod plan;

use std::iter::zip;

use srn_plan::ops::{adam, bfgs, image_loss};
use srn_plan::{Executor, StageId};

use self::plan::{By, Handles, SEED, build};
use crate::camera::{Pose6, from_rows, to_rows};
use crate::engine::{Engine, Runner};
use crate::model::Model;
use crate::network::streamed::OnHost;
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
        if let Method::Bfgs { soft, grain } = method {
            let is_length = |value: f32| (0.0..f32::INFINITY).contains(&value);
            if !(is_length(soft) && soft > 0.0 && is_length(grain)) {
                let what = format!("BFGS needs soft above 0 and a grain of at least 0, both finite, got {soft} and {grain}");
                return Err(Error::Setting { field: "method", what });
            }
        }
        let rows = Engine::rows([hypotheses, width, height])?;
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
            Runner::Gpu(executor) => Ok(Some(executor.profile(&[stage])?)),
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
