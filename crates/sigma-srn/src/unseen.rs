//! One-shot: the pose of an object that the model was not trained on, from a single image. The nearest of the known objects gives a first
//! pose and a first latent code; then code and pose are fitted to the image in turn.

use glam::DMat4;

use crate::estimator::{Estimate, Options, Phase, Query, Ranked, estimate};
use crate::random::stream;
use crate::trainer::{Train, Trainer, TrainingBatch};
use crate::{Engine, Error, Model, Rays, pixel_grid};

/// Known objects that are gone on with.
const CANDIDATES: usize = 3;
/// Turns of code and pose.
const ROUNDS: usize = 4;
/// Steps of Adam for the code in a turn, and their rate.
const CODE_STEPS: u64 = 40;
const LEARNING_RATE: f64 = 2e-3;

/// What was found of an object that the model does not know.
#[derive(Clone, Debug)]
pub struct Unseen {
    /// The pose.
    pub estimate: Estimate,
    /// The model with the object as its only instance: for further images of it.
    pub model: Model,
    /// The known instance that it began with.
    pub nearest: u32,
}

/// Estimates the pose of an object of the model's kind, but none of its instances; [`Query::instance`] is not looked at. `observe` hears the
/// number of the turn before each, and how many there are.
pub fn estimate_unseen(
    engine: &Engine,
    model: &Model,
    query: &Query,
    seed: u64,
    mut observe: impl FnMut(usize, usize) -> Result<(), Error>,
) -> Result<Unseen, Error> {
    let (latent, codes) = (model.hypernetwork()?.latent as usize, model.codes()?);
    observe(0, ROUNDS + 1)?;
    let known: Vec<Query> = (0..model.layout.instances).map(|instance| Query { instance, ..query.clone() }).collect();
    // A code says what colours an object has.
    let phase = |steps, stride, keep| Phase { steps, stride, keep, light: false, closer_look: false, outlines: false };
    // The coarsest look that still sees something of the image.
    let coarse = (query.width.min(query.height) / 8).max(1);
    let options = |phases| Options { phases, anew: 0, settle: 0, min_starts: 0, align: false, seed, ..Options::default() };
    let looks = estimate(engine, model, &known, &options(vec![phase(0, coarse, usize::MAX), phase(8, 4, 1)]), |_| Ok(()))?;
    let mut order: Vec<usize> = (0..looks.len()).collect();
    order.sort_by(|&a, &b| looks[a].loss.total_cmp(&looks[b].loss));
    order.truncate(CANDIDATES);

    let names = order.iter().map(|&instance| model.instance_name(instance as u32)).collect();
    let code = |of: &[f32], instance: usize| of[instance * latent..][..latent].to_vec();
    let nearest = order.iter().flat_map(|&instance| code(codes, instance)).collect();
    let mut fitted = model.with_codes(names, nearest)?;
    let mut poses: Vec<DMat4> = order.iter().map(|&instance| looks[instance].pose.to_matrix()).collect();
    let mut estimates = Vec::new();
    for round in 1..=ROUNDS {
        observe(round, ROUNDS + 1)?;
        fitted = fit_codes(engine, fitted, query, &poses, seed)?;
        let each = |(k, pose): (usize, &DMat4)| Query { instance: k as u32, starts: vec![*pose], ..query.clone() };
        let queries: Vec<Query> = poses.iter().enumerate().map(each).collect();
        let last = round == ROUNDS;
        let phases = vec![if last { phase(12, 1, 1) } else { phase(6, 2, 1) }];
        estimates = estimate(engine, &fitted, &queries, &options(phases), |_| Ok(()))?;
        poses = estimates.iter().map(|estimate| estimate.pose.to_matrix()).collect();
    }
    let mut by_loss: Vec<usize> = (0..estimates.len()).collect();
    by_loss.sort_by(|&a, &b| estimates[a].loss.total_cmp(&estimates[b].loss));
    let best = by_loss[0];
    let model = fitted.with_codes(vec!["unseen".into()], code(fitted.codes()?, best))?;
    // Each went on from another known object: where they end in different poses, the object may be one thing here or another there.
    let ranked = |k: usize| Ranked { start: looks[order[k]].ranking[0].start, ..estimates[k].ranking[0] };
    let ranking = by_loss.into_iter().map(ranked).collect();
    Ok(Unseen { estimate: Estimate { ranking, ..estimates.swap_remove(best) }, model, nearest: order[best] as u32 })
}

/// Fits the codes of all instances to the image, each from its own pose.
fn fit_codes(engine: &Engine, model: Model, query: &Query, poses: &[DMat4], seed: u64) -> Result<Model, Error> {
    let pixels: Vec<(u32, u32)> = pixel_grid(query.width, query.height, 2).collect();
    let mut trainer = Trainer::new(engine, model, Train::Codes, poses.len() as u32, pixels.len() as u32)?;
    let seen = query.seen(query.outline);
    let of_pixel = |&(u, v): &(u32, u32)| &seen.rgb[3 * (v * query.width + u) as usize..][..3];
    let colours: Vec<f32> = pixels.iter().flat_map(of_pixel).copied().collect();
    let mut random = stream(seed, 0);
    let mut rays = Rays::default();
    poses.iter().for_each(|pose| rays.push(pose, &query.intrinsics, pixels.iter().copied(), &mut random));
    let (instances, target_rgb) = ((0..poses.len() as u32).collect(), colours.repeat(poses.len()));
    let weights = seen.ray_weights(query.pixels(2)).repeat(poses.len());
    let batch = TrainingBatch { instances, rays, target_rgb, weights: Some(weights) };
    for _ in 0..CODE_STEPS {
        trainer.step(&batch, LEARNING_RATE)?;
    }
    trainer.model().cloned()
}
