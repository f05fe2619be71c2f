//! Pose estimation (spec 4): many starts per image in one batch, the unpromising ones dropped between phases.

use std::borrow::Cow;
use std::iter::zip;

use glam::{DMat4, DVec2};
use serde::Serialize;

use crate::align::{Shown, hidden_side};
use crate::camera::{Intrinsics, Pose6};
use crate::confidence::{motion, promise};
use crate::descent::{Descent, Loss, Method, Shape};
use crate::engine::{Engine, proof};
use crate::light::Light;
use crate::mask::{DILATIONS, best_dilation, dilated, has_outline};
use crate::model::Model;
use crate::random::{MEAN_DEPTH, initial_depths, stream};
use crate::region::region;
use crate::{Error, Rays, pixel_grid};

/// How far starts are turned that the search adds. Not the 30° of `neighbor4`: one of them would be turned back to where it came from.
const TURN: f64 = 40.0 * std::f64::consts::PI / 180.0;

/// How far apart two hypotheses are at most that have met: a turn about each axis (rad) and a shift along it (object units), a tenth of a pixel
/// of 64. What is left of the search takes both to the same minimum.
const MET: f64 = 1e-3;

/// How many times the loss of the best hypothesis a rival may have to go on beside it. A search that has not ended exaggerates: of the steering part's
/// `000018` the right pose stands at 1.6 times the loss of the one turned by 180° where three go on, and ends at 0.7 times.
const RIVAL: f64 = 2.0;

/// How far a rival is turned from the best, in degrees, where rays are cast at every pixel. At every other pixel it is twice as far: descents there are from
/// starts 30° and more apart, have just begun, and may lead to one side yet.
const RIVAL_DEG: f64 = 15.0;

/// What steps at every pixel are multiples of, in radians and object units: a sixtieth of a pixel of 64 at most, and a number that sums of it are exact of.
const GRAIN: f32 = 1.0 / 4096.0;

/// By which part second derivatives may promise a lower loss where a search has arrived.
const ARRIVED: f64 = 0.01;

/// Hypotheses that a GPU, and cooperative matrices, are tried on.
const TRIED: usize = 8;

/// An image whose camera pose is wanted.
#[derive(Clone, Debug)]
pub struct Query {
    /// Number of the instance that it shows.
    pub instance: u32,
    /// Colours in [-1, 1], `[height, width, 3]`, white background.
    pub rgb: Vec<f32>,
    /// How much each pixel counts `[height, width]`, from 0, not at all: where something stands before the object, say. `None`: all
    /// the same. GMSD takes none.
    pub weights: Option<Vec<f32>>,
    /// How much of each pixel the object covers `[height, width]`, 0 to 1; the rest of it is white. Where it is known, a phase may make up
    /// for the light of the image, see [`Phase::light`], and for an outline that is not exact, see [`Phase::dilate`].
    pub coverage: Option<Vec<f32>>,
    /// By how many pixels its outline is known to be too far in, or too far out where this is below zero: the search begins with the mask dilated by as
    /// much. 0 where nothing is known.
    pub dilation: f64,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Intrinsics of this image.
    pub intrinsics: Intrinsics,
    /// Where the search starts: `world_from_camera`.
    pub starts: Vec<DMat4>,
}

/// Some steps with the same settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Phase {
    /// Steps; none: the poses are only compared with the image.
    pub steps: u32,
    /// Every how many pixels, in both directions, a ray is cast; with BFGS only near what the image or the view from a hypothesis's pose at the
    /// beginning of the phase shows: where both are white nothing is to be seen.
    pub stride: u32,
    /// How many hypotheses of each image enter this phase: those with the lowest loss, and of several that have come to the same pose the best
    /// alone. Where all of them look at the same side of the object, one more: the best of another side, unless its loss is more than twice that of the best.
    /// `usize::MAX`: all.
    pub keep: usize,
    /// Whether the object is compared as it would be in the model's light, where [`Query::coverage`] is known: see [`Light`]. From wrong
    /// poses the light looks wrong, too.
    pub light: bool,
    /// Whether masks are tried dilated and eroded by up to two pixels beside [`Query::dilation`], where [`Query::coverage`] is known, with the
    /// best `keep` hypotheses; later phases compare with the one that leaves the least loss, see [`Estimate::dilation`]. Other hypotheses and
    /// other images wait: none is dropped for it.
    pub dilate: bool,
}

/// How poses are estimated.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// How hypotheses move.
    pub method: Method,
    /// Where an image has fewer starts than this, six more are tried around each, turned by 40° about the object: to either side about each
    /// axis of the camera.
    pub min_starts: usize,
    /// Whether starts are moved first, where [`Query::coverage`] is known: nearer or farther away, and turned about themselves, until the object is as large and
    /// at the same place in the views from there, as the first phase would show them, as in the image; where a part of it is hidden, or as the whole of it would
    /// be, whichever has the lower loss. Else their distance and aim are taken for known.
    pub align: bool,
    /// Phases, one after the other.
    pub phases: Vec<Phase>,
    /// How many times the last phase begins anew, at most, for images whose poses have not arrived: where the second derivatives there promise a loss that
    /// is lower than the best by more than a hundredth. With BFGS only.
    pub anew: u32,
    /// Seed of the initial depths of Adam's rays. With BFGS all begin at the mean depth: random ones change the losses of hypotheses by half a
    /// thousandth, as much as those of minima side by side differ.
    pub seed: u64,
}

/// How hard a search tries.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Effort {
    /// For poses that are roughly known, and objects that look different from every side.
    Fast,
    /// What the figures are measured with.
    #[default]
    Normal,
    /// For what `Normal` has lost.
    Exhaustive,
}

impl Default for Options {
    fn default() -> Self {
        Options::of(Effort::Normal)
    }
}

impl Options {
    /// BFGS: a look at all starts, steps for the most promising ones on few rays, then for the best on more, and for the best few on
    /// all, until they stand still: the loss has minima side by side. Then once more with new second derivatives: where a valley is flat and
    /// full of kinks, those that steps have learnt leave a pose a tenth of a degree before its end. These two make up for the light, and before them masks
    /// are tried dilated. And on so for those that have not arrived: most have, in a number of steps that would be too small for some.
    pub fn of(effort: Effort) -> Self {
        let (min_starts, descents) = match effort {
            Effort::Fast => (84, [(6, 6), (6, 2), (5, 1), (5, 1), (3, 1)]),
            Effort::Normal => (84, [(8, 16), (8, 6), (6, 1), (16, 3), (6, 3)]),
            Effort::Exhaustive => (168, [(10, 64), (10, 20), (6, 6), (18, 6), (6, 6)]),
        };
        let mut phases = vec![Phase { steps: 0, stride: 4, keep: usize::MAX, light: false, dilate: false }];
        let phase = |((stride, light, dilate), (steps, keep))| Phase { steps, stride, keep, light, dilate };
        let kinds = [(4, false, false), (2, false, false), (2, true, true), (1, true, false), (1, true, false)];
        phases.extend(zip(kinds, descents).map(phase));
        Options { method: Method::Bfgs { soft: 0.3, grain: GRAIN }, min_starts, align: true, phases, anew: 6, seed: 0 }
    }

    /// The paper's settings: Adam at 0.1, 300 steps for every start, all pixels, MAE, last step.
    pub fn paper() -> Self {
        let method = Method::Adam { loss: Loss::Mae, learning_rate: 0.1 };
        Options {
            method,
            min_starts: 0,
            align: false,
            phases: vec![Phase { steps: 300, stride: 1, keep: usize::MAX, light: false, dilate: false }],
            anew: 0,
            seed: 0,
        }
    }

    /// The same with `steps` steps in all, none anew, shared between the phases in their present proportions; those that try dilations have as many more or fewer,
    /// and come on top. Where there are any at all, a phase whose share is none is left out.
    pub fn with_steps(mut self, steps: u32) -> Self {
        self.anew = 0;
        let total = self.phases.iter().filter(|phase| !phase.dilate).map(|phase| u64::from(phase.steps)).sum::<u64>().max(1);
        let share = |of: u64| (2 * of * u64::from(steps) + total) / (2 * total);
        let (mut before, mut done) = (0, 0);
        self.phases.retain_mut(|phase| {
            let present = u64::from(phase.steps);
            if phase.dilate {
                phase.steps = share(present) as u32;
            } else {
                before += present;
                phase.steps = (share(before) - done) as u32;
                done = share(before);
            }
            phase.steps > 0 || present == 0 || phase.dilate || steps == 0
        });
        self
    }

    /// The same with this stride in every phase.
    pub fn with_stride(mut self, stride: u32) -> Self {
        self.phases.iter_mut().for_each(|phase| phase.stride = stride);
        self
    }

    /// The same with all starts as they are given, and no others, in every phase.
    pub fn without_culling(mut self) -> Self {
        self.align = false;
        self.min_starts = 0;
        self.phases.iter_mut().filter(|phase| !phase.dilate).for_each(|phase| phase.keep = usize::MAX);
        self
    }

    /// The same, but where all starts would run to the end, only the best 6 do so after a fifth of the steps.
    pub fn with_culling(mut self) -> Self {
        let all_to_the_end = self.phases.iter().all(|phase| phase.keep == usize::MAX);
        if let Some(last) = self.phases.last_mut().filter(|_| all_to_the_end) {
            let first = Phase { steps: last.steps / 5, ..*last };
            *last = Phase { steps: last.steps - first.steps, keep: 6, ..*last };
            self.phases.insert(self.phases.len() - 1, first);
        }
        self
    }
}

/// Where one start ended.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Ranked {
    /// Number of the start in [`Query::starts`]; beyond those, of one that was added, see [`Options::min_starts`].
    pub start: usize,
    /// Its loss when it was dropped, or at the end; infinite where it was not a number.
    pub loss: f64,
    /// Phases that it went through, or waited for.
    pub phases: usize,
    /// Its pose then.
    #[serde(skip)]
    pub pose: Pose6,
}

/// An estimated pose.
#[derive(Clone, Debug)]
pub struct Estimate {
    /// The pose of the winning start.
    pub pose: Pose6,
    /// Its loss.
    pub loss: f64,
    /// Second derivatives of the loss there, those of least squares, over a turn about the object and a shift, in the camera's axes; with
    /// BFGS only.
    pub curvature: Option<[[f64; 6]; 6]>,
    /// The light of the image, if the last phase has made up for it.
    pub light: Option<Light>,
    /// By how many pixels the mask of the image was dilated at the end, if that was tried or given: below zero where it was too large.
    pub dilation: Option<f64>,
    /// The image as it was compared at the end, dilated and in the model's light `[height, width, 3]`.
    pub target: Vec<f32>,
    /// How long the object's diagonal is in the picture, as a part of the picture's width.
    pub extent: f64,
    /// All starts, the winner first: more phases before fewer, then by loss.
    pub ranking: Vec<Ranked>,
}

/// What an observer of [`estimate`] sees before every step, and at the end of every phase: poses, and the losses there.
pub struct Progress<'a> {
    /// Steps done, over all phases.
    pub step: u32,
    /// Steps in all, as far as is known: more where poses have not arrived, see [`Options::anew`].
    pub steps: u32,
    /// Searches that have gone before, where several follow one another: see [`Search`](crate::Search).
    pub search: usize,
    /// `(query, start)` of each hypothesis in the running phase.
    pub hypotheses: &'a [(usize, usize)],
    /// The running descent; reading from it waits for the device. With BFGS its rays are no whole image, but those near what is to be seen.
    pub descent: &'a mut Descent,
}

/// Hypothesis on its way.
#[derive(Clone, Copy, Debug)]
struct Hypothesis {
    query: usize,
    start: usize,
    pose: Pose6,
    loss: f64,
    curvature: Option<[[f64; 6]; 6]>,
    /// By how much that promises a lower loss.
    promise: f64,
    phases: usize,
    /// Of the image's mask, in the running phase.
    dilation: f64,
}

/// Estimates the poses of all queries in one batch. `observe` is called after every evaluation: before each step, and at the end
/// of each phase.
///
/// A GPU that has looked for no poses before is compared with the CPU executor first, and refused where gradients are wrong ([`Error::Adapter`]).
pub fn estimate(
    engine: &Engine,
    model: &Model,
    queries: &[Query],
    options: &Options,
    observe: impl FnMut(Progress) -> Result<(), Error>,
) -> Result<Vec<Estimate>, Error> {
    check(model, queries, options)?;
    let (model, queries) = at_work(model, queries)?;
    let (model, queries) = (&*model, &*queries);
    let can_dilate =
        |query: &Query| query.coverage.as_ref().is_some_and(|coverage| has_outline(coverage, query.weights.as_deref()));
    let runs = |phase: &&Phase| !phase.dilate || queries.iter().any(can_dilate);
    let (steps, last) = (
        options.phases.iter().filter(runs).map(|phase| phase.steps).sum(),
        options.phases.iter().rposition(|phase| runs(&phase)),
    );
    let mut hypotheses: Vec<Hypothesis> = Vec::new();
    let mut dilations: Vec<Option<f64>> = queries.iter().map(|query| (query.dilation != 0.0).then_some(query.dilation)).collect();
    for (query, q) in queries.iter().enumerate() {
        let new = |(start, matrix)| {
            let pose = Pose6::from_matrix(matrix);
            Hypothesis { query, start, pose, loss: f64::INFINITY, curvature: None, promise: 0.0, phases: 0, dilation: q.dilation }
        };
        hypotheses.extend(starts_of(q, options).iter().enumerate().map(new));
    }
    let gradients_of = |engine: &Engine, tried: &[Hypothesis], stride: u32| {
        let phase = Phase { stride, ..options.phases[0] };
        let (mut descent, _) = prepare(engine, model, queries, options, &phase, true, tried)?;
        descent.evaluate()?;
        descent.gradients()
    };
    let work = if model.layout.is_baked() { "gradients of poses of baked objects" } else { "gradients of poses" };
    engine.prove(work, |engine| {
        // As many of them from one start alone.
        let around = |h: &Hypothesis| {
            let at = |matrix: DMat4| Hypothesis { pose: Pose6::from_matrix(&matrix), ..*h };
            turned(&h.pose.to_matrix()).map(at).collect::<Vec<_>>()
        };
        let tried: Vec<Hypothesis> = hypotheses.iter().copied().chain(hypotheses.iter().flat_map(around)).take(TRIED).collect();
        let stride = if is_gmsd(options.method) { 1 } else { queries[0].width.max(queries[0].height).div_ceil(proof::SIDE) };
        Ok(gradients_of(engine, &tried, stride)?.iter().map(|six| vec![six.to_vec()]).collect())
    })?;
    engine
        .check_cooperative(|engine| gradients_of(engine, &hypotheses[..hypotheses.len().min(TRIED)], options.phases[0].stride))?;

    if options.align {
        align(engine, model, queries, options, &mut hypotheses)?;
    }
    let mut search = Course { engine, model, queries, options, lights: vec![None; queries.len()], step: 0, steps, observe };
    for (number, phase) in options.phases.iter().enumerate() {
        let mut running: Vec<Hypothesis> = Vec::new();
        // Dropped, or waiting.
        let mut rest: Vec<Hypothesis> = Vec::new();
        for query in 0..queries.len() {
            let mut own: Vec<Hypothesis> =
                hypotheses.iter().copied().filter(|h| h.query == query && h.phases == number).collect();
            own.sort_by(|a, b| a.loss.total_cmp(&b.loss));
            if phase.keep < usize::MAX {
                rest.extend(split_off_met(&mut own));
            }
            let keep = if phase.dilate && !can_dilate(&queries[query]) { 0 } else { phase.keep };
            let rival = if phase.dilate { None } else { take_rival(&mut own, keep, phase.stride) };
            let mut others = own.split_off(keep.min(own.len()));
            own.extend(rival);
            if phase.dilate {
                others.iter_mut().for_each(|h| h.phases = number + 1);
                own = own.iter().flat_map(|&h| DILATIONS.map(|by| Hypothesis { dilation: h.dilation + by, ..h })).collect();
            }
            running.extend(own);
            rest.extend(others);
        }
        rest.extend(hypotheses.iter().filter(|h| h.phases < number));
        if running.is_empty() {
            hypotheses = rest;
            continue;
        }
        search.follow(phase, Some(number) == last, &mut running)?;
        running.iter_mut().for_each(|h| h.phases = number + 1);
        if phase.dilate {
            // Those of one start come one after the other.
            let least = |tried: &&[Hypothesis]| tried.iter().map(|h| h.loss).fold(f64::INFINITY, f64::min);
            for (query, dilation) in dilations.iter_mut().enumerate() {
                let own = running.chunks(DILATIONS.len()).filter(|tried| tried[0].query == query);
                let best = own.min_by(|a, b| least(a).total_cmp(&least(b)));
                let per_area = |h: &Hypothesis| h.loss / area(&queries[query], h.dilation);
                let by = best.map(|tried| best_dilation(&tried.iter().map(per_area).collect::<Vec<_>>()));
                *dilation = by.map(|by| dilation.unwrap_or(queries[query].dilation) + by).or(*dilation);
            }
            let apart = |h: &&Hypothesis| (h.dilation - dilations[h.query].unwrap_or(0.0)).abs();
            let nearest = |tried: &[Hypothesis]| tried.iter().min_by(|a, b| apart(a).total_cmp(&apart(b))).copied();
            running = running.chunks(DILATIONS.len()).filter_map(nearest).collect();
        }
        hypotheses = running;
        hypotheses.extend(rest);
        hypotheses.iter_mut().for_each(|h| h.dilation = dilations[h.query].unwrap_or(0.0));
    }
    for _ in 0..options.anew {
        let (mut running, rest) = split_off_late(&hypotheses, queries.len(), options.phases.len());
        let Some(phase) = last.filter(|_| !running.is_empty()).map(|last| &options.phases[last]) else { break };
        search.steps += phase.steps;
        search.follow(phase, true, &mut running)?;
        hypotheses = running;
        hypotheses.extend(rest);
    }

    let mut estimates = Vec::new();
    for (query, q) in queries.iter().enumerate() {
        let mut own: Vec<&Hypothesis> = hypotheses.iter().filter(|h| h.query == query).collect();
        own.sort_by(|a, b| b.phases.cmp(&a.phases).then(a.loss.total_cmp(&b.loss)));
        let ranked = |h: &&Hypothesis| Ranked { start: h.start, loss: h.loss, phases: h.phases, pose: h.pose };
        let &Hypothesis { pose, loss, curvature, .. } = own[0];
        let (light, dilation) = (search.lights[query], dilations[query]);
        let (rgb, coverage) = seen(q, dilation.unwrap_or(0.0));
        let mut target = rgb.into_owned();
        if let Some(light) = light {
            light.undo(&mut target, &coverage);
        }
        let extent = q.intrinsics.fx / (pose.distance() * f64::from(q.width));
        let ranking = own.iter().map(ranked).collect();
        estimates.push(Estimate { pose, loss, curvature, light, dilation, target, extent, ranking });
    }
    Ok(estimates)
}

/// The model for work on these queries, see [`Model::for_work_on`], and they with the numbers that their instances have there.
pub(crate) fn at_work<'a>(model: &'a Model, queries: &'a [Query]) -> Result<(Cow<'a, Model>, Cow<'a, [Query]>), Error> {
    let instances: Vec<u32> = queries.iter().map(|query| query.instance).collect();
    let (at_work, numbers) = model.for_work_on(&instances)?;
    if numbers == instances {
        return Ok((at_work, queries.into()));
    }
    let numbered = zip(queries, numbers).map(|(query, instance)| Query { instance, ..query.clone() });
    Ok((at_work, numbered.collect()))
}

/// A search on its way through the phases.
struct Course<'a, F> {
    engine: &'a Engine,
    model: &'a Model,
    queries: &'a [Query],
    options: &'a Options,
    /// Of each query, as the last phase made up for it.
    lights: Vec<Option<Light>>,
    step: u32,
    steps: u32,
    observe: F,
}

impl<F: FnMut(Progress) -> Result<(), Error>> Course<'_, F> {
    /// Takes hypotheses through a phase, those of a query one after the other, the best first. What second derivatives say at its end is found out where
    /// the search may end there.
    fn follow(&mut self, phase: &Phase, may_end: bool, running: &mut [Hypothesis]) -> Result<(), Error> {
        let Course { engine, model, queries, options, .. } = *self;
        let names: Vec<(usize, usize)> = running.iter().map(|h| (h.query, h.start)).collect();
        let is_moving = phase.steps > 0 || may_end;
        let (mut descent, lights) = prepare(engine, model, queries, options, phase, is_moving, running)?;
        running.iter().for_each(|h| self.lights[h.query] = lights[h.query]);
        let rows = running.len() * rays_of(&queries[0], phase.stride).count();
        for _ in 0..phase.steps {
            // New depths in every step, as in the paper.
            if matches!(options.method, Method::Adam { .. }) {
                let mut random = stream(options.seed, 1 + u64::from(self.step));
                descent.set_initial_depths(&initial_depths(&mut random, rows))?;
            }
            descent.evaluate()?;
            self.observe(&names, &mut descent)?;
            descent.descend()?;
            self.step += 1;
        }
        if phase.steps == 0 {
            descent.compare()?;
        } else {
            descent.evaluate()?;
        }
        self.observe(&names, &mut descent)?;
        let standing = descent.standing()?;
        if may_end && matches!(options.method, Method::Bfgs { .. }) {
            // What BFGS has learnt of them by now depends on how many steps it took, and on their way.
            let poses: Vec<Pose6> = standing.iter().map(|(_, pose)| *pose).collect();
            descent.set_poses(&poses)?;
            descent.evaluate()?;
            for (h, (curvature, gradient)) in zip(&mut *running, zip(descent.curvatures()?, descent.gradients()?)) {
                (h.curvature, h.promise) = (Some(curvature), promise(&curvature, &gradient));
            }
        }
        for (hypothesis, standing) in zip(running, standing) {
            (hypothesis.loss, hypothesis.pose) = standing;
            // A NaN must not win; something near the largest f32 is what a descent holds that never had another.
            if hypothesis.loss.is_nan() || hypothesis.loss > 1e38 {
                hypothesis.loss = f64::INFINITY;
            }
        }
        Ok(())
    }

    fn observe(&mut self, hypotheses: &[(usize, usize)], descent: &mut Descent) -> Result<(), Error> {
        (self.observe)(Progress { step: self.step, steps: self.steps, search: 0, hypotheses, descent })
    }
}

/// Moves the starts of images whose coverage is known, see [`Options::align`].
fn align(
    engine: &Engine,
    model: &Model,
    queries: &[Query],
    options: &Options,
    hypotheses: &mut [Hypothesis],
) -> Result<(), Error> {
    let mut starts: Vec<&mut Hypothesis> = hypotheses.iter_mut().filter(|h| queries[h.query].coverage.is_some()).collect();
    let running: Vec<Hypothesis> = starts.iter().map(|h| **h).collect();
    if running.is_empty() {
        return Ok(());
    }
    let (phase, method) = (&options.phases[0], options.method);
    let targets = Targets::new(queries, options, phase, &running);
    let mut views = targets.descent(engine, model, method, false, &running)?;
    views.compare()?;
    let renders = views.rgb()?;
    let values = 3 * targets.rays_per_image();
    let hidden: Vec<Option<DVec2>> = queries.iter().map(hidden_side_of).collect();
    // By number of the start: aligned as if nothing, and as if something of the object were hidden.
    let mut either: Vec<(usize, [Pose6; 2])> = Vec::new();
    for (k, (rgb, render)) in zip(targets.rgb.chunks(values), renders.chunks(values)).enumerate() {
        let (query, start) = (&queries[running[k].query], running[k].pose.to_matrix());
        let weights = weights_of(query, phase.stride);
        let shown = |rgb: &[f32], weights: &[f32]| Shown::of(rgb, weights, rays_of(query, phase.stride));
        let aligned = |wanted: Shown, now: &Shown| Pose6::from_matrix(&wanted.seen_by(now, &start, &query.intrinsics));
        let (Some(wanted), Some(in_sight)) = (shown(rgb, &weights), shown(render, &weights)) else { continue };
        starts[k].pose = aligned(wanted, &in_sight);
        if let (Some(side), Some(all)) = (hidden[running[k].query], shown(render, &vec![1.0; weights.len()])) {
            either.push((k, [starts[k].pose, aligned(wanted.whole(&all, side), &all)]));
        }
    }
    if !either.is_empty() {
        let tried = either.iter().flat_map(|(k, poses)| poses.map(|pose| Hypothesis { pose, ..running[*k] }));
        let tried: Vec<Hypothesis> = tried.collect();
        let mut views = Targets::new(queries, options, phase, &tried).descent(engine, model, method, false, &tried)?;
        views.compare()?;
        for ((k, poses), losses) in zip(either, views.standing()?.chunks(2)) {
            starts[k].pose = poses[usize::from(losses[1].0 < losses[0].0)];
        }
    }
    Ok(())
}

/// On which side something is before the object of an image, see [`hidden_side`].
fn hidden_side_of(query: &Query) -> Option<DVec2> {
    hidden_side(query.coverage.as_ref()?, query.weights.as_ref()?, query.width as usize)
}

/// Those that went through all phases, of queries that have not arrived, see [`Options::anew`]; and all others.
fn split_off_late(hypotheses: &[Hypothesis], queries: usize, phases: usize) -> (Vec<Hypothesis>, Vec<Hypothesis>) {
    let (mut late, mut rest) = (Vec::new(), Vec::new());
    for query in 0..queries {
        let of_query = hypotheses.iter().copied().filter(|h| h.query == query);
        let (mut own, others): (Vec<_>, Vec<_>) = of_query.partition(|h| h.phases == phases);
        own.sort_by(|a, b| a.loss.total_cmp(&b.loss));
        let promised = own.iter().map(|h| h.loss - h.promise).fold(f64::INFINITY, f64::min);
        let is_late = own.first().is_some_and(|best| promised < (1.0 - ARRIVED) * best.loss);
        if is_late { &mut late } else { &mut rest }.extend(own);
        rest.extend(others);
    }
    (late, rest)
}

/// Takes those out of a query's hypotheses, the best first, that have come to where a better one stands.
fn split_off_met(own: &mut Vec<Hypothesis>) -> Vec<Hypothesis> {
    let mut met = Vec::new();
    for hypothesis in std::mem::take(own) {
        let here = hypothesis.pose.to_matrix();
        let is_here = |better: &Hypothesis| motion(&better.pose.to_matrix(), &here).iter().all(|by| by.abs() < MET);
        if own.iter().any(is_here) { &mut met } else { &mut *own }.push(hypothesis);
    }
    met
}

/// Takes the best that shows another side than the first of a query's hypotheses, the best first, out of those, if it would not be among the
/// `keep` that enter a phase.
fn take_rival(own: &mut Vec<Hypothesis>, keep: usize, stride: u32) -> Option<Hypothesis> {
    let best = *own.first()?;
    let rival = own.iter().position(|other| best.pose.degrees_from(other.pose) > RIVAL_DEG * f64::from(stride))?;
    (rival >= keep && own[rival].loss <= RIVAL * best.loss).then(|| own.remove(rival))
}

fn is_gmsd(method: Method) -> bool {
    matches!(method, Method::Adam { loss: Loss::Gmsd, .. })
}

/// The starts of an image, and those that are added.
fn starts_of(query: &Query, options: &Options) -> Vec<DMat4> {
    let around = (query.starts.len() < options.min_starts).then(|| query.starts.iter().flat_map(turned));
    query.starts.iter().copied().chain(around.into_iter().flatten()).collect()
}

/// How many rays an image has in the phase in which it has the most.
pub(crate) fn most_rays(query: &Query, options: &Options) -> usize {
    let starts = starts_of(query, options).len();
    let rays = |phase: &Phase| {
        let tried = if phase.dilate { DILATIONS.len() } else { 1 };
        tried * starts.min(phase.keep) * rays_of(query, phase.stride).count()
    };
    options.phases.iter().map(rays).max().unwrap_or(0)
}

/// A camera turned about the object by 40°, to either side about each of its axes.
fn turned(world_from_camera: &DMat4) -> impl Iterator<Item = DMat4> {
    let axes = [world_from_camera.x_axis, world_from_camera.y_axis, world_from_camera.z_axis];
    let turns =
        axes.into_iter().flat_map(|axis| [-TURN, TURN].map(|angle| DMat4::from_axis_angle(axis.truncate().normalize(), angle)));
    turns.map(|turn| turn * *world_from_camera)
}

/// Colours of an image, and how much the object covers (none where that is not known), with its mask dilated.
fn seen(query: &Query, dilation: f64) -> (Cow<'_, [f32]>, Cow<'_, [f32]>) {
    match &query.coverage {
        Some(coverage) if dilation != 0.0 => {
            let (rgb, coverage) = dilated(&query.rgb, coverage, query.weights.as_deref(), query.width as usize, dilation);
            (rgb.into(), coverage.into())
        }
        coverage => (query.rgb.as_slice().into(), coverage.as_deref().unwrap_or_default().into()),
    }
}

/// How many of the pixels that count the object covers with its mask dilated.
fn area(query: &Query, dilation: f64) -> f64 {
    let (_, coverage) = seen(query, dilation);
    let weight = |pixel: usize| query.weights.as_ref().map_or(1.0, |weights| weights[pixel]);
    coverage.iter().enumerate().map(|(pixel, cover)| f64::from(cover * weight(pixel))).sum()
}

fn rays_of(query: &Query, stride: u32) -> impl Iterator<Item = (u32, u32)> {
    pixel_grid(query.width, query.height, stride)
}

/// Pixels of the rays.
fn pixels_of(query: &Query, stride: u32) -> impl Iterator<Item = usize> {
    rays_of(query, stride).map(|(u, v)| (v * query.width + u) as usize)
}

/// Weights of the rays, scaled to a mean of 1: losses of pictures with masks and without are then of one kind.
pub(crate) fn weights_of(query: &Query, stride: u32) -> Vec<f32> {
    let weight = |pixel: usize| query.weights.as_ref().map_or(1.0, |weights| weights[pixel]);
    let weights: Vec<f32> = pixels_of(query, stride).map(weight).collect();
    let mean = weights.iter().sum::<f32>() / weights.len() as f32;
    weights.into_iter().map(|weight| weight / mean).collect()
}

/// What the hypotheses of a phase are compared with; those of a query come one after the other, the best first.
struct Targets {
    shape: Shape,
    /// The instances, and which of them each hypothesis shows.
    instances: Vec<u32>,
    slots: Vec<u32>,
    rays: Rays,
    /// `[hypotheses, rays, 3]`.
    rgb: Vec<f32>,
    /// `[hypotheses, rays]`, none where all rays count the same.
    weights: Option<Vec<f32>>,
}

impl Targets {
    /// On the whole grid of a phase.
    fn new(queries: &[Query], options: &Options, phase: &Phase, running: &[Hypothesis]) -> Self {
        let mut instances: Vec<u32> = running.iter().map(|h| queries[h.query].instance).collect();
        instances.sort_unstable();
        instances.dedup();
        let mut random = stream(options.seed, 0);
        let (mut slots, mut rays, mut rgb, mut weights) = (Vec::new(), Rays::default(), Vec::new(), Vec::new());
        for hypothesis in running {
            let query = &queries[hypothesis.query];
            slots.push(instances.binary_search(&query.instance).expect("collected above") as u32);
            rays.push(&DMat4::IDENTITY, &query.intrinsics, rays_of(query, phase.stride), &mut random);
            let (colours, _) = seen(query, hypothesis.dilation);
            pixels_of(query, phase.stride).for_each(|pixel| rgb.extend_from_slice(&colours[3 * pixel..][..3]));
            weights.extend(weights_of(query, phase.stride));
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
        let weights = queries.iter().any(|query| query.weights.is_some()).then_some(weights);
        Targets { shape, instances, slots, rays, rgb, weights }
    }

    fn rays_per_image(&self) -> usize {
        (self.shape.width * self.shape.height) as usize
    }

    /// Makes up for the light of the image of each query, where its coverage is known: that between it and the view from the best pose.
    fn undo_lights(&mut self, queries: &[Query], stride: u32, running: &[Hypothesis], renders: &[f32]) -> Vec<Option<Light>> {
        let mut lights = vec![None; queries.len()];
        let values = 3 * self.rays_per_image();
        for ((hypothesis, render), rgb) in zip(running, renders.chunks(values)).zip(self.rgb.chunks_mut(values)) {
            let query = &queries[hypothesis.query];
            let (_, coverage) = seen(query, hypothesis.dilation);
            if query.coverage.is_some() {
                let coverage: Vec<f32> = pixels_of(query, stride).map(|pixel| coverage[pixel]).collect();
                let between = || Light::between(rgb, render, &coverage, &weights_of(query, stride));
                lights[hypothesis.query].get_or_insert_with(between).undo(rgb, &coverage);
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

    /// At the hypotheses' poses; from there they move, or are only compared.
    fn descent(
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

/// The descent of a phase, whose poses move or are only compared, and the light of each query that it makes up for.
fn prepare(
    engine: &Engine,
    model: &Model,
    queries: &[Query],
    options: &Options,
    phase: &Phase,
    is_moving: bool,
    running: &[Hypothesis],
) -> Result<(Descent, Vec<Option<Light>>), Error> {
    let mut targets = Targets::new(queries, options, phase, running);
    let method = options.method.with_stride(phase.stride);
    let mut lights = vec![None; queries.len()];
    let makes_up = phase.light && queries.iter().any(|query| query.coverage.is_some());
    // The paper's way compares whole images.
    let looks_closer = phase.steps > 0 && matches!(method, Method::Bfgs { .. });
    if makes_up || looks_closer {
        let mut views = targets.descent(engine, model, method, false, running)?;
        views.compare()?;
        let renders = views.rgb()?;
        if makes_up {
            lights = targets.undo_lights(queries, phase.stride, running, &renders);
        }
        if looks_closer {
            targets = targets.in_regions(&renders).unwrap_or(targets);
        }
    }
    Ok((targets.descent(engine, model, method, is_moving, running)?, lights))
}

/// Says what is wrong with what is asked for.
pub(crate) fn check(model: &Model, queries: &[Query], options: &Options) -> Result<(), Error> {
    let setting = |field, what: &str| Err(Error::Setting { field, what: what.into() });
    if queries.is_empty() {
        return setting("queries", "there are none");
    }
    if options.phases.is_empty() {
        return setting("phases", "there are none");
    }
    for phase in &options.phases {
        if phase.stride == 0 || phase.keep == 0 {
            return setting("phases", "stride and keep must be at least 1");
        }
        if is_gmsd(options.method) && phase.stride != 1 {
            return setting("loss", "GMSD compares neighbouring pixels: it needs stride 1 in every phase");
        }
    }
    for (number, query) in queries.iter().enumerate() {
        let input = |what: String| Err(Error::Input { input: format!("image {number}"), what });
        if query.rgb.len() != 3 * query.width as usize * query.height as usize || query.rgb.is_empty() {
            return input(format!("{} values for {} × {} pixels of 3", query.rgb.len(), query.width, query.height));
        }
        if [query.width, query.height] != [queries[0].width, queries[0].height] {
            let first = &queries[0];
            return input(format!("{} × {}, but the first is {} × {}", query.width, query.height, first.width, first.height));
        }
        if query.instance >= model.layout.instances {
            return input(format!("instance {}, but the model has {}", query.instance, model.layout.instances));
        }
        if query.starts.is_empty() {
            return input("no starts".into());
        }
        if query.starts.iter().any(|start| !start.is_finite()) {
            return input("a start has values that are not finite".into());
        }
        if options.phases.iter().any(|phase| rays_of(query, phase.stride).next().is_none()) {
            return input(format!("a stride larger than {} × {} pixels", query.width, query.height));
        }
        let pixels = query.rgb.len() / 3;
        if query.coverage.as_ref().is_some_and(|c| c.len() != pixels || c.iter().any(|cover| !(0.0..=1.0).contains(cover))) {
            return input(format!("needs a coverage of {pixels} values from 0 to 1"));
        }
        let side = f64::from(query.width.max(query.height));
        if query.dilation.is_nan() || query.dilation.abs() > side {
            return input(format!("a mask dilated by {} pixels, where the image has {side}", query.dilation));
        }
        if let Some(weights) = &query.weights {
            if weights.len() != pixels || weights.iter().any(|weight| !(0.0..f32::INFINITY).contains(weight)) {
                return input(format!("needs {pixels} weights of 0 or more, finite"));
            }
            if options.phases.iter().any(|phase| weights_of(query, phase.stride).iter().any(|weight| !weight.is_finite())) {
                return input("too few pixels count: a phase of the search sees none of them".into());
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn added_starts_are_40_degrees_away_on_the_same_sphere() {
        let start = crate::camera::look_at_origin(glam::DVec3::new(0.9, -0.7, 0.6));
        let added: Vec<DMat4> = turned(&start).collect();
        assert_eq!(added.len(), 6);
        for (k, pose) in added.iter().enumerate() {
            let (degrees, _) = crate::camera::pose_error(pose, &start);
            let [near, far] = [&start, pose].map(|pose| pose.w_axis.truncate().length());
            assert!((degrees - 40.0).abs() < 1e-6 && (near - far).abs() < 1e-12, "{k}: {degrees}°");
            assert!(added[..k].iter().all(|other| crate::camera::pose_error(pose, other).0 > 40.0), "{k}");
        }
    }

    #[test]
    fn no_added_start_is_the_pose_that_others_were_turned_away_from() {
        let truth = crate::camera::look_at_origin(glam::DVec3::new(0.9, -0.7, 0.6));
        for start in crate::camera::neighbor4(&truth).iter().flat_map(turned) {
            let (degrees, _) = crate::camera::pose_error(&start, &truth);
            assert!(degrees > 5.0, "{degrees}°");
        }
    }

    #[test]
    fn of_hypotheses_that_have_met_the_best_goes_on() {
        let truth = crate::camera::look_at_origin(glam::DVec3::new(0.9, -0.7, 0.6));
        let turned = |angle: f64| DMat4::from_axis_angle(glam::DVec3::Y, angle) * truth;
        let shifted = |by: f64| DMat4::from_translation(by * glam::DVec3::Z) * truth;
        let poses = [truth, turned(9e-4), turned(1.5e-3), shifted(9e-4), shifted(2e-3), turned(1.6e-3), turned(3.0)];
        let new = |(start, pose)| {
            let pose = Pose6::from_matrix(pose);
            Hypothesis { query: 0, start, pose, loss: start as f64, curvature: None, promise: 0.0, phases: 1, dilation: 0.0 }
        };
        let mut own: Vec<Hypothesis> = poses.iter().enumerate().map(new).collect();
        own.push(Hypothesis { pose: Pose6([f64::NAN; 6]), start: 7, loss: f64::INFINITY, ..own[0] });
        let met = split_off_met(&mut own);
        let starts = |of: &[Hypothesis]| of.iter().map(|h| h.start).collect::<Vec<_>>();
        assert_eq!((starts(&own), starts(&met)), (vec![0, 2, 4, 6, 7], vec![1, 3, 5]));
    }

    #[test]
    fn a_rival_goes_on_with_those_that_crowd_it_out() {
        let truth = crate::camera::look_at_origin(glam::DVec3::new(0.9, -0.7, 0.6));
        let new = |(start, (degrees, loss)): (usize, (f64, f64))| {
            let pose = Pose6::from_matrix(&(DMat4::from_axis_angle(glam::DVec3::Y, f64::to_radians(degrees)) * truth));
            Hypothesis { query: 0, start, pose, loss, curvature: None, promise: 0.0, phases: 1, dilation: 0.0 }
        };
        let own = [(0.0, 1.0), (3.0, 1.1), (14.0, 1.2), (20.0, 1.5), (180.0, 1.9), (170.0, 2.1)];
        let own: Vec<Hypothesis> = own.into_iter().enumerate().map(new).collect();
        let taken = |own: &[Hypothesis], keep: usize, stride: u32| {
            let mut own = own.to_vec();
            let rival = take_rival(&mut own, keep, stride).map(|rival| rival.start);
            assert!(own.iter().all(|left| Some(left.start) != rival) && own.is_sorted_by_key(|left| left.start));
            rival
        };
        // 20° are another side with rays at every pixel, but not at every other one.
        assert_eq!([1, 3, 4].map(|keep| taken(&own, keep, 1)), [Some(3), Some(3), None]);
        assert_eq!([1, 3, 4, 5, usize::MAX].map(|keep| taken(&own, keep, 2)), [Some(4), Some(4), Some(4), None, None]);
        // The loss of the last is more than twice that of the best.
        assert_eq!(taken(&[own[0], own[1], own[5]], 1, 1), None);
        assert_eq!([taken(&[], 1, 1), taken(&own[..3], 1, 1)], [None, None]);
    }

    #[test]
    fn an_image_goes_on_while_a_lower_loss_than_the_best_is_promised() {
        let pose = Pose6::from_matrix(&crate::camera::look_at_origin(glam::DVec3::new(0.9, -0.7, 0.6)));
        let new = |(query, start, loss, promise, phases)| Hypothesis {
            query,
            start,
            pose,
            loss,
            curvature: None,
            promise,
            phases,
            dilation: 0.0,
        };
        // Of the images one has arrived; another's best, or what is beside its best, promises more; what another's dropped one promises counts no more.
        let all = [
            (0, 0, 1.0, 0.009, 2),
            (0, 1, 1.5, 0.5, 2),
            (1, 0, 1.5, 0.0, 2),
            (1, 1, 1.0, 0.02, 2),
            (1, 2, 0.5, 0.4, 1),
            (2, 0, 1.0, 0.0, 2),
            (2, 1, 1.5, 0.6, 2),
            (3, 0, 1.0, 0.0, 2),
            (3, 1, 1.0, 0.5, 1),
            (4, 0, f64::INFINITY, f64::NAN, 2),
        ];
        let all: Vec<Hypothesis> = all.into_iter().map(new).collect();
        let (late, rest) = split_off_late(&all, 5, 2);
        let names = |of: &[Hypothesis]| of.iter().map(|h| (h.query, h.start)).collect::<Vec<_>>();
        assert_eq!(names(&late), [(1, 1), (1, 0), (2, 0), (2, 1)]);
        assert_eq!(names(&rest), [(0, 0), (0, 1), (1, 2), (3, 0), (3, 1), (4, 0)]);
    }

    #[test]
    fn steps_keep_their_proportions() {
        let default = Options::default();
        // Pictures without a mask have no others.
        let all = |options: &Options| options.phases.iter().filter(|phase| !phase.dilate).map(|phase| phase.steps).sum::<u32>();
        for steps in [0, 1, 7, 250, 1000] {
            assert_eq!(all(&default.clone().with_steps(steps)), steps);
        }
        let total = all(&default);
        assert_eq!(default.clone().with_steps(total), Options { anew: 0, ..default.clone() });
        // A look at all starts, dilations, and the phase that has the step.
        let one: Vec<(u32, u32)> = default.clone().with_steps(1).phases.iter().map(|phase| (phase.steps, phase.stride)).collect();
        assert_eq!(one, [(0, 4), (0, 2), (1, 1)]);
        assert_eq!(default.clone().with_steps(0).phases.len(), default.phases.len());
        let keeps = |options: &Options| options.phases.iter().map(|phase| (phase.steps, phase.keep)).collect::<Vec<_>>();
        assert_eq!(keeps(&Options::paper().with_culling()), [(60, usize::MAX), (240, 6)]);
        assert_eq!(default.clone().with_culling(), default);
        let all_to_the_end = default.with_stride(1).without_culling();
        assert!(all_to_the_end.phases.iter().all(|phase| phase.stride == 1 && (phase.keep == usize::MAX || phase.dilate)));
    }
}
