//! A model: its sizes, and its parameters by the names of the released checkpoints.

use std::borrow::Cow;
use std::collections::HashMap;
use std::path::Path;

use rand::RngExt;
use safetensors::SafeTensorError;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};

use crate::confidence::Calibration;
use crate::random::{Random, normal, stream};
use crate::{Error, renderer};

/// Sizes of a model that is made from nothing. A loaded model takes them from its tensors.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelConfig {
    /// Features of the scene MLP, the density net and the pixel generator.
    pub hidden: u32,
    /// Length of a latent code.
    pub latent: u32,
    /// Number of latent codes.
    pub instances: u32,
    /// Marching steps M.
    pub tracing_steps: u32,
    /// True: σSRN, the density-weighted sum; false: plain SRN, the end point.
    pub density: bool,
}

/// One linear layer, with or without the layer norm and ReLU behind it; numbers of [`Model::parameters`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Block {
    /// Weight and bias.
    pub linear: usize,
    /// Gamma and beta of the layer norm that follows, if one does.
    pub affine: Option<usize>,
    /// Values in.
    pub in_features: u32,
    /// Values out.
    pub out_features: u32,
}

/// From an instance's code to the weights of the scene MLP.
#[derive(Clone, Debug, PartialEq)]
pub struct Hypernetwork {
    /// Latent codes `[instances, latent]`.
    pub codes: usize,
    /// Length of a code.
    pub latent: u32,
    /// One MLP per layer of the scene MLP.
    pub layers: Vec<Vec<Block>>,
}

/// Where the weights of the scene MLP f come from.
#[derive(Clone, Debug, PartialEq)]
pub enum Source {
    /// Made from the instance's code.
    Hypernetwork(Hypernetwork),
    /// Stored, those of the few instances that the model knows ([`Model::bake`]): one parameter per layer, a row for each instance.
    Baked(Vec<usize>),
}

/// Which parameter is what.
#[derive(Clone, Debug, PartialEq)]
pub struct Layout {
    /// Number of instances: latent codes, or rows of stored weights.
    pub instances: u32,
    /// Marching steps M.
    pub tracing_steps: u32,
    /// Where the weights of f come from.
    pub source: Source,
    /// The scene MLP f as `(in, out)` per layer.
    pub scene: Vec<(u32, u32)>,
    /// LSTM, input to gates.
    pub lstm_input: Block,
    /// LSTM, hidden state to gates.
    pub lstm_hidden: Block,
    /// Hidden state to step length.
    pub step_head: Block,
    /// The density net g, where there is one.
    pub density: Option<Vec<Block>>,
    /// The pixel generator.
    pub pixel_generator: Vec<Block>,
}

impl Layout {
    /// Features of f.
    pub fn features(&self) -> u32 {
        self.scene.last().map_or(0, |layer| layer.1)
    }

    /// Whether the weights of f are stored, so that plans need no kernels that make them.
    pub(crate) fn is_baked(&self) -> bool {
        matches!(self.source, Source::Baked(_))
    }

    /// Size of the LSTM's hidden state.
    pub fn lstm_size(&self) -> u32 {
        self.lstm_hidden.in_features
    }
}

/// What a parameter is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The table of latent codes.
    Codes,
    /// A linear layer of a network.
    Linear,
    /// The last layer of the hypernetwork.
    HyperOutput,
    /// One of the two linear maps of the LSTM.
    Lstm,
    /// Hidden state to step length.
    StepHead,
    /// Gamma and beta of a layer norm.
    Affine,
}

/// Tensors that share one buffer: weight then bias, gamma then beta, or the table of codes.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameter {
    /// What it is; decides its first values.
    pub kind: Kind,
    /// Names and shapes of the tensors in it, in order.
    pub tensors: Vec<(String, Vec<usize>)>,
    /// Their values, one behind the other.
    pub values: Vec<f32>,
}

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
    /// How its estimates compare with known poses, if that was measured.
    pub calibration: Option<Calibration>,
    /// The same for objects that it was not trained on, fitted to two views each: the calibration of a model that `sigma-train adapt` makes of
    /// this one.
    pub calibration_of_new: Option<Calibration>,
}

/// Marching steps of a file, at most: what a renderer allocates grows with them.
const MOST_STEPS: f64 = 1000.0;
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

/// Where the shapes of a layout come from: a file's tensors, or a configuration.
trait Shapes {
    /// Shape of a tensor, `None` if it is not there.
    fn shape(&self, name: &str) -> Option<Vec<usize>>;
}

impl Shapes for Tensors {
    fn shape(&self, name: &str) -> Option<Vec<usize>> {
        self.get(name).map(|tensor| tensor.0.clone())
    }
}

const CODES: &str = "latent_codes.weight";
const HYPER: &str = "hyper_phi.layers";
const BAKED: &str = "phi.layers";
const SCENE_INPUT: u32 = 3;

impl Shapes for ModelConfig {
    fn shape(&self, name: &str) -> Option<Vec<usize>> {
        const LSTM_SIZE: usize = 16;
        const SCENE_LAYERS: usize = 4;
        let (hidden, latent) = (self.hidden as usize, self.latent as usize);
        let mlp = |rest: &str, widths: &[usize]| -> Option<Vec<usize>> {
            let last = widths.len() - 2;
            let (layer, rest) = rest.split_once('.')?;
            let layer: usize = layer.parse().ok()?;
            let shape = |out: usize, input: usize, kind: &str| match kind {
                "weight" => Some(vec![out, input]),
                "bias" => Some(vec![out]),
                _ => None,
            };
            match rest.strip_prefix("net.") {
                Some(rest) if layer < last => {
                    let (part, kind) = rest.split_once('.')?;
                    if part == "0" { shape(widths[layer + 1], widths[layer], kind) } else { Some(vec![widths[layer + 1]]) }
                }
                None if layer == last => shape(widths[layer + 1], widths[layer], rest),
                _ => None,
            }
        };
        if name == CODES {
            return Some(vec![self.instances as usize, latent]);
        }
        if let Some(rest) = name.strip_prefix(HYPER).and_then(|rest| rest.strip_prefix('.')) {
            let (layer, rest) = rest.split_once(".hyper_linear.hypo_params.net.")?;
            let layer: usize = layer.parse().ok().filter(|&layer: &usize| layer < SCENE_LAYERS)?;
            let input = if layer == 0 { SCENE_INPUT as usize } else { hidden };
            return mlp(rest, &[latent, latent, latent, input * hidden + hidden]);
        }
        if let Some(rest) = name.strip_prefix("sigma.net.") {
            return if self.density { mlp(rest, &[SCENE_INPUT as usize, hidden, hidden, hidden, 1]) } else { None };
        }
        if let Some(rest) = name.strip_prefix("pixel_generator.net.") {
            return mlp(rest, &[hidden, hidden, hidden, hidden, hidden, hidden, 3]);
        }
        match name.strip_prefix("ray_marcher.")? {
            "lstm.weight_ih" => Some(vec![4 * LSTM_SIZE, hidden]),
            "lstm.weight_hh" => Some(vec![4 * LSTM_SIZE, LSTM_SIZE]),
            "lstm.bias_ih" | "lstm.bias_hh" => Some(vec![4 * LSTM_SIZE]),
            "out_layer.weight" => Some(vec![1, LSTM_SIZE]),
            "out_layer.bias" => Some(vec![1]),
            _ => None,
        }
    }
}

/// Walks the tensors by name and collects the parameters.
struct Collector<'a> {
    shapes: &'a dyn Shapes,
    parameters: Vec<Parameter>,
}

impl Collector<'_> {
    fn shape(&self, name: &str, dimensions: usize) -> Result<Vec<usize>, Error> {
        let shape = self.shapes.shape(name).ok_or_else(|| Error::MissingTensor { name: name.into() })?;
        if shape.len() != dimensions || shape.contains(&0) {
            let expected = format!("{dimensions} dimensions, none of them 0");
            return Err(Error::Tensor { name: name.into(), expected, got: format!("{shape:?}") });
        }
        Ok(shape)
    }

    fn expect(&self, name: &str, expected: &[usize]) -> Result<(), Error> {
        let got = self.shape(name, expected.len())?;
        if got != expected {
            return Err(Error::Tensor { name: name.into(), expected: format!("{expected:?}"), got: format!("{got:?}") });
        }
        Ok(())
    }

    fn push(&mut self, kind: Kind, tensors: Vec<(String, Vec<usize>)>) -> usize {
        self.parameters.push(Parameter { kind, tensors, values: Vec::new() });
        self.parameters.len() - 1
    }

    /// A linear layer whose number of inputs is known; the rest is read from its tensors.
    fn linear(&mut self, kind: Kind, weight: &str, bias: &str, in_features: u32) -> Result<Block, Error> {
        let shape = self.shape(weight, 2)?;
        self.expect(weight, &[shape[0], in_features as usize])?;
        self.expect(bias, &[shape[0]])?;
        let linear = self.push(kind, vec![(weight.into(), shape.clone()), (bias.into(), vec![shape[0]])]);
        Ok(Block { linear, affine: None, in_features, out_features: shape[0] as u32 })
    }

    /// `{prefix}.{k}.net.{0: linear, 1: layer norm}` as long as they go on, then `{prefix}.{k}` alone.
    fn mlp(&mut self, last: Kind, prefix: &str, in_features: u32) -> Result<Vec<Block>, Error> {
        let mut blocks = Vec::new();
        let mut width = in_features;
        loop {
            let at = format!("{prefix}.{}", blocks.len());
            if self.shapes.shape(&format!("{at}.net.0.weight")).is_none() {
                blocks.push(self.linear(last, &format!("{at}.weight"), &format!("{at}.bias"), width)?);
                return Ok(blocks);
            }
            let mut block = self.linear(Kind::Linear, &format!("{at}.net.0.weight"), &format!("{at}.net.0.bias"), width)?;
            width = block.out_features;
            let norm = ["weight", "bias"].map(|kind| format!("{at}.net.1.{kind}"));
            for name in &norm {
                self.expect(name, &[width as usize])?;
            }
            block.affine = Some(self.push(Kind::Affine, norm.map(|name| (name, vec![width as usize])).into()));
            blocks.push(block);
        }
    }

    /// Codes and hypernetwork, and the layers that it makes.
    fn hypernetwork(&mut self) -> Result<(Hypernetwork, Vec<(u32, u32)>), Error> {
        let shape = self.shape(CODES, 2)?;
        let latent = shape[1] as u32;
        let codes = self.push(Kind::Codes, vec![(CODES.into(), shape)]);
        let mut layers = Vec::new();
        let mut scene = Vec::new();
        let mut width = SCENE_INPUT;
        loop {
            let prefix = format!("{HYPER}.{}.hyper_linear.hypo_params.net", layers.len());
            let first = ["net.0.weight", "weight"].map(|name| self.shapes.shape(&format!("{prefix}.0.{name}")));
            if first == [None, None] && !layers.is_empty() {
                return Ok((Hypernetwork { codes, latent, layers }, scene));
            }
            let blocks = self.mlp(Kind::HyperOutput, &prefix, latent)?;
            let emitted = blocks.last().expect("an MLP has a last layer").out_features;
            let out = self.outputs(&format!("{prefix} (last layer)"), width, emitted)?;
            scene.push((width, out));
            width = out;
            layers.push(blocks);
        }
    }

    /// The stored layers of a baked model's scene MLP, `[instances, in · out + out]` each; none in another model.
    fn baked(&mut self) -> Result<Vec<Block>, Error> {
        let mut layers: Vec<Block> = Vec::new();
        loop {
            let name = format!("{BAKED}.{}", layers.len());
            if self.shapes.shape(&name).is_none() {
                return Ok(layers);
            }
            let shape = self.shape(&name, 2)?;
            if let Some(first) = layers.first() {
                self.expect(&name, &[self.rows(first.linear), shape[1]])?;
            }
            let in_features = layers.last().map_or(SCENE_INPUT, |layer| layer.out_features);
            let out_features = self.outputs(&name, in_features, shape[1] as u32)?;
            let linear = self.push(Kind::Linear, vec![(name, shape)]);
            layers.push(Block { linear, affine: None, in_features, out_features });
        }
    }

    /// Rows of a parameter.
    fn rows(&self, parameter: usize) -> usize {
        self.parameters[parameter].tensors[0].1[0]
    }

    /// Outputs of a layer of f with so many inputs, of which there are `emitted` weights and biases.
    fn outputs(&self, name: &str, in_features: u32, emitted: u32) -> Result<u32, Error> {
        if emitted.is_multiple_of(in_features + 1) {
            return Ok(emitted / (in_features + 1));
        }
        let expected = format!("in · out + out values for a layer with {in_features} inputs");
        Err(Error::Tensor { name: name.into(), expected, got: emitted.to_string() })
    }
}

fn collect(shapes: &dyn Shapes, tracing_steps: u32) -> Result<(Layout, Vec<Parameter>), Error> {
    let mut collector = Collector { shapes, parameters: Vec::new() };
    let baked = collector.baked()?;
    let (source, instances, scene) = match baked.first() {
        None => {
            let (hypernetwork, scene) = collector.hypernetwork()?;
            let instances = collector.rows(hypernetwork.codes);
            (Source::Hypernetwork(hypernetwork), instances, scene)
        }
        Some(first) => {
            let scene = baked.iter().map(|layer| (layer.in_features, layer.out_features)).collect();
            (Source::Baked(baked.iter().map(|layer| layer.linear).collect()), collector.rows(first.linear), scene)
        }
    };
    let instances = instances as u32;
    let width = scene.last().map_or(SCENE_INPUT, |layer| layer.1);

    let lstm = |part: &str| format!("ray_marcher.lstm.{part}");
    let lstm_input = collector.linear(Kind::Lstm, &lstm("weight_ih"), &lstm("bias_ih"), width)?;
    let lstm_size = lstm_input.out_features / 4;
    let lstm_hidden = collector.linear(Kind::Lstm, &lstm("weight_hh"), &lstm("bias_hh"), lstm_size)?;
    collector.expect(&lstm("weight_hh"), &[lstm_input.out_features as usize, lstm_size as usize])?;
    let step_head = collector.linear(Kind::StepHead, "ray_marcher.out_layer.weight", "ray_marcher.out_layer.bias", lstm_size)?;
    collector.expect("ray_marcher.out_layer.bias", &[1])?;

    let has_density = shapes.shape("sigma.net.0.net.0.weight").or_else(|| shapes.shape("sigma.net.0.weight")).is_some();
    let density = has_density.then(|| collector.mlp(Kind::Linear, "sigma.net", SCENE_INPUT)).transpose()?;
    let pixel_generator = collector.mlp(Kind::Linear, "pixel_generator.net", width)?;
    for (layers, outputs) in density.iter().map(|layers| (layers, 1)).chain([(&pixel_generator, 3)]) {
        if let Some(last) = layers.last().filter(|last| last.out_features != outputs) {
            let (name, shape) = &collector.parameters[last.linear].tensors[0];
            let expected = format!("[{outputs}, {}]", last.in_features);
            return Err(Error::Tensor { name: name.clone(), expected, got: format!("{shape:?}") });
        }
    }
    let layout = Layout { instances, tracing_steps, source, scene, lstm_input, lstm_hidden, step_head, density, pixel_generator };
    Ok((layout, collector.parameters))
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

    /// Reads a safetensors file. Sizes come from the tensors, M from the metadata key `tracing_steps`.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let bytes = std::fs::read(path).map_err(|source| Error::Io { path: path.into(), source })?;
        Self::from_bytes(&bytes, "", path)
    }

    /// Reads a model from the bytes of a safetensors file, from the tensors whose names begin with `prefix`.
    pub fn from_bytes(bytes: &[u8], prefix: &str, path: &Path) -> Result<Self, Error> {
        let format = |what: String| Error::Format { path: path.into(), what };
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|error| not_safetensors(path, error))?;
        let text = header.metadata().clone().unwrap_or_default();
        let file = SafeTensors::deserialize(bytes).map_err(|error| not_safetensors(path, error))?;
        let mut tensors = Tensors::new();
        for (name, view) in file.tensors() {
            if let Some(name) = name.strip_prefix(prefix) {
                if view.dtype() == Dtype::F32 {
                    tensors.insert(name.to_string(), (view.shape().to_vec(), floats(&view)));
                } else if [CODES, HYPER, BAKED].iter().any(|part| name.starts_with(part)) {
                    let got = format!("{:?}", view.dtype());
                    return Err(Error::Tensor { name: name.into(), expected: "F32".into(), got });
                }
            }
        }
        let number = |key: &str| text.get(key).map(|value| value.parse::<f64>());
        let tracing_steps = match number("tracing_steps") {
            Some(Ok(steps)) if (1.0..=MOST_STEPS).contains(&steps) && steps.fract() == 0.0 => steps as u32,
            Some(_) => return Err(format(format!("metadata `tracing_steps` must be a whole number from 1 to {MOST_STEPS}"))),
            None => return Err(format("it is no model of this program: it has no metadata `tracing_steps`".into())),
        };
        let json = |key: &str| text.get(key).map_or("null", String::as_str);
        let wrong = |key: &str, error: serde_json::Error| format(format!("metadata `{key}`: {error}"));
        let calibration = |key: &str| serde_json::from_str(json(key)).map_err(|error| wrong(key, error));
        let instance_names: Option<Vec<String>> =
            serde_json::from_str(json("instance_names")).map_err(|error| wrong("instance_names", error))?;
        let ray_sphere = match number("ray_sphere") {
            Some(Ok(radius)) if radius > 0.0 && radius.is_finite() => Some(radius),
            None => None,
            Some(_) => return Err(format("metadata `ray_sphere` must be a positive number".into())),
        };
        let metadata = Metadata {
            instance_names: instance_names.unwrap_or_default(),
            side: number("side").and_then(Result::ok).map(|side| side as u32),
            orbit_radius: number("orbit_radius").and_then(Result::ok),
            ray_sphere,
            distances: serde_json::from_str(json("distances")).map_err(|error| wrong("distances", error))?,
            calibration: calibration("calibration")?,
            calibration_of_new: calibration("calibration_of_new")?,
        };
        Self::from_tensors(&tensors, tracing_steps, metadata)
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

    /// Writes a safetensors file, by way of a temporary file beside it: a crash leaves the old one whole.
    pub fn save(&self, path: &Path) -> Result<(), Error> {
        write_tensors(path, &self.tensors(), self.metadata_text())
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

    pub(crate) fn metadata_text(&self) -> HashMap<String, String> {
        let mut text = HashMap::from([
            ("format".to_string(), "sigma-srn 1".to_string()),
            ("tracing_steps".into(), self.layout.tracing_steps.to_string()),
            ("density".into(), self.layout.density.is_some().to_string()),
            ("hidden".into(), self.layout.features().to_string()),
            ("instances".into(), self.layout.instances.to_string()),
        ]);
        if let Source::Hypernetwork(hypernetwork) = &self.layout.source {
            text.insert("latent".into(), hypernetwork.latent.to_string());
        }
        if !self.metadata.instance_names.is_empty() {
            text.insert("instance_names".into(), serde_json::json!(self.metadata.instance_names).to_string());
        }
        if let Some(side) = self.metadata.side {
            text.insert("side".into(), side.to_string());
        }
        if let Some(radius) = self.metadata.orbit_radius {
            text.insert("orbit_radius".into(), radius.to_string());
        }
        if let Some(radius) = self.metadata.ray_sphere {
            text.insert("ray_sphere".into(), radius.to_string());
        }
        if let Some(distances) = self.metadata.distances {
            text.insert("distances".into(), serde_json::json!(distances).to_string());
        }
        let Metadata { calibration, calibration_of_new, .. } = &self.metadata;
        for (key, calibration) in [("calibration", calibration), ("calibration_of_new", calibration_of_new)] {
            if let Some(calibration) = calibration {
                text.insert(key.into(), serde_json::json!(calibration).to_string());
            }
        }
        text
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

    /// The same networks with these instances alone, whose latent codes are `codes`, `[names.len(), latent]`. Without the calibration, which tells
    /// of errors at the old ones.
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

/// Values of a parameter, by the rules of spec 2, "Initialisation".
fn initial_values(parameter: &Parameter, random: &mut Random) -> Vec<f32> {
    let shape = &parameter.tensors[0].1;
    let count: usize = shape.iter().product();
    let mut gaussian =
        |count: usize, deviation: f64| -> Vec<f32> { (0..count).map(|_| (deviation * normal(random)) as f32).collect() };
    match parameter.kind {
        Kind::Codes => gaussian(count, 0.01),
        Kind::Affine => [vec![1.0; count], vec![0.0; count]].concat(),
        Kind::Lstm => {
            let gates = shape[0];
            let mut values = gaussian(count + gates, 1.0);
            values[count + gates / 4..count + gates / 2].fill(1.0);
            values
        }
        Kind::Linear | Kind::HyperOutput | Kind::StepHead => {
            let fan_in = shape[1] as f64;
            let uniform = |random: &mut Random| ((2.0 * random.random::<f64>() - 1.0) / fan_in.sqrt()) as f32;
            let mut values = match parameter.kind {
                Kind::StepHead => (0..count).map(|_| uniform(random)).collect(),
                kind => {
                    let scale = if kind == Kind::HyperOutput { 0.1 } else { 1.0 };
                    (0..count).map(|_| ((2.0 / fan_in).sqrt() * scale * normal(random)) as f32).collect::<Vec<f32>>()
                }
            };
            values.extend((0..shape[0]).map(|_| uniform(random)));
            values
        }
    }
}

fn floats(view: &TensorView) -> Vec<f32> {
    view.data().chunks_exact(4).map(|bytes| f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])).collect()
}

fn not_safetensors(path: &Path, error: SafeTensorError) -> Error {
    Error::Format { path: path.into(), what: format!("not a safetensors file: {error}") }
}

/// Writes named tensors to `path` by way of a temporary file beside it.
pub(crate) fn write_tensors(
    path: &Path,
    tensors: &[(String, Vec<usize>, &[f32])],
    metadata: HashMap<String, String>,
) -> Result<(), Error> {
    let views: Vec<(&str, TensorView)> = tensors
        .iter()
        .map(|(name, shape, values)| {
            let bytes = bytemuck::cast_slice(values);
            (name.as_str(), TensorView::new(Dtype::F32, shape.clone(), bytes).expect("a parameter fills its shape"))
        })
        .collect();
    let bytes = safetensors::serialize(views, Some(metadata)).map_err(|error| not_safetensors(path, error))?;
    write_atomically(path, &bytes)
}

/// Writes a file so that at any moment either the old or the new content is there.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    let io = |source| Error::Io { path: path.into(), source };
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(".partial");
    let temporary = path.with_file_name(name);
    let mut file = std::fs::File::create(&temporary).map_err(io)?;
    std::io::Write::write_all(&mut file, bytes).map_err(io)?;
    file.sync_all().map_err(io)?;
    std::fs::rename(&temporary, path).map_err(io)
}

/// Tensors and metadata of a file.
pub(crate) fn read_tensors(path: &Path) -> Result<(Tensors, HashMap<String, String>), Error> {
    let bytes = std::fs::read(path).map_err(|source| Error::Io { path: path.into(), source })?;
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|error| not_safetensors(path, error))?;
    let file = SafeTensors::deserialize(&bytes).map_err(|error| not_safetensors(path, error))?;
    let floats = file.tensors().into_iter().filter(|(_, view)| view.dtype() == Dtype::F32);
    let tensors = floats.map(|(name, view)| (name, (view.shape().to_vec(), self::floats(&view)))).collect();
    Ok((tensors, header.metadata().clone().unwrap_or_default()))
}

/// Named tensors of a file, with shape and values; those of other types than `F32` are left out.
pub(crate) type Tensors = HashMap<String, (Vec<usize>, Vec<f32>)>;
