//! Objects that a model was not trained on: it is adapted to two views of each, the others are searched for.

use std::path::{Path, PathBuf};

use sigma_srn::{Engine, Model};
use srn_data::{Dataset, Instance, LoadedView};

use super::views::{self, Views};
use crate::common::{Result, load_set, spread};
use crate::train::Shown;
use crate::train::adapt::Fit;

/// Views of each object that the model is adapted to.
const SHOTS: usize = 2;

/// A data set of such objects.
pub struct Heldout {
    dir: PathBuf,
    /// Of its pictures.
    pub side: u32,
    set: Dataset,
}

impl Heldout {
    /// Reads at most so many instances, evenly spread over those that there are, with pictures of `side` pixels.
    pub fn open(dir: &Path, side: u32, instances: u32) -> Result<Self> {
        let mut set = load_set(dir, side)?;
        if let Some(few) = set.instances.iter().find(|instance| instance.views.len() <= SHOTS) {
            return Err(format!("--heldout: `{}` has {} views; {SHOTS} are for its code", few.name, few.views.len()).into());
        }
        set.instances = spread(set.instances, instances as usize);
        Ok(Heldout { dir: dir.into(), side, set })
    }

    /// The model with these objects instead of its own.
    pub fn adapt(&self, engine: &Engine, model: &Model, fit: &Fit) -> Result<Model> {
        let names = self.set.instances.iter().map(|instance| instance.name.clone()).collect();
        let shown: Vec<Shown> = (0..)
            .zip(&self.set.instances)
            .flat_map(|(i, instance)| split(instance).0.into_iter().map(move |view| (i, view)))
            .collect();
        Ok(fit.run(engine, model, names, &shown, &[], self.side)?.model)
    }

    /// At most so many of each object's other views.
    pub fn others(&self, count: u32) -> Vec<Views> {
        let of = |(i, instance): (u32, &Instance)| {
            let others = spread(split(instance).1, count as usize).into_iter();
            let (pictures, truths) = others.map(|view| views::picture(view.clone(), i, self.side)).unzip();
            Views { name: instance.name.clone(), dir: self.dir.join(&instance.name), pictures, truths }
        };
        (0..).zip(&self.set.instances).map(of).collect()
    }
}

/// Two views, a quarter of the way from either end, and the others.
fn split(instance: &Instance) -> (Vec<&LoadedView>, Vec<&LoadedView>) {
    let count = instance.views.len();
    let shots: [usize; SHOTS] = [count / 4, count - 1 - count / 4];
    let (shown, others): (Vec<_>, Vec<_>) = instance.views.iter().enumerate().partition(|(k, _)| shots.contains(k));
    let views = |views: Vec<(usize, _)>| views.into_iter().map(|(_, view)| view).collect();
    (views(shown), views(others))
}
