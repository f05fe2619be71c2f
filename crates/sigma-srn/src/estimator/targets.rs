//! What hypotheses are compared with in a phase: rays, and the colours that are wanted of them.

use std::iter::zip;

use glam::DMat4;

use super::Hypothesis;
use super::options::{Options, Phase};
use super::query::Query;
use crate::camera::Pose6;
use crate::descent::{Descent, Method, Shape};
use crate::engine::Engine;
use crate::light::Light;
use crate::model::Model;
use crate::random::{MEAN_DEPTH, stream};
use crate::region::region;
use crate::{Error, Rays};

/// What the hypotheses of a phase are compared with; those of a query come one after the other, the best first.
pub(super) struct Targets {
    shape: Shape,
    /// The instances, and which of them each hypothesis shows.
    instances: Vec<u32>,
    slots: Vec<u32>,
    rays: Rays,
    /// `[hypotheses, rays, 3]`.
    pub rgb: Vec<f32>,
    /// `[hypotheses, rays]`, none where all rays count the same.
    weights: Option<Vec<f32>>,
}

impl Targets {
    /// On the whole grid of a phase.
    pub fn new(queries: &[Query], options: &Options, phase: &Phase, running: &[Hypothesis]) -> Self {
        let mut instances: Vec<u32> = running.iter().map(|h| queries[h.query].instance).collect();
        instances.sort_unstable();
        instances.dedup();
        let mut random = stream(options.seed, 0);
        let (mut slots, mut rays, mut rgb, mut weights) = (Vec::new(), Rays::default(), Vec::new(), Vec::new());
        for hypothesis in running {
            let query = &queries[hypothesis.query];
            slots.push(instances.binary_search(&query.instance).expect("collected above") as u32);
            rays.push(&DMat4::IDENTITY, &query.intrinsics, query.rays(phase.stride), &mut random);
            let seen = query.seen(hypothesis.outline);
            query.pixels(phase.stride).for_each(|pixel| rgb.extend_from_slice(&seen.rgb[3 * pixel..][..3]));
            weights.extend(seen.ray_weights(query.pixels(phase.stride)));
        }
        if matches!(options.method, Method::Bfgs { .. }) {
            rays.z0.fill(MEAN_DEPTH);
        }
        let across = |size: u32| (phase.stride / 2..size).step_by(phase.stride as usize).count() as u32;
        let shape = Shape {
            hypotheses: running.len() as u32,
            width: across(queries[0].width),
            height: across(queries[0].height),
            instances: instances.len() as u32,
        };
        let weights = weights.iter().any(|weight| *weight != 1.0).then_some(weights);
        Targets { shape, instances, slots, rays, rgb, weights }
    }

    pub fn rays_per_image(&self) -> usize {
        (self.shape.width * self.shape.height) as usize
    }

    /// Rays per row of an image.
    pub fn columns(&self) -> usize {
        self.shape.width as usize
    }

    /// Makes up for the light of the image of each query of which `is_made_up` says so. Where the phase is in the model's light, that is the light between it and the
    /// view from the best pose, which is returned; before, each hypothesis has its own.
    fn undo_lights(
        &mut self,
        queries: &[Query],
        phase: &Phase,
        running: &[Hypothesis],
        renders: &[f32],
        is_made_up: impl Fn(&Query) -> bool,
    ) -> Vec<Option<Light>> {
        let mut lights = vec![None; queries.len()];
        let values = 3 * self.rays_per_image();
        for ((hypothesis, render), rgb) in zip(running, renders.chunks(values)).zip(self.rgb.chunks_mut(values)) {
            let query = &queries[hypothesis.query];
            if is_made_up(query) {
                let seen = query.seen(hypothesis.outline);
                let coverage: Vec<f32> = query.pixels(phase.stride).map(|pixel| seen.coverage[pixel]).collect();
                let weights = || seen.ray_weights(query.pixels(phase.stride));
                let between = || Light::between(rgb, render, &coverage, &weights(), query.has_outline());
                let light = if phase.light { *lights[hypothesis.query].get_or_insert_with(between) } else { between() };
                light.undo(rgb, &coverage);
            }
        }
        lights
    }

    /// The same on the rays alone that are worth their time, see [`region`]; losses stay means over the whole grid. `None` if that is all of them, or none.
    fn in_regions(&self, renders: &[f32]) -> Option<Self> {
        let all = self.rays_per_image();
        let weights = self.weights.clone().unwrap_or_else(|| vec![1.0; self.rgb.len() / 3]);
        let each = zip(self.rgb.chunks(3 * all), renders.chunks(3 * all)).zip(weights.chunks(all));
        let regions: Vec<Vec<usize>> =
            each.map(|((rgb, render), weights)| region(rgb, render, weights, self.shape.width as usize)).collect();
        let most = regions.iter().map(Vec::len).max()?;
        if most == all || regions.iter().any(Vec::is_empty) {
            return None;
        }
        let (mut uv, mut z0, mut rgb, mut counts) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for (hypothesis, region) in regions.iter().enumerate() {
            // Hypotheses have as many rays each: some of a small region are there more than once, and count once.
            for (number, ray) in region.iter().cycle().take(most).enumerate() {
                let ray = hypothesis * all + ray;
                uv.extend_from_slice(&self.rays.uv[2 * ray..][..2]);
                z0.push(self.rays.z0[ray]);
                rgb.extend_from_slice(&self.rgb[3 * ray..][..3]);
                counts.push(if number < region.len() { weights[ray] * most as f32 / all as f32 } else { 0.0 });
            }
        }
        let (instances, slots, intrinsics) = (self.instances.clone(), self.slots.clone(), self.rays.intrinsics.clone());
        let rays = Rays { world_from_camera: self.rays.world_from_camera.clone(), intrinsics, uv, z0 };
        let shape = Shape { width: most as u32, height: 1, ..self.shape };
        Some(Targets { shape, instances, slots, rays, rgb, weights: Some(counts) })
    }

    /// The same for so many hypotheses in the place of each.
    pub fn repeated(&self, times: usize) -> Self {
        let rays = self.rays_per_image();
        fn repeat<T: Copy>(all: &[T], of_each: usize, times: usize) -> Vec<T> {
            all.chunks(of_each).flat_map(|own| own.repeat(times)).collect()
        }
        Targets {
            shape: Shape { hypotheses: self.shape.hypotheses * times as u32, ..self.shape },
            instances: self.instances.clone(),
            slots: repeat(&self.slots, 1, times),
            rays: Rays {
                world_from_camera: repeat(&self.rays.world_from_camera, 1, times),
                intrinsics: repeat(&self.rays.intrinsics, 1, times),
                uv: repeat(&self.rays.uv, 2 * rays, times),
                z0: repeat(&self.rays.z0, rays, times),
            },
            rgb: repeat(&self.rgb, 3 * rays, times),
            weights: self.weights.as_ref().map(|weights| repeat(weights, rays, times)),
        }
    }

    /// At the hypotheses' poses; from there they move, or are only compared.
    pub fn descent(
        &self,
        engine: &Engine,
        model: &Model,
        method: Method,
        is_moving: bool,
        running: &[Hypothesis],
    ) -> Result<Descent, Error> {
        let new = if is_moving { Descent::new } else { Descent::still };
        let mut descent = new(engine, model, self.shape, method)?;
        descent.set_targets(&self.instances, &self.slots, &self.rays, &self.rgb, self.weights.as_deref())?;
        let poses: Vec<Pose6> = running.iter().map(|h| h.pose).collect();
        descent.set_poses(&poses)?;
        Ok(descent)
    }
}

/// What the hypotheses of a phase are compared with, and the light of each query that is made up for. `looks_closer`: on the rays alone that are worth their time.
pub(super) fn seen_by(
    engine: &Engine,
    model: &Model,
    queries: &[Query],
    options: &Options,
    phase: &Phase,
    looks_closer: bool,
    running: &[Hypothesis],
) -> Result<(Targets, Vec<Option<Light>>), Error> {
    let mut targets = Targets::new(queries, options, phase, running);
    let mut lights = vec![None; queries.len()];
    let is_made_up = |query: &Query| phase.light && query.coverage.is_some() || options.has_own_lights(query);
    let makes_up = queries.iter().any(is_made_up);
    if makes_up || looks_closer {
        let mut views = targets.descent(engine, model, options.method, false, running)?;
        views.compare()?;
        let renders = views.rgb()?;
        if makes_up {
            lights = targets.undo_lights(queries, phase, running, &renders, is_made_up);
        }
        if looks_closer {
            targets = targets.in_regions(&renders).unwrap_or(targets);
        }
    }
    Ok((targets, lights))
}

/// The descent of a phase, whose poses move or are only compared, and the light of each query that it makes up for.
pub(super) fn prepare(
    engine: &Engine,
    model: &Model,
    queries: &[Query],
    options: &Options,
    phase: &Phase,
    is_moving: bool,
    running: &[Hypothesis],
) -> Result<(Descent, Vec<Option<Light>>), Error> {
    // The paper's way compares whole images.
    let looks_closer = phase.steps > 0 && matches!(options.method, Method::Bfgs { .. });
    let (targets, lights) = seen_by(engine, model, queries, options, phase, looks_closer, running)?;
    let method = options.method.with_stride(phase.stride);
    Ok((targets.descent(engine, model, method, is_moving, running)?, lights))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::fixed24;
    use crate::renderer::render_views;
    use crate::{Effort, Intrinsics, ModelConfig, Outline};

    /// In half the contrast, darker: losses of the pose that a picture was made from and of another one in a search's first look.
    fn losses(options: &Options, coverage: Option<Vec<f32>>) -> Vec<f64> {
        const SIDE: u32 = 32;
        let model =
            Model::init(&ModelConfig { hidden: 16, latent: 4, instances: 1, tracing_steps: 3, density: true }, 3).unwrap();
        let engine = Engine::cpu();
        let intrinsics = Intrinsics { fx: 36.0, fy: 36.0, cx: 16.0, cy: 16.0, pixel_center: 0.0 };
        let starts = vec![fixed24(1.3)[5], fixed24(1.3)[16]];
        let view = render_views(&engine, &model, [SIDE, SIDE], &[(0, starts[0], intrinsics)]).unwrap().remove(0).rgb;
        let rgb = view.iter().map(|colour| 0.5 * colour - 0.2).collect();
        let (width, height, outline) = (SIDE, SIDE, Outline::AS_GIVEN);
        let query = Query { instance: 0, rgb, weights: None, coverage, outline, width, height, intrinsics, starts };
        let hypothesis = |start: usize| Hypothesis::new(0, start, Pose6::from_matrix(&query.starts[start]), outline);
        let running = [0, 1].map(hypothesis);
        let (mut descent, lights) =
            prepare(&engine, &model, std::slice::from_ref(&query), options, &options.phases[0], false, &running).unwrap();
        assert_eq!(lights, [None], "it is no light of the image yet");
        descent.compare().unwrap();
        descent.losses().unwrap()
    }

    #[test]
    fn an_object_alone_is_compared_in_each_hypothesis_own_light() {
        let options = Options::of(Effort::Fast);
        let alone = || Some(vec![1.0; 32 * 32]);
        let [dark, other] = losses(&options, None)[..] else { panic!() };
        let [own, wrong] = losses(&options, alone())[..] else { panic!() };
        assert!(3.0 * own < dark.min(wrong), "{dark} {other} {own} {wrong}");
        // The paper's way knows no light.
        let paper = Options::paper();
        assert_eq!(losses(&paper, alone()), losses(&paper, None));
        // An outline says where the object is: colours are taken as they are.
        let cut: Vec<f32> = (0..32 * 32).map(|k| if k % 32 < 16 { 1.0 } else { 0.0 }).collect();
        assert_eq!(losses(&options, Some(cut)), losses(&options, None));
    }
}
