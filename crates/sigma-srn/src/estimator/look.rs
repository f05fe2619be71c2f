//! The first look: every start is compared with its image, and moved before to where the image has the object ([`Options::align`]). There are thousands, of few places: of each
//! place one view is rendered, and those of the starts there are made of it.

use std::borrow::Cow;
use std::iter::zip;

use glam::{DMat4, DVec2, DVec3};

use super::Hypothesis;
use super::align::Shown;
use super::options::{Options, Phase};
use super::place::Place;
use super::query::Query;
use super::targets::Targets;
use crate::Error;
use crate::camera::Pose6;
use crate::engine::Engine;
use crate::light::Light;
use crate::model::Model;

/// How far guesses of where the whole of a hidden object is are apart: towards the hidden side, in size, and aside, see [`Shown::whole`].
const GUESSES: [DVec3; 3] = [DVec3::new(0.0, 0.3, 0.0), DVec3::new(0.18, 0.0, 0.0), DVec3::new(0.0, 0.0, 0.3)];

/// Takes all hypotheses, those of a query and of a place one after the other, through the first phase, which is a look.
pub(super) fn look(
    engine: &Engine,
    model: &Model,
    queries: &[Query],
    options: &Options,
    (phase, soft): (&Phase, f32),
    hypotheses: &mut [Hypothesis],
) -> Result<(), Error> {
    let wanted: Vec<Wanted> = queries.iter().map(|query| Wanted::of(query, options, phase, soft)).collect();
    let starts = hypotheses.len();
    let mut places: Vec<&mut [Hypothesis]> = hypotheses.chunk_by_mut(are_of_one_place).collect();
    let firsts: Vec<Hypothesis> = places.iter().map(|starts| starts[0]).collect();
    // What is between rays is known less well: where views are turned there are more of them.
    let stride = if firsts.len() < starts { phase.stride.div_ceil(2) } else { phase.stride };
    let targets = Targets::new(queries, options, &Phase { stride, ..*phase }, &firsts);
    let mut views = targets.descent(engine, model, options.method, false, &firsts)?;
    views.compare()?;
    let (rays, columns) = (targets.rays_per_image(), targets.columns());
    let renders = views.rgb()?;
    for ((starts, first), rgb) in zip(zip(&mut places, &firsts), renders.chunks(3 * rays)) {
        let Query { intrinsics, .. } = queries[first.query];
        let place = Place { rgb, columns, stride, world_from_camera: first.pose.to_matrix(), intrinsics };
        for start in starts.iter_mut() {
            let (loss, pose) = wanted[start.query].found(&place, &start.pose.to_matrix());
            // A NaN must not win.
            start.loss = if loss.is_nan() { f64::INFINITY } else { loss };
            (start.pose, start.phases) = (Pose6::from_matrix(&pose), 1);
        }
    }
    Ok(())
}

fn are_of_one_place(one: &Hypothesis, other: &Hypothesis) -> bool {
    one.query == other.query && one.pose.0[3..] == other.pose.0[3..]
}

/// A query's image as a look sees it: the pixels that count.
struct Wanted<'a> {
    query: &'a Query,
    stride: u32,
    soft: f32,
    pixels: Vec<(u32, u32)>,
    rgb: Vec<f32>,
    weights: Vec<f32>,
    /// Where each start is compared in a light of its own.
    coverage: Option<Vec<f32>>,
    /// Where starts are aligned.
    shown: Option<Shown>,
    hidden: Option<DVec2>,
}

impl<'a> Wanted<'a> {
    fn of(query: &'a Query, options: &Options, phase: &Phase, soft: f32) -> Self {
        let (stride, seen) = (phase.stride, query.seen(query.outline));
        let all = zip(query.rays(stride), zip(query.pixels(stride), seen.ray_weights(query.pixels(stride))));
        let (pixels, (numbers, weights)): (Vec<_>, (Vec<_>, Vec<_>)) = all.filter(|(_, (_, weight))| *weight > 0.0).unzip();
        let rgb: Vec<f32> = numbers.iter().flat_map(|&pixel: &usize| seen.rgb[3 * pixel..][..3].iter().copied()).collect();
        let coverage = options.has_own_lights(query).then(|| numbers.iter().map(|&pixel| seen.coverage[pixel]).collect());
        let is_aligned = options.align && query.coverage.is_some();
        let shown = Shown::of(&rgb, &weights, pixels.iter().copied()).filter(|_| is_aligned);
        Wanted { query, stride, soft, pixels, rgb, weights, coverage, shown, hidden: query.hidden_side() }
    }

    /// The loss of a start, and its pose: where it is aligned that with the least.
    fn found(&self, place: &Place, start: &DMat4) -> (f64, DMat4) {
        let view = |pose: &DMat4| place.seen_by(pose, self.pixels.iter().copied());
        let now = view(start);
        let in_sight = Shown::of(&now, &self.weights, self.pixels.iter().copied());
        let (Some(wanted), Some(in_sight)) = (self.shown, in_sight) else { return (self.loss(&now), *start) };
        let moved = |wanted: Shown, now: &Shown| {
            let pose = wanted.seen_by(now, start, &self.query.intrinsics);
            (self.loss(&view(&pose)), pose)
        };
        let as_it_is = moved(wanted, &in_sight);
        let all = || self.query.rays(self.stride);
        let whole = || Shown::of(&place.seen_by(start, all()), &vec![1.0; all().count()], all());
        let Some((side, whole)) = self.hidden.and_then(|side| Some((side, whole()?))) else { return as_it_is };
        let as_hidden = least(|guess| moved(wanted.whole(&whole, side, guess), &whole));
        if as_hidden.0 < as_it_is.0 { as_hidden } else { as_it_is }
    }

    /// See [`Method::Bfgs`](crate::Method::Bfgs).
    fn loss(&self, view: &[f32]) -> f64 {
        let mut rgb = Cow::from(&self.rgb);
        if let Some(coverage) = &self.coverage {
            Light::between(&rgb, view, coverage, &self.weights, false).undo(rgb.to_mut(), coverage);
        }
        let rho = |(wanted, seen): (&f32, &f32)| ((wanted - seen).powi(2) + self.soft * self.soft).sqrt() - self.soft;
        let pixels = zip(rgb.chunks(3), view.chunks(3)).map(|(wanted, seen)| zip(wanted, seen).map(rho).sum::<f32>());
        let sum: f64 = zip(pixels, &self.weights).map(|(pixel, weight)| f64::from(weight * pixel)).sum();
        sum / (3 * self.query.rays(self.stride).count()) as f64
    }
}

/// What is found with the least loss near a first guess: from there to either side, then half as far.
fn least(found: impl Fn(DVec3) -> (f64, DMat4)) -> (f64, DMat4) {
    let mut guess = DVec3::ZERO;
    let mut best = found(guess);
    for (times, axis) in [1.0, 0.5].into_iter().flat_map(|times| GUESSES.map(|axis| (times, axis))) {
        let tries = [-times, times].into_iter().map(|by| guess + by * axis).map(|guess| (guess, found(guess)));
        if let Some(better) = tries.into_iter().find(|(_, (loss, _))| *loss < best.0) {
            (guess, best) = better;
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, fixed24};
    use crate::descent::Method;
    use crate::renderer::render_views;
    use crate::{Effort, Outline};

    const SIDE: u32 = 64;

    /// 24 places, at each the camera upright and turned; the picture is the view from start 11.
    fn query(engine: &Engine, model: &Model) -> Query {
        let intrinsics = Intrinsics { fx: 60.0, fy: 60.0, cx: 32.0, cy: 32.0, pixel_center: 0.5 };
        let rolls = |place: DMat4| [0.0, 1.0].map(|roll| place * DMat4::from_rotation_z(roll));
        let starts: Vec<DMat4> = fixed24(1.3).into_iter().flat_map(rolls).collect();
        let rgb = render_views(engine, model, [SIDE, SIDE], &[(0, starts[11], intrinsics)]).unwrap().remove(0).rgb;
        let (width, height, outline) = (SIDE, SIDE, Outline::AS_GIVEN);
        Query { instance: 0, rgb, weights: None, coverage: None, outline, width, height, intrinsics, starts }
    }

    #[test]
    fn turned_cameras_are_compared_by_the_view_from_their_place() {
        // An object on white.
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/models/compact.safetensors");
        let (engine, model) = (Engine::cpu(), Model::load(path.as_ref()).unwrap());
        let query = query(&engine, &model);
        let options = Options::of(Effort::Fast);
        let queries = std::slice::from_ref(&query);
        let new = |(start, pose)| Hypothesis::new(0, start, Pose6::from_matrix(pose), Outline::AS_GIVEN);
        let all: Vec<Hypothesis> = query.starts.iter().enumerate().map(new).collect();
        let targets = Targets::new(queries, &options, &options.phases[0], &all);
        let mut views = targets.descent(&engine, &model, options.method, false, &all).unwrap();
        views.compare().unwrap();
        let rendered = views.losses().unwrap();
        let looked_at = |starts: &[Hypothesis]| {
            let mut looked = starts.to_vec();
            look(&engine, &model, queries, &options, options.first_look().unwrap(), &mut looked).unwrap();
            for (before, after) in zip(starts, &looked) {
                assert_eq!((after.phases, after.pose), (1, before.pose), "nothing says what the object is: no start moves");
            }
            looked
        };
        // Between rays views are a little blurred.
        let turned = looked_at(&all);
        for looked in &turned {
            let loss = rendered[looked.start];
            assert!((looked.loss - loss).abs() < 0.2 * loss + 0.02, "{}: {} {loss}", looked.start, looked.loss);
        }
        let best = turned.iter().min_by(|a, b| a.loss.total_cmp(&b.loss)).unwrap();
        assert_eq!(best.start, 11);
        // What is rendered itself is compared as it is.
        let upright: Vec<Hypothesis> = all.iter().copied().step_by(2).collect();
        for looked in looked_at(&upright) {
            let loss = rendered[looked.start];
            assert!((looked.loss - loss).abs() < 1e-5 * loss, "{}: {} {loss}", looked.start, looked.loss);
        }
    }

    #[test]
    fn guesses_come_nearer_to_the_least_loss() {
        let apart = |x: DVec3| (x / (GUESSES[0] + GUESSES[1] + GUESSES[2])).length();
        for truth in [DVec3::ZERO, GUESSES[0], DVec3::new(0.09, -0.3, 0.15), DVec3::new(-0.25, 0.4, 0.45)] {
            let found = |guess: DVec3| (apart(guess - truth), DMat4::from_translation(guess));
            let (loss, pose) = least(found);
            assert_eq!(loss, apart(pose.w_axis.truncate() - truth), "the loss is that of the pose");
            assert!(loss <= apart(truth) && loss < 0.25, "{truth}: {loss}");
        }
    }

    #[test]
    fn only_a_first_phase_by_bfgs_without_steps_is_a_look() {
        let options = Options::of(Effort::Fast);
        let Method::Bfgs { soft, .. } = options.method else { panic!() };
        assert_eq!(options.first_look(), Some((&options.phases[0], soft)));
        assert!(options.clone().with_steps(9).without_culling().first_look().is_some());
        assert_eq!([Options::paper(), Options::paper().with_steps(0)].map(|options| options.first_look().is_some()), [false; 2]);
        let with = |first: Phase| Options { phases: vec![first, options.phases[1]], ..options.clone() };
        let look = options.phases[0];
        let others = [Phase { steps: 1, ..look }, Phase { light: true, ..look }, Phase { closer_look: true, ..look }];
        assert_eq!(others.map(|phase| with(phase).first_look().is_some()), [false; 3]);
    }
}
