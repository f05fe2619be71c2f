//! Pose estimation (spec 4): many starts per image in one batch, the unpromising ones dropped between phases.

mod align;
mod look;
mod options;
mod place;
mod query;
mod settle;
mod targets;

use std::borrow::Cow;
use std::cmp::Ordering;
use std::iter::{self, zip};

use glam::DMat4;
use serde::Serialize;

use self::look::look;
pub use self::options::{Effort, Options, Phase};
pub use self::query::Query;
use self::query::{CLOSER_LOOKS, TURN_DEG, closer_looks, turned};
use self::settle::settling_steps;
use self::targets::prepare;
use crate::Error;
use crate::camera::Pose6;
use crate::confidence::{motion, promise};
use crate::descent::{Descent, Method};
use crate::engine::{Engine, proof};
use crate::light::Light;
use crate::mask::{NARROW_CUTS, Outline, best_outline, closer_outlines, outlines};
use crate::model::Model;
use crate::random::{initial_depths, stream};

/// How far apart two hypotheses are at most that have met: a turn about each axis (rad) and a shift along it (object units), a tenth of a pixel
/// of 64. What is left of the search takes both to the same minimum.
const MET: f64 = 1e-3;

/// How many times the loss of the best hypothesis a rival may have to go on beside it. A search that has not ended exaggerates: of the steering part's
/// `000018` the right pose stands at 1.6 times the loss of the one turned by 180° where three go on, and ends at 0.7 times.
const RIVAL: f64 = 2.0;

/// How far a rival is turned from the best, in degrees, where rays are cast at every pixel. At every other pixel it is twice as far: descents there are from
/// starts 30° and more apart, have just begun, and may lead to one side yet.
const RIVAL_DEG: f64 = 15.0;

/// By which part second derivatives may promise a lower loss where a search has arrived.
const ARRIVED: f64 = 0.01;

/// Hypotheses that a GPU, and cooperative matrices, are tried on.
const TRIED: usize = 8;

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
    /// How the outline of the image's mask was moved at the end, if it has one.
    pub outline: Option<Outline>,
    /// Whether a mask hides all around the object, so that nothing but its colours say how large it is.
    pub is_without_outline: bool,
    /// The part that counts of the disc around the object in the picture, as wide as its diagonal; 1 where nothing hides any of it.
    pub in_sight: f64,
    /// The image as it was compared at the end, with this outline and in the model's light `[height, width, 3]`.
    pub target: Vec<f32>,
    /// How much each pixel of it counted then `[height, width]`: not at all where a part of the object may be missing in the mask. `None`: all the same.
    pub weights: Option<Vec<f32>>,
    /// Pixels per row of it.
    pub width: u32,
    /// How long the object's diagonal is in the picture, as a part of the picture's width.
    pub extent: f64,
    /// All starts, the winner first, then more phases before fewer, then by loss. What lies beside the winner may have a loss a little lower where that has settled, see
    /// [`Options::settle`].
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
    /// `(query, start)` of each hypothesis in the running phase; none while the best settle, see [`Options::settle`].
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
    /// How the outline of the image's mask is moved, in the running phase.
    outline: Outline,
    /// Whether it is the best of its image, taken to where the loss around it is least.
    is_settled: bool,
}

impl Hypothesis {
    /// Of a start, which has been in no phase yet.
    fn new(query: usize, start: usize, pose: Pose6, outline: Outline) -> Self {
        Hypothesis {
            query,
            start,
            pose,
            loss: f64::INFINITY,
            curvature: None,
            promise: 0.0,
            phases: 0,
            outline,
            is_settled: false,
        }
    }

    /// At this loss and pose.
    fn stand(&mut self, standing: (f64, Pose6)) {
        (self.loss, self.pose) = standing;
        // A NaN must not win; something near the largest f32 is what a descent holds that never had another.
        if self.loss.is_nan() || self.loss > 1e38 {
            self.loss = f64::INFINITY;
        }
    }

    /// Which of two is the better one at the end: what has settled is what was found; else more phases before fewer, then by loss.
    fn behind(&self, other: &Self) -> Ordering {
        let settled = other.is_settled.cmp(&self.is_settled);
        settled.then(other.phases.cmp(&self.phases)).then(self.loss.total_cmp(&other.loss))
    }
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
    let mut hypotheses = Vec::new();
    for (number, query) in queries.iter().enumerate() {
        let new = |(start, matrix)| Hypothesis::new(number, start, Pose6::from_matrix(matrix), query.outline);
        hypotheses.extend(query.all_starts(options).iter().enumerate().map(new));
    }
    prove(engine, model, queries, options, &hypotheses)?;
    let first_look = options.first_look();
    if let Some(how) = first_look {
        look(engine, model, queries, options, how, &mut hypotheses)?;
    }
    let mut course = Course::new(engine, model, queries, options, observe);
    for number in usize::from(first_look.is_some())..options.phases.len() {
        hypotheses = course.phase(number, &hypotheses)?;
    }
    for _ in 0..options.anew {
        let (late, rest) = split_off_late(&hypotheses, queries.len(), options.phases.len());
        if late.is_empty() {
            break;
        }
        hypotheses = course.last_phase_anew(late)?;
        hypotheses.extend(rest);
    }
    course.settle(&mut hypotheses)?;
    Ok((0..queries.len()).map(|query| course.estimate(query, &hypotheses)).collect())
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

/// Tries a GPU, and cooperative matrices, on the gradients of the first hypotheses, before anything is believed that they compute.
fn prove(engine: &Engine, model: &Model, queries: &[Query], options: &Options, hypotheses: &[Hypothesis]) -> Result<(), Error> {
    let gradients_of = |engine: &Engine, tried: &[Hypothesis], stride: u32| {
        let phase = Phase { stride, ..options.phases[0] };
        let (mut descent, _) = prepare(engine, model, queries, options, &phase, true, tried)?;
        descent.evaluate()?;
        descent.gradients()
    };
    let work = if model.layout.is_baked() { "gradients of poses of baked objects" } else { "gradients of poses" };
    engine.prove(work, model, |engine| {
        // As many of them from one start alone.
        let around = |h: &Hypothesis| {
            let at = |matrix: DMat4| Hypothesis { pose: Pose6::from_matrix(&matrix), ..*h };
            turned(&h.pose.to_matrix(), TURN_DEG).map(at).collect::<Vec<_>>()
        };
        let tried: Vec<Hypothesis> = hypotheses.iter().copied().chain(hypotheses.iter().flat_map(around)).take(TRIED).collect();
        // The phases' rays are known to see something.
        let coarsest = options.phases.iter().map(|phase| phase.stride).max().unwrap_or(1);
        let longest = if options.is_gmsd() { 1 } else { queries[0].width.max(queries[0].height) };
        let finer = iter::successors(Some(longest.div_ceil(proof::SIDE)), |stride| Some(stride / 2));
        let all_see = |stride: &u32| *stride <= coarsest || tried.iter().all(|h| queries[h.query].sees(*stride));
        let stride = finer.take_while(|stride| *stride > 0).find(all_see).unwrap_or(1);
        Ok(gradients_of(engine, &tried, stride)?.iter().map(|six| vec![six.to_vec()]).collect())
    })?;
    let tried = &hypotheses[..hypotheses.len().min(TRIED)];
    engine.check_cooperative(|engine| gradients_of(engine, tried, options.phases[0].stride))
}

/// A search on its way through the phases.
struct Course<'a, F> {
    engine: &'a Engine,
    model: &'a Model,
    queries: &'a [Query],
    options: &'a Options,
    /// Number of the last phase that any query goes through.
    last: Option<usize>,
    /// Of each query, as the last phase made up for it.
    lights: Vec<Option<Light>>,
    /// How the outline of each query's mask is moved, if it has one.
    outlines: Vec<Option<Outline>>,
    step: u32,
    steps: u32,
    observe: F,
}

impl<'a, F: FnMut(Progress) -> Result<(), Error>> Course<'a, F> {
    fn new(engine: &'a Engine, model: &'a Model, queries: &'a [Query], options: &'a Options, observe: F) -> Self {
        let runs = |phase: &&Phase| !phase.outlines || queries.iter().any(Query::has_outline);
        Course {
            engine,
            model,
            queries,
            options,
            last: options.phases.iter().rposition(|phase| runs(&phase)),
            lights: vec![None; queries.len()],
            outlines: queries.iter().map(|query| query.has_outline().then_some(query.outline)).collect(),
            step: 0,
            steps: options.phases.iter().filter(runs).map(|phase| phase.steps).sum::<u32>() + settling_steps(options),
            observe,
        }
    }

    /// All hypotheses after a phase, those that went through it first.
    fn phase(&mut self, number: usize, hypotheses: &[Hypothesis]) -> Result<Vec<Hypothesis>, Error> {
        let phase = &self.options.phases[number];
        let (mut running, rest) = self.entering(number, hypotheses);
        if running.is_empty() {
            return Ok(rest);
        }
        if phase.closer_look {
            running = running.iter().flat_map(looked_at_closer).collect();
        }
        let entered = running.clone();
        self.follow(phase, Some(number) == self.last, &mut running)?;
        if phase.closer_look {
            let best = |tried: &[Hypothesis]| tried.iter().copied().min_by(|a, b| a.loss.total_cmp(&b.loss));
            running = running.chunks(CLOSER_LOOKS).filter_map(best).collect();
        }
        if phase.outlines {
            let mut closer = self.with_closer_outlines(&running, &entered);
            if !closer.is_empty() {
                self.steps += phase.steps;
                self.follow(phase, false, &mut closer)?;
            }
            running = self.with_best_outlines(&running, &closer);
        }
        running.iter_mut().for_each(|h| h.phases = number + 1);
        running.extend(rest);
        running.iter_mut().for_each(|h| h.outline = self.outline(h.query));
        Ok(running)
    }

    /// Those that enter a phase, of each query the best first, with each outline where those are tried; and those that are dropped, or wait.
    fn entering(&self, number: usize, hypotheses: &[Hypothesis]) -> (Vec<Hypothesis>, Vec<Hypothesis>) {
        let phase = &self.options.phases[number];
        let (mut running, mut rest) = (Vec::new(), Vec::new());
        for (of_query, query) in self.queries.iter().enumerate() {
            let is_own = |h: &Hypothesis| h.query == of_query && h.phases == number;
            let mut own: Vec<Hypothesis> = hypotheses.iter().copied().filter(is_own).collect();
            own.sort_by(|a, b| a.loss.total_cmp(&b.loss));
            if phase.keep < usize::MAX {
                rest.extend(split_off_met(&mut own));
            }
            let keep = query.keep(phase);
            let rival = if phase.outlines { None } else { take_rival(&mut own, keep, phase.stride) };
            let mut others = own.split_off(keep.min(own.len()));
            own.extend(rival);
            if phase.outlines {
                others.iter_mut().for_each(|h| h.phases = number + 1);
                own = own.iter().flat_map(|&h| outlines().map(move |by| Hypothesis { outline: h.outline + by, ..h })).collect();
            }
            running.extend(own);
            rest.extend(others);
        }
        rest.extend(hypotheses.iter().filter(|h| h.phases < number));
        (running, rest)
    }

    fn outline(&self, query: usize) -> Outline {
        self.outlines[query].unwrap_or_default()
    }

    /// Of each query the best start's hypotheses, one for each of [`outlines`], and their losses per covered pixel.
    fn best_outlined<'h>(&self, tried: &'h [Hypothesis]) -> Vec<(&'h [Hypothesis], Vec<f64>)> {
        let least = |tried: &&[Hypothesis]| tried.iter().map(|h| h.loss).fold(f64::INFINITY, f64::min);
        let of_query = |number| {
            // Those of one start come one after the other.
            let own = tried.chunks(outlines().count()).filter(move |tried| tried[0].query == number);
            own.min_by(|a, b| least(a).total_cmp(&least(b)))
        };
        let best = (0..self.queries.len()).filter_map(of_query);
        best.map(|tried| (tried, tried.iter().map(|h| self.per_area(h)).collect())).collect()
    }

    fn per_area(&self, h: &Hypothesis) -> f64 {
        h.loss / self.queries[h.query].seen(h.outline).area()
    }

    /// The best start of each query with the outlines that are worth a closer look, as it has `entered`, or where the nearest outline has led it.
    fn with_closer_outlines(&self, tried: &[Hypothesis], entered: &[Hypothesis]) -> Vec<Hypothesis> {
        let of_query = |(tried, losses): (&[Hypothesis], Vec<f64>)| {
            let first = *entered.iter().find(|h| (h.query, h.start) == (tried[0].query, tried[0].start)).expect("it has entered");
            let new = |(number, by)| {
                let outline = first.outline + by;
                let led = if number < NARROW_CUTS { None } else { nearest(tried, outline).copied() };
                Hypothesis { outline, ..led.unwrap_or(first) }
            };
            closer_outlines(&losses).into_iter().enumerate().map(new).collect::<Vec<_>>()
        };
        self.best_outlined(tried).into_iter().flat_map(of_query).collect()
    }

    /// Finds the outline of each query that leaves the least loss, and of each start the hypothesis whose own is nearest to it.
    fn with_best_outlines(&mut self, tried: &[Hypothesis], closer: &[Hypothesis]) -> Vec<Hypothesis> {
        for (tried, losses) in self.best_outlined(tried) {
            let (query, as_given) = (tried[0].query, tried[0].outline);
            let closer: Vec<f64> = closer.iter().filter(|h| h.query == query).map(|h| self.per_area(h)).collect();
            let by = best_outline(&losses, &closer);
            self.outlines[query] = Some(Outline { undecided: by.undecided, ..as_given + by });
        }
        let of_start = |tried: &[Hypothesis]| {
            let first = tried[0];
            let closer = closer.iter().filter(|h| (h.query, h.start) == (first.query, first.start));
            nearest(tried.iter().chain(closer), self.outline(first.query)).copied()
        };
        tried.chunks(outlines().count()).filter_map(of_start).collect()
    }

    /// The last phase once more, for those that have not arrived.
    fn last_phase_anew(&mut self, mut late: Vec<Hypothesis>) -> Result<Vec<Hypothesis>, Error> {
        if let Some(last) = self.last {
            let phase = &self.options.phases[last];
            self.steps += phase.steps;
            self.follow(phase, true, &mut late)?;
        }
        Ok(late)
    }

    /// What is known of a query at the end.
    fn estimate(&self, query: usize, hypotheses: &[Hypothesis]) -> Estimate {
        let mut own: Vec<&Hypothesis> = hypotheses.iter().filter(|h| h.query == query).collect();
        own.sort_by(|a, b| a.behind(b));
        let ranked = |h: &&Hypothesis| Ranked { start: h.start, loss: h.loss, phases: h.phases, pose: h.pose };
        let &Hypothesis { pose, loss, curvature, .. } = own[0];
        let (light, outline, of_query) = (self.lights[query], self.outlines[query], query);
        let query = &self.queries[query];
        let seen = query.seen(self.outline(of_query));
        let (mut target, weights) = (seen.rgb.into_owned(), seen.weights.map(Cow::into_owned));
        if let Some(light) = light {
            light.undo(&mut target, &seen.coverage);
        }
        let width = query.width;
        let extent = query.intrinsics.fx / (pose.distance() * f64::from(width));
        let ranking = own.iter().map(ranked).collect();
        let is_without_outline = query.coverage.is_some() && !query.has_outline();
        let in_sight = query.in_sight(&pose, weights.as_deref());
        Estimate { pose, loss, curvature, light, outline, is_without_outline, in_sight, target, weights, width, extent, ranking }
    }

    /// Takes hypotheses through a phase, those of a query one after the other, the best first. What second derivatives say at its end is found out where
    /// the search may end there.
    fn follow(&mut self, phase: &Phase, may_end: bool, running: &mut [Hypothesis]) -> Result<(), Error> {
        let Course { engine, model, queries, options, .. } = *self;
        let names: Vec<(usize, usize)> = running.iter().map(|h| (h.query, h.start)).collect();
        let is_moving = phase.steps > 0 || may_end;
        let (mut descent, lights) = prepare(engine, model, queries, options, phase, is_moving, running)?;
        running.iter().for_each(|h| self.lights[h.query] = lights[h.query]);
        let rows = running.len() * queries[0].rays(phase.stride).count();
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
            learn_curvatures(&mut descent, running)?;
        }
        zip(running, standing).for_each(|(hypothesis, standing)| hypothesis.stand(standing));
        Ok(())
    }

    fn observe(&mut self, hypotheses: &[(usize, usize)], descent: &mut Descent) -> Result<(), Error> {
        (self.observe)(Progress { step: self.step, steps: self.steps, search: 0, hypotheses, descent })
    }
}

/// What second derivatives say at the poses that a descent has begun from.
fn learn_curvatures(descent: &mut Descent, hypotheses: &mut [Hypothesis]) -> Result<(), Error> {
    for (h, (curvature, gradient)) in zip(hypotheses, zip(descent.curvatures()?, descent.gradients()?)) {
        (h.curvature, h.promise) = (Some(curvature), promise(&curvature, &gradient));
    }
    Ok(())
}

/// A hypothesis at each pose that a closer look at it tries, see [`Phase::closer_look`].
fn looked_at_closer(hypothesis: &Hypothesis) -> Vec<Hypothesis> {
    let at = |matrix: DMat4| Hypothesis { pose: Pose6::from_matrix(&matrix), ..*hypothesis };
    closer_looks(&hypothesis.pose.to_matrix()).map(at).collect()
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
    let (mut met, mut matrices) = (Vec::new(), Vec::<DMat4>::new());
    for hypothesis in std::mem::take(own) {
        let here = hypothesis.pose.to_matrix();
        // Of thousands most are told apart by where their axes point.
        let looks_along = |better: &DMat4| (better.z_axis - here.z_axis).abs().max_element() < 2.0 * MET;
        let is_here = |better: &DMat4| looks_along(better) && motion(better, &here).iter().all(|by| by.abs() < MET);
        if matrices.iter().any(is_here) {
            met.push(hypothesis);
        } else {
            own.push(hypothesis);
            matrices.push(here);
        }
    }
    met
}

/// Of some hypotheses the one whose outline is the nearest to this.
fn nearest<'h>(tried: impl IntoIterator<Item = &'h Hypothesis>, outline: Outline) -> Option<&'h Hypothesis> {
    let apart = |h: &&Hypothesis| (h.outline + outline * -1.0).length();
    tried.into_iter().min_by(|a, b| apart(a).total_cmp(&apart(b)))
}

/// Takes the best that shows another side than the first of a query's hypotheses, the best first, out of those, if it would not be among the
/// `keep` that enter a phase.
fn take_rival(own: &mut Vec<Hypothesis>, keep: usize, stride: u32) -> Option<Hypothesis> {
    let best = *own.first()?;
    let rival = own.iter().position(|other| best.pose.degrees_from(other.pose) > RIVAL_DEG * f64::from(stride))?;
    (rival >= keep && own[rival].loss <= RIVAL * best.loss).then(|| own.remove(rival))
}

/// Says what is wrong with what is asked for.
pub(crate) fn check(model: &Model, queries: &[Query], options: &Options) -> Result<(), Error> {
    let setting = |field, what: &str| Err(Error::Setting { field, what: what.into() });
    let Some(first) = queries.first() else {
        return setting("queries", "there are none");
    };
    if options.phases.is_empty() {
        return setting("phases", "there are none");
    }
    for phase in &options.phases {
        if phase.stride == 0 || phase.keep == 0 {
            return setting("phases", "stride and keep must be at least 1");
        }
        if options.is_gmsd() && phase.stride != 1 {
            return setting("loss", "GMSD compares neighbouring pixels: it needs stride 1 in every phase");
        }
    }
    for (number, query) in queries.iter().enumerate() {
        let wrong = |what| Error::Query { number, what };
        query.check(model, options).map_err(wrong)?;
        let &Query { width, height, .. } = query;
        if [width, height] != [first.width, first.height] {
            return Err(wrong(format!("{width} × {height}, but the first is {} × {}", first.width, first.height)));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_hypotheses_that_have_met_the_best_goes_on() {
        let truth = crate::camera::look_at_origin(glam::DVec3::new(0.9, -0.7, 0.6));
        let turned = |angle: f64| DMat4::from_axis_angle(glam::DVec3::Y, angle) * truth;
        let shifted = |by: f64| DMat4::from_translation(by * glam::DVec3::Z) * truth;
        let poses = [truth, turned(9e-4), turned(1.5e-3), shifted(9e-4), shifted(2e-3), turned(1.6e-3), turned(3.0)];
        let new = |(start, pose)| {
            let pose = Pose6::from_matrix(pose);
            Hypothesis { loss: start as f64, phases: 1, ..Hypothesis::new(0, start, pose, Outline::AS_GIVEN) }
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
            Hypothesis { loss, phases: 1, ..Hypothesis::new(0, start, pose, Outline::AS_GIVEN) }
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
            loss,
            promise,
            phases,
            ..Hypothesis::new(query, start, pose, Outline::AS_GIVEN)
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
}
