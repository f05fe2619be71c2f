//! `sigma-train fit`: a run, its folder, and how it goes on after a stop.
//!
//! A run's folder: `config.json` (all settings), `metrics.jsonl`, `samples/step_NNNNNN.png` (target, rendering, depth),
//! `checkpoint.safetensors` (model and moments), in the end `model.safetensors` and `curves.png`. Metrics are written before the
//! checkpoint; on resuming, lines behind the checkpoint's step are dropped, and those steps are done again. `lock` is held by who trains.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::Args;
use image::RgbImage;
use indicatif::ProgressBar;
use rand::RngExt;
use serde::{Deserialize, Serialize};
use sigma_srn::confidence::UNEXPLAINED;
use sigma_srn::{Engine, Losses, Metadata, Model, Random, Renderer, Train, Trainer, stream, unexplained, write_atomically};
use srn_data::{Dataset, SrnSet, pixels, sheet};

use super::{Changeable, ForGood, Preset, Settings, Shown, psnr_of_each, render, training_batch};
use crate::common::{self, EngineArgs, Result, load_model, print, spread, write_picture};
use crate::progress;

/// Time between checkpoints.
const CHECKPOINT_INTERVAL: Duration = Duration::from_secs(60);
/// Time after which the loss on the terminal is old.
const STALE: Duration = Duration::from_secs(2);
/// Instances, and views of each, at which a trained model is looked at, at most.
const LOOKED_AT: usize = 24;
/// Radius of the ball around the object, object units.
const BALL: f64 = 0.5;

/// Flags of `sigma-train fit`.
#[derive(Args, Debug)]
#[command(override_usage = "sigma-train fit --data <DIR> --out <RUN> [OPTIONS]\n       sigma-train fit --resume <RUN> [OPTIONS]")]
pub struct FitArgs {
    /// Folder of the run, made here: model, checkpoint, metrics, sample images.
    #[arg(long, value_name = "RUN", required_unless_present = "resume")]
    out: Option<PathBuf>,
    /// Go on with the run in this folder, with its own settings and to the same numbers.
    #[arg(long, value_name = "RUN", conflicts_with = "out")]
    resume: Option<PathBuf>,
    #[command(flatten)]
    changeable: Changeable,
    #[command(flatten)]
    for_good: ForGood,
    #[command(flatten)]
    engine: EngineArgs,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
}

/// The error of a new run where there is something already.
fn is_there(run: &Path) -> String {
    format!("{}: not empty, nothing was overwritten; --resume goes on with a run", run.display())
}

/// Trains; false if it was stopped before the end.
pub fn fit(args: &FitArgs) -> Result<bool> {
    let is_resumed = args.resume.is_some();
    let run = args.resume.as_ref().or(args.out.as_ref()).ok_or("--out or --resume is needed")?;
    // Held to the end. What is no run gets no lock.
    let mut held = None;
    if is_resumed {
        Settings::read(run)?;
        held = Some(lock(run)?);
    }
    let mut settings = if is_resumed {
        let mut settings = Settings::read(run)?;
        settings.change(&args.changeable);
        settings
    } else {
        if fs::read_dir(run).is_ok_and(|mut files| files.next().is_some()) {
            return Err(is_there(run).into());
        }
        Settings::new(&args.for_good, &args.changeable)?
    };
    let set = load(&settings.data, settings.side, settings.views)?;
    let instances: BTreeMap<_, _> = set.instances.iter().map(|i| (i.name.clone(), i.views.len())).collect();
    if is_resumed && instances != settings.instances {
        let what = "other instances or numbers of views than this run began with";
        return Err(format!("{}: {what}", settings.data.display()).into());
    }
    settings.instances = instances;
    let validation = settings.validation.as_ref().map(|dir| load(dir, settings.side, None)).transpose()?;
    let watched = watched_views(&set, validation.as_ref(), settings.validation_views as usize)?;
    let engine = if is_resumed { args.engine.open_like(&settings.executor, settings.memory)? } else { args.engine.open()? };

    let instance_names: Vec<String> = set.instances.iter().map(|instance| instance.name.clone()).collect();
    let checkpoint = run.join("checkpoint.safetensors");
    // A run that was killed before its first checkpoint begins again.
    let has_checkpoint = is_resumed && checkpoint.exists();
    let mut model = match settings.from.clone() {
        Some(from) => begin_with(if has_checkpoint { &checkpoint } else { &from }, &mut settings, &instance_names)?,
        None => Model::init(&settings.model(), settings.seed)?,
    };
    let (orbit_radius, distances) = distances(&set);
    if !is_resumed {
        // What networks have learnt already they know from where their rays began.
        let Metadata { ray_sphere, orbit_radius: trained, .. } = model.metadata;
        let is_paper = args.for_good.preset == Some(Preset::Paper);
        // None where cameras are within the object.
        let wanted = trained.or(Some(orbit_radius)).filter(|radius| !is_paper && *radius > BALL);
        settings.ray_sphere = ray_sphere.or(wanted);
    }
    model.metadata = Metadata {
        instance_names,
        side: Some(settings.side),
        orbit_radius: Some(orbit_radius),
        ray_sphere: settings.ray_sphere,
        distances: Some(distances),
        // How well it shows what it has learnt is known in the end.
        unexplained: BTreeMap::new(),
        calibration: None,
        calibration_of_new: None,
    };
    let mut trainer = Trainer::new(&engine, model, Train::Everything, settings.batch, settings.rays)?;
    if has_checkpoint {
        trainer.load_checkpoint(&checkpoint)?;
    }
    if trainer.steps() > settings.steps {
        return Err(format!("--steps {}: the run has done {} already", settings.steps, trainer.steps()).into());
    }
    // Whether there is memory to look at views, too, is found out before anything is written.
    Renderer::new(&engine, trainer.model()?, watched.len() as u32, settings.side, settings.side)?;
    fs::create_dir_all(run).map_err(|error| format!("{}: {error}", run.display()))?;
    if !is_resumed {
        held = Some(lock(run)?);
        // Another may have begun, and ended, since this one looked.
        if Settings::is_in(run) {
            return Err(is_there(run).into());
        }
    }
    // Now that it is known whether a GPU is believed.
    (settings.executor, settings.memory) = (engine.to_string(), engine.budget());
    settings.write(run)?;
    let samples = run.join("samples");
    fs::create_dir_all(&samples).map_err(|error| format!("{}: {error}", samples.display()))?;
    let mut metrics = Metrics::open(run.join("metrics.jsonl"), trainer.steps())?;

    if is_resumed {
        eprintln!("going on after step {}", trainer.steps());
    }
    if trainer.bytes_on_host() > 0 {
        let (on_host, budget) = (trainer.bytes_on_host() >> 20, engine.budget() >> 20);
        eprintln!(
            "{on_host} MiB of weights stay on the host and come to the device in parts, for the memory budget of {budget} MiB"
        );
    }
    let stop = stop_on_signal()?;
    let mut meter = Meter::new(&settings, trainer.steps(), metrics.last().map_or(0.0, |record| record.seconds));
    let mut checkpointed = Instant::now();
    while trainer.steps() < settings.steps && !stop.load(Ordering::SeqCst) {
        let step = trainer.steps() + 1;
        let learning_rate = settings.learning_rate(step);
        // Everything random comes from seed and step: a resumed run needs no memory of it.
        let mut random = stream(settings.seed, step);
        let views = draw_views(&set, settings.batch, &mut random);
        trainer.step(&training_batch(&views, settings.side, settings.rays, settings.detail, &mut random), learning_rate)?;
        meter.bar.inc(1);

        let is_due = |every: u64| step.is_multiple_of(every) || step == settings.steps;
        let is_logged = is_due(settings.log_every) || is_due(settings.validate_every);
        // Reading waits for the device, so not every step.
        if is_logged || meter.is_stale() {
            let losses = trainer.losses()?;
            let rays_per_second = meter.rays_per_second(step);
            if is_logged {
                let mut record = Record::new(step, &losses, learning_rate, meter.seconds());
                if is_due(settings.validate_every) {
                    let (psnr, picture) = look(&engine, trainer.model()?, &watched, settings.side, orbit_radius)?;
                    let path = samples.join(format!("step_{step:06}.png"));
                    write_picture(&path, &picture)?;
                    record.validation_psnr = Some(psnr);
                }
                metrics.push(record)?;
            }
            meter.show(step, &losses, rays_per_second, metrics.validation_psnr());
        }
        if checkpointed.elapsed() > CHECKPOINT_INTERVAL || settings.checkpoint_every.is_some_and(is_due) {
            save_checkpoint(&mut trainer, &metrics, &checkpoint)?;
            checkpointed = Instant::now();
        }
    }
    meter.bar.finish_and_clear();
    save_checkpoint(&mut trainer, &metrics, &checkpoint)?;
    if trainer.steps() < settings.steps {
        eprintln!("stopped after step {}; to go on: sigma-train fit --resume {}", trainer.steps(), run.display());
        return Ok(false);
    }

    let mut trained = trainer.model()?.clone();
    trained.metadata.unexplained =
        unexplained_at_truth(&engine, &trained, &set, validation.as_ref(), settings.side, watched.len())?;
    let is_much = |(_, part): &(&String, &f64)| **part > UNEXPLAINED;
    let much: Vec<String> = (trained.metadata.unexplained.iter().filter(is_much))
        .map(|(name, part)| format!("{name} ({:.0} %)", 100.0 * part))
        .collect();
    if !much.is_empty() {
        let what = "much of the pictures is not explained by the model's views, so few poses will be trusted";
        eprintln!("warning: {what}: {}; train longer, or go on from a trained model (--from)", much.join(", "));
    }
    let model = run.join("model.safetensors");
    trained.save(&model)?;
    let curves = run.join("curves.png");
    write_picture(&curves, &metrics.curves())?;
    let (steps, psnr) = (trainer.steps(), metrics.validation_psnr());
    let which = if validation.is_some() { "unseen" } else { "training" };
    drop(held);
    if args.json {
        let result = serde_json::json!({ "model": model, "steps": steps, "views": which, "validation_psnr": psnr });
        print(&format!("{result:#}"))?;
    } else {
        print(&format!("PSNR {:.2} dB on {} {which} views after {steps} steps", psnr.unwrap_or(f64::NAN), watched.len()))?;
        print(&format!("model: {}", model.display()))?;
    }
    Ok(true)
}

/// Only one process trains a run.
fn lock(run: &Path) -> Result<File> {
    common::lock(&run.join("lock"), &format!("{}: another fit is training it", run.display()))
}

/// Reads a set, the first `views` of each instance.
fn load(dir: &Path, side: u32, views: Option<usize>) -> Result<Dataset> {
    let mut set = SrnSet::open(dir)?;
    for instance in &mut set.instances {
        instance.views.truncate(views.unwrap_or(usize::MAX));
    }
    Ok(set.load(side as usize)?)
}

/// The networks of a trained model with new codes, and its sizes in the settings.
fn begin_with(path: &Path, settings: &mut Settings, instance_names: &[String]) -> Result<Model> {
    let of_file = |error| common::about_model(path, error);
    let model = load_model(path)?.with_new_instances(instance_names.to_vec()).map_err(of_file)?;
    settings.hidden = model.layout.features();
    settings.latent = model.hypernetwork().map_err(of_file)?.latent;
    settings.tracing_steps = model.layout.tracing_steps;
    settings.density = model.layout.density.is_some();
    Ok(model)
}

/// Random instances, and of each a random view.
fn draw_views<'a>(set: &'a Dataset, count: u32, random: &mut Random) -> Vec<Shown<'a>> {
    (0..count)
        .map(|_| {
            let instance = random.random_range(0..set.instances.len());
            let views = &set.instances[instance].views;
            (instance as u32, &views[random.random_range(0..views.len())])
        })
        .collect()
}

/// The views of a validation: from every instance in turn, spread over its views.
fn watched_views<'a>(set: &'a Dataset, validation: Option<&'a Dataset>, count: usize) -> Result<Vec<Shown<'a>>> {
    let from = validation.unwrap_or(set);
    let number = |name: &str| set.instances.iter().position(|known| known.name == name);
    (0..count)
        .map(|k| {
            let instance = &from.instances[k % from.instances.len()];
            let number = number(&instance.name)
                .ok_or_else(|| format!("--validation: instance `{}` is not in the training set", instance.name))?;
            Ok((number as u32, &instance.views[k * instance.views.len() / count]))
        })
        .collect()
}

/// What true poses leave unexplained, see [`Metadata::unexplained`]: of the validation's pictures where there are any, `at_once` of them at a time.
fn unexplained_at_truth(
    engine: &Engine,
    model: &Model,
    set: &Dataset,
    validation: Option<&Dataset>,
    side: u32,
    at_once: usize,
) -> Result<BTreeMap<String, f64>> {
    let mut all = BTreeMap::new();
    let instances = spread((0..set.instances.len()).collect(), LOOKED_AT);
    let bar = progress::bar(instances.len() as u64, "looking at views");
    for number in instances {
        let instance = &set.instances[number];
        let unseen = validation.iter().flat_map(|set| &set.instances).find(|other| other.name == instance.name);
        let views = spread(unseen.unwrap_or(instance).views.iter().collect(), LOOKED_AT);
        let views: Vec<Shown> = views.into_iter().map(|view| (number as u32, view)).collect();
        let mut parts = Vec::new();
        for views in views.chunks(at_once) {
            let rendering = render(engine, model, views, side)?;
            let pictures = rendering.rgb.chunks(rendering.rgb.len() / views.len());
            parts.extend(pictures.zip(views).map(|(picture, (_, view))| unexplained(&view.rgb, None, picture)));
        }
        // A white picture leaves nothing to explain.
        parts.retain(|part| part.is_finite());
        parts.sort_by(f64::total_cmp);
        // Masks and cameras of a tenth may be wrong.
        if let Some(&most) = parts.get((9 * parts.len() / 10).saturating_sub(1)) {
            all.insert(instance.name.clone(), most);
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(all)
}

/// Distances of the cameras to the origin: the median, and the nearest and the farthest.
fn distances(set: &Dataset) -> (f64, [f64; 2]) {
    let cameras = set.instances.iter().flat_map(|instance| &instance.views).map(common::camera);
    let mut distances: Vec<f64> = cameras.map(|(pose, _)| pose.w_axis.truncate().length()).collect();
    distances.sort_by(f64::total_cmp);
    // One camera in a hundred may be a mistake.
    let few = distances.len() / 100;
    (distances[distances.len() / 2], [distances[few], distances[distances.len() - 1 - few]])
}

/// Mean PSNR over the views, and a picture of them: target, rendering and depth side by side.
fn look(engine: &Engine, model: &Model, views: &[Shown], side: u32, distance: f64) -> Result<(f64, RgbImage)> {
    let rendering = render(engine, model, views, side)?;
    let psnr = psnr_of_each(&rendering, views);
    // Large enough for the labels.
    let picture = |rgb: &[f32]| sheet::enlarge(&pixels::rgb8(rgb, side as usize, side as usize), 96u32.div_ceil(side));
    let depth_picture = |depth| sheet::enlarge(&common::depth_picture(depth, side, distance), 96u32.div_ceil(side));
    let count = (side * side) as usize;
    let mut cells = vec![];
    for (k, &(instance, view)) in views.iter().enumerate() {
        cells.push((picture(&view.rgb), model.instance_name(instance)));
        cells.push((picture(&rendering.rgb[3 * k * count..][..3 * count]), format!("{:.1} dB", psnr[k])));
        cells.push((depth_picture(&rendering.depth[k * count..][..count]), "depth".into()));
    }
    let cells: Vec<_> = cells.iter().map(|(picture, label)| (picture, label.as_str())).collect();
    Ok((psnr.iter().sum::<f64>() / psnr.len() as f64, sheet::grid(&cells, 6)))
}

/// Metrics first: a checkpoint's steps must all be in them.
fn save_checkpoint(trainer: &mut Trainer, metrics: &Metrics, path: &Path) -> Result<()> {
    metrics.sync()?;
    Ok(trainer.save_checkpoint(path)?)
}

/// A flag that Ctrl-C raises; the second one ends the process at once.
fn stop_on_signal() -> Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let raised = stop.clone();
    ctrlc::set_handler(move || {
        if raised.swap(true, Ordering::SeqCst) {
            std::process::exit(1);
        }
    })?;
    Ok(stop)
}

/// A line of `metrics.jsonl`.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Record {
    step: u64,
    /// The weighted sum of the three terms that follow, on the step's batch.
    loss: f64,
    image: f64,
    latent: f64,
    depth: f64,
    psnr: f64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    validation_psnr: Option<f64>,
    learning_rate: f64,
    /// Time since the beginning, without the time between the parts of a run.
    seconds: f64,
}

impl Record {
    fn new(step: u64, losses: &Losses, learning_rate: f64, seconds: f64) -> Self {
        let Losses { image, latent, depth } = *losses;
        let (loss, psnr) = (losses.total(), losses.psnr());
        Record { step, loss, image, latent, depth, psnr, validation_psnr: None, learning_rate, seconds }
    }
}

/// `metrics.jsonl`, on disk and in memory.
struct Metrics {
    path: PathBuf,
    file: File,
    records: Vec<Record>,
}

impl Metrics {
    /// Opens or makes the file; lines behind `step`, and one cut short by a crash, are dropped.
    fn open(path: PathBuf, step: u64) -> Result<Self> {
        let text = match fs::read(&path) {
            Err(error) if error.kind() == ErrorKind::NotFound => String::new(),
            bytes => String::from_utf8_lossy(&bytes.map_err(|error| format!("{}: {error}", path.display()))?).into_owned(),
        };
        let records = text.lines().filter_map(|line| serde_json::from_str(line).ok());
        let records: Vec<Record> = records.filter(|record: &Record| record.step <= step).collect();
        let lines = records.iter().map(|record| Ok(serde_json::to_string(record)? + "\n")).collect::<Result<String>>()?;
        write_atomically(&path, lines.as_bytes())?;
        let file = OpenOptions::new().append(true).open(&path).map_err(|error| format!("{}: {error}", path.display()))?;
        Ok(Metrics { path, file, records })
    }

    fn push(&mut self, record: Record) -> Result<()> {
        let line = serde_json::to_string(&record)? + "\n";
        self.file.write_all(line.as_bytes()).map_err(|error| format!("{}: {error}", self.path.display()))?;
        self.records.push(record);
        Ok(())
    }

    fn sync(&self) -> Result<()> {
        self.file.sync_data().map_err(|error| format!("{}: {error}", self.path.display()).into())
    }

    fn last(&self) -> Option<&Record> {
        self.records.last()
    }

    /// The latest there is.
    fn validation_psnr(&self) -> Option<f64> {
        self.records.iter().rev().find_map(|record| record.validation_psnr)
    }

    /// Loss and PSNR over the steps.
    fn curves(&self) -> RgbImage {
        let points = |value: &dyn Fn(&Record) -> Option<f64>| -> Vec<(f64, f64)> {
            self.records.iter().filter_map(|record| Some((record.step as f64, value(record)?))).collect()
        };
        let curve = |label, points, number: usize| sheet::Curve { label, points, colour: sheet::CURVES[number] };
        let loss = points(&|record| Some(record.loss));
        let [training, validation] = [points(&|record| Some(record.psnr)), points(&|record| record.validation_psnr)];
        let size = [800, 400];
        let loss = sheet::plot_curve("loss", &[curve("", &loss, 0)], size, [false, true]);
        let psnr = [curve("training batch", &training, 0), curve("validation", &validation, 1)];
        sheet::grid(&[(&loss, ""), (&sheet::plot_curve("PSNR (dB)", &psnr, size, [false; 2]), "")], 1)
    }
}

/// Progress on stderr.
struct Meter {
    bar: ProgressBar,
    rays_per_step: u64,
    start: Instant,
    seconds_before: f64,
    /// Step and time from which the speed is measured.
    since: (u64, Instant),
    /// Mean of the image loss over about the last ten readings, and their number.
    image_loss: (f64, u32),
}

impl Meter {
    fn new(settings: &Settings, step: u64, seconds_before: f64) -> Self {
        let bar = progress::bar(settings.steps, "training").with_position(step);
        bar.reset_eta();
        let now = Instant::now();
        Meter {
            bar,
            rays_per_step: u64::from(settings.batch) * u64::from(settings.rays),
            start: now,
            seconds_before,
            since: (step, now),
            image_loss: (0.0, 0),
        }
    }

    /// Time of training up to now, over all parts of the run.
    fn seconds(&self) -> f64 {
        self.seconds_before + self.start.elapsed().as_secs_f64()
    }

    /// Rays per second since the last call of [`Meter::show`].
    fn rays_per_second(&self, step: u64) -> f64 {
        ((step - self.since.0) * self.rays_per_step) as f64 / self.since.1.elapsed().as_secs_f64()
    }

    fn is_stale(&self) -> bool {
        self.since.1.elapsed() > STALE
    }

    fn show(&mut self, step: u64, losses: &Losses, rays_per_second: f64, validation_psnr: Option<f64>) {
        let (mean, readings) = self.image_loss;
        let image = mean + (losses.image - mean) / f64::from(readings + 1).min(10.0);
        self.image_loss = (image, readings + 1);
        let psnr = Losses { image, ..*losses }.psnr();
        let validation = validation_psnr.map_or(String::new(), |psnr| format!(", validation {psnr:.2} dB"));
        let message = format!("loss {:.3}, PSNR {psnr:.2} dB{validation}, {rays_per_second:.0} rays/s", losses.total());
        self.bar.set_message(message);
        self.since = (step, Instant::now());
    }
}
