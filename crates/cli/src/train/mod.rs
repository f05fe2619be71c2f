//! `sigma-train`: training from nothing, the two-shot fit of new instances, and PyTorch checkpoints.

pub mod adapt;
pub mod fit;
mod settings;
pub mod torch;

use rand::seq::index;
use sigma_srn::{Engine, Model, Random, Rays, Renderer, Rendering, TrainingBatch, pixel_grid};
use srn_data::LoadedView;

use crate::common::{Result, camera, psnr};

pub use settings::{Changeable, ForGood, Preset, Settings};

/// A view and the number of the instance that it shows.
type Shown<'a> = (u32, &'a LoadedView);

/// The images of a training step: `rays` random pixels of each view, without repetition, or all of them in order.
fn training_batch(views: &[Shown], side: u32, rays: u32, random: &mut Random) -> TrainingBatch {
    let mut batch = TrainingBatch { instances: vec![], rays: Rays::default(), target_rgb: vec![] };
    for &(instance, view) in views {
        let pixels: Vec<(u32, u32)> = if rays == side * side {
            pixel_grid(side, side, 1).collect()
        } else {
            let drawn = index::sample(random, (side * side) as usize, rays as usize);
            drawn.iter().map(|at| (at as u32 % side, at as u32 / side)).collect()
        };
        for &(u, v) in &pixels {
            let at = 3 * (v * side + u) as usize;
            batch.target_rgb.extend(&view.rgb[at..at + 3]);
        }
        let (world_from_camera, intrinsics) = camera(view);
        batch.instances.push(instance);
        batch.rays.push(&world_from_camera, &intrinsics, pixels, random);
    }
    batch
}

/// Renders the given views whole, with the same initial depths every time.
fn render(engine: &Engine, model: &Model, views: &[Shown], side: u32) -> Result<Rendering> {
    let (instances, cameras): (Vec<_>, Vec<_>) = views.iter().map(|&(instance, view)| (instance, camera(view))).unzip();
    Ok(Renderer::new(engine, model, views.len() as u32, side, side)?.render(&instances, &cameras, 0)?)
}

/// PSNR of each view in dB.
fn psnr_of_each(rendering: &Rendering, views: &[Shown]) -> Vec<f64> {
    let pictures = rendering.rgb.chunks(rendering.rgb.len() / views.len());
    pictures.zip(views).map(|(rgb, (_, view))| psnr(rgb, &view.rgb)).collect()
}
