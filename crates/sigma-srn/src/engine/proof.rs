//! Whether a GPU computes what it should.
//!
//! Drivers have compiled kernels wrongly, and an adapter may compute nothing at all, without any error: a pose is found all the same,
//! and it is anything. So a GPU is believed once its views and its gradients, which need all kernels of their kind of work but those that take the
//! step, are those of the CPU executor.

use std::iter::zip;
use std::sync::PoisonError;

use srn_cpu::Precision;
use srn_gpu::{Choice, Gpu};

use super::{Engine, Kind};
use crate::{Error, Model};

/// Most difference from the CPU executor's results, relative to the largest, in the median of the trials: in one of twenty a single ray makes rounding as
/// large as a hundredth; a wrong kernel is wrong in all.
const LIMIT: f64 = 0.01;

/// Parts whose largest number is below this share of the largest of all are compared with that: they are rounding, more than anything.
const SMALL: f64 = 1e-3;

/// Most rays to a side of the pictures of a trial: the CPU has to do the same.
pub(crate) const SIDE: u32 = 16;

/// Most width of a network that a software adapter is tried with in all forms of kernels; with wider ones, some take it seconds.
const SOFTWARE_WIDTH: u32 = 16;

/// What is remembered of a device: all forms of kernels are right, or the plain ones alone.
const AGREES: &str = "agrees";
const AGREES_PLAIN: &str = "agrees/plain";

/// Results of one trial, in parts of like numbers: tensors, say.
pub(crate) type Trial = Vec<Vec<f64>>;

/// What was found of a GPU.
#[derive(Debug, Default)]
pub(super) struct Proofs {
    /// Kinds of work, and widths of networks, that it does as the CPU does.
    works: Vec<(&'static str, u32)>,
    /// What computes in its place: the same device with the plain forms of kernels, if others are wrong, or the CPU.
    pub instead: Option<Kind>,
}

impl Engine {
    /// Compares some trials of a kind of work, for networks as wide as the model's, with the CPU executor's. Where only the plain forms of kernels agree the
    /// engine goes on with those; where they do not, it fails, or goes on with the CPU ([`Engine::or_cpu`]). Done once for a device, its driver and the kernels'
    /// texts: the answer is kept where choices of variants are.
    ///
    /// Tried are the forms that are fastest for a trial, and each other one in turn, for larger work may choose those. Not where forms are
    /// [named](Choice::Named): whoever names one wants to see what it does.
    pub(crate) fn prove(
        &self,
        work: &'static str,
        model: &Model,
        trials: impl Fn(&Engine) -> Result<Vec<Trial>, Error>,
    ) -> Result<(), Error> {
        let Kind::Gpu(gpu) = &self.kind else { return Ok(()) };
        if matches!(gpu.choice(), Choice::Named(_)) {
            return Ok(());
        }
        let width = model.layout.features();
        // Not held while trials run: the CPU executor's threads may take up work of the caller's meanwhile that asks, too. Two may find the same answer.
        let proofs = || self.proofs.lock().unwrap_or_else(PoisonError::into_inner);
        let is_known = |proofs: &Proofs| proofs.works.contains(&(work, width)) || matches!(proofs.instead, Some(Kind::Cpu(_)));
        if is_known(&proofs()) {
            return Ok(());
        }
        let named = |form: &str| gpu.with_choice(Choice::Named(form.into())).without_cooperative();
        let plain = named("plain");
        let kept = format!("{work}, {width} wide");
        let is_plain = match gpu.remembered(&kept).as_deref() {
            Some(AGREES) => false,
            Some(AGREES_PLAIN) => true,
            _ => {
                let by = |engine: Engine| trials(&Engine { budget: self.budget, tile_rows: self.tile_rows, ..engine });
                let expected = by(Engine::cpu())?;
                if !expected.iter().any(tells) {
                    tracing::debug!(work, "nothing to compare the GPU's results with");
                    return Ok(());
                }
                let off = |gpu: &Gpu| by(Engine::gpu(gpu.clone())).map(|found| median(zip(&found, &expected)));
                let mut fast = off(&gpu.without_cooperative())?;
                if !gpu.adapter().is_software || width <= SOFTWARE_WIDTH {
                    for form in gpu.forms() {
                        // What does not run is never chosen.
                        match off(&named(form)) {
                            Ok(difference) => fast = fast.max(difference),
                            Err(error) => tracing::debug!(%error, form, "no such form of kernels"),
                        }
                    }
                }
                tracing::debug!(work, "the GPU's results differ from the CPU executor's by {fast:.1e} of the largest");
                if fast > LIMIT {
                    let difference = off(&plain)?;
                    if difference > LIMIT && self.or_cpu {
                        tracing::warn!("{} computes wrong results, so the CPU does", gpu.adapter());
                        proofs().instead = Some(Kind::Cpu(Precision::F32));
                        return Ok(());
                    }
                    if difference > LIMIT {
                        return Err(Error::Adapter { adapter: gpu.adapter().to_string(), work, difference });
                    }
                }
                gpu.remember(&kept, if fast > LIMIT { AGREES_PLAIN } else { AGREES });
                fast > LIMIT
            }
        };
        let mut proofs = proofs();
        if is_plain && proofs.instead.is_none() {
            tracing::warn!("{} computes wrong results with the fast forms of kernels; the plain ones are used", gpu.adapter());
            proofs.instead = Some(Kind::Gpu(plain));
        }
        proofs.works.push((work, width));
        Ok(())
    }
}

/// Whether there is anything in a trial of the CPU executor: a view of nothing has gradients of zero, as a GPU that computes nothing.
fn tells(expected: &Trial) -> bool {
    (f64::MIN_POSITIVE..f64::INFINITY).contains(&largest(expected.iter().flatten()))
}

/// The median difference of the trials that tell anything; there must be one.
fn median<'a>(trials: impl Iterator<Item = (&'a Trial, &'a Trial)>) -> f64 {
    let telling = trials.filter(|(_, expected)| tells(expected));
    let mut differences: Vec<f64> = telling.map(|(found, expected)| difference(found, expected)).collect();
    differences.sort_by(f64::total_cmp);
    differences[differences.len() / 2]
}

/// The worst difference of all parts, each relative to its largest number; infinite where a number is not finite.
pub(super) fn difference(found: &[Vec<f64>], expected: &[Vec<f64>]) -> f64 {
    let least = (SMALL * largest(expected.iter().flatten())).max(f64::MIN_POSITIVE);
    let parts = zip(found, expected).map(|(found, expected)| {
        let apart: Vec<f64> = zip(found, expected).map(|(a, b)| a - b).collect();
        largest(&apart) / largest(expected).max(least)
    });
    parts.fold(0.0, f64::max)
}

/// The largest magnitude; infinite where one is not finite.
fn largest<'a>(values: impl IntoIterator<Item = &'a f64>) -> f64 {
    let magnitude = |value: &f64| if value.is_finite() { value.abs() } else { f64::INFINITY };
    values.into_iter().map(magnitude).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_is_of_the_trials_that_tell_anything() {
        let trial = |value: f64| vec![vec![value, 0.5 * value], vec![-value]];
        let expected = [0.0, 0.0, 0.0, f64::NAN, 2.0].map(trial);
        assert!(expected.iter().any(tells) && !expected[..4].iter().any(tells));
        let off = |found: [f64; 5]| median(zip(&found.map(trial), &expected));
        assert_eq!(off([0.0, 0.0, 0.0, 0.0, 0.0]), 1.0, "computes nothing");
        assert_eq!(off([1.0, 1.0, 1.0, 1.0, 2.0]), 0.0);
        assert_eq!(off([0.0, 0.0, 0.0, 0.0, f64::NAN]), f64::INFINITY);
    }

    #[test]
    fn each_part_counts_by_its_own_size_unless_it_is_rounding() {
        let expected = vec![vec![1000.0, -500.0], vec![10.0], vec![1e-6]];
        assert_eq!(difference(&[vec![1000.0, -500.0], vec![9.0], vec![1e-6]], &expected), 0.1);
        assert!(difference(&[vec![1000.0, -500.0], vec![10.0], vec![-1e-6]], &expected) < 1e-5);
    }
}
