//! Forward pass (spec 2).

use std::collections::BTreeMap;

use srn_plan::ops::embedding::Embedding;
use srn_plan::ops::layer_norm_relu::Saved as NormSaved;
use srn_plan::ops::rays::Pixels;
use srn_plan::ops::{
    advance, density_sum, depth, embedding, layer_norm_relu, linear, lstm_cell, point_layer, rays, tile as tile_ops,
};
use srn_plan::{BufferId, Builder, Executor, ExecutorError, PlanError, Rows, StageId, Tile};

use super::streamed::{OnHost, Streamed};
use super::{BlockBuffers, BlockSaved, HyperBuffers, HyperSaved, Network, Saved, SourceBuffers};
use crate::model::Model;

/// Makes the weights of f for each slot, where nothing is trained: by the hypernetwork, or as they are stored.
#[derive(Debug)]
pub(crate) struct Instances {
    stage: StageId,
    streamed: Option<Streamed>,
    /// Values of the parameters that are streamed.
    on_host: BTreeMap<usize, Vec<f32>>,
}

impl Instances {
    /// Adds the stages.
    pub fn new(b: &mut Builder, network: &Network, model: &Model, on_host: &OnHost) -> Result<Self, PlanError> {
        let mut streamed = Streamed::new(b, model, network.batch, on_host, false)?;
        let stage = match &network.source {
            SourceBuffers::Hypernetwork(hyper) => {
                let saved = HyperSaved::new(b, network, hyper)?;
                let stage = b.stage("instances");
                hypernetwork(b, network, hyper, &saved)?;
                if let Some(streamed) = &mut streamed {
                    streamed.forward(b, network, &saved)?;
                }
                stage
            }
            // A table as that of the codes is.
            SourceBuffers::Baked(stored) => {
                let stage = b.stage("instances");
                for (&stored, scene) in stored.iter().zip(&network.scene) {
                    let (batch, instances) = (network.batch.slots, network.instances);
                    let table = Embedding { batch, instances, latent: scene.layer.parameters() };
                    embedding::forward(b, table, stored, network.index, scene.layer.weights)?;
                }
                stage
            }
        };
        Ok(Instances { stage, streamed, on_host: BTreeMap::new() })
    }

    /// Writes the parameters, those that are streamed to the host.
    pub fn upload(&mut self, executor: &mut dyn Executor, network: &Network, model: &Model) -> Result<(), ExecutorError> {
        self.on_host = network.upload(executor, model)?;
        Ok(())
    }

    /// Runs the stages.
    pub fn run(&mut self, executor: &mut dyn Executor) -> Result<(), ExecutorError> {
        executor.run(self.stage)?;
        match &mut self.streamed {
            Some(streamed) => streamed.run_forward(executor, |number| &self.on_host[&number]),
            None => Ok(()),
        }
    }
}

/// Codes of the slots, then one MLP per layer of f: code to weights.
pub(crate) fn hypernetwork(
    b: &mut Builder,
    network: &Network,
    hyper: &HyperBuffers,
    saved: &HyperSaved,
) -> Result<(), PlanError> {
    embedding::forward(b, network.embedding(hyper), hyper.codes, network.index, saved.z)?;
    for (blocks, saved_blocks) in hyper.layers.iter().zip(&saved.mlps) {
        mlp(b, Rows::plain(network.batch.slots), blocks, saved.z, network.index, saved_blocks)?;
    }
    Ok(())
}

/// One tile of rays to colours and depths, `rgb` and `depth` of the batch.
pub(crate) fn render(b: &mut Builder, network: &Network, saved: &Saved, tile: Tile) -> Result<(), PlanError> {
    let rows = tile.rows;
    let n = rows.count();
    let (features, lstm) = (network.features(), network.lstm_size());
    let last = network.tracing_steps as usize;

    tile_ops::gather(b, tile, 2, network.uv, saved.uv)?;
    tile_ops::gather(b, tile, 1, network.z0, saved.z0)?;
    // x_0, at the camera or on the sphere around the object
    rays::forward(b, rows, network.pixels(saved), saved.x[0], saved.direction)?;
    for i in 0..=last {
        // v_i = f(x_i)
        let v = mlp(b, rows, &network.scene, saved.x[i], network.slots, &saved.scene[i])?;
        // phi = Σ g(x_i) f(x_i)
        if let Some(density) = &network.density {
            let (head, layers) = density.split_last().expect("g has layers");
            let (g, saved_layers) = saved.density[i].split_last().expect("g has layers");
            let hidden = mlp(b, rows, layers, saved.x[i], network.slots, saved_layers)?;
            density_sum::forward(b, n, features, head.layer, hidden, v, g.y, saved.phi, i > 0)?;
        }
        if i == last {
            break;
        }
        // (h, c) = lstm(v_i, (h, c)); x_{i+1} = x_i + d (w·h + b)
        linear::forward(b, rows, network.lstm_input.layer, v, network.slots, saved.gates[i], false)?;
        linear::forward(b, rows, network.lstm_hidden.layer, saved.h[i], network.slots, saved.gates[i], true)?;
        lstm_cell::forward(b, n, lstm, saved.gates[i], saved.c[i], saved.h[i + 1], saved.c[i + 1])?;
        let head = network.step_head.layer;
        advance::forward(b, n, head, saved.x[i], saved.direction, saved.h[i + 1], saved.step[i], saved.x[i + 1])?;
    }
    // rgb = h(phi); depth = z of x_M
    let rgb = mlp(b, rows, &network.pixel_generator, saved.phi, network.slots, &saved.pixel_generator)?;
    depth::forward(b, rows, network.world_from_camera, saved.x[last], saved.depth)?;
    tile_ops::scatter(b, tile, 3, rgb, network.rgb)?;
    tile_ops::scatter(b, tile, 1, saved.depth, network.depth)
}

/// Layers one after the other; returns the buffer of the last output.
fn mlp(
    b: &mut Builder,
    rows: Rows,
    blocks: &[BlockBuffers],
    x: BufferId,
    slots: BufferId,
    saved: &[BlockSaved],
) -> Result<BufferId, PlanError> {
    let mut x = x;
    for (k, (block, saved)) in blocks.iter().zip(saved).enumerate() {
        if let Some(affine) = block.of_points(k) {
            point_layer::forward(b, rows, block.layer, x, slots, affine, saved.y)?;
        } else {
            linear::forward(b, rows, block.layer, x, slots, saved.z, false)?;
            if let Some(affine) = block.affine {
                let norm = NormSaved { x: saved.z, stats: saved.stats, affine, centred: block.centred };
                layer_norm_relu::forward(b, rows.count(), block.layer.out_features, norm, saved.y)?;
            }
        }
        x = saved.y;
    }
    Ok(x)
}

impl Network {
    pub(super) fn embedding(&self, hyper: &HyperBuffers) -> Embedding {
        Embedding { batch: self.batch.slots, instances: self.instances, latent: hyper.latent }
    }

    pub(crate) fn pixels(&self, saved: &Saved) -> Pixels {
        Pixels {
            world_from_camera: self.world_from_camera,
            intrinsics: self.intrinsics,
            uv: saved.uv,
            z0: saved.z0,
            sphere: self.ray_sphere,
        }
    }
}
