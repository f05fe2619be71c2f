//! Output layers of the hypernetwork that would fill the memory budget: they and their moments stay on the host, and the device has a part
//! of one at a time, some of its outputs.

use std::collections::BTreeMap;
use std::ops::Range;

use srn_plan::ops::linear::{Layer, Sets};
use srn_plan::ops::{adam, linear, tile as tile_ops};
use srn_plan::{BufferId, Builder, Executor, ExecutorError, Parts, PlanError, Rows, StageId, Tile, tiles};

use super::backward::HyperScratch;
use super::{Batch, HyperSaved, Network, Started};
use crate::engine::Engine;
use crate::model::{Kind, Model, Source};

/// Which parameters stay on the host, and how much of one the device gets at a time.
#[derive(Clone, Debug)]
pub(crate) struct OnHost {
    /// Their numbers in the model.
    pub parameters: Vec<usize>,
    /// Values of a part, at most.
    most: usize,
}

impl OnHost {
    /// Those that are large, where all parameters would take more than half of the engine's memory budget, and those that no buffer holds.
    /// `copies`: how often the device has each parameter; 1, or 4 with its gradient and moments.
    pub fn of(engine: &Engine, model: &Model, copies: u64) -> Self {
        let values: usize = model.parameters.iter().map(|parameter| parameter.values.len()).sum();
        let fits = copies * values as u64 * engine.value_bytes() <= engine.budget() / 2;
        // The buffers of a part take a quarter of the budget at most.
        let of_budget = if fits { u64::MAX } else { engine.budget() / (4 * copies * engine.value_bytes()) };
        let most = of_budget.min(engine.max_binding_bytes() / 4) as usize;
        let parameters = model.parameters.iter().enumerate();
        let large = parameters.filter(|(_, parameter)| parameter.kind == Kind::HyperOutput && parameter.values.len() > most);
        OnHost { parameters: large.map(|(number, _)| number).collect(), most }
    }
}

/// Some outputs of a layer.
#[derive(Clone, Copy, Debug)]
struct Part {
    /// Number of the layer's parameter in the model.
    parameter: usize,
    /// Number of the layer of f whose weights it makes.
    scene: usize,
    layer: Layer,
    /// The outputs as rows of an image, the slots as images.
    tile: Tile,
}

impl Part {
    /// Where its weights and its bias are among the values of the parameter.
    fn ranges(&self) -> [Range<usize>; 2] {
        let (inputs, first, count) =
            (self.layer.in_features as usize, self.tile.first_row as usize, self.tile.rows.rows_per_group as usize);
        let bias = self.tile.rows_per_image as usize * inputs + first;
        [first * inputs..(first + count) * inputs, bias..bias + count]
    }

    /// Copies its values out of those of the parameter, into the beginning of `part`.
    fn cut(&self, values: &[f32], part: &mut [f32]) {
        let [weights, bias] = self.ranges();
        let (to_weights, rest) = part.split_at_mut(weights.len());
        to_weights.copy_from_slice(&values[weights]);
        rest[..bias.len()].copy_from_slice(&values[bias]);
    }

    /// Copies its values back.
    fn put(&self, part: &[f32], values: &mut [f32]) {
        let [weights, bias] = self.ranges();
        let (from_weights, rest) = part.split_at(weights.len());
        let count = bias.len();
        values[weights].copy_from_slice(from_weights);
        values[bias].copy_from_slice(&rest[..count]);
    }
}

/// What is only there where the layers are trained.
#[derive(Debug)]
struct Trained {
    d_weights: BufferId,
    /// First and second moment of a part.
    moments: [BufferId; 2],
    /// Those of the whole layers, by the number of the parameter.
    host_moments: BTreeMap<usize, [Vec<f32>; 2]>,
    /// Of each part: gradient of its weights, and Adam.
    stages: Vec<[StageId; 2]>,
}

/// The parts of all such layers, and the buffers that hold one of them.
#[derive(Debug)]
pub(crate) struct Streamed {
    /// In the order of their computation.
    parts: Vec<Part>,
    /// Weights, then bias.
    weights: BufferId,
    /// Outputs of a part `[slots, outputs]`, or their gradient.
    outputs: BufferId,
    trained: Option<Trained>,
    /// Stage of each part.
    forward: Vec<StageId>,
    backward: Vec<StageId>,
    /// A part on its way.
    values: Vec<f32>,
}

impl Streamed {
    /// Adds the buffers; `None` where no layer is streamed.
    pub fn new(
        b: &mut Builder,
        model: &Model,
        batch: Batch,
        on_host: &OnHost,
        is_trained: bool,
    ) -> Result<Option<Self>, PlanError> {
        let Source::Hypernetwork(hypernetwork) = &model.layout.source else { return Ok(None) };
        let outputs = hypernetwork.layers.iter().enumerate().filter_map(|(scene, mlp)| Some((scene, mlp.last()?)));
        let outputs: Vec<_> = outputs.filter(|(_, block)| on_host.parameters.contains(&block.linear)).collect();
        let mut cut = Vec::new();
        for &(scene, block) in &outputs {
            let most_outputs = on_host.most / (block.in_features as usize + 1);
            cut.extend(tiles(1, block.out_features, most_outputs as u32).into_iter().map(|tile| (scene, block, tile)));
        }
        let longest = |width: fn(u32) -> u32| {
            cut.iter().map(|(_, block, tile)| (tile.rows.rows_per_group * width(block.in_features)) as usize).max()
        };
        let (Some(len), Some(outputs)) = (longest(|inputs| inputs + 1), longest(|_| 1)) else { return Ok(None) };
        let weights = b.input("part of hyper", len)?;
        let trained = match is_trained {
            true => Some(Trained {
                d_weights: b.scratch("d part of hyper", len)?,
                moments: [b.input("m part of hyper", len)?, b.input("v part of hyper", len)?],
                host_moments: on_host
                    .parameters
                    .iter()
                    .map(|&number| (number, [(); 2].map(|()| vec![0.0; model.parameters[number].values.len()])))
                    .collect(),
                stages: Vec::new(),
            }),
            false => None,
        };
        let part = |(scene, block, tile): (usize, &crate::model::Block, Tile)| Part {
            parameter: block.linear,
            scene,
            layer: Layer { weights, in_features: block.in_features, out_features: tile.rows.rows_per_group, sets: Sets::Shared },
            tile: Tile { rows: Rows { groups: batch.slots, ..tile.rows }, ..tile },
        };
        Ok(Some(Streamed {
            parts: cut.into_iter().map(part).collect(),
            weights,
            outputs: b.scratch("outputs of part", batch.slots as usize * outputs)?,
            trained,
            forward: Vec::new(),
            backward: Vec::new(),
            values: vec![0.0; len],
        }))
    }

    /// Adds the stages from the last hidden layers to the weights of f.
    pub fn forward(&mut self, b: &mut Builder, network: &Network, saved: &HyperSaved) -> Result<(), PlanError> {
        let rows = Rows::plain(network.batch.slots);
        for part in &self.parts {
            self.forward.push(b.stage("part of hyper"));
            linear::forward(b, rows, part.layer, saved.last_hidden(part.scene), network.index, self.outputs, false)?;
            tile_ops::scatter(b, part.tile, 1, self.outputs, network.scene[part.scene].layer.weights)?;
        }
        Ok(())
    }

    /// Adds the stages from the gradients of the weights of f to those of the last hidden layers.
    pub fn backward(
        &mut self,
        b: &mut Builder,
        network: &Network,
        scratch: &HyperScratch,
        started: &mut Started,
    ) -> Result<(), PlanError> {
        let rows = Rows::plain(network.batch.slots);
        for part in &self.parts {
            self.backward.push(b.stage("part of hyper back"));
            self.gather_gradient(b, network, part)?;
            let into = scratch.d_last_hidden[part.scene].expect("the last layer of this MLP is streamed");
            linear::backward_input(b, rows, part.layer, self.outputs, network.index, into, started.accumulate(into, 0))?;
        }
        Ok(())
    }

    /// Adds the stages for the gradients of the layers' own weights, and for Adam.
    pub fn update(
        &mut self,
        b: &mut Builder,
        network: &Network,
        saved: &HyperSaved,
        schedule: BufferId,
    ) -> Result<(), PlanError> {
        let Some(Trained { d_weights, moments: [m, v], .. }) = self.trained else { return Ok(()) };
        let rows = Rows::plain(network.batch.slots);
        let mut stages = Vec::new();
        for part in &self.parts {
            let gradient = b.stage("gradient of a part");
            self.gather_gradient(b, network, part)?;
            let x = saved.last_hidden(part.scene);
            linear::backward_weight(b, Parts::whole(rows), part.layer, x, self.outputs, d_weights, false)?;
            let update = b.stage("update of a part");
            adam::step(b, part.layer.parameters(), d_weights, schedule, self.weights, m, v)?;
            stages.push([gradient, update]);
        }
        if let Some(trained) = &mut self.trained {
            trained.stages = stages;
        }
        Ok(())
    }

    fn gather_gradient(&self, b: &mut Builder, network: &Network, part: &Part) -> Result<(), PlanError> {
        let d_weights = network.scene[part.scene].d_weights.expect("a trainer wants gradients of f's weights");
        tile_ops::gather(b, part.tile, 1, d_weights, self.outputs)
    }

    /// Runs the stages of [`Streamed::forward`]; `home` has the values of each parameter.
    pub fn run_forward<'a>(
        &mut self,
        executor: &mut dyn Executor,
        home: impl Fn(usize) -> &'a [f32],
    ) -> Result<(), ExecutorError> {
        let Self { parts, weights, forward, values, .. } = self;
        run(executor, home, parts, forward, *weights, values)
    }

    /// Runs the stages of [`Streamed::backward`]; `home` has the values of each parameter.
    pub fn run_backward<'a>(
        &mut self,
        executor: &mut dyn Executor,
        home: impl Fn(usize) -> &'a [f32],
    ) -> Result<(), ExecutorError> {
        let Self { parts, weights, backward, values, .. } = self;
        run(executor, home, parts, backward, *weights, values)
    }

    /// Runs the stages of [`Streamed::update`]: values and moments of each part go to the device and come back.
    pub fn run_update(&mut self, executor: &mut dyn Executor, model: &mut Model) -> Result<(), ExecutorError> {
        let Some(trained) = &mut self.trained else { return Ok(()) };
        for (part, &[gradient, update]) in self.parts.iter().zip(&trained.stages) {
            executor.run(gradient)?;
            let [m, v] = trained.host_moments.get_mut(&part.parameter).expect("there for each").each_mut();
            let mut homes =
                [(self.weights, &mut model.parameters[part.parameter].values), (trained.moments[0], m), (trained.moments[1], v)];
            for (buffer, home) in &homes {
                part.cut(home, &mut self.values);
                executor.write(*buffer, &self.values)?;
            }
            executor.run(update)?;
            for (buffer, home) in &mut homes {
                part.put(&executor.read(*buffer)?, home);
            }
        }
        Ok(())
    }

    /// Numbers of the parameters with their moments, where they are trained.
    pub fn moments(&self) -> impl Iterator<Item = (usize, &[Vec<f32>; 2])> {
        self.trained.iter().flat_map(|trained| &trained.host_moments).map(|(&number, moments)| (number, moments))
    }

    /// The same, to be replaced.
    pub fn moments_mut(&mut self) -> impl Iterator<Item = (usize, &mut [Vec<f32>; 2])> {
        self.trained.iter_mut().flat_map(|trained| &mut trained.host_moments).map(|(&number, moments)| (number, moments))
    }

    /// Gradient of parameter `number`, which has `len` values; `None` where it is not streamed or not trained.
    pub fn read_gradient(
        &self,
        executor: &mut dyn Executor,
        number: usize,
        len: usize,
    ) -> Result<Option<Vec<f32>>, ExecutorError> {
        let Some(trained) = self.trained.as_ref().filter(|trained| trained.host_moments.contains_key(&number)) else {
            return Ok(None);
        };
        let mut values = vec![0.0; len];
        for (part, &[gradient, _]) in self.parts.iter().zip(&trained.stages).filter(|(part, _)| part.parameter == number) {
            executor.run(gradient)?;
            part.put(&executor.read(trained.d_weights)?, &mut values);
        }
        Ok(Some(values))
    }
}

/// Runs the stage of each part, its values brought to the device before.
fn run<'a>(
    executor: &mut dyn Executor,
    home: impl Fn(usize) -> &'a [f32],
    parts: &[Part],
    stages: &[StageId],
    weights: BufferId,
    values: &mut [f32],
) -> Result<(), ExecutorError> {
    for (part, &stage) in parts.iter().zip(stages) {
        part.cut(home(part.parameter), values);
        executor.write(weights, values)?;
        executor.run(stage)?;
    }
    Ok(())
}
