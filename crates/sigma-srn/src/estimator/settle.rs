//! The end of a search. The loss has kinks, and so minima side by side, tenths of a degree apart, whose losses differ by thousandths: which of them a descent
//! ends in is decided by rounding. Of losses all around one quadratic function comes nearest, and that has one minimum. (Not of gradients: at a kink those jump, losses do not.)

use std::array;
use std::iter::zip;

use glam::DMat4;

use super::targets::seen_by;
use super::{Course, Hypothesis, Options, Phase, Progress, learn_curvatures};
use crate::Error;
use crate::camera::Pose6;
use crate::cholesky::{backward, cholesky, solve};
use crate::confidence::{Matrix6, moved};
use crate::random::{normal, stream};

/// By which part of it the loss rises from a pose to those that are tried around it.
const RISES: f64 = 0.02;

/// How much farther away those are whose second derivatives say, in the mean, how far that is: at one pose alone they would differ from one minimum to the next.
const WIDER: f64 = 1.5;

/// Poses that are tried around one, all at once: to either side along six directions.
pub(super) const AROUND: usize = 12;

/// How fast poses lose weight: at this distance from the least loss, squared, they count 1/e. Losses rise by [`RISES`] over a distance of 1.
const REACH: f64 = 3.0;

/// How much what second derivatives are expected to be counts beside losses, which of the first rounds are too few to tell all of them.
const EXPECTED: f64 = 0.1;

/// What a quadratic function of six numbers consists of: a constant, first and second derivatives.
const COEFFICIENTS: usize = 1 + 6 + 21;

/// By which part settling may raise the loss.
const MOST: f64 = RISES;

/// How many quarters of what second derivatives are expected to be are added at most until they are those of a minimum.
const MOST_QUARTERS: usize = 40;

/// The best pose of an image, and losses around it.
struct Surroundings {
    best: Hypothesis,
    origin: DMat4,
    /// `L`, where `L Lᵀ` are second derivatives of the loss over what it may rise by: a motion `L⁻ᵀ u` with a `u` of length 1 takes it as far up.
    lower: Matrix6,
    /// The motion to where the least loss is known to be.
    here: [f64; 6],
    /// Motions to where losses are known, and these.
    known: Vec<([f64; 6], f64)>,
}

impl Surroundings {
    /// `None` where the loss has no minimum.
    fn new(best: Hypothesis) -> Option<Self> {
        let rise = 2.0 * RISES * best.loss;
        let lower = cholesky(&best.curvature?.map(|row| row.map(|entry| entry / rise)))?;
        Some(Surroundings { best, origin: best.pose.to_matrix(), lower, here: [0.0; 6], known: vec![] })
    }

    /// Motions to around where the least loss is known to be.
    fn around(&self, directions: &[[f64; 6]; AROUND], by: f64) -> [[f64; 6]; AROUND] {
        directions.map(|u| {
            let motion = backward(&self.lower, u.map(|x| by * x));
            array::from_fn(|k| self.here[k] + motion[k])
        })
    }

    fn hypothesis(&self, motion: &[f64; 6]) -> Hypothesis {
        Hypothesis { pose: Pose6::from_matrix(&moved(&self.origin, motion)), ..self.best }
    }

    /// Takes the mean of some second derivatives for what they are all around.
    fn set_curvature(&mut self, all: &[Matrix6]) {
        let rise = 2.0 * RISES * self.best.loss * all.len() as f64;
        let mean = |i: usize, j: usize| all.iter().map(|c| c[i][j]).sum::<f64>() / rise;
        let mean = array::from_fn(|i| array::from_fn(|j| mean(i, j)));
        self.lower = cholesky(&mean).unwrap_or(self.lower);
    }

    /// Learns losses, and goes to where a quadratic function that is near them has its minimum.
    fn learn(&mut self, motions: &[[f64; 6]], losses: &[f64]) {
        self.known.extend(zip(motions.iter().copied(), losses.iter().copied()));
        let Some((gradient, factor)) = self.fit() else { return };
        let by = solve(&factor, gradient.map(|x| -x));
        // Not beyond what is known.
        let length = by.iter().map(|x| x * x).sum::<f64>().sqrt().max(1.0);
        let motion = backward(&self.lower, by.map(|x| x / length));
        zip(&mut self.here, motion).for_each(|(here, by)| *here += by);
    }

    /// The gradient, and the factor of the second derivatives, over `u` (see `lower`), of the quadratic function that comes nearest to the losses, where those count that are near.
    fn fit(&self) -> Option<([f64; 6], Matrix6)> {
        let pairs = || (0..6).flat_map(|i| (i..6).map(move |j| (i, j)));
        let (mut squares, mut right) = ([[0.0; COEFFICIENTS]; COEFFICIENTS], [0.0; COEFFICIENTS]);
        for (k, (i, j)) in (7..).zip(pairs()) {
            squares[k][k] = EXPECTED;
            right[k] = if i == j { EXPECTED } else { 0.0 };
        }
        for (motion, loss) in &self.known {
            let u = product(&self.lower, &array::from_fn(|k| motion[k] - self.here[k]));
            let weight = (-u.iter().map(|x| x * x).sum::<f64>() / REACH).exp();
            let mut row = [1.0; COEFFICIENTS];
            row[1..7].copy_from_slice(&u);
            zip(&mut row[7..], pairs()).for_each(|(entry, (i, j))| *entry = u[i] * u[j] * if i == j { 0.5 } else { 1.0 });
            // In units in which the expected second derivatives are 1.
            let loss = (loss - self.best.loss) / (2.0 * RISES * self.best.loss);
            for i in 0..COEFFICIENTS {
                (0..COEFFICIENTS).for_each(|j| squares[i][j] += weight * row[i] * row[j]);
                right[i] += weight * row[i] * loss;
            }
        }
        let fit = solve(&cholesky(&squares)?, right);
        let mut second = [[0.0; 6]; 6];
        zip(&fit[7..], pairs()).for_each(|(&entry, (i, j))| (second[i][j], second[j][i]) = (entry, entry));
        // Between two minima they need not be positive.
        for _ in 0..MOST_QUARTERS {
            if let Some(factor) = cholesky(&second) {
                return Some((array::from_fn(|k| fit[1 + k]), factor));
            }
            (0..6).for_each(|k| second[k][k] += 0.25);
        }
        None
    }
}

/// `Lᵀ x`.
fn product(lower: &Matrix6, x: &[f64; 6]) -> [f64; 6] {
    array::from_fn(|i| (i..6).map(|k| lower[k][i] * x[k]).sum())
}

/// A step for each round, and one to see where they have led.
pub(super) fn settling_steps(options: &Options) -> u32 {
    if options.settle > 0 { options.settle + 1 } else { 0 }
}

impl<F: FnMut(Progress) -> Result<(), Error>> Course<'_, F> {
    /// Takes the best hypothesis of each image to where the loss around it is least, see [`Options::settle`](super::Options::settle).
    pub(super) fn settle(&mut self, hypotheses: &mut [Hypothesis]) -> Result<(), Error> {
        let Course { engine, model, queries, options, .. } = *self;
        let best = |query: usize| hypotheses.iter().filter(|h| h.query == query).min_by(|a, b| a.behind(b)).copied();
        let mut all: Vec<Surroundings> = (0..queries.len()).filter_map(best).filter_map(Surroundings::new).collect();
        let Some(phase) = self.last.map(|last| &options.phases[last]).filter(|_| options.settle > 0 && !all.is_empty()) else {
            self.steps -= settling_steps(options);
            return Ok(());
        };
        let centres: Vec<Hypothesis> = all.iter().map(|of| of.best).collect();
        let around = |all: &[Surroundings], round: u32, by: f64| {
            let directions = directions(options.seed, round);
            all.iter().map(|of| of.around(&directions, by)).collect::<Vec<_>>()
        };
        let tried = |all: &[Surroundings], motions: &[[[f64; 6]; AROUND]]| {
            zip(all, motions).flat_map(|(of, motions)| motions.iter().map(|motion| of.hypothesis(motion))).collect::<Vec<_>>()
        };
        // How far is far needs few rays.
        let twice = Phase { stride: 2 * phase.stride, ..*phase };
        let coarse = if queries.iter().all(|query| query.sees(twice.stride)) { &twice } else { phase };
        let (targets, _) = seen_by(engine, model, queries, options, coarse, true, &centres)?;
        let first = tried(&all, &around(&all, 0, WIDER));
        let mut descent = targets.repeated(AROUND).descent(engine, model, options.method, true, &first)?;
        descent.evaluate()?;
        for (of, curvatures) in zip(&mut all, descent.curvatures()?.chunks(AROUND)) {
            of.set_curvature(curvatures);
        }

        let (targets, lights) = seen_by(engine, model, queries, options, phase, true, &centres)?;
        centres.iter().for_each(|h| self.lights[h.query] = lights[h.query]);
        let mut descent = targets.repeated(AROUND).descent(engine, model, options.method, false, &first)?;
        for round in 1..=options.settle {
            let motions = around(&all, round, 1.0);
            let poses: Vec<Pose6> = tried(&all, &motions).iter().map(|h| h.pose).collect();
            descent.set_poses(&poses)?;
            descent.compare()?;
            for ((of, motions), losses) in zip(&mut all, &motions).zip(descent.losses()?.chunks(AROUND)) {
                of.learn(motions, losses);
            }
            self.step += 1;
            self.observe(&[], &mut descent)?;
        }
        let settled = all.iter().map(|of| Hypothesis { is_settled: true, ..of.hypothesis(&of.here) });
        let mut found: Vec<Hypothesis> = settled.collect();
        let mut descent = targets.descent(engine, model, options.method, true, &found)?;
        descent.evaluate()?;
        let losses = descent.losses()?;
        let rises = |of: &Surroundings, loss: f64| loss.is_nan() || loss > (1.0 + MOST) * of.best.loss;
        if zip(&all, &losses).any(|(of, &loss)| rises(of, loss)) {
            for ((found, of), &loss) in zip(&mut found, &all).zip(&losses) {
                *found = if rises(of, loss) { of.best } else { *found };
            }
            descent.set_poses(&found.iter().map(|h| h.pose).collect::<Vec<_>>())?;
            descent.evaluate()?;
        }
        self.step += 1;
        let names: Vec<(usize, usize)> = found.iter().map(|h| (h.query, h.start)).collect();
        self.observe(&names, &mut descent)?;
        learn_curvatures(&mut descent, &mut found)?;
        zip(&mut found, descent.standing()?).for_each(|(h, standing)| h.stand(standing));
        for found in found {
            let is_it = |h: &&mut Hypothesis| (h.query, h.start) == (found.query, found.start);
            if let Some(best) = hypotheses.iter_mut().find(is_it) {
                *best = found;
            }
        }
        Ok(())
    }
}

/// To either side along six directions at right angles, others in each round.
fn directions(seed: u64, round: u32) -> [[f64; 6]; AROUND] {
    let mut random = stream(seed, round.into());
    // A reflection takes the axes to them.
    let mirror: [f64; 6] = array::from_fn(|_| normal(&mut random));
    let squares: f64 = mirror.iter().map(|x| x * x).sum();
    array::from_fn(|number| {
        let (k, sign) = (number / 2, if number % 2 == 0 { 1.0 } else { -1.0 });
        array::from_fn(|i| sign * (f64::from(i == k) - 2.0 * mirror[k] * mirror[i] / squares))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::look_at_origin;
    use crate::confidence::motion;
    use crate::mask::Outline;

    #[test]
    fn directions_are_at_right_angles_and_others_in_each_round() {
        let all: Vec<[f64; 6]> = (0..2).flat_map(|round| directions(7, round)).collect();
        let dot = |a: &[f64; 6], b: &[f64; 6]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
        for i in 0..AROUND {
            for j in 0..AROUND {
                let expected = if i == j {
                    1.0
                } else if i / 2 == j / 2 {
                    -1.0
                } else {
                    0.0
                };
                assert!((dot(&all[i], &all[j]) - expected).abs() < 1e-12, "{i} {j}");
            }
            assert!(all[AROUND..].iter().all(|other| dot(&all[i], other).abs() < 0.999));
        }
    }

    /// A valley with minima side by side: wherever a descent ends in it, it settles in the middle.
    #[test]
    fn what_has_ended_in_one_of_several_minima_settles_in_their_midst() {
        let scales = [0.3, 0.6, 2.0, 40.0, 60.0, 10.0];
        let middle = look_at_origin(glam::DVec3::new(0.9, -0.7, 0.6));
        let curvature: Matrix6 = array::from_fn(|i| array::from_fn(|j| if i == j { scales[i] } else { 0.02 }));
        // Ripples along every axis, a third as long as the neighbourhood: the gradient changes its sign several times.
        let least = 2e-3f64;
        let rippled = |pose: &DMat4| -> f64 {
            let x = motion(&middle, pose);
            let along = |i: usize| {
                let length = (2.0 * RISES * least / scales[i]).sqrt() / 3.0;
                let slope: f64 = (0..6).map(|k| curvature[i][k] * x[k]).sum();
                0.5 * x[i] * slope - 0.1 * scales[i] * length.powi(2) * (6.0 * x[i] / length).cos()
            };
            least + (0..6).map(along).sum::<f64>()
        };
        let off = |of: &Surroundings| {
            let x = motion(&middle, &moved(&of.origin, &of.here));
            product(&of.lower, &x).iter().map(|x| x * x).sum::<f64>().sqrt()
        };
        for side in [-1.0, 0.2, 0.7] {
            let from = moved(&middle, &array::from_fn(|i| side * 0.6 * (2.0 * RISES * least / scales[i]).sqrt()));
            let best = Hypothesis {
                loss: least,
                curvature: Some(curvature),
                ..Hypothesis::new(0, 0, Pose6::from_matrix(&from), Outline::AS_GIVEN)
            };
            let mut of = Surroundings::new(best).unwrap();
            of.set_curvature(&[curvature; 3]);
            let before = off(&of);
            for round in 1..=12 {
                let motions = of.around(&directions(0, round), 1.0);
                of.learn(&motions, &motions.map(|motion| rippled(&moved(&of.origin, &motion))));
            }
            println!("{before:.3} {:.3}", off(&of));
            assert!(off(&of) < 0.2, "{side}: {before} {}", off(&of));
        }
        let flat = Hypothesis { curvature: None, ..Hypothesis::new(0, 0, Pose6::from_matrix(&middle), Outline::AS_GIVEN) };
        assert!(Surroundings::new(flat).is_none());
        assert!(Surroundings::new(Hypothesis { curvature: Some([[f64::NAN; 6]; 6]), ..flat }).is_none());
    }
}
