//! The network as steps of a plan, in the paper's order: hypernetwork (codes to the weights of f), rays, scene MLP f, LSTM ray
//! marcher, density net g, density-weighted sum, pixel generator h. [`forward`] and [`backward`] mirror each other.

pub(crate) mod backward;
mod centred;
pub(crate) mod forward;
mod saved;
pub(crate) mod streamed;

use std::collections::{BTreeMap, HashSet};

use srn_plan::ops::linear::{Layer, Sets};
use srn_plan::ops::point_layer;
use srn_plan::{BufferId, Builder, PlanError};

pub(crate) use saved::{BlockSaved, HyperSaved, Saved, Scratch, Sums};

use crate::model::{Block, Hypernetwork, Model, Source};

/// What the renderer will be used for; decides what the forward pass keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Purpose {
    /// Images only: nothing is kept.
    Render,
    /// Gradients to the rays.
    Pose,
    /// Gradients to the rays and to the weights.
    Train,
}

/// Sizes of a batch of images.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Batch {
    /// Images (hypotheses, when poses are estimated).
    pub images: u32,
    /// Rays of each.
    pub rays: u32,
    /// Sets of weights of f: one per image in training, one per instance otherwise.
    pub slots: u32,
}

/// A layer with its buffers.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BlockBuffers {
    pub layer: Layer,
    /// Gamma and beta; `None` for a layer without norm and ReLU.
    pub affine: Option<BufferId>,
    /// Gradient of the weights, if wanted.
    pub d_weights: Option<BufferId>,
    /// Gradient of gamma and beta, if wanted.
    pub d_affine: Option<BufferId>,
    /// Before a norm: its weights have no mean over its outputs.
    pub centred: bool,
}

impl BlockBuffers {
    /// Gamma and beta of a network's first layer, if its input are points and it is done in one step: where its weights take no gradient,
    /// nothing of it need be kept. `number` is that of the layer in its network.
    pub fn of_points(&self, number: usize) -> Option<BufferId> {
        let in_one = number == 0 && self.layer.in_features == point_layer::COORDINATES && self.d_weights.is_none();
        self.affine.filter(|_| in_one)
    }
}

/// Codes and hypernetwork.
#[derive(Debug)]
pub(crate) struct HyperBuffers {
    pub codes: BufferId,
    /// Gradient of the codes, if wanted.
    pub d_codes: Option<BufferId>,
    pub latent: u32,
    /// One MLP per layer of f, without its last layer where that is streamed.
    pub layers: Vec<Vec<BlockBuffers>>,
}

/// Where the weights of f come from.
#[derive(Debug)]
pub(crate) enum SourceBuffers {
    Hypernetwork(HyperBuffers),
    /// Stored weights of each layer of f, a row for each instance.
    Baked(Vec<BufferId>),
}

/// The model's parameters, and what is shared by the whole batch, as buffers of a plan.
#[derive(Debug)]
pub(crate) struct Network {
    pub batch: Batch,
    trainable: Trainable,
    pub tracing_steps: u32,
    /// Radius of the sphere on which rays begin; 0: at the camera.
    pub ray_sphere: f32,
    pub instances: u32,
    /// One buffer per parameter of the model, in its order; `None` for those that are streamed.
    pub parameters: Vec<Option<BufferId>>,
    /// Gradients of the parameters that are trained.
    pub d_parameters: Vec<Option<BufferId>>,
    /// Number of the instance behind each slot `[slots]`.
    pub index: BufferId,
    /// Slot of each image `[images]`.
    pub slots: BufferId,
    /// `world_from_camera [images,12]`, `intrinsics [images,4]`, `uv [images·rays,2]`, `z0 [images·rays]`.
    pub world_from_camera: BufferId,
    pub intrinsics: BufferId,
    pub uv: BufferId,
    pub z0: BufferId,
    /// Results `[images·rays,3]` and `[images·rays]`.
    pub rgb: BufferId,
    pub depth: BufferId,
    pub source: SourceBuffers,
    pub scene: Vec<BlockBuffers>,
    pub lstm_input: BlockBuffers,
    pub lstm_hidden: BlockBuffers,
    pub step_head: BlockBuffers,
    pub density: Option<Vec<BlockBuffers>>,
    pub pixel_generator: Vec<BlockBuffers>,
    /// Gamma = 1, beta = 0 for each width of f: its layer norm has no affine part.
    pub identity: Vec<(BufferId, u32)>,
}

/// Which parameters get gradients.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Trainable {
    Nothing,
    Codes,
    Everything,
}

impl Network {
    /// Adds the buffers. `world_from_camera` is a step's output when poses are estimated, else the caller's input; the parameters numbered in
    /// `streamed` get none.
    pub fn new(
        b: &mut Builder,
        model: &Model,
        batch: Batch,
        trainable: Trainable,
        pose_is_input: bool,
        streamed: &[usize],
    ) -> Result<Self, PlanError> {
        let layout = &model.layout;
        let codes = match &layout.source {
            Source::Hypernetwork(hypernetwork) => Some(hypernetwork.codes),
            Source::Baked(_) => None,
        };
        let mut parameters = Vec::new();
        let mut d_parameters = Vec::new();
        for (number, parameter) in model.parameters.iter().enumerate() {
            if streamed.contains(&number) {
                parameters.push(None);
                d_parameters.push(None);
                continue;
            }
            let (name, len) = (&parameter.tensors[0].0, parameter.values.len());
            parameters.push(Some(b.input(name.clone(), len)?));
            let wanted = match trainable {
                Trainable::Nothing => false,
                Trainable::Codes => Some(number) == codes,
                Trainable::Everything => true,
            };
            d_parameters.push(if wanted { Some(b.scratch(format!("d {name}"), len)?) } else { None });
        }
        let resident = |number: usize| parameters[number].expect("what is streamed has been left out");
        let block = |block: &Block| BlockBuffers {
            layer: Layer {
                weights: resident(block.linear),
                in_features: block.in_features,
                out_features: block.out_features,
                sets: Sets::Shared,
            },
            affine: block.affine.map(resident),
            d_weights: d_parameters[block.linear],
            d_affine: block.affine.and_then(|affine| d_parameters[affine]),
            centred: trainable == Trainable::Nothing,
        };
        let blocks =
            |list: &Vec<Block>| list.iter().filter(|block| parameters[block.linear].is_some()).map(block).collect::<Vec<_>>();

        let mut identity: Vec<(BufferId, u32)> = Vec::new();
        let mut scene = Vec::new();
        for (number, &(in_features, out_features)) in layout.scene.iter().enumerate() {
            if !identity.iter().any(|known| known.1 == out_features) {
                identity.push((b.input(format!("identity affine {out_features}"), 2 * out_features as usize)?, out_features));
            }
            let len = batch.slots as usize * (out_features * (in_features + 1)) as usize;
            let weights = b.scratch(format!("f.{number} weights"), len)?;
            let d_weights =
                if trainable == Trainable::Nothing { None } else { Some(b.scratch(format!("d f.{number} weights"), len)?) };
            scene.push(BlockBuffers {
                layer: Layer { weights, in_features, out_features, sets: Sets::Slots { count: batch.slots } },
                affine: identity.iter().find(|known| known.1 == out_features).map(|known| known.0),
                d_weights,
                d_affine: None,
                centred: trainable == Trainable::Nothing,
            });
        }

        let images = batch.images as usize;
        let rows = images * batch.rays as usize;
        Ok(Network {
            batch,
            trainable,
            tracing_steps: layout.tracing_steps,
            ray_sphere: model.metadata.ray_sphere.unwrap_or(0.0) as f32,
            instances: layout.instances,
            index: b.input_u32("instance of slot", batch.slots as usize)?,
            slots: b.input_u32("slot of image", images)?,
            world_from_camera: if pose_is_input {
                b.input("world_from_camera", 12 * images)?
            } else {
                b.scratch("world_from_camera", 12 * images)?
            },
            intrinsics: b.input("intrinsics", 4 * images)?,
            uv: b.input("uv", 2 * rows)?,
            z0: b.input("z0", rows)?,
            rgb: b.scratch("rgb", 3 * rows)?,
            depth: b.scratch("depth", rows)?,
            source: match &layout.source {
                Source::Hypernetwork(Hypernetwork { codes, latent, layers }) => SourceBuffers::Hypernetwork(HyperBuffers {
                    codes: resident(*codes),
                    d_codes: d_parameters[*codes],
                    latent: *latent,
                    layers: layers.iter().map(blocks).collect(),
                }),
                Source::Baked(stored) => SourceBuffers::Baked(stored.iter().map(|&number| resident(number)).collect()),
            },
            scene,
            lstm_input: block(&layout.lstm_input),
            lstm_hidden: block(&layout.lstm_hidden),
            step_head: block(&layout.step_head),
            density: layout.density.as_ref().map(blocks),
            pixel_generator: blocks(&layout.pixel_generator),
            parameters,
            d_parameters,
            identity,
        })
    }

    /// Features of f.
    pub fn features(&self) -> u32 {
        self.scene.last().map_or(0, |block| block.layer.out_features)
    }

    /// The layers that rays go through, in the paper's order.
    pub fn blocks_of_rays(&self) -> impl Iterator<Item = &BlockBuffers> {
        let marcher = [&self.lstm_input, &self.lstm_hidden, &self.step_head];
        self.scene.iter().chain(marcher).chain(self.density.iter().flatten()).chain(&self.pixel_generator)
    }

    /// Size of the LSTM's hidden state.
    pub fn lstm_size(&self) -> u32 {
        self.lstm_hidden.layer.in_features
    }

    /// Writes the parameters and constants into an executor; where nothing is trained, without the means that a norm takes off anyway.
    /// Returns what it would have written of those that are streamed, by their numbers, if nothing is trained.
    pub fn upload(
        &self,
        executor: &mut dyn srn_plan::Executor,
        model: &Model,
    ) -> Result<BTreeMap<usize, Vec<f32>>, srn_plan::ExecutorError> {
        let mut on_host = BTreeMap::new();
        let is_frozen = self.trainable == Trainable::Nothing;
        for (number, (buffer, parameter)) in self.parameters.iter().zip(&model.parameters).enumerate() {
            let centred = is_frozen.then(|| centred::centred(&model.layout, number, parameter)).flatten();
            match (*buffer, centred) {
                (Some(buffer), Some(values)) => executor.write_f64(buffer, &values)?,
                (Some(buffer), None) => executor.write(buffer, &parameter.values)?,
                (None, Some(values)) => drop(on_host.insert(number, values.iter().map(|&value| value as f32).collect())),
                (None, None) => {}
            }
        }
        for &(buffer, width) in &self.identity {
            executor.write(buffer, &[vec![1.0; width as usize], vec![0.0; width as usize]].concat())?;
        }
        Ok(on_host)
    }
}

/// Gradients that have been written already: the first contribution overwrites, the next ones accumulate.
#[derive(Debug, Default)]
pub(crate) struct Started(HashSet<(BufferId, u32)>);

impl Started {
    /// Whether to accumulate into `buffer`; `part` tells apart the parts of a buffer that tiles write separately.
    pub fn accumulate(&mut self, buffer: BufferId, part: u32) -> bool {
        !self.0.insert((buffer, part))
    }

    /// Makes the next contribution to `buffer` the first one again.
    pub fn restart(&mut self, buffer: BufferId, part: u32) {
        self.0.remove(&(buffer, part));
    }
}
