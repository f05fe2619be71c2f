//! The views of a data set that poses are searched for.

use std::path::{Path, PathBuf};

use glam::DMat4;
use sigma_srn::photo::Shot;
use sigma_srn::{Error, Found, Intrinsics, Model, Progress};
use srn_data::LoadedView;
use srn_data::srn::SrnSet;

use super::files::{Picture, model_side};
use super::notation::Notation;
use super::search::{On, SearchArgs, Starts, run};
use crate::common::{Result, camera, spread};
use crate::progress;

/// Views of one instance.
pub struct Views {
    /// Name of the instance.
    pub name: String,
    /// Its folder.
    pub dir: PathBuf,
    /// The views.
    pub pictures: Vec<Picture>,
    /// Their true poses.
    pub truths: Vec<DMat4>,
}

/// Side of the model's images, and at most `views` views of at most `instances` instances that the model knows by name; both evenly
/// spread over those that there are.
pub fn open(model: &Model, data: &Path, instances: u32, views: u32) -> Result<(u32, Vec<Views>)> {
    let mut known = SrnSet::open(data)?.instances;
    let found = known.len();
    known.retain(|files| model.instance(&files.name).is_ok());
    if known.is_empty() {
        let known = model.known_instances();
        return Err(format!("{}: none of its {found} instances is in the model, which knows {known}", data.display()).into());
    }
    if known.len() < found {
        eprintln!("{} of {found} instances are not in the model and are left out", found - known.len());
    }
    let mut known = spread(known, instances as usize);
    for files in &mut known {
        files.views = spread(std::mem::take(&mut files.views), views as usize);
    }
    let first = known.iter().flat_map(|files| &files.views).find_map(|view| view.rgb.as_deref());
    let side = model_side(model, first.unwrap_or(data))?;
    let mut all = Vec::new();
    for files in &known {
        let instance = model.instance(&files.name)?;
        let views = files.load(side as usize)?.views.into_iter().map(|view| picture(view, instance, side));
        let (pictures, truths) = views.unzip();
        all.push(Views { name: files.name.clone(), dir: files.dir.clone(), pictures, truths });
    }
    Ok((side, all))
}

/// Searches for all views, instance by instance, with a bar on stderr. `observe` also gets the number of the
/// instance. Returns what was found for the views of each.
pub fn search(
    asked: &[Views],
    on: On,
    args: &SearchArgs,
    starts: &Starts,
    notation: &Notation,
    mut observe: impl FnMut(usize, Progress) -> std::result::Result<(), Error>,
) -> Result<Vec<Vec<Found>>> {
    let search = args.search()?;
    // All starts are known before the first is searched for.
    let mut all_starts = Vec::new();
    for Views { pictures, truths, .. } in asked {
        let of = |(picture, truth): (&Picture, _)| args.starts(starts, on.model, &picture.shot, Some(truth), notation);
        all_starts.push(pictures.iter().zip(truths).map(of).collect::<Result<Vec<_>>>()?);
    }
    // Views of data sets have no masks to be made right.
    let steps: u64 = search.tries[0].phases.iter().filter(|phase| !phase.outlines).map(|phase| u64::from(phase.steps)).sum();
    let bar = progress::bar(steps * asked.len() as u64, "steps");
    let mut found = Vec::new();
    for (i, (Views { name, pictures, .. }, starts)) in asked.iter().zip(&all_starts).enumerate() {
        bar.set_message(name.clone());
        found.push(run(&search, on, pictures, starts, |progress| {
            if progress.search == 0 {
                bar.set_position(i as u64 * steps + u64::from(progress.step).min(steps));
            } else {
                bar.set_message(format!("{name}, once more"));
            }
            observe(i, progress)
        })?);
    }
    bar.finish_and_clear();
    Ok(found)
}

/// A view as a picture that is searched for, and its true pose.
pub fn picture(view: LoadedView, instance: u32, side: u32) -> (Picture, DMat4) {
    let (truth, intrinsics): (DMat4, Intrinsics) = camera(&view);
    let LoadedView { name, rgb, .. } = view;
    (Picture { name, truth: Some(truth), shot: Shot::whole(rgb, intrinsics, instance, side) }, truth)
}
