//! `sigma-train adapt`: the two-shot fit (spec 4). The networks are frozen; new instances get latent codes.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;
use sigma_srn::{Engine, Model, Train, Trainer, stream};
use srn_data::{Instance, LoadedView};

use super::settings::{positive, up_to};
use super::{Shown, psnr_of_each, render, training_batch};
use crate::common::{self, EngineArgs, Result};

/// Unseen views of an instance that are looked at in the end, at most.
const UNSEEN: usize = 8;

/// Defaults of [`FitCodes`].
const STEPS: u64 = 1000;
const LEARNING_RATE: f64 = 1e-3;
const RAYS: u32 = 1024;

/// Flags of `sigma-train adapt`.
#[derive(Args, Debug)]
pub struct AdaptArgs {
    /// The trained model.
    #[arg(long, value_name = "FILE")]
    model: PathBuf,
    /// New instances: a folder of SRN instance folders, or one of those.
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// The model to write: the same networks, the new instances alone.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Fit to the first views of each instance, this many.
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = up_to(u32::MAX))]
    views: u32,
    /// Fit to the view of this name; may be repeated.
    #[arg(long, value_name = "NAME", conflicts_with = "views")]
    view: Vec<String>,
    #[command(flatten)]
    fit: FitCodes,
    /// Side of the images in pixels [the model's].
    #[arg(long, value_name = "PIXELS", value_parser = up_to(4096))]
    side: Option<u32>,
    #[command(flatten)]
    engine: EngineArgs,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
}

/// How codes are fitted.
#[derive(Args, Clone, Debug)]
pub struct FitCodes {
    /// Number of steps.
    #[arg(long, value_name = "N", default_value_t = STEPS, value_parser = clap::value_parser!(u64).range(1..))]
    steps: u64,
    /// Learning rate of Adam.
    #[arg(long, value_name = "RATE", default_value_t = LEARNING_RATE, value_parser = positive)]
    lr: f64,
    /// Random rays per image and step, at most a whole image.
    #[arg(long, value_name = "N", default_value_t = RAYS, value_parser = up_to(u32::MAX))]
    rays: u32,
    /// Decides the random rays.
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
}

impl Default for FitCodes {
    fn default() -> Self {
        FitCodes { steps: STEPS, lr: LEARNING_RATE, rays: RAYS, seed: 0 }
    }
}

/// Fits the codes to views, everything else frozen.
pub fn fit_codes(engine: &Engine, model: Model, views: &[Shown], side: u32, how: &FitCodes) -> Result<Model> {
    let rays = how.rays.min(side * side);
    let mut trainer = Trainer::new(engine, model, Train::Codes, views.len() as u32, rays)?;
    let bar = common::progress(how.steps, "fitting");
    for step in 1..=how.steps {
        trainer.step(&training_batch(views, side, rays, 0.0, &mut stream(how.seed, step)), how.lr)?;
        bar.inc(1);
        if step.is_multiple_of(20) || step == how.steps {
            bar.set_message(format!("PSNR {:.2} dB", trainer.losses()?.psnr()));
        }
    }
    bar.finish_and_clear();
    Ok(trainer.model()?.clone())
}

/// Fits codes to a few views of each instance, and writes the model.
pub fn adapt(args: &AdaptArgs) -> Result<bool> {
    let out = args.out.display();
    if args.out.exists() {
        return Err(format!("{out}: exists already, nothing was overwritten").into());
    }
    // Found out now rather than after the fit.
    if args.out.parent().is_some_and(|folder| !folder.as_os_str().is_empty() && !folder.is_dir()) {
        return Err(format!("{out}: its folder does not exist").into());
    }
    let model = common::load_model(&args.model)?;
    let side = args.side.or(model.metadata.side).ok_or("the model file names no image side; give --side")?;
    let set = common::load_set(&args.data, side)?;
    let model = model.with_new_instances(set.instances.iter().map(|instance| instance.name.clone()).collect());
    let model = model.map_err(|error| common::about_model(&args.model, error))?;
    let split = set.instances.iter().map(|instance| split(args, instance)).collect::<Result<Vec<_>>>()?;
    let fitted: Vec<Shown> = (0..).zip(&split).flat_map(|(k, (fitted, _))| fitted.iter().map(move |&view| (k, view))).collect();

    let engine = args.engine.open()?;
    let model = fit_codes(&engine, model, &fitted, side, &args.fit)?;
    let mut results = vec![];
    for (instance, (fitted, unseen)) in (0..).zip(&split) {
        let views: Vec<Shown> = fitted.iter().chain(unseen).map(|&view| (instance, view)).collect();
        let psnr = psnr_of_each(&render(&engine, &model, &views, side)?, &views);
        let (fitted, unseen) = psnr.split_at(fitted.len());
        let name = model.instance_name(instance);
        results.push(Fitted { instance: name, fitted_psnr: mean(fitted), unseen_psnr: mean(unseen) });
    }
    model.save(&args.out)?;
    if args.json {
        println!("{:#}", serde_json::json!({ "model": args.out, "instances": results }));
    } else {
        println!("{:<24} {:>14} {:>14}", "instance", "fitted views", "unseen views");
        for Fitted { instance, fitted_psnr, unseen_psnr } in &results {
            let [fitted, unseen] = [fitted_psnr, unseen_psnr].map(|psnr| psnr.map_or("-".into(), |psnr| format!("{psnr:.2} dB")));
            println!("{instance:<24} {fitted:>14} {unseen:>14}");
        }
        println!("model: {out}");
    }
    Ok(true)
}

/// How well an instance came out.
#[derive(Serialize)]
struct Fitted {
    instance: String,
    fitted_psnr: Option<f64>,
    /// None if there are no other views than the fitted ones.
    unseen_psnr: Option<f64>,
}

/// The views to fit to, and some of the others.
fn split<'a>(args: &AdaptArgs, instance: &'a Instance) -> Result<(Vec<&'a LoadedView>, Vec<&'a LoadedView>)> {
    let (count, wanted) = (args.views as usize, &args.view);
    let unknown = wanted.iter().find(|name| instance.views.iter().all(|view| view.name != **name));
    if let Some(name) = unknown {
        return Err(format!("--view {name}: instance `{}` has no view of this name", instance.name).into());
    }
    if wanted.is_empty() && instance.views.len() < count {
        return Err(format!("--views {count}: instance `{}` has only {}", instance.name, instance.views.len()).into());
    }
    let is_fitted = |at: usize, name: &String| if wanted.is_empty() { at < count } else { wanted.contains(name) };
    let (fitted, others): (Vec<_>, Vec<_>) = instance.views.iter().enumerate().partition(|(at, view)| is_fitted(*at, &view.name));
    let stride = others.len().div_ceil(UNSEEN).max(1);
    let views = |views: Vec<(usize, &'a LoadedView)>| views.into_iter().map(|(_, view)| view);
    Ok((views(fitted).collect(), views(others).step_by(stride).collect()))
}

fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}
