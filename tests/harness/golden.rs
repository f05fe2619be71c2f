//! Values that the authors' released code computed, against ours: every quantity of a file, on any engine.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;

use rand::RngExt;
use safetensors::tensor::{Dtype, SafeTensors};
use sigma_srn::camera::to_rows;
use sigma_srn::{Descent, Engine, Loss, Method, Model, Pose6, Rays, Shape, Train, Trainer, TrainingBatch, stream};
use srn_plan::Executor;

/// How far a quantity is from the golden value, relative to the tensor's largest value, and how far it may be.
#[derive(Clone, Debug)]
pub struct Figure {
    /// Name of the quantity; tensors of one kind share it.
    pub quantity: String,
    /// Worst relative difference.
    pub worst: f64,
    /// The tensor it was found in.
    pub tensor: String,
    /// Largest difference that passes.
    pub limit: f64,
    /// Where the limit was exceeded in `f32`: how far the `f64` oracle is off when all that is wrong with it is that every
    /// weight was moved to the next `f32`.
    pub conditioning: Option<f64>,
}

impl Figure {
    /// Whether the difference is within the limit, or within twice what weights one `f32` away make of `f64` arithmetic: where
    /// a hidden unit or a colour error is closer to its kink than that, `f32` decides by chance on which side it is, and a
    /// training or a refinement goes its own way from there.
    pub fn passes(&self) -> bool {
        self.worst <= self.limit.max(2.0 * self.conditioning.unwrap_or(0.0))
    }
}

impl fmt::Display for Figure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:<20} {:>9.1e} {:>9.0e}  {}", self.quantity, self.worst, self.limit, self.tensor)?;
        if let Some(conditioning) = self.conditioning {
            write!(f, "; f64 with weights one f32 away: {conditioning:.1e}")?;
        }
        if self.passes() { Ok(()) } else { write!(f, "  EXCEEDS ITS LIMIT") }
    }
}

/// Largest relative differences that pass.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Outputs and losses.
    pub output: f64,
    /// Gradients and trained parameters.
    pub gradient: f64,
    /// Along a refinement.
    pub refinement: f64,
}

impl Limits {
    /// For arithmetic in `f64`; the golden values are stored as `f32`.
    pub const F64: Limits = Limits { output: 1e-6, gradient: 1e-6, refinement: 1e-6 };
    /// For arithmetic in `f32`.
    pub const F32: Limits = Limits { output: 5e-5, gradient: 5e-4, refinement: 2e-3 };
}

/// Times that the weights are moved to find the conditioning of a quantity.
const TRIALS: u64 = 6;

struct Golden {
    path: String,
    tensors: BTreeMap<String, Vec<f32>>,
    index: Vec<u32>,
    model: Model,
    side: u32,
}

impl Golden {
    fn read(path: &Path) -> Result<Self, String> {
        let text = |error: &dyn fmt::Display| format!("{}: {error}", path.display());
        let bytes = std::fs::read(path).map_err(|error| text(&error))?;
        let model = Model::from_bytes(&bytes, "model.", path).map_err(|error| error.to_string())?;
        let file = SafeTensors::deserialize(&bytes).map_err(|error| text(&error))?;
        let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|error| text(&error))?;
        let side = header.metadata().as_ref().and_then(|data| data.get("side")).and_then(|side| side.parse().ok());
        let (mut tensors, mut index) = (BTreeMap::new(), Vec::new());
        for (name, view) in file.tensors() {
            let words = view.data().chunks_exact(4).map(|word| [word[0], word[1], word[2], word[3]]);
            match view.dtype() {
                Dtype::F32 => _ = tensors.insert(name, words.map(f32::from_le_bytes).collect()),
                Dtype::I32 if name == "in.instance_idx" => index = words.map(u32::from_le_bytes).collect(),
                other => return Err(text(&format!("tensor {name} has type {other:?}"))),
            }
        }
        let side = side.ok_or_else(|| text(&"metadata `side` is missing"))?;
        Ok(Golden { path: path.display().to_string(), tensors, index, model, side })
    }

    fn get(&self, name: &str) -> Result<&[f32], String> {
        self.tensors.get(name).map(Vec::as_slice).ok_or_else(|| format!("{}: tensor {name} is missing", self.path))
    }

    fn batch(&self) -> Result<TrainingBatch, String> {
        let intrinsics = self.get("in.intrinsics")?.chunks_exact(16);
        Ok(TrainingBatch {
            instances: self.index.clone(),
            rays: Rays {
                // Not `in.cam2world`, which was rounded to f32 after the golden values were computed from it.
                world_from_camera: self.poses("in.pose6")?.iter().map(|pose| to_rows(&pose.to_matrix())).collect(),
                intrinsics: intrinsics.map(|k| [k[0], k[5], k[2], k[6]]).collect(),
                uv: self.get("in.uv")?.to_vec(),
                z0: self.get("in.initial_depth")?.to_vec(),
            },
            target_rgb: self.get("in.target_rgb")?.to_vec(),
            weights: None,
        })
    }

    fn images(&self) -> u32 {
        self.index.len() as u32
    }

    /// Moves every weight to the next `f32`, up or down.
    fn move_weights(&mut self, seed: u64) {
        let mut random = stream(seed, 0);
        for value in self.model.parameters.iter_mut().flat_map(|parameter| &mut parameter.values) {
            *value = if random.random() { value.next_up() } else { value.next_down() };
        }
    }

    fn poses(&self, name: &str) -> Result<Vec<Pose6>, String> {
        Ok(self.get(name)?.chunks_exact(6).map(|pose| Pose6(std::array::from_fn(|k| pose[k].into()))).collect())
    }
}

/// Collects the worst figure of each quantity.
struct Report<'a> {
    golden: &'a Golden,
    limits: Limits,
    figures: Vec<Figure>,
}

impl Report<'_> {
    /// Compares `got` with the golden tensor `name`.
    fn compare(&mut self, quantity: &str, name: &str, got: &[f32], limit: f64) -> Result<(), String> {
        let want = self.golden.get(name)?;
        if got.len() != want.len() {
            return Err(format!("{}: {name} has {} values, got {}", self.golden.path, want.len(), got.len()));
        }
        let worst = relative_difference(got, want);
        match self.figures.iter_mut().find(|figure| figure.quantity == quantity) {
            Some(figure) if figure.worst >= worst => {}
            Some(figure) => (figure.worst, figure.tensor) = (worst, name.into()),
            None => {
                let figure = Figure { quantity: quantity.into(), worst, tensor: name.into(), limit, conditioning: None };
                self.figures.push(figure);
            }
        }
        Ok(())
    }

    fn error(&self, error: sigma_srn::Error) -> String {
        format!("{}: {error}", self.golden.path)
    }
}

/// Largest difference over the largest golden value; infinite where anything is not finite.
fn relative_difference(got: &[f32], want: &[f32]) -> f64 {
    let scale = want.iter().fold(0.0f64, |most, &value| most.max(f64::from(value).abs()));
    let mut worst = 0.0f64;
    for (&got, &want) in got.iter().zip(want) {
        let difference = (f64::from(got) - f64::from(want)).abs();
        worst = if difference.is_finite() { worst.max(difference) } else { f64::INFINITY };
    }
    if worst == 0.0 { 0.0 } else { worst / scale }
}

/// Computes everything that the file holds and returns the worst figure per quantity.
pub fn check(engine: &Engine, path: &Path, limits: Limits) -> Result<Vec<Figure>, String> {
    check_all(engine, Golden::read(path)?, limits)
}

/// The same with the weights from elsewhere.
pub fn check_model(engine: &Engine, path: &Path, model: Model, limits: Limits) -> Result<Vec<Figure>, String> {
    check_all(engine, Golden { model, ..Golden::read(path)? }, limits)
}

fn check_all(engine: &Engine, mut golden: Golden, limits: Limits) -> Result<Vec<Figure>, String> {
    let mut figures = measure(engine, &golden, limits)?;
    if limits.output > Limits::F64.output && figures.iter().any(|figure| !figure.passes()) {
        let exact = golden.model.parameters.clone();
        for seed in 0..TRIALS {
            golden.model.parameters.clone_from(&exact);
            golden.move_weights(seed);
            for (figure, moved) in figures.iter_mut().zip(measure(&Engine::cpu_f64(), &golden, limits)?) {
                if figure.worst > figure.limit {
                    figure.conditioning = Some(moved.worst.max(figure.conditioning.unwrap_or(0.0)));
                }
            }
        }
    }
    Ok(figures)
}

fn measure(engine: &Engine, golden: &Golden, limits: Limits) -> Result<Vec<Figure>, String> {
    let mut report = Report { golden, limits, figures: Vec::new() };
    outputs_and_gradients(engine, &mut report)?;
    training(engine, &mut report)?;
    pose_gradients(engine, &mut report)?;
    refinement(engine, &mut report)?;
    Ok(report.figures)
}

/// A buffer of the running plan, by name.
pub fn read(executor: &mut dyn Executor, name: &str) -> Result<Vec<f32>, String> {
    let id = executor.plan().find(name).ok_or_else(|| format!("no buffer is called `{name}`"))?;
    executor.read(id).map_err(|error| error.to_string())
}

fn trainer(engine: &Engine, report: &Report, train: Train) -> Result<Trainer, String> {
    let golden = report.golden;
    let rays = golden.side * golden.side;
    Trainer::new(engine, golden.model.clone(), train, golden.images(), rays).map_err(|error| report.error(error))
}

fn outputs_and_gradients(engine: &Engine, report: &mut Report) -> Result<(), String> {
    let (golden, limit) = (report.golden, report.limits.output);
    // One tile for everything, so that the buffers of the tile hold the whole batch.
    let mut trainer = trainer(&engine.clone().with_tile_rows(u32::MAX), report, Train::Everything)?;
    trainer.gradients(&golden.batch()?).map_err(|error| report.error(error))?;
    let losses = trainer.losses().map_err(|error| report.error(error))?;
    for (name, value) in [("image", losses.image), ("latent", losses.latent), ("depth", losses.depth), ("total", losses.total())]
    {
        report.compare("losses", &format!("loss.{name}"), &[value as f32], limit)?;
    }
    let layout = &golden.model.layout;
    let points = layout.tracing_steps as usize + 1;
    let executor = trainer.executor();
    let mut series = |name: &dyn Fn(usize) -> String| -> Result<Vec<f32>, String> {
        Ok((0..points).map(|point| read(executor, &name(point))).collect::<Result<Vec<_>, _>>()?.concat())
    };
    report.compare("points", "out.points", &series(&|i| format!("x[{i}]"))?, limit)?;
    let mut feature = format!("f[{}].{} y", points - 1, layout.scene.len() - 1);
    if let Some(density) = &layout.density {
        report.compare("densities", "out.sigma", &series(&|i| format!("g[{i}].{} y", density.len() - 1))?, limit)?;
        feature = "phi".into();
    }
    for (quantity, name, buffer) in
        [("features", "out.feature", feature.as_str()), ("rgb", "out.rgb", "rgb"), ("depth", "out.depth", "depth")]
    {
        report.compare(quantity, name, &read(executor, buffer)?, limit)?;
    }
    for (name, values) in trainer.read_gradients().map_err(|error| report.error(error))? {
        report.compare("parameter gradients", &format!("grad.{name}"), &values, report.limits.gradient)?;
    }
    Ok(())
}

fn training(engine: &Engine, report: &mut Report) -> Result<(), String> {
    let golden = report.golden;
    for (kind, train, learning_rate) in [("train", Train::Everything, 5e-5), ("embed", Train::Codes, 1e-3)] {
        let mut trainer = trainer(engine, report, train)?;
        let mut totals = Vec::new();
        for _ in golden.get(&format!("{kind}.losses"))? {
            trainer.step(&golden.batch()?, learning_rate).map_err(|error| report.error(error))?;
            totals.push(trainer.losses().map_err(|error| report.error(error))?.total() as f32);
        }
        report.compare(&format!("{kind} losses"), &format!("{kind}.losses"), &totals, report.limits.output)?;
        let model = trainer.model().map_err(|error| report.error(error))?;
        for (name, _, values) in model.tensors() {
            let name = format!("{kind}.final.{name}");
            if golden.tensors.contains_key(&name) {
                report.compare(&format!("{kind} parameters"), &name, values, report.limits.gradient)?;
            }
        }
    }
    Ok(())
}

fn descent(engine: &Engine, report: &Report, loss: Loss, learning_rate: f64, start: &str) -> Result<Descent, String> {
    let golden = report.golden;
    let images = golden.images();
    let shape = Shape { hypotheses: images, width: golden.side, height: golden.side, instances: images };
    let slots: Vec<u32> = (0..images).collect();
    let batch = golden.batch()?;
    let ready = || {
        let mut descent = Descent::new(engine, &golden.model, shape, Method::Adam { loss, learning_rate })?;
        descent.set_targets(&golden.index, &slots, &batch.rays, &batch.target_rgb, None)?;
        Ok(descent)
    };
    let mut descent = ready().map_err(|error| report.error(error))?;
    descent.set_poses(&golden.poses(start)?).map_err(|error| report.error(error))?;
    Ok(descent)
}

fn pose_gradients(engine: &Engine, report: &mut Report) -> Result<(), String> {
    let kinds = [Loss::Mae, Loss::Mse, Loss::Gmsd, Loss::NormL1, Loss::NormL2];
    for (name, loss) in ["mae", "mse", "gmsd", "norm_l1", "norm_l2"].into_iter().zip(kinds) {
        let mut descent = descent(engine, report, loss, 0.1, "in.pose6")?;
        descent.evaluate().map_err(|error| report.error(error))?;
        let losses: Vec<f32> = descent.losses().map_err(|error| report.error(error))?.iter().map(|&loss| loss as f32).collect();
        report.compare("pose losses", &format!("pose.{name}.loss"), &losses, report.limits.output)?;
        let gradients = descent.gradients().map_err(|error| report.error(error))?;
        let gradients: Vec<f32> = gradients.as_flattened().iter().map(|&d| d as f32).collect();
        report.compare("pose gradients", &format!("pose.{name}.grad"), &gradients, report.limits.gradient)?;
    }
    Ok(())
}

fn refinement(engine: &Engine, report: &mut Report) -> Result<(), String> {
    for learning_rate in ["0.1", "0.01"] {
        let tensor = |part: &str| format!("refine.lr{learning_rate}.{part}");
        let rate = learning_rate.parse().map_err(|error| format!("{learning_rate}: {error}"))?;
        let mut descent = descent(engine, report, Loss::Mae, rate, &tensor("start"))?;
        let steps = report.golden.get(&tensor("losses"))?.len() / report.golden.images() as usize;
        let (mut losses, mut path) = (Vec::new(), Vec::new());
        for _ in 0..steps {
            descent.evaluate().map_err(|error| report.error(error))?;
            losses.extend(descent.losses().map_err(|error| report.error(error))?.into_iter().map(|loss| loss as f32));
            descent.descend().map_err(|error| report.error(error))?;
            path.extend(descent.poses().map_err(|error| report.error(error))?.into_iter().flat_map(Pose6::to_f32));
        }
        report.compare("refinement losses", &tensor("losses"), &losses, report.limits.refinement)?;
        report.compare("refinement poses", &tensor("poses"), &path, report.limits.refinement)?;
    }
    Ok(())
}
