//! The plan of a descent: render, compare, go back to the poses, move them.

use srn_plan::ops::bfgs::{self, Channel, Residuals};
use srn_plan::ops::rays::Pixels;
use srn_plan::ops::{adam, gmsd, image_loss, pose, rays, tile as tile_ops};
use srn_plan::{BufferId, Builder, PlanError, Rows, StageId, Tile, tiles};

use super::{Loss, Method, Shape};
use crate::model::Model;
use crate::network::forward::{self, Instances};
use crate::network::streamed::OnHost;
use crate::network::{Batch, Network, Purpose, Saved, Scratch, Started, Sums, Trainable, backward};

/// What the backward pass of a channel begins with: small, since gradients in the marcher are clamped to ±10 (spec 2), which is
/// meant for those of a mean over an image. A power of two, so that nothing is rounded.
pub const SEED: f32 = 1.0 / 4096.0;

/// What a [`Descent`](super::Descent) knows of its plan.
pub struct Handles {
    pub network: Network,
    /// See [`wanted`](crate::rays::wanted) `[hypotheses, rays, 4]`; for GMSD, which knows no weights, colours `[hypotheses, rays, 3]`.
    pub target: BufferId,
    pub gmsd: bool,
    pub instances: Instances,
    /// What follows from the targets alone.
    pub targets: StageId,
    pub compare: StageId,
    pub loss: BufferId,
    /// `None`: poses are only compared.
    pub moves: Option<Moves>,
}

/// How poses move: two stages, and what they have by method.
#[derive(Clone, Copy)]
pub struct Moves {
    pub evaluate: StageId,
    pub descend: StageId,
    pub by: By,
}

/// Buffers of the poses, by method.
#[derive(Clone, Copy)]
pub enum By {
    Adam { learning_rate: f64, pose6: BufferId, d_pose6: BufferId, schedule: BufferId, moments: [BufferId; 2] },
    Bfgs { begin: StageId, equations: BufferId, gradient: BufferId, state: BufferId, seeds: [BufferId; 3] },
}

/// Appends it, in tiles of so many rows.
pub fn build(
    b: &mut Builder,
    model: &Model,
    shape: Shape,
    method: Method,
    is_moving: bool,
    tile_rows: u32,
    on_host: &OnHost,
) -> Result<Handles, PlanError> {
    let Shape { hypotheses, width, height, instances: slots } = shape;
    let rays_per_image = width * height;
    let batch = Batch { images: hypotheses, rays: rays_per_image, slots };
    // Adam's matrices come from six numbers, those of BFGS are what it moves.
    let pose_is_input = matches!(method, Method::Bfgs { .. }) || !is_moving;
    let network = Network::new(b, model, batch, Trainable::Nothing, pose_is_input, &on_host.parameters)?;
    let cut = tiles(hypotheses, rays_per_image, tile_rows);
    let most = cut.iter().map(|tile| tile.rows.count()).max().unwrap_or(1);
    let saved = Saved::new(b, &network, if is_moving { Purpose::Pose } else { Purpose::Render }, most)?;
    let gmsd = matches!(method, Method::Adam { loss: Loss::Gmsd, .. });
    let target = b.input("target", if gmsd { 3 } else { 4 } * hypotheses as usize * rays_per_image as usize)?;

    let instances = Instances::new(b, &network, model, on_host)?;

    let loss = match method {
        Method::Adam { loss, .. } => loss.per_pixel(),
        Method::Bfgs { soft, .. } => Some(image_loss::Kind::Charbonnier { soft }),
    };
    let comparison = Comparison::new(b, &cut, shape, loss)?;
    let parts = Parts { network: &network, saved: &saved, target, cut: &cut, comparison: &comparison, shape };

    let targets = b.stage("targets");
    parts.look_at_targets(b)?;

    let (compare, moves) = match method {
        _ if !is_moving => (parts.still(b)?, None),
        Method::Adam { learning_rate, .. } => parts.adam(b, learning_rate)?,
        Method::Bfgs { soft, grain } => parts.bfgs(b, soft, grain)?,
    };
    let loss = comparison.loss;
    Ok(Handles { network, target, gmsd, instances, targets, compare, loss, moves })
}

/// How renders are compared, with the buffers for it.
struct Comparison {
    kind: Kind,
    partial: BufferId,
    loss: BufferId,
}

#[derive(Clone, Copy)]
enum Kind {
    /// `count`: of target values that are not white.
    PerPixel {
        kind: image_loss::Kind,
        count: BufferId,
    },
    Gmsd {
        images: gmsd::Images,
        saved: gmsd::Saved,
    },
}

impl Comparison {
    fn new(b: &mut Builder, cut: &[Tile], shape: Shape, loss: Option<image_loss::Kind>) -> Result<Self, PlanError> {
        let Shape { hypotheses, width, height, .. } = shape;
        let n = hypotheses as usize;
        let images = gmsd::Images { count: hypotheses, width, height };
        let of_tile = |tile: &Tile| bfgs::partial_len(tile.rows);
        let of_rays = rays::partial_len(Rows { groups: hypotheses, rows_per_group: width * height, first_group: 0 });
        let of_images = image_loss::partial_len(hypotheses, width * height).max(images.partial_len());
        let partial = b.scratch("partial sums", cut.iter().map(of_tile).max().unwrap_or(1).max(of_images).max(of_rays))?;
        let kind = match loss {
            Some(kind) => Kind::PerPixel { kind, count: b.scratch("target count", n)? },
            None => {
                let pooled = n * images.pooled() as usize;
                let saved = gmsd::Saved {
                    luma: b.scratch("luma", pooled)?,
                    target_luma: b.scratch("target luma", pooled)?,
                    quality: b.scratch("quality", pooled)?,
                    moments: b.scratch("moments", 2 * n)?,
                };
                Kind::Gmsd { images, saved }
            }
        };
        Ok(Comparison { kind, partial, loss: b.scratch("loss", n)? })
    }
}

/// What the way back begins with.
#[derive(Clone, Copy)]
enum Back {
    /// `tile_target`: the tile's part of [`Handles::target`].
    PerPixel {
        kind: image_loss::Kind,
        count: BufferId,
        tile_target: BufferId,
    },
    Gmsd {
        images: gmsd::Images,
        saved: gmsd::Saved,
        d_response: BufferId,
        d_rgb: BufferId,
    },
}

/// What both methods work with.
struct Parts<'a> {
    network: &'a Network,
    saved: &'a Saved,
    target: BufferId,
    cut: &'a [Tile],
    comparison: &'a Comparison,
    shape: Shape,
}

/// The stage "compare", and how poses move.
type Stages = (StageId, Option<Moves>);

impl Parts<'_> {
    /// Per-pixel losses need the number of target values that are not white; GMSD needs the target's luma.
    fn look_at_targets(&self, b: &mut Builder) -> Result<(), PlanError> {
        let Shape { hypotheses, width, height, .. } = self.shape;
        match self.comparison.kind {
            Kind::PerPixel { count, .. } => {
                image_loss::count(b, hypotheses, width * height, self.target, self.comparison.partial, count)
            }
            Kind::Gmsd { images, saved } => gmsd::pool(b, images, self.target, saved.target_luma),
        }
    }

    /// Losses of the whole images in `network.rgb`.
    fn losses(&self, b: &mut Builder) -> Result<(), PlanError> {
        let Shape { hypotheses, width, height, .. } = self.shape;
        let &Comparison { kind, partial, loss, .. } = self.comparison;
        match kind {
            Kind::PerPixel { kind, count } => {
                let pixels = width * height;
                image_loss::forward(b, kind, hypotheses, pixels, self.network.rgb, self.target, count, partial, loss)
            }
            Kind::Gmsd { images, saved } => {
                gmsd::pool(b, images, self.network.rgb, saved.luma)?;
                gmsd::similarity(b, images, saved)?;
                gmsd::deviation(b, images, saved, partial, loss)
            }
        }
    }

    /// Renders and compares.
    fn compare(&self, b: &mut Builder) -> Result<(), PlanError> {
        for &tile in self.cut {
            forward::render(b, self.network, self.saved, tile)?;
        }
        self.losses(b)
    }

    /// The poses are given, and stay.
    fn still(&self, b: &mut Builder) -> Result<StageId, PlanError> {
        let compare = b.stage("compare");
        self.compare(b)?;
        Ok(compare)
    }

    /// Buffers for the way back.
    fn back(&self, b: &mut Builder) -> Result<Back, PlanError> {
        Ok(match self.comparison.kind {
            Kind::PerPixel { kind, count } => {
                Back::PerPixel { kind, count, tile_target: b.scratch("tile target", 4 * self.saved.rows as usize)? }
            }
            Kind::Gmsd { images, saved } => {
                let Shape { hypotheses, width, height, .. } = self.shape;
                let d_rgb = b.scratch("d rgb", 3 * (hypotheses * width * height) as usize)?;
                let d_response = b.scratch("d response", 2 * (hypotheses * images.pooled()) as usize)?;
                Back::Gmsd { images, saved, d_response, d_rgb }
            }
        })
    }

    /// Renders, compares, and goes back to the poses: losses, and `d_matrix [hypotheses, 12]`. Every tile takes the same steps, one after the other, so that
    /// on the CPU no thread waits for another until all are done.
    fn differentiate(&self, b: &mut Builder, scratch: &Scratch, back: Back, d_matrix: BufferId) -> Result<(), PlanError> {
        let &Parts { network, saved, target, cut, comparison, shape: Shape { hypotheses, width, height, .. } } = self;
        let &Comparison { partial, loss, .. } = comparison;
        let mut of_rays = |name: &str| b.scratch(name, 3 * (hypotheses * width * height) as usize);
        let (d_origin, d_direction) = (of_rays("d origins")?, of_rays("d directions")?);
        let tile_d_rgb = b.scratch("tile d rgb", 3 * saved.rows as usize)?;
        let mut started = Started::default();
        // A loss of whole images needs all tiles before the first gradient; the tiles are rendered once more on the way back.
        if let Back::Gmsd { images, saved: maps, d_response, d_rgb } = back {
            self.compare(b)?;
            gmsd::backward(b, images, 1.0, maps, loss, d_response, d_rgb)?;
        }
        for &tile in cut {
            match back {
                Back::PerPixel { kind, count, tile_target } => {
                    forward::render(b, network, saved, tile)?;
                    tile_ops::gather(b, tile, 4, target, tile_target)?;
                    let pixels = width * height;
                    image_loss::backward(b, kind, tile.rows, pixels, 1.0, saved.rgb(), tile_target, count, tile_d_rgb)?;
                }
                Back::Gmsd { d_rgb, .. } => {
                    if cut.len() > 1 {
                        forward::render(b, network, saved, tile)?;
                    }
                    tile_ops::gather(b, tile, 3, d_rgb, tile_d_rgb)?;
                }
            }
            backward::render(b, network, saved, scratch, tile, tile_d_rgb, false, &mut started)?;
            tile_ops::scatter(b, tile, 3, scratch.d_origin, d_origin)?;
            tile_ops::scatter(b, tile, 3, scratch.d_direction, d_direction)?;
        }
        let all = Rows { groups: hypotheses, rows_per_group: width * height, first_group: 0 };
        let pixels = Pixels { uv: network.uv, z0: network.z0, ..network.pixels(saved) };
        rays::backward(b, all, pixels, d_origin, d_direction, partial, d_matrix, false)?;
        if matches!(back, Back::PerPixel { .. }) {
            self.losses(b)?;
        }
        Ok(())
    }

    /// The paper's method.
    fn adam(&self, b: &mut Builder, learning_rate: f64) -> Result<Stages, PlanError> {
        let (poses, n) = (self.shape.hypotheses, self.shape.hypotheses as usize);
        let (scratch, back) = (Scratch::new(b, self.network, self.saved, Sums::default())?, self.back(b)?);
        let pose6 = b.input("pose6", 6 * n)?;
        let (d_pose6, d_matrix) = (b.scratch("d pose6", 6 * n)?, b.scratch("d world_from_camera", 12 * n)?);

        let compare = b.stage("compare");
        pose::forward(b, poses, pose6, self.network.world_from_camera)?;
        self.compare(b)?;

        let evaluate = b.stage("evaluate");
        pose::forward(b, poses, pose6, self.network.world_from_camera)?;
        self.differentiate(b, &scratch, back, d_matrix)?;
        pose::backward(b, poses, pose6, d_matrix, d_pose6)?;

        let descend = b.stage("descend");
        let schedule = b.input("schedule", 3)?;
        let moments = [b.input("m pose6", 6 * n)?, b.input("v pose6", 6 * n)?];
        adam::step(b, 6 * poses, d_pose6, schedule, pose6, moments[0], moments[1])?;
        let by = By::Adam { learning_rate, pose6, d_pose6, schedule, moments };
        Ok((compare, Some(Moves { evaluate, descend, by })))
    }

    /// BFGS. Its first evaluation is another stage, "begin": rays are independent, so one backward pass for each channel, begun with the
    /// same number for every ray, gives every ray's derivative of that channel, the rows of the Jacobian.
    fn bfgs(&self, b: &mut Builder, soft: f32, grain: f32) -> Result<Stages, PlanError> {
        let &Parts { network, saved, target, cut, comparison, shape: Shape { hypotheses, width, height, .. } } = self;
        let &Comparison { partial, loss, .. } = comparison;
        let (scratch, back) = (Scratch::new(b, network, saved, Sums::default())?, self.back(b)?);
        let Back::PerPixel { tile_target, .. } = back else { unreachable!("BFGS compares pixel by pixel") };
        let n = hypotheses as usize;
        let mut seed = |name: &str| b.input(name, 3 * saved.rows as usize);
        let seeds = [seed("seed of red")?, seed("seed of green")?, seed("seed of blue")?];
        let equations = b.scratch("equations", n * bfgs::EQUATIONS as usize)?;
        let (state, gradient) = (b.scratch("state", n * bfgs::STATE as usize)?, b.scratch("gradient", 6 * n)?);
        let d_matrix = b.scratch("d world_from_camera", 12 * n)?;

        let compare = b.stage("compare");
        self.compare(b)?;

        let begin = b.stage("begin");
        let mut started = Started::default();
        let residuals = Residuals {
            world_from_camera: network.world_from_camera,
            origin: saved.x[0],
            direction: saved.direction,
            d_origin: scratch.d_origin,
            d_direction: scratch.d_direction,
            sphere: network.ray_sphere,
            rgb: saved.rgb(),
            wanted: tile_target,
        };
        let scale = 1.0 / (3 * width * height) as f32;
        for &tile in cut {
            forward::render(b, network, saved, tile)?;
            tile_ops::gather(b, tile, 4, target, tile_target)?;
            for (number, d_rgb) in (0..).zip(seeds) {
                backward::render(b, network, saved, &scratch, tile, d_rgb, false, &mut started)?;
                let channel = Channel { number, seed: SEED, scale, soft };
                let accumulate = started.accumulate(equations, tile.rows.first_group);
                bfgs::equations(b, tile.rows, residuals, channel, partial, equations, accumulate)?;
            }
        }
        self.losses(b)?;
        bfgs::begin(b, hypotheses, equations, loss, network.world_from_camera, state)?;

        let evaluate = b.stage("evaluate");
        self.differentiate(b, &scratch, back, d_matrix)?;
        bfgs::gradient(b, hypotheses, network.world_from_camera, d_matrix, gradient)?;
        bfgs::update(b, hypotheses, gradient, loss, network.world_from_camera, state)?;

        let descend = b.stage("descend");
        bfgs::solve(b, hypotheses, grain, network.world_from_camera, state)?;
        let by = By::Bfgs { begin, equations, gradient, state, seeds };
        Ok((compare, Some(Moves { evaluate, descend, by })))
    }
}
