//! Weights without means. Layer norm takes the mean over the features off what a linear map makes; where the weights stay as they are, it can
//! be taken off the weights instead, once, and of all rows there is none to be looked for.

use crate::model::{Block, Layout, Parameter, Source};

/// A parameter that makes or is the weights of a layer with a norm behind it.
struct Map {
    /// Number of the parameter in the model.
    parameter: usize,
    /// Features that the layer makes.
    out_features: usize,
    /// Its matrices one behind the other, each `[out_features, columns]`, by their columns.
    columns: Vec<usize>,
}

impl Map {
    /// A layer's own weight and bias.
    fn of_layer(parameter: usize, in_features: u32, out_features: u32) -> Self {
        Map { parameter, out_features: out_features as usize, columns: vec![in_features as usize, 1] }
    }

    /// Inputs of the hypernetwork's output layer → weight and bias of a layer of f.
    fn of_output(output: &Block, in_features: u32, out_features: u32) -> Self {
        let (inputs, hidden) = (in_features as usize, output.in_features as usize);
        Map { parameter: output.linear, out_features: out_features as usize, columns: vec![inputs * hidden, hidden, inputs, 1] }
    }

    fn centre(&self, values: &[f32]) -> Vec<f64> {
        let mut centred: Vec<f64> = values.iter().map(|&value| value.into()).collect();
        let mut rest = centred.as_mut_slice();
        for &columns in &self.columns {
            let (matrix, others) = rest.split_at_mut(self.out_features * columns);
            let mut means = vec![0.0; columns];
            for row in matrix.chunks_exact(columns) {
                means.iter_mut().zip(row).for_each(|(mean, value)| *mean += value / self.out_features as f64);
            }
            for row in matrix.chunks_exact_mut(columns) {
                row.iter_mut().zip(&means).for_each(|(value, mean)| *value -= mean);
            }
            rest = others;
        }
        centred
    }
}

fn maps(layout: &Layout) -> Vec<Map> {
    let mut blocks: Vec<&Block> = layout.density.iter().flatten().chain(&layout.pixel_generator).collect();
    let mut maps = Vec::new();
    match &layout.source {
        Source::Hypernetwork(hypernetwork) => {
            for (mlp, &(in_features, out_features)) in hypernetwork.layers.iter().zip(&layout.scene) {
                maps.extend(mlp.last().map(|output| Map::of_output(output, in_features, out_features)));
                blocks.extend(mlp);
            }
        }
        Source::Baked(stored) => {
            maps.extend(stored.iter().zip(&layout.scene).map(|(&number, &(ins, outs))| {
                let of_one = Map::of_layer(number, ins, outs);
                Map { columns: of_one.columns.repeat(layout.instances as usize), ..of_one }
            }));
        }
    }
    let with_norm = blocks.into_iter().filter(|block| block.affine.is_some());
    maps.extend(with_norm.map(|block| Map::of_layer(block.linear, block.in_features, block.out_features)));
    maps
}

/// The values of parameter `number` less their means, if a norm follows.
pub(crate) fn centred(layout: &Layout, number: usize, parameter: &Parameter) -> Option<Vec<f64>> {
    let map = maps(layout).into_iter().find(|map| map.parameter == number)?;
    Some(map.centre(&parameter.values))
}
