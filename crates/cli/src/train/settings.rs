//! Settings of a training run: presets, flags over them, and the `config.json` that a run keeps.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use serde::{Deserialize, Serialize};
use sigma_srn::{ModelConfig, write_atomically};

use crate::common::Result;

/// What a run was begun with, in its folder.
const CONFIG: &str = "config.json";

/// Everything that decides the numbers of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// Training set: a folder of SRN instance folders.
    pub data: PathBuf,
    /// Set of unseen views of the same instances; training views are looked at where there is none.
    pub validation: Option<PathBuf>,
    /// Name and number of views of each instance, so that a resumed run notices another set.
    pub instances: BTreeMap<String, usize>,
    /// The model whose networks this one began with; sizes are its own.
    #[serde(default)]
    pub from: Option<PathBuf>,
    /// Features of the networks.
    pub hidden: u32,
    /// Length of a latent code.
    pub latent: u32,
    /// Marching steps M.
    pub tracing_steps: u32,
    /// False: plain SRN, without the density net.
    pub density: bool,
    /// Radius of the sphere on which rays begin; without it, at the camera.
    #[serde(default)]
    pub ray_sphere: Option<f64>,
    /// Side of the images in pixels.
    pub side: u32,
    /// Views of an instance at most.
    pub views: Option<usize>,
    /// Images per step.
    pub batch: u32,
    /// Rays per image.
    pub rays: u32,
    /// Part of the rays drawn where a picture is not of one colour.
    #[serde(default)]
    pub detail: f64,
    /// Number of steps.
    pub steps: u64,
    /// Learning rate of Adam.
    pub lr: f64,
    /// Steps over which the learning rate rises to it.
    #[serde(default)]
    pub warm_up: u64,
    /// Factor on the learning rate at the last step.
    pub decay: f64,
    /// The last step at the full learning rate; it falls evenly after that.
    pub decay_from: u64,
    /// Decides everything random.
    pub seed: u64,
    /// Steps between lines of `metrics.jsonl`.
    pub log_every: u64,
    /// Steps between validations.
    pub validate_every: u64,
    /// Views of a validation.
    pub validation_views: u32,
    /// Steps between checkpoints; besides, there is one every minute.
    pub checkpoint_every: Option<u64>,
    /// The executor, and its memory budget in bytes: both decide the order of sums.
    pub executor: String,
    /// See `executor`.
    pub memory: u64,
}

/// Starting points for the settings.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Preset {
    /// Trains in under two hours on two CPU cores: small networks, random rays.
    #[default]
    Compact,
    /// Twice as wide, for sets of many or fine objects: each step takes about three times as long.
    Base,
    /// The paper's: 256 features, batches of 10 whole images at 5e-5, at most 50 views of an instance, rays that begin at the camera.
    Paper,
}

/// Flags that a run keeps for good.
#[derive(Args, Clone, Debug)]
#[group(conflicts_with = "resume")]
pub struct ForGood {
    /// Starting point for all numbers.
    #[arg(long, value_enum)]
    pub preset: Option<Preset>,
    /// Begin with the networks of this trained model, whatever it was trained on, and with the mean of its codes: fewer steps will do. Sizes
    /// are the model's.
    #[arg(long, value_name = "MODEL", conflicts_with_all = ["hidden", "latent", "tracing_steps", "plain_srn"])]
    from: Option<PathBuf>,
    /// Features of the networks [compact 64, base 128, paper 256].
    #[arg(long, value_name = "N", value_parser = up_to(4096))]
    hidden: Option<u32>,
    /// Length of a latent code [compact 32, base 64, paper 256].
    #[arg(long, value_name = "N", value_parser = up_to(4096))]
    latent: Option<u32>,
    /// Marching steps along a ray [10].
    #[arg(long, value_name = "N", value_parser = up_to(1000))]
    tracing_steps: Option<u32>,
    /// Plain SRN, the baseline: no density net, the colour comes from the end point alone.
    #[arg(long)]
    plain_srn: bool,
    /// Images are cut to squares and resampled to this side, in pixels [64].
    #[arg(long, value_name = "PIXELS", value_parser = up_to(4096))]
    side: Option<u32>,
    /// Use only the first views of each instance, this many [all, paper 50].
    #[arg(long, value_name = "N", value_parser = up_to(u32::MAX))]
    views: Option<u32>,
    /// Images per step [20, paper 10].
    #[arg(long, value_name = "N", value_parser = up_to(100000))]
    batch: Option<u32>,
    /// Random rays per image; side² takes whole images [256, paper side²].
    #[arg(long, value_name = "N", value_parser = up_to(u32::MAX))]
    rays: Option<u32>,
    /// Part of the random rays drawn where a picture is not of one colour; the others fall anywhere [0.5, paper 0].
    #[arg(long, value_name = "PART", value_parser = part)]
    detail: Option<f64>,
    /// Decides the first weights and every draw [0].
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Steps between lines of metrics.jsonl [50].
    #[arg(long, value_name = "STEPS", value_parser = clap::value_parser!(u64).range(1..))]
    log_every: Option<u64>,
    /// Steps between validations with a sample image [500].
    #[arg(long, value_name = "STEPS", value_parser = clap::value_parser!(u64).range(1..))]
    validate_every: Option<u64>,
    /// Views of a validation, spread over the set [16].
    #[arg(long, value_name = "N", value_parser = up_to(1000))]
    validation_views: Option<u32>,
    /// Steps between checkpoints, besides one every minute.
    #[arg(long, value_name = "STEPS", value_parser = clap::value_parser!(u64).range(1..))]
    checkpoint_every: Option<u64>,
}

/// Flags that may change when a run is resumed.
#[derive(Args, Clone, Debug)]
pub struct Changeable {
    /// Training set: a folder of SRN instance folders.
    #[arg(long, value_name = "DIR", required_unless_present = "resume")]
    data: Option<PathBuf>,
    /// Unseen views of the same instances, for validation. Without it, training views are looked at.
    #[arg(long, value_name = "DIR")]
    validation: Option<PathBuf>,
    /// Number of steps [14000, paper 100000].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    steps: Option<u64>,
    /// Learning rate of Adam [2e-3, paper 5e-5].
    #[arg(long, value_name = "RATE", value_parser = positive)]
    lr: Option<f64>,
    /// Steps over which the learning rate rises to it [200, paper 0].
    #[arg(long, value_name = "STEPS")]
    warm_up: Option<u64>,
    /// Factor on the learning rate at the last step, towards which it falls evenly [0.005, paper 1].
    #[arg(long, value_name = "FACTOR", value_parser = positive)]
    decay: Option<f64>,
    /// The last step at the full learning rate [0].
    #[arg(long, value_name = "STEP")]
    decay_from: Option<u64>,
}

pub(super) fn up_to(most: u32) -> clap::builder::RangedI64ValueParser<u32> {
    clap::value_parser!(u32).range(1..=i64::from(most))
}

pub(super) fn positive(text: &str) -> std::result::Result<f64, String> {
    match text.parse() {
        Ok(value) if 0.0 < value && value < f64::INFINITY => Ok(value),
        _ => Err("expected a positive number".into()),
    }
}

fn part(text: &str) -> std::result::Result<f64, String> {
    match text.parse() {
        Ok(value) if (0.0..=1.0).contains(&value) => Ok(value),
        _ => Err("expected a number from 0 to 1".into()),
    }
}

/// Overwrites the fields for which a flag was given.
macro_rules! take {
    ($settings:ident, $flags:ident: $($field:ident),*) => {
        $(if let Some(value) = $flags.$field.clone() { $settings.$field = value.into(); })*
    };
}

impl Settings {
    /// Settings of a new run: the preset's, with the flags over them. The data set and the executor are not looked at yet.
    pub fn new(for_good: &ForGood, changeable: &Changeable) -> Result<Self> {
        let preset = for_good.preset.unwrap_or_default();
        let is_paper = preset == Preset::Paper;
        let (hidden, latent) = match preset {
            Preset::Compact => (64, 32),
            Preset::Base => (128, 64),
            Preset::Paper => (256, 256),
        };
        let mut settings = Settings {
            data: PathBuf::new(),
            validation: None,
            instances: BTreeMap::new(),
            from: for_good.from.clone(),
            hidden,
            latent,
            tracing_steps: 10,
            density: !for_good.plain_srn,
            ray_sphere: None,
            side: 64,
            views: is_paper.then_some(50),
            batch: if is_paper { 10 } else { 20 },
            rays: 0,
            detail: if is_paper { 0.0 } else { 0.5 },
            steps: if is_paper { 100_000 } else { 14_000 },
            lr: if is_paper { 5e-5 } else { 2e-3 },
            warm_up: if is_paper { 0 } else { 200 },
            decay: if is_paper { 1.0 } else { 0.005 },
            decay_from: 0,
            seed: 0,
            log_every: 50,
            validate_every: 500,
            validation_views: 16,
            checkpoint_every: None,
            executor: String::new(),
            memory: 0,
        };
        take!(settings, for_good: hidden, latent, tracing_steps, side, batch, detail, seed);
        take!(settings, for_good: log_every, validate_every, validation_views);
        settings.views = for_good.views.map(|views| views as usize).or(settings.views);
        settings.checkpoint_every = for_good.checkpoint_every;
        let pixels = settings.side.saturating_mul(settings.side);
        settings.rays = for_good.rays.unwrap_or(if is_paper { pixels } else { 256.min(pixels) });
        if settings.rays > pixels {
            return Err(format!("--rays {}: an image of side {} has {pixels} pixels", settings.rays, settings.side).into());
        }
        // Numbers of values are u32 in the kernels.
        for (flags, values) in [
            ("--batch × --rays", [settings.batch, settings.rays, 3]),
            ("--latent × --hidden²", [settings.latent, settings.hidden, settings.hidden]),
        ] {
            if values.map(u64::from).iter().product::<u64>() > 1 << 30 {
                return Err(format!("{flags}: too large").into());
            }
        }
        settings.change(changeable);
        Ok(settings)
    }

    /// Takes the flags that were given.
    pub fn change(&mut self, flags: &Changeable) {
        take!(self, flags: data, validation, steps, lr, warm_up, decay, decay_from);
    }

    /// Whether there is a run in this folder.
    pub fn is_in(run: &Path) -> bool {
        run.join(CONFIG).exists()
    }

    /// Reads the `config.json` of a run.
    pub fn read(run: &Path) -> Result<Self> {
        let path = run.join(CONFIG);
        let text = std::fs::read_to_string(&path).map_err(|error| format!("{}: {error}; no run to resume", path.display()))?;
        serde_json::from_str(&text).map_err(|error| format!("{}: {error}", path.display()).into())
    }

    /// Writes the `config.json` of a run.
    pub fn write(&self, run: &Path) -> Result<()> {
        Ok(write_atomically(&run.join(CONFIG), (serde_json::to_string_pretty(self)? + "\n").as_bytes())?)
    }

    /// Learning rate of a step, counted from 1.
    pub fn learning_rate(&self, step: u64) -> f64 {
        let risen = if step < self.warm_up { step as f64 / self.warm_up as f64 } else { 1.0 };
        let fallen = step.saturating_sub(self.decay_from) as f64 / self.steps.saturating_sub(self.decay_from).max(1) as f64;
        risen * self.lr * (1.0 + (self.decay - 1.0) * fallen)
    }

    /// Sizes of the model.
    pub fn model(&self) -> ModelConfig {
        ModelConfig {
            hidden: self.hidden,
            latent: self.latent,
            instances: self.instances.len() as u32,
            tracing_steps: self.tracing_steps,
            density: self.density,
        }
    }
}
