//! Which tensor is which part of the network, by the names of the released checkpoints.

use rand::RngExt;

use super::Tensors;
use crate::Error;
use crate::random::{Random, normal};

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

/// One linear layer, with or without the layer norm and ReLU behind it; numbers of [`Model::parameters`](super::Model::parameters).
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
    /// Stored, those of the few instances that the model knows ([`Model::bake`](super::Model::bake)): one parameter per layer, a row for each instance.
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

/// Where the shapes of a layout come from: a file's tensors, or a configuration.
pub(super) trait Shapes {
    /// Shape of a tensor, `None` if it is not there.
    fn shape(&self, name: &str) -> Option<Vec<usize>>;
}

impl Shapes for Tensors {
    fn shape(&self, name: &str) -> Option<Vec<usize>> {
        self.get(name).map(|tensor| tensor.0.clone())
    }
}

pub(super) const CODES: &str = "latent_codes.weight";
pub(super) const HYPER: &str = "hyper_phi.layers";
pub(super) const BAKED: &str = "phi.layers";
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

pub(super) fn collect(shapes: &dyn Shapes, tracing_steps: u32) -> Result<(Layout, Vec<Parameter>), Error> {
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

/// Values of a parameter, by the rules of spec 2, "Initialisation".
pub(super) fn initial_values(parameter: &Parameter, random: &mut Random) -> Vec<f32> {
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
