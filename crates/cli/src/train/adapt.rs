//! `sigma-train adapt`: the two-shot fit. New instances get latent codes, while the networks are frozen (spec 4); then the networks learn
//! what no code can say.

use std::path::PathBuf;

use clap::Args;
use glam::DMat4;
use rand::RngExt;
use serde::Serialize;
use sigma_srn::{Engine, Model, Train, Trainer, stream};
use srn_data::camera::uniform_sphere;
use srn_data::{Instance, LoadedView};

use super::found::{self, Moved};
use super::reflection::{self, Reflection};
use super::settings::{positive, up_to};
use super::{Shown, psnr_of_each, render, training_batch};
use crate::common::{self, EngineArgs, Result, print};
use crate::progress;

/// Unseen views of an instance that are looked at in the end, at most.
const UNSEEN: usize = 8;

/// Defaults of [`Fit`].
const STEPS: u64 = 500;
const LEARNING_RATE: f64 = 3e-3;
const NETWORK_STEPS: u64 = 400;
const NETWORK_LEARNING_RATE: f64 = 1e-3;
/// A code fitted by few rays ends where their noise leads it: of a stool after 500 steps at 20.6 to 22.9 dB by 128 rays, as their seed is.
const RAYS: u32 = 1024;
const NETWORK_RAYS: u32 = 128;
/// Views of known objects that the networks are held to, and how many of them in a step.
const KNOWN: usize = 64;
const KNOWN_IN_STEP: usize = 16;
/// Steps of the networks from one descent of poses that were found to the next: fitted less often, networks have learnt the wrong ones in between.
const DESCENT_EVERY: u64 = 5;
/// Part of the networks' rays that is drawn where a picture is not of one colour.
const DETAIL: f64 = 0.5;

/// Flags of `sigma-train adapt`.
#[derive(Args, Debug)]
pub struct AdaptArgs {
    /// The trained model.
    #[arg(long, value_name = "FILE")]
    model: PathBuf,
    /// New instances: a folder of SRN instance folders, or one of those.
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// More views of these instances, with poses that the adapted model has found, as `sigma-pose estimate --save-views` writes them. All are
    /// fitted to, and their poses along with the networks; with --network-steps 0 they stay.
    #[arg(long, value_name = "DIR")]
    more: Option<PathBuf>,
    /// The model to write: the new instances alone.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Fit to the first views of each instance, this many.
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = up_to(u32::MAX))]
    views: u32,
    /// Fit to the view of this name; may be repeated.
    #[arg(long, value_name = "NAME", conflicts_with = "views")]
    view: Vec<String>,
    #[command(flatten)]
    fit: Fit,
    /// Side of the images in pixels [the model's].
    #[arg(long, value_name = "PIXELS", value_parser = up_to(4096))]
    side: Option<u32>,
    #[command(flatten)]
    engine: EngineArgs,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
}

/// How new instances are fitted.
#[derive(Args, Clone, Debug)]
pub struct Fit {
    /// Steps for the codes alone.
    #[arg(long, value_name = "N", default_value_t = STEPS, value_parser = clap::value_parser!(u64).range(1..))]
    steps: u64,
    /// Learning rate of Adam for them.
    #[arg(long, value_name = "RATE", default_value_t = LEARNING_RATE, value_parser = positive)]
    lr: f64,
    /// Random rays per image and step for them, at most a whole image.
    #[arg(long, value_name = "N", default_value_t = RAYS, value_parser = up_to(u32::MAX))]
    rays: u32,
    /// Steps for codes and networks after that, with views of known objects, as the model shows them, that the networks are held to; the last
    /// third at a tenth of the rate. 0 leaves the networks as they are, as in the paper.
    #[arg(long, value_name = "N", default_value_t = NETWORK_STEPS)]
    network_steps: u64,
    /// Learning rate of Adam for these.
    #[arg(long, value_name = "RATE", default_value_t = NETWORK_LEARNING_RATE, value_parser = positive)]
    network_lr: f64,
    /// Random rays per image and step for these.
    #[arg(long, value_name = "N", default_value_t = NETWORK_RAYS, value_parser = up_to(u32::MAX))]
    network_rays: u32,
    /// Have the networks learn from the pictures alone, not from their mirror images, too, where an object seems to be its own: say so where
    /// the known objects are symmetric, and the new one is not.
    #[arg(long)]
    no_reflections: bool,
    /// Decides the random rays, and the views of known objects.
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
}

impl Default for Fit {
    fn default() -> Self {
        let (steps, lr, network_steps, network_lr) = (STEPS, LEARNING_RATE, NETWORK_STEPS, NETWORK_LEARNING_RATE);
        let (rays, network_rays) = (RAYS, NETWORK_RAYS);
        Fit { steps, lr, rays, network_steps, network_lr, network_rays, no_reflections: false, seed: 0 }
    }
}

/// What a fit ends with.
pub struct Fitted {
    /// With the new instances alone.
    pub model: Model,
    /// Of each instance, as far as it was asked for them.
    reflections: Vec<Vec<Reflection>>,
    /// The views whose poses were fitted, where they are now.
    more: Vec<(u32, LoadedView)>,
}

fn borrowed(views: &[(u32, LoadedView)]) -> Vec<Shown<'_>> {
    views.iter().map(|(instance, view)| (*instance, view)).collect()
}

impl Fit {
    /// As in the paper: the networks stay.
    pub const fn of_codes(self) -> Self {
        Fit { network_steps: 0, ..self }
    }

    /// The trained model with these instances instead of its own, fitted to views of them, and to `more`, whose poses are fitted, too.
    pub fn run(
        &self,
        engine: &Engine,
        trained: &Model,
        names: Vec<String>,
        views: &[Shown],
        more: &[Shown],
        side: u32,
    ) -> Result<Fitted> {
        let bar = progress::bar(self.steps + self.network_steps, "fitting");
        let [rays, network_rays] = [self.rays, self.network_rays].map(|rays| rays.min(side * side));
        let has_two_views = views.len() >= 2 * names.len();
        let posed = views.len();
        let views = [views, more].concat();
        let mut own: Vec<(u32, LoadedView)> = views.iter().map(|&(instance, view)| (instance, view.clone())).collect();
        let model = trained.with_new_instances(names.clone())?;
        let mut trainer = Trainer::new(engine, model, Train::Codes, views.len() as u32, rays)?;
        let take = |trainer: &mut Trainer, step: u64, views: &[Shown], rays, detail, lr| -> Result<()> {
            trainer.step(&training_batch(views, side, rays, detail, &mut stream(self.seed, step)), lr)?;
            bar.inc(1);
            if step.is_multiple_of(20) || step == self.steps + self.network_steps {
                bar.set_message(format!("PSNR {:.2} dB", trainer.losses()?.psnr()));
            }
            Ok(())
        };
        for step in 1..=self.steps {
            take(&mut trainer, step, &views, rays, 0.0, self.lr)?;
        }
        let fitted = trainer.model()?.clone();
        drop(trainer);
        if self.network_steps == 0 {
            bar.finish_and_clear();
            return Ok(Fitted { model: fitted, reflections: vec![vec![]; names.len()], more: own.split_off(posed) });
        }
        let reflections =
            if self.no_reflections { vec![vec![]; names.len()] } else { reflection::reflections(engine, &fitted, &views, side)? };
        let images_of =
            |own: &[(u32, LoadedView)]| reflection::images(&borrowed(own), side, |instance| &reflections[instance as usize]);
        let mut images = images_of(&own);
        // Instances: the new ones, then the known ones.
        let known = self.known(engine, trained, &views, side)?;
        let all = (0..trained.layout.instances).map(|instance| trained.instance_name(instance));
        let all = names.iter().cloned().chain(all).collect();
        let joined = trained.with_codes(all, [fitted.codes()?, trained.codes()?].concat())?;
        let shown: Vec<Shown> = known.iter().map(|(instance, view)| (names.len() as u32 + instance, view)).collect();
        let batch = own.len() + images.len() + KNOWN_IN_STEP;
        let mut trainer = Trainer::new(engine, joined, Train::Everything, batch as u32, network_rays)?;
        for step in 1..=self.network_steps {
            let lr = if 3 * step > 2 * self.network_steps { 0.1 * self.network_lr } else { self.network_lr };
            if posed < own.len() && step.is_multiple_of(DESCENT_EVERY) {
                found::descend(engine, trainer.model()?, &mut own[posed..], side)?;
                images = images_of(&own);
            }
            let some = shown.iter().copied().cycle().skip(step as usize * KNOWN_IN_STEP % KNOWN).take(KNOWN_IN_STEP);
            let views: Vec<Shown> = borrowed(&own).into_iter().chain(borrowed(&images)).chain(some).collect();
            take(&mut trainer, self.steps + step, &views, network_rays, DETAIL, lr)?;
        }
        bar.finish_and_clear();
        let joined = trainer.model()?;
        let codes = joined.codes()?[..fitted.codes()?.len()].to_vec();
        let mut model = joined.with_codes(names, codes)?;
        // Of objects that are known from fewer views, or by less of a fit, it says nothing.
        let is_as_calibrated = self.network_steps >= NETWORK_STEPS && self.steps >= STEPS && has_two_views;
        model.metadata.calibration = model.metadata.calibration_of_new.take().filter(|_| is_as_calibrated);
        Ok(Fitted { model, reflections, more: own.split_off(posed) })
    }

    /// Views of the trained model's own instances, drawn at random, from as far away as it was trained, through the first view's lens.
    fn known(&self, engine: &Engine, trained: &Model, views: &[Shown], side: u32) -> Result<Vec<(u32, LoadedView)>> {
        let intrinsics = views[0].1.intrinsics;
        let distance = |&(_, view): &Shown| common::camera(view).0.w_axis.truncate().length();
        let radius =
            trained.metadata.orbit_radius.unwrap_or_else(|| views.iter().map(distance).sum::<f64>() / views.len() as f64);
        let mut random = stream(self.seed, 0);
        let view = |camera: DMat4| {
            let world_from_camera = camera.transpose().to_cols_array();
            let view = LoadedView { name: String::new(), rgb: vec![], world_from_camera, intrinsics };
            (random.random_range(0..trained.layout.instances), view)
        };
        let mut known: Vec<_> = uniform_sphere(KNOWN, radius, self.seed).into_iter().map(view).collect();
        let rendering = render(engine, trained, &borrowed(&known), side)?;
        let pictures = rendering.rgb.chunks_exact(3 * (side * side) as usize);
        known.iter_mut().zip(pictures).for_each(|((_, view), rgb)| view.rgb = rgb.to_vec());
        Ok(known)
    }
}

/// Fits new instances to a few views of each, and writes the model.
pub fn adapt(args: &AdaptArgs) -> Result<bool> {
    let out = args.out.display();
    if args.out.exists() {
        return Err(format!("{out}: exists already, nothing was overwritten").into());
    }
    common::refuse_to_write(&args.out, false)?;
    let model = common::load_model(&args.model)?;
    let side = args.side.or(model.metadata.side).ok_or("the model file names no image side; give --side")?;
    let set = common::load_set(&args.data, side)?;
    model.hypernetwork().map_err(|error| common::about_model(&args.model, error))?;
    let split = set.instances.iter().map(|instance| split(args, instance)).collect::<Result<Vec<_>>>()?;
    let fitted: Vec<Shown> = (0..).zip(&split).flat_map(|(k, (fitted, _))| fitted.iter().map(move |&view| (k, view))).collect();

    let found = args.more.as_ref().map(|dir| common::load_set(dir, side)).transpose()?.map_or(vec![], |set| set.instances);
    let mut more: Vec<Shown> = vec![];
    for Instance { name, views } in &found {
        let Some((number, _)) = (0..).zip(&set.instances).find(|(_, instance)| instance.name == *name) else {
            return Err(format!("--more: instance `{name}` is not in --data {}", args.data.display()).into());
        };
        more.extend(views.iter().map(|view| (number, view)));
    }

    let engine = args.engine.open()?;
    let names = set.instances.iter().map(|instance| instance.name.clone()).collect();
    let Fitted { model, reflections, more: moved } = args.fit.run(&engine, &model, names, &fitted, &more, side)?;
    let mut results = vec![];
    for (instance, (fitted, unseen)) in (0..).zip(&split) {
        let views: Vec<Shown> = fitted.iter().chain(unseen).map(|&view| (instance, view)).collect();
        let psnr = psnr_of_each(&render(&engine, &model, &views, side)?, &views);
        let (fitted, unseen) = psnr.split_at(fitted.len());
        let name = model.instance_name(instance);
        let reflections = reflections[instance as usize].iter().map(|reflection| reflection.name).collect();
        results.push(Outcome { instance: name, fitted_psnr: mean(fitted), unseen_psnr: mean(unseen), reflections });
    }
    let moved = more
        .iter()
        .zip(&moved)
        .map(|((instance, before), (_, after))| Moved::between(model.instance_name(*instance), before, after));
    let moved: Vec<Moved> = moved.collect();
    model.save(&args.out)?;
    if args.json {
        print(&format!("{:#}", serde_json::json!({ "model": args.out, "instances": results, "more": moved })))?;
    } else {
        print(&format!("{:<24} {:>14} {:>14}  reflections", "instance", "fitted views", "unseen views"))?;
        for Outcome { instance, fitted_psnr, unseen_psnr, reflections } in &results {
            let [fitted, unseen] = [fitted_psnr, unseen_psnr].map(|psnr| psnr.map_or("-".into(), |psnr| format!("{psnr:.2} dB")));
            let reflections = if reflections.is_empty() { "-".into() } else { reflections.join(" ") };
            print(&format!("{instance:<24} {fitted:>14} {unseen:>14}  {reflections}"))?;
        }
        if let Some(degrees) = mean(&moved.iter().map(|moved| moved.moved_deg).collect::<Vec<_>>()) {
            print(&format!("poses of --more, {} of them, were moved by {degrees:.2}° in the mean", moved.len()))?;
        }
        let deviations = match model.metadata.calibration {
            Some(_) => "stated, as learnt from other new objects",
            None => {
                "none stated: how far off such objects are found, `sigma-pose calibrate --heldout` learns from others, fitted as these are by default"
            }
        };
        print(&format!("deviations of their poses: {deviations}"))?;
        print(&format!("model: {out}"))?;
    }
    Ok(true)
}

/// How well an instance came out.
#[derive(Serialize)]
struct Outcome {
    instance: String,
    fitted_psnr: Option<f64>,
    /// None if there are no other views than the fitted ones.
    unseen_psnr: Option<f64>,
    /// Those of the object, each by the coordinates that it turns round.
    reflections: Vec<&'static str>,
}

/// The views to fit to, and some of the others.
fn split<'a>(args: &AdaptArgs, instance: &'a Instance) -> Result<(Vec<&'a LoadedView>, Vec<&'a LoadedView>)> {
    let (count, wanted) = (args.views as usize, &args.view);
    if let Some((_, again)) = wanted.iter().enumerate().find(|(k, name)| wanted[..*k].contains(name)) {
        return Err(format!("--view {again}: given twice").into());
    }
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
