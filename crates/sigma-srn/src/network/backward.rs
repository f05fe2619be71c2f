//! Backward pass: [`super::forward`] in reverse.

use srn_plan::ops::layer_norm_relu::Saved as NormSaved;
use srn_plan::ops::{advance, density_sum, embedding, layer_norm_relu, linear, lstm_cell, point_layer};
use srn_plan::{BufferId, Builder, PlanError, Rows, Tile};

use super::{BlockBuffers, BlockSaved, HyperBuffers, HyperSaved, Network, Saved, Scratch, Started, Sums};

/// Where a gradient goes, and whether it is added.
#[derive(Clone, Copy)]
struct Into {
    buffer: BufferId,
    accumulate: bool,
}

/// Scratch inside an MLP: gradient towards `y` (holds the incoming gradient at first), gradient towards `z`, sums of those of the parameters.
#[derive(Clone, Copy)]
struct Inside<'a> {
    d_y: BufferId,
    d_z: BufferId,
    sums: &'a Sums,
}

/// From `d_rgb` of the tile's rows, which is left as it is, to `scratch.d_origin` and `scratch.d_direction` of its rays, and to the weights
/// that have gradients. `d_end`: whether `scratch.d_origin` already holds a gradient of the end points (the depth term).
pub(crate) fn render(
    b: &mut Builder,
    network: &Network,
    saved: &Saved,
    scratch: &Scratch,
    tile: Tile,
    d_rgb: BufferId,
    d_end: bool,
    started: &mut Started,
) -> Result<(), PlanError> {
    let rows = tile.rows;
    let n = rows.count();
    let features = network.features();
    let last = network.tracing_steps as usize;
    // x_{i+1} = x_i + …: one buffer carries d_x from the end point to the origin.
    let d_x = scratch.d_origin;
    let sums = &scratch.sums;
    let inside = Inside { d_y: scratch.d_y, d_z: scratch.d_z, sums };
    sums.restart(started);
    started.restart(d_x, 0);
    if d_end {
        started.accumulate(d_x, 0);
    }

    let d_phi = Into { buffer: scratch.d_phi, accumulate: false };
    mlp(b, network, rows, &network.pixel_generator, saved.phi, &saved.pixel_generator, d_rgb, inside, Some(d_phi), started)?;

    for i in (0..=last).rev() {
        let v = saved.scene[i].last().expect("f has layers").y;
        // The gradient of v_i: from the sum …
        let mut d_v = (i == last).then_some(scratch.d_phi);
        if let Some(density) = &network.density {
            let (head, layers) = density.split_last().expect("g has layers");
            let (g, saved_layers) = saved.density[i].split_last().expect("g has layers");
            let (d_g, d_hidden) = (scratch.d_density, scratch.d_hidden);
            density_sum::backward(b, n, features, head.layer, g.y, v, scratch.d_phi, d_g, scratch.d_y, d_hidden)?;
            d_v = Some(scratch.d_y);
            // … and, before anything else touches d_x, from the marcher.
            if i < last {
                marcher(b, network, saved, scratch, rows, i, d_v, started)?;
            }
            let inside = Inside { d_y: d_hidden, ..inside };
            let into = Into { buffer: d_x, accumulate: started.accumulate(d_x, 0) };
            if let Some(hidden) = saved_layers.last() {
                weights(b, rows, head, hidden.y, d_g, sums, started)?;
                mlp(b, network, rows, layers, saved.x[i], saved_layers, d_hidden, inside, Some(into), started)?;
            } else {
                // What the head reads are the points.
                mlp(b, network, rows, density, saved.x[i], &saved.density[i], d_g, inside, Some(into), started)?;
            }
        } else if i < last {
            marcher(b, network, saved, scratch, rows, i, None, started)?;
            d_v = Some(scratch.d_y);
        }
        let d_v = d_v.expect("set on every path");
        let into = Into { buffer: d_x, accumulate: started.accumulate(d_x, 0) };
        let inside = Inside { d_y: d_v, ..inside };
        mlp(b, network, rows, &network.scene, saved.x[i], &saved.scene[i], d_v, inside, Some(into), started)?;
    }
    parameters(b, network, rows, sums, started)
}

/// Adds what the tile has of the gradients of the parameters, from its sums over parts of the rows.
fn parameters(b: &mut Builder, network: &Network, rows: Rows, sums: &Sums, started: &mut Started) -> Result<(), PlanError> {
    let parts = sums.parts(rows);
    for block in network.blocks_of_rays() {
        if let Some((d_weights, sums)) = block.d_weights.and_then(|d| Some((d, sums.of(d)?))) {
            // Tiles of different images write different sets of per-instance weights.
            let set = if matches!(block.layer.sets, linear::Sets::Shared) { 0 } else { rows.first_group };
            let accumulate = started.accumulate(d_weights, set);
            linear::sum_of_parts(b, parts, block.layer, sums, d_weights, accumulate)?;
        }
        if let Some((d_affine, sums)) = block.d_affine.and_then(|d| Some((d, sums.of(d)?))) {
            let (features, accumulate) = (block.layer.out_features, started.accumulate(d_affine, 0));
            layer_norm_relu::sum_of_parts(b, parts, features, sums, d_affine, accumulate)?;
        }
    }
    Ok(())
}

/// Step `i` of the marcher: from `d_x` of `x_{i+1}` to `d_step`, `d_h`, the gates, and on to `scratch.d_y`, the gradient of `v_i`
/// (added to what is there if `d_v` is given).
fn marcher(
    b: &mut Builder,
    network: &Network,
    saved: &Saved,
    scratch: &Scratch,
    rows: Rows,
    i: usize,
    d_v: Option<BufferId>,
    started: &mut Started,
) -> Result<(), PlanError> {
    let n = rows.count();
    let steps = network.tracing_steps as usize;
    let v = saved.scene[i].last().expect("f has layers").y;
    let first = i + 1 == steps;
    let (head, direction, step) = (network.step_head.layer, saved.direction, saved.step[i]);
    let (d_step, d_direction, d_h) = (scratch.d_step, scratch.d_direction, scratch.d_h);
    advance::backward(b, n, head, direction, step, scratch.d_origin, d_step, d_direction, d_h, !first)?;
    weights(b, rows, &network.step_head, saved.h[i + 1], scratch.d_step, &scratch.sums, started)?;

    let d_c = if first { scratch.zero_state } else { scratch.d_c[(i + 1) % 2] };
    let d_c_prev = scratch.d_c[i % 2];
    let (gates, d_gates) = (saved.gates[i], scratch.d_gates);
    lstm_cell::backward(b, n, network.lstm_size(), gates, saved.c[i], saved.c[i + 1], scratch.d_h, d_c, d_gates, d_c_prev)?;
    weights(b, rows, &network.lstm_hidden, saved.h[i], d_gates, &scratch.sums, started)?;
    weights(b, rows, &network.lstm_input, v, d_gates, &scratch.sums, started)?;
    if i > 0 {
        linear::backward_input(b, rows, network.lstm_hidden.layer, d_gates, network.slots, scratch.d_h, false)?;
    }
    linear::backward_input(b, rows, network.lstm_input.layer, d_gates, network.slots, scratch.d_y, d_v.is_some())
}

/// Layers in reverse. `d` is the gradient of the last output; it is left unchanged where it is neither `inside.d_y` nor `d_z`.
fn mlp(
    b: &mut Builder,
    network: &Network,
    rows: Rows,
    blocks: &[BlockBuffers],
    x: BufferId,
    saved: &[BlockSaved],
    d: BufferId,
    inside: Inside<'_>,
    d_x: Option<Into>,
    started: &mut Started,
) -> Result<(), PlanError> {
    let mut d = d;
    for (k, (block, block_saved)) in blocks.iter().zip(saved).enumerate().rev() {
        let features = block.layer.out_features;
        let input = if k == 0 { x } else { saved[k - 1].y };
        let into = if k == 0 { d_x } else { Some(Into { buffer: inside.d_y, accumulate: false }) };
        if let Some(affine) = block.of_points(k) {
            if let Some(Into { buffer, accumulate }) = into {
                point_layer::backward_input(b, rows, block.layer, input, network.slots, affine, d, buffer, accumulate)?;
                d = buffer;
            }
            continue;
        }
        if let Some(affine) = block.affine {
            let norm = NormSaved { x: block_saved.z, stats: block_saved.stats, affine, centred: block.centred };
            layer_norm_relu::backward_input(b, rows.count(), features, norm, d, inside.d_z)?;
            if let Some(d_affine) = block.d_affine {
                let (parts, to) = (inside.sums.parts(rows), inside.sums.of(d_affine).unwrap_or(d_affine));
                layer_norm_relu::backward_affine(b, parts, features, norm, d, to, started.accumulate(to, 0))?;
            }
            d = inside.d_z;
        }
        weights(b, rows, block, input, d, inside.sums, started)?;
        if let Some(into) = into {
            linear::backward_input(b, rows, block.layer, d, network.slots, into.buffer, into.accumulate)?;
            d = into.buffer;
        }
    }
    Ok(())
}

/// Gradient of a layer's weights, where it is wanted.
fn weights(
    b: &mut Builder,
    rows: Rows,
    block: &BlockBuffers,
    x: BufferId,
    d_y: BufferId,
    sums: &Sums,
    started: &mut Started,
) -> Result<(), PlanError> {
    let Some(d_weights) = block.d_weights else { return Ok(()) };
    let to = sums.of(d_weights).unwrap_or(d_weights);
    linear::backward_weight(b, sums.parts(rows), block.layer, x, d_y, to, started.accumulate(to, 0))
}

/// From the gradients of f's weights to the hypernetwork's parameters and to `d_z` `[slots, latent]`, the codes of the batch.
pub(crate) fn hypernetwork(
    b: &mut Builder,
    network: &Network,
    hyper: &HyperBuffers,
    saved: &HyperSaved,
    scratch: &HyperScratch,
    started: &mut Started,
) -> Result<(), PlanError> {
    let rows = Rows::plain(network.batch.slots);
    let inside = Inside { d_y: scratch.d_y, d_z: scratch.d_hidden, sums: &Sums::default() };
    for (number, (blocks, scene)) in hyper.layers.iter().zip(&network.scene).enumerate() {
        // A streamed last layer has been gone through already.
        let Some(d) = scratch.d_last_hidden[number].or(scene.d_weights).filter(|_| !blocks.is_empty()) else { continue };
        let into = Into { buffer: scratch.d_z, accumulate: started.accumulate(scratch.d_z, 0) };
        mlp(b, network, rows, blocks, saved.z, &saved.mlps[number], d, inside, Some(into), started)?;
    }
    Ok(())
}

/// Gradient of the codes in the batch to the table of codes.
pub(crate) fn codes(b: &mut Builder, network: &Network, hyper: &HyperBuffers, d_z: BufferId) -> Result<(), PlanError> {
    match hyper.d_codes {
        Some(d_codes) => embedding::backward(b, network.embedding(hyper), network.index, d_z, d_codes),
        None => Ok(()),
    }
}

/// Scratch of the hypernetwork's backward pass.
#[derive(Debug)]
pub(crate) struct HyperScratch {
    pub d_y: BufferId,
    pub d_hidden: BufferId,
    /// Gradient of the codes in the batch `[slots, latent]`.
    pub d_z: BufferId,
    /// Of each MLP whose last layer is streamed, gradient of the values that this layer reads; `d_z` where those are the codes.
    pub d_last_hidden: Vec<Option<BufferId>>,
}

impl HyperScratch {
    pub fn new(b: &mut Builder, network: &Network, hyper: &HyperBuffers) -> Result<Self, PlanError> {
        let hidden = hyper.layers.iter().flatten().filter(|block| block.affine.is_some()).map(|block| block.layer.out_features);
        let len = (network.batch.slots * hidden.max().unwrap_or(1)) as usize;
        let d_z = b.scratch("d z of slots", (network.batch.slots * hyper.latent) as usize)?;
        let mut d_last_hidden = Vec::new();
        for (number, blocks) in hyper.layers.iter().enumerate() {
            d_last_hidden.push(match blocks.last() {
                None => Some(d_z),
                Some(block) if block.affine.is_some() => {
                    let len = (network.batch.slots * block.layer.out_features) as usize;
                    Some(b.scratch(format!("d y of hyper.{number}"), len)?)
                }
                Some(_) => None,
            });
        }
        Ok(HyperScratch { d_y: b.scratch("d y of hyper", len)?, d_hidden: b.scratch("d z of hyper", len)?, d_z, d_last_hidden })
    }
}
