//! A model: its sizes, and its parameters by the names of the released checkpoints.

mod file;
mod layout;

use std::borrow::Cow;
use std::collections::BTreeMap;

pub use self::file::write_atomically;
pub(crate) use self::file::{Tensors, read_tensors, write_tensors};
use self::layout::{BAKED, CODES, HYPER, collect, initial_values};
pub use self::layout::{Block, Hypernetwork, Kind, Layout, ModelConfig, Parameter, Source};
use crate::confidence::Calibration;
use crate::random::stream;
use crate::{Error, renderer};

/// Layout, parameters and what else a model file says.
#[derive(Clone, Debug, PartialEq)]
pub struct Model {
    /// Which parameter is what.
    pub layout: Layout,
    /// All parameters.
    pub parameters: Vec<Parameter>,
    /// Free text of the file: instance names, image side, orbit radius.
    pub metadata: Metadata,
}

/// What a model knows about the data it was trained on.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Metadata {
    /// Name of each instance, in the order of the codes; may be empty.
    pub instance_names: Vec<String>,
    /// Side of the training images in pixels, if known.
    pub side: Option<u32>,
    /// Distance of the training cameras from the origin in object units, if known.
    pub orbit_radius: Option<f64>,
    /// Radius of the sphere around the origin on which rays begin, wherever the camera is: outside the object a ray shows the same from
    /// everywhere on it. `None`: they begin at the camera, as in the paper.
    pub ray_sphere: Option<f64>,
    /// The nearest and the farthest of the training cameras, but for a hundredth on each side, in object units, if known.
    pub distances: Option<[f64; 2]>,
    /// How well it shows what it was trained on, if known: by instance, the part of a picture that the view from its true pose leaves
    /// [`unexplained`](crate::unexplained), in nine of ten of the training's pictures, or of its validation's, at most.
    pub unexplained: BTreeMap<String, f64>,
    /// How its estimates compare with known poses, if that was measured.
    pub calibration: Option<Calibration>,
    /// The same for objects that it was not trained on, fitted to two views each: the calibration of a model that `sigma-train adapt` makes of
    /// this one.
    pub calibration_of_new: Option<Calibration>,
}

/// How much nearer, or farther, than all training cameras a camera may be for the model to know what it sees.
const BEYOND: f64 = 1.1;
/// The same beside the one distance that is known of all of them.
const BEYOND_RADIUS: f64 = 1.25;
/// How near a camera may be where rays begin on a sphere; the corners of the object's box are 0.5 away. From nearer than 0.58 anything is
/// explained, also pictures of one colour.
const NEAREST: f64 = 0.7;

impl Metadata {
    /// Whether the model knows what a camera so far from the object's centre sees: where rays begin on a sphere, any outside of the object,
    /// else those that are about as far away as the ones that it has learnt from; all where it does not say from which.
    pub fn knows_distance(&self, distance: f64) -> bool {
        if self.ray_sphere.is_some() {
            return distance >= NEAREST;
        }
        let radius = self.orbit_radius.map(|radius| [radius / BEYOND_RADIUS, radius * BEYOND_RADIUS]);
        let range = self.distances.map(|[nearest, farthest]| [nearest / BEYOND, farthest * BEYOND]).or(radius);
        range.is_none_or(|[nearest, farthest]| nearest <= distance && distance <= farthest)
    }
}

impl Model {
    /// A model with the released initialisation (spec 2), the same for the same seed.
    pub fn init(config: &ModelConfig, seed: u64) -> Result<Self, Error> {
        for (field, value) in [
            ("hidden", config.hidden),
            ("latent", config.latent),
            ("instances", config.instances),
            ("tracing_steps", config.tracing_steps),
        ] {
            if value == 0 {
                return Err(Error::Setting { field, what: "must be at least 1".into() });
            }
        }
        let (layout, mut parameters) = collect(config, config.tracing_steps)?;
        let mut random = stream(seed, 0);
        for parameter in &mut parameters {
            parameter.values = initial_values(parameter, &mut random);
        }
        Ok(Model { layout, parameters, metadata: Metadata::default() })
    }

    /// A model of named tensors. Sizes come from them; what is no part of a model is left out.
    pub(crate) fn from_tensors(tensors: &Tensors, tracing_steps: u32, metadata: Metadata) -> Result<Self, Error> {
        let (layout, mut parameters) = collect(tensors, tracing_steps)?;
        for parameter in &mut parameters {
            for (name, _) in &parameter.tensors {
                let values = &tensors[name].1;
                if let Some(at) = values.iter().position(|value| !value.is_finite()) {
                    let got = format!("{} at {at}", values[at]);
                    return Err(Error::Tensor { name: name.clone(), expected: "finite values".into(), got });
                }
                parameter.values.extend(values);
            }
        }
        let names = metadata.instance_names.len();
        if names != 0 && names != layout.instances as usize {
            let what = format!("{names} for {} instances", layout.instances);
            return Err(Error::Input { input: "instance names".into(), what });
        }
        Ok(Model { layout, parameters, metadata })
    }

    /// Networks without codes and hypernetwork: a model with the weights of f that the hypernetwork makes for these instances, which get the
    /// numbers from 0 on.
    pub fn bake(&self, instances: &[u32]) -> Result<Self, Error> {
        self.hypernetwork()?;
        let is_shared = |name: &str| name != CODES && !name.starts_with(HYPER);
        let shared = self.tensors().into_iter().filter(|(name, ..)| is_shared(name));
        let mut tensors: Tensors = shared.map(|(name, shape, values)| (name, (shape, values.to_vec()))).collect();
        for (l, weights) in renderer::scene_weights(self, instances)?.into_iter().enumerate() {
            tensors.insert(format!("{BAKED}.{l}"), (vec![instances.len(), weights.len() / instances.len()], weights));
        }
        let instance_names = instances.iter().map(|&instance| self.instance_name(instance)).collect();
        Self::from_tensors(&tensors, self.layout.tracing_steps, Metadata { instance_names, ..self.metadata.clone() })
    }

    /// The model for work on these instances, and the number of each there: baked where that leaves fewer numbers, for each plan needs all of
    /// them, at the paper's sizes 200 MB, and makes of them what is the same in all plans.
    pub(crate) fn for_work_on(&self, instances: &[u32]) -> Result<(Cow<'_, Self>, Vec<u32>), Error> {
        let as_it_is = || Ok((Cow::Borrowed(self), instances.to_vec()));
        let Source::Hypernetwork(Hypernetwork { codes, layers, .. }) = &self.layout.source else { return as_it_is() };
        let mut known = instances.to_vec();
        known.sort_unstable();
        known.dedup();
        // Whoever works on them says what is wrong with them.
        if known.last().is_none_or(|&last| last >= self.layout.instances) {
            return as_it_is();
        }
        let values = |parameter: usize| self.parameters[parameter].values.len();
        let of_block = |block: &Block| values(block.linear) + block.affine.map_or(0, values);
        let whole = values(*codes) + layers.iter().flatten().map(of_block).sum::<usize>();
        let baked: usize = self.layout.scene.iter().map(|&(width, out)| known.len() * ((width + 1) * out) as usize).sum();
        if baked >= whole {
            return as_it_is();
        }
        let number = |instance| known.binary_search(instance).expect("it was put there") as u32;
        Ok((Cow::Owned(self.bake(&known)?), instances.iter().map(number).collect()))
    }

    /// Codes and hypernetwork; an error where the model is baked.
    pub fn hypernetwork(&self) -> Result<&Hypernetwork, Error> {
        match &self.layout.source {
            Source::Hypernetwork(hypernetwork) => Ok(hypernetwork),
            Source::Baked(_) => Err(Error::Input {
                input: "the model is baked".into(),
                what: "it has its instances' networks, but neither codes nor a hypernetwork".into(),
            }),
        }
    }

    /// Every tensor by name, with shape and values.
    pub fn tensors(&self) -> Vec<(String, Vec<usize>, &[f32])> {
        let mut tensors = Vec::new();
        for parameter in &self.parameters {
            let mut rest = parameter.values.as_slice();
            for (name, shape) in &parameter.tensors {
                let (values, after) = rest.split_at(shape.iter().product());
                tensors.push((name.clone(), shape.clone(), values));
                rest = after;
            }
        }
        tensors
    }

    /// Number of the instance with this [`Model::instance_name`].
    pub fn instance(&self, name: &str) -> Result<u32, Error> {
        (0..self.layout.instances).find(|&number| self.instance_name(number) == name).ok_or_else(|| Error::Input {
            input: format!("instance `{name}`"),
            what: format!("the model knows {}", self.known_instances()),
        })
    }

    /// How many instances there are, and their names, in words.
    pub fn known_instances(&self) -> String {
        let (count, names) = (self.layout.instances, &self.metadata.instance_names);
        if names.is_empty() {
            format!("{count} instances, by number")
        } else {
            format!("{count} instances: {}", names.join(", "))
        }
    }

    /// Name of instance `number`: from the file, or the number itself.
    pub fn instance_name(&self, number: u32) -> String {
        self.metadata.instance_names.get(number as usize).cloned().unwrap_or_else(|| number.to_string())
    }

    /// The latent codes, `[instances, latent]`.
    pub fn codes(&self) -> Result<&[f32], Error> {
        Ok(&self.parameters[self.hypernetwork()?.codes].values)
    }

    /// The same networks with these instances alone, whose latent codes are `codes`, `[names.len(), latent]`. Without what is known of
    /// the old ones: the calibration, and how well they are shown.
    pub fn with_codes(&self, names: Vec<String>, codes: Vec<f32>) -> Result<Self, Error> {
        let hypernetwork = self.hypernetwork()?;
        let (latent, of_codes) = (hypernetwork.latent as usize, hypernetwork.codes);
        if codes.len() != names.len() * latent {
            let what = format!("{} values, where {} codes have {latent} each", codes.len(), names.len());
            return Err(Error::Input { input: "codes".into(), what });
        }
        let mut model = self.clone();
        model.parameters[of_codes].values = codes;
        model.parameters[of_codes].tensors[0].1 = vec![names.len(), latent];
        model.layout.instances = names.len() as u32;
        (model.metadata.instance_names, model.metadata.calibration) = (names, None);
        model.metadata.unexplained.clear();
        Ok(model)
    }

    /// The same networks with `names.len()` fresh latent codes, each the mean of the old ones (two-shot fit, spec 4).
    pub fn with_new_instances(&self, names: Vec<String>) -> Result<Self, Error> {
        let latent = self.hypernetwork()?.latent as usize;
        let old = self.codes()?.chunks_exact(latent);
        let count = old.len() as f32;
        let mean: Vec<f32> = (0..latent).map(|k| old.clone().map(|code| code[k]).sum::<f32>() / count).collect();
        let codes = mean.repeat(names.len());
        self.with_codes(names, codes)
    }
}
