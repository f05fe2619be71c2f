//! Buffers of one tile: what the forward pass leaves for the backward pass, and scratch.

use std::collections::HashMap;

use srn_plan::ops::{layer_norm_relu, linear, point_layer};
use srn_plan::{BufferId, Builder, Parts, PlanError, Rows, Tile};

use super::{BlockBuffers, HyperBuffers, Network, Purpose, Started};

/// What a layer leaves behind.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BlockSaved {
    /// After the linear map `[rows, out]`.
    pub z: BufferId,
    /// Mean and rstd `[rows, 2]`, with a norm.
    pub stats: BufferId,
    /// After norm and ReLU `[rows, out]`; the same as `z` without them, and where all is done in one step.
    pub y: BufferId,
}

/// Buffers that are used again and again where nothing must be kept; each is made when it is first wanted.
#[derive(Default)]
struct Reused(HashMap<&'static str, BufferId>);

impl Reused {
    fn get(&mut self, b: &mut Builder, name: &'static str, len: usize) -> Result<BufferId, PlanError> {
        if let Some(&buffer) = self.0.get(name) {
            return Ok(buffer);
        }
        let buffer = b.scratch(name, len)?;
        self.0.insert(name, buffer);
        Ok(buffer)
    }
}

/// What one tile's forward pass leaves for its backward pass. Point `i` of a ray is `x[i]`, `i = 0..=M`.
#[derive(Debug)]
pub(crate) struct Saved {
    /// Rows that the buffers hold.
    pub rows: u32,
    pub uv: BufferId,
    pub z0: BufferId,
    pub direction: BufferId,
    pub x: Vec<BufferId>,
    /// Layers of f at each point; the last `y` is the feature `v_i`.
    pub scene: Vec<Vec<BlockSaved>>,
    /// Layers of g at each point; the last `y` is the density.
    pub density: Vec<Vec<BlockSaved>>,
    pub gates: Vec<BufferId>,
    /// Hidden and cell state before step `i`; number 0 is the zero state.
    pub h: Vec<BufferId>,
    pub c: Vec<BufferId>,
    pub step: Vec<BufferId>,
    pub phi: BufferId,
    /// Layers of the pixel generator; the last `y` is the tile's rgb.
    pub pixel_generator: Vec<BlockSaved>,
    pub depth: BufferId,
}

impl Saved {
    /// Adds the buffers for tiles of up to `rows` rows.
    pub fn new(b: &mut Builder, network: &Network, purpose: Purpose, rows: u32) -> Result<Self, PlanError> {
        let len = |width: u32| rows as usize * width as usize;
        let points = network.tracing_steps as usize + 1;
        let blocks = || {
            let density = network.density.iter().flatten();
            network.scene.iter().chain(density).chain(&network.pixel_generator)
        };
        let widest = blocks().map(|block| block.layer.out_features).max().unwrap_or(1);
        let mut reused = Reused::default();
        let mut mlp = |b: &mut Builder, name: String, blocks: &[BlockBuffers], keep_last: bool| {
            let last = blocks.len() - 1;
            let mut saved = Vec::new();
            for (k, block) in blocks.iter().enumerate() {
                let width = block.layer.out_features;
                let keep_z = purpose != Purpose::Render;
                let keep_y = purpose == Purpose::Train || (k == last && keep_last);
                let y = if keep_y {
                    b.scratch(format!("{name}.{k} y"), len(width))?
                } else {
                    reused.get(b, ["y even", "y odd"][k % 2], len(widest))?
                };
                saved.push(match block.affine.filter(|_| block.of_points(k).is_none()) {
                    None => BlockSaved { z: y, stats: y, y },
                    Some(_) if keep_z => BlockSaved {
                        z: b.scratch(format!("{name}.{k} z"), len(width))?,
                        stats: b.scratch(format!("{name}.{k} stats"), len(2))?,
                        y,
                    },
                    Some(_) => BlockSaved { z: reused.get(b, "z", len(widest))?, stats: reused.get(b, "stats", len(2))?, y },
                });
            }
            Ok::<_, PlanError>(saved)
        };
        // Rendering keeps the features of one point only, in a buffer of its own: the marcher and the sum both read them.
        let mut scene: Vec<Vec<BlockSaved>> = Vec::new();
        let mut density = Vec::new();
        for point in 0..points {
            let first = scene.first().cloned();
            scene.push(match first {
                Some(first) if purpose == Purpose::Render => first,
                _ => mlp(b, format!("f[{point}]"), &network.scene, true)?,
            });
            if let Some(blocks) = &network.density {
                density.push(mlp(b, format!("g[{point}]"), blocks, true)?);
            }
        }
        let phi = match &network.density {
            Some(_) => b.scratch("phi", len(network.features()))?,
            None => scene[points - 1].last().expect("f has layers").y,
        };
        let lstm = network.lstm_size();
        let pixel_generator = mlp(b, "h".into(), &network.pixel_generator, true)?;
        let mut series = |name: &str, count: usize, width: u32| -> Result<Vec<BufferId>, PlanError> {
            (0..count).map(|i| b.scratch(format!("{name}[{i}]"), len(width))).collect()
        };
        let steps = points - 1;
        let (x, gates, step) = (series("x", points, 3)?, series("gates", steps, 4 * lstm)?, series("step", steps, 1)?);
        let (mut h, mut c) = (series("lstm h", steps, lstm)?, series("lstm c", steps, lstm)?);
        let zero_state = b.input("zero state", len(lstm))?;
        h.insert(0, zero_state);
        c.insert(0, zero_state);
        Ok(Saved {
            rows,
            uv: b.scratch("tile uv", len(2))?,
            z0: b.scratch("tile z0", len(1))?,
            direction: b.scratch("direction", len(3))?,
            x,
            scene,
            density,
            gates,
            h,
            c,
            step,
            phi,
            pixel_generator,
            depth: b.scratch("tile depth", len(1))?,
        })
    }
}

/// Sums over parts of a tile's rows, of which gradients of parameters are made.
#[derive(Debug, Default)]
pub(crate) struct Sums {
    /// Rows of a part, at most; all where none is given.
    part_rows: Option<u32>,
    /// By gradient. Where all rows are one part, the sum is the gradient itself.
    sums: HashMap<BufferId, BufferId>,
}

impl Sums {
    /// Adds those of what the rays go through, for `tiles` in parts of up to `part_rows` rows.
    pub fn new(b: &mut Builder, network: &Network, tiles: &[Tile], part_rows: u32) -> Result<Self, PlanError> {
        let parts = || tiles.iter().map(|tile| Parts::of(tile.rows, part_rows));
        let one_part = parts().all(|parts| parts.count() == 1);
        let mut sums = HashMap::new();
        for (number, block) in network.blocks_of_rays().enumerate() {
            let one_set = matches!(block.layer.sets, linear::Sets::Shared);
            if let Some(d_weights) = block.d_weights.filter(|_| !(one_part && one_set)) {
                let len = parts().map(|parts| linear::sums_len(parts, block.layer)).max().unwrap_or(0);
                sums.insert(d_weights, b.scratch(format!("sums of d weights {number}"), len)?);
            }
            if let Some(d_affine) = block.d_affine.filter(|_| !one_part) {
                let len = parts().map(|parts| layer_norm_relu::sums_len(parts, block.layer.out_features)).max().unwrap_or(0);
                sums.insert(d_affine, b.scratch(format!("sums of d affine {number}"), len)?);
            }
        }
        Ok(Sums { part_rows: Some(part_rows), sums })
    }

    /// The parts of `rows`.
    pub fn parts(&self, rows: Rows) -> Parts {
        self.part_rows.map_or(Parts::whole(rows), |most| Parts::of(rows, most))
    }

    /// Where the sums for a gradient are, if they are not the gradient itself.
    pub fn of(&self, gradient: BufferId) -> Option<BufferId> {
        self.sums.get(&gradient).copied()
    }

    /// Makes the next contribution to each the first one again.
    pub fn restart(&self, started: &mut Started) {
        self.sums.values().for_each(|&sums| started.restart(sums, 0));
    }
}

/// Scratch of the backward pass.
#[derive(Debug)]
pub(crate) struct Scratch {
    pub d_phi: BufferId,
    /// Gradients inside an MLP: towards `y`, towards `z`, and towards `y` of the density net's layers before its head.
    pub d_y: BufferId,
    pub d_z: BufferId,
    pub d_hidden: BufferId,
    /// Gradient of the density `[rows, 1]`.
    pub d_density: BufferId,
    pub d_gates: BufferId,
    pub d_h: BufferId,
    pub d_c: [BufferId; 2],
    pub d_step: BufferId,
    /// Every ray's derivative to its origin `[rows, 3]`, when the pass is over.
    pub d_origin: BufferId,
    /// Every ray's derivative to its direction `[rows, 3]`.
    pub d_direction: BufferId,
    /// Zeros `[rows, lstm]`: the gradient of the last cell state.
    pub zero_state: BufferId,
    pub sums: Sums,
}

impl Saved {
    /// Colours of the tile.
    pub fn rgb(&self) -> BufferId {
        self.pixel_generator.last().expect("the pixel generator has layers").y
    }
}

impl Scratch {
    /// Adds the buffers for tiles of up to `saved.rows` rows.
    pub fn new(b: &mut Builder, network: &Network, saved: &Saved, sums: Sums) -> Result<Self, PlanError> {
        let widest = |blocks: &[BlockBuffers]| blocks.iter().map(|block| block.layer.out_features).max().unwrap_or(1);
        let density = network.density.as_deref().unwrap_or_default();
        let f_and_h = widest(&network.scene).max(widest(&network.pixel_generator));
        let lstm = network.lstm_size();
        let mut scratch = |name: &str, width: u32| b.scratch(name, saved.rows as usize * width as usize);
        let even = scratch("d c even", lstm)?;
        let d_c = [even, if network.tracing_steps > 1 { scratch("d c odd", lstm)? } else { even }];
        let (d_phi, d_y) = (scratch("d phi", f_and_h)?, scratch("d y", f_and_h)?);
        Ok(Scratch {
            d_phi,
            d_y,
            d_z: scratch("d z", f_and_h.max(widest(density)))?,
            // Plain SRN has neither; its gradients never reach these buffers.
            d_hidden: if density.is_empty() { d_y } else { scratch("d y of g", widest(density).max(point_layer::COORDINATES))? },
            d_density: if density.is_empty() { d_y } else { scratch("d density", 1)? },
            d_gates: scratch("d gates", 4 * lstm)?,
            d_h: scratch("d h", lstm)?,
            d_c,
            d_step: scratch("d step", 1)?,
            d_origin: scratch("d x", 3)?,
            d_direction: scratch("d direction", 3)?,
            zero_state: saved.c[0],
            sums,
        })
    }
}

/// What the hypernetwork leaves behind: the layers of one MLP per layer of f.
#[derive(Debug)]
pub(crate) struct HyperSaved {
    /// Codes of the batch `[slots, latent]`.
    pub z: BufferId,
    pub mlps: Vec<Vec<BlockSaved>>,
}

impl HyperSaved {
    /// Adds the buffers; the last layer of each MLP writes the weights of f.
    pub fn new(b: &mut Builder, network: &Network, hyper: &HyperBuffers) -> Result<Self, PlanError> {
        let slots = network.batch.slots as usize;
        let z = b.scratch("z of slots", slots * hyper.latent as usize)?;
        let mut mlps = Vec::new();
        for (l, (blocks, scene)) in hyper.layers.iter().zip(&network.scene).enumerate() {
            let mut saved = Vec::new();
            for (k, block) in blocks.iter().enumerate() {
                let len = slots * block.layer.out_features as usize;
                saved.push(match block.affine {
                    None => BlockSaved { z: scene.layer.weights, stats: scene.layer.weights, y: scene.layer.weights },
                    Some(_) => {
                        let y = b.scratch(format!("hyper.{l}.{k} y"), len)?;
                        // A code of three numbers is a point, too.
                        match block.of_points(k) {
                            Some(_) => BlockSaved { z: y, stats: y, y },
                            None => BlockSaved {
                                z: b.scratch(format!("hyper.{l}.{k} z"), len)?,
                                stats: b.scratch(format!("hyper.{l}.{k} stats"), 2 * slots)?,
                                y,
                            },
                        }
                    }
                });
            }
            mlps.push(saved);
        }
        Ok(HyperSaved { z, mlps })
    }

    /// What the last layer of MLP `number` reads, where that layer is not one of `mlps`.
    pub fn last_hidden(&self, number: usize) -> BufferId {
        self.mlps[number].last().map_or(self.z, |layer| layer.y)
    }
}
