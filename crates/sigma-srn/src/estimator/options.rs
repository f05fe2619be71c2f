//! How poses are estimated: phases, and what each is for.

use std::iter::{self, zip};

use super::query::Query;
use crate::descent::{Loss, Method};

/// What steps at every pixel are multiples of, in radians and object units: a sixtieth of a pixel of 64 at most, and a number that sums of it are exact of.
const GRAIN: f32 = 1.0 / 4096.0;

/// Some steps with the same settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Phase {
    /// Steps; none: the poses are only compared with the image, in a first phase by one view from each place, turned as the starts there are.
    pub steps: u32,
    /// Every how many pixels, in both directions, a ray is cast; with BFGS only near what the image or the view from a hypothesis's pose at the
    /// beginning of the phase shows: where both are white nothing is to be seen.
    pub stride: u32,
    /// How many hypotheses of each image enter this phase: those with the lowest loss, and of several that have come to the same pose the best
    /// alone. Where all of them look at the same side of the object, one more: the best of another side, unless its loss is more than twice that of the best.
    /// `usize::MAX`: all. Of an object that is partly hidden, or of more than 168 starts, twice as many, where rays are not cast at every pixel.
    pub keep: usize,
    /// Whether the object is compared as it would be in the model's light, where [`Query::coverage`](crate::Query::coverage) is known: see [`Light`](crate::Light). From wrong
    /// poses the light looks wrong, too. In the phases before the first such one each hypothesis has a light of its own, if no outline is in sight: then colours are all there is.
    pub light: bool,
    /// Whether each hypothesis begins where it looks best: at its pose, turned from it by 15° about the object, to either side about each axis of the camera, or an eighth
    /// nearer or farther away. Of a sharp model a descent finds the way from less far than starts are apart.
    pub closer_look: bool,
    /// Whether outlines of masks are tried beside [`Query::outline`](crate::Query::outline), where [`Query::coverage`](crate::Query::coverage) is known, with the best `keep` hypotheses:
    /// dilated and eroded by up to two pixels, and with three cut away on one side. Later phases compare with what leaves the least loss, see
    /// [`Estimate::outline`](crate::Estimate::outline). Other hypotheses and other images wait: none is dropped for it.
    pub outlines: bool,
}

/// How poses are estimated.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// How hypotheses move.
    pub method: Method,
    /// Where an image has fewer starts than this, six more are tried around each, turned by 40° about the object: to either side about each
    /// axis of the camera.
    pub min_starts: usize,
    /// Whether a first phase that only looks at all starts, without steps, moves them first, where [`Query::coverage`](crate::Query::coverage) is known: nearer or farther away, and turned about
    /// themselves, until the object is as large and at the same place in the views from there as in the image; where a part of it is hidden, or as the whole of it would be, whichever has the
    /// lower loss. Else their distance and aim are taken for known.
    pub align: bool,
    /// Phases, one after the other.
    pub phases: Vec<Phase>,
    /// How many times the last phase begins anew, at most, for images whose poses have not arrived: where the second derivatives there promise a loss that
    /// is lower than the best by more than a hundredth. With BFGS only.
    pub anew: u32,
    /// Rounds in which the best of each image is taken from where its loss is least to the minimum of the quadratic function that comes nearest to losses all around, as far as
    /// they rise by half a hundredth: which of several minima side by side a descent ends in, rounding decides. Each takes twelve views; fewer than ten do not suffice. With BFGS only.
    pub settle: u32,
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
    /// BFGS: a look at all starts, a closer one around the best, steps for the most promising ones on few rays, then for the best on more, and for the best few on
    /// all, until they stand still; before these, which make up for the light, masks are tried with other outlines. And on so, with new second derivatives, for those that
    /// have not arrived: most have, in a number of steps that would be too small for some. The loss has minima side by side: at last the best settles in their midst. A fast
    /// search does not; it goes on a little with new second derivatives, without which a pose is left a tenth of a degree before the end of a valley that is flat and full of
    /// kinks.
    pub fn of(effort: Effort) -> Self {
        let (min_starts, descents, settle): (_, &[_], _) = match effort {
            Effort::Fast => (84, &[(0, 12), (6, 6), (6, 2), (5, 1), (5, 1), (3, 1)], 0),
            Effort::Normal => (84, &[(0, 24), (8, 12), (8, 4), (6, 1), (6, 2)], 12),
            Effort::Exhaustive => (168, &[(0, 96), (10, 64), (10, 20), (6, 6), (18, 6), (6, 6)], 12),
        };
        let look = Phase { steps: 0, stride: 4, keep: usize::MAX, light: false, closer_look: false, outlines: false };
        let closer_look = Phase { closer_look: true, ..look };
        let in_the_light = |stride| Phase { stride, light: true, ..look };
        let kinds = [
            closer_look,
            look,
            Phase { stride: 2, ..look },
            Phase { outlines: true, ..in_the_light(2) },
            in_the_light(1),
            in_the_light(1),
        ];
        let phase = |(kind, &(steps, keep))| Phase { steps, keep, ..kind };
        let phases = iter::once(look).chain(zip(kinds, descents).map(phase)).collect();
        Options { method: Method::Bfgs { soft: 0.3, grain: GRAIN }, min_starts, align: true, phases, anew: 6, settle, seed: 0 }
    }

    /// The paper's settings: Adam at 0.1, 300 steps for every start, all pixels, MAE, last step.
    pub fn paper() -> Self {
        let method = Method::Adam { loss: Loss::Mae, learning_rate: 0.1 };
        Options {
            method,
            min_starts: 0,
            align: false,
            phases: vec![Phase { steps: 300, stride: 1, keep: usize::MAX, light: false, closer_look: false, outlines: false }],
            anew: 0,
            settle: 0,
            seed: 0,
        }
    }

    /// The same with `steps` steps in all, none anew and without settling, shared between the phases in their present proportions; those that try outlines have as many more or fewer,
    /// and come on top. Where there are any at all, a phase whose share is none is left out.
    pub fn with_steps(mut self, steps: u32) -> Self {
        (self.anew, self.settle) = (0, 0);
        let total = self.phases.iter().filter(|phase| !phase.outlines).map(|phase| u64::from(phase.steps)).sum::<u64>().max(1);
        // A part of a step is one of the later phase: a single one is the last phase's.
        let share = |of: u64| of * u64::from(steps) / total;
        let (mut before, mut done) = (0, 0);
        self.phases.retain_mut(|phase| {
            let present = u64::from(phase.steps);
            if phase.outlines {
                phase.steps = share(present) as u32;
            } else {
                before += present;
                phase.steps = (share(before) - done) as u32;
                done = share(before);
            }
            phase.steps > 0 || present == 0 || phase.outlines || steps == 0
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
        self.phases.retain(|phase| !phase.closer_look);
        self.phases.iter_mut().filter(|phase| !phase.outlines).for_each(|phase| phase.keep = usize::MAX);
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

    /// The first phase where it is a look at all starts, which compares them as they are, without steps; and [`Method::Bfgs`]'s `soft`.
    pub(super) fn first_look(&self) -> Option<(&Phase, f32)> {
        let is_look = |phase: &&Phase| phase.steps == 0 && !(phase.light || phase.closer_look || phase.outlines);
        let Method::Bfgs { soft, .. } = self.method else { return None };
        Some((self.phases.first().filter(is_look)?, soft))
    }

    /// Whether each hypothesis is compared in a light of its own before the phases that make up for the image's. Without an outline in sight colours are all there is:
    /// in another light no pose would look right before those.
    pub(super) fn has_own_lights(&self, query: &Query) -> bool {
        self.phases.iter().any(|phase| phase.light) && query.coverage.is_some() && !query.has_outline()
    }

    pub(crate) fn is_gmsd(&self) -> bool {
        matches!(self.method, Method::Adam { loss: Loss::Gmsd, .. })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_keep_their_proportions() {
        let default = Options::default();
        // Pictures without a mask have no others.
        let all = |options: &Options| options.phases.iter().filter(|phase| !phase.outlines).map(|phase| phase.steps).sum::<u32>();
        for steps in [0, 1, 7, 250, 1000] {
            assert_eq!(all(&default.clone().with_steps(steps)), steps);
        }
        let total = all(&default);
        assert_eq!(default.clone().with_steps(total), Options { anew: 0, settle: 0, ..default.clone() });
        // A look at all starts and a closer one, outlines, and the phase that has the step.
        let one: Vec<(u32, u32)> = default.clone().with_steps(1).phases.iter().map(|phase| (phase.steps, phase.stride)).collect();
        assert_eq!(one, [(0, 4), (0, 4), (0, 2), (1, 1)]);
        assert_eq!(default.clone().with_steps(0).phases.len(), default.phases.len());
        let keeps = |options: &Options| options.phases.iter().map(|phase| (phase.steps, phase.keep)).collect::<Vec<_>>();
        assert_eq!(keeps(&Options::paper().with_culling()), [(60, usize::MAX), (240, 6)]);
        assert_eq!(default.clone().with_culling(), default);
        let all_to_the_end = default.with_stride(1).without_culling();
        assert!(all_to_the_end.phases.iter().all(|phase| phase.stride == 1 && (phase.keep == usize::MAX || phase.outlines)));
    }
}
