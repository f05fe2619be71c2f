//! `sigma-train`: training from nothing, the two-shot fit of new instances, and PyTorch checkpoints.

pub mod adapt;
pub mod fit;
mod found;
mod reflection;
mod settings;
pub mod torch;

use rand::seq::index;
use sigma_srn::{Engine, Model, Random, Rays, Renderer, Rendering, TrainingBatch, pixel_grid};
use srn_data::LoadedView;

use crate::common::{Result, camera, psnr};

pub use settings::{Changeable, ForGood, Preset, Settings};

/// A view and the number of the instance that it shows.
pub type Shown<'a> = (u32, &'a LoadedView);

/// Distance in pixels over which [`detailed`] looks for another colour.
const DETAIL_REACH: usize = 3;
/// Difference in a colour channel that counts as another colour.
const DETAIL_CONTRAST: f32 = 0.03;

/// The images of a training step: `rays` random pixels of each view, without repetition, or all of them in order. The part
/// `detail` of them is drawn where the picture is not of one colour, as far as there are such pixels.
fn training_batch(views: &[Shown], side: u32, rays: u32, detail: f64, random: &mut Random) -> TrainingBatch {
    let mut batch = TrainingBatch { instances: vec![], rays: Rays::default(), target_rgb: vec![], weights: None };
    for &(instance, view) in views {
        let pixels: Vec<(u32, u32)> = if rays == side * side {
            pixel_grid(side, side, 1).collect()
        } else {
            let drawn = draw_pixels(view, side as usize, rays as usize, detail, random);
            drawn.into_iter().map(|at| (at as u32 % side, at as u32 / side)).collect()
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

/// Numbers of `count` different pixels.
fn draw_pixels(view: &LoadedView, side: usize, count: usize, detail: f64, random: &mut Random) -> Vec<usize> {
    let mut draw = |from: &[usize], count: usize| -> Vec<usize> {
        index::sample(random, from.len(), count).iter().map(|at| from[at]).collect()
    };
    let mut pixels: Vec<usize> = (0..side * side).collect();
    let mut drawn = vec![];
    if detail > 0.0 {
        let of_detail = detailed(&view.rgb, side);
        drawn = draw(&of_detail, ((detail * count as f64).round() as usize).min(of_detail.len()));
        let mut is_drawn = vec![false; pixels.len()];
        drawn.iter().for_each(|&at| is_drawn[at] = true);
        pixels.retain(|&at| !is_drawn[at]);
    }
    drawn.extend(draw(&pixels, count - drawn.len()));
    drawn
}

/// The pixels with another colour near them: an object in front of a plain ground, its edges, its texture.
fn detailed(rgb: &[f32], side: usize) -> Vec<usize> {
    let pixels: Vec<[f32; 3]> = rgb.as_chunks().0.to_vec();
    let join = |(low, high): ([f32; 3], [f32; 3]), (other_low, other_high): ([f32; 3], [f32; 3])| {
        let channels = [0, 1, 2];
        (channels.map(|c| low[c].min(other_low[c])), channels.map(|c| high[c].max(other_high[c])))
    };
    // The least and the greatest values around a pixel: along its row, then of those along its column.
    let around = |ranges: Vec<_>, step: usize, along: fn(usize, usize) -> usize| -> Vec<_> {
        let range_around = |at: usize| {
            let place = along(at, side);
            let near = place.saturating_sub(DETAIL_REACH)..(place + DETAIL_REACH + 1).min(side);
            near.map(|other| ranges[at + other * step - place * step]).reduce(join).expect("the pixel itself is near")
        };
        (0..side * side).map(range_around).collect()
    };
    let rows = around(pixels.into_iter().map(|rgb| (rgb, rgb)).collect(), 1, |at, side| at % side);
    let squares = around(rows, side, |at, side| at / side);
    let has_contrast = |(low, high): ([f32; 3], [f32; 3])| (0..3).any(|c| high[c] - low[c] > DETAIL_CONTRAST);
    (0..side * side).filter(|&at| has_contrast(squares[at])).collect()
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
