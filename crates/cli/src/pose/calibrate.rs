//! `sigma-pose calibrate`: what a model's estimates are worth, from views with known poses.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::Args;
use glam::DMat4;
use serde::Serialize;
use sigma_srn::confidence::{self, LEAST_UNEXPLAINED, Matrix6, UNEXPLAINED, fit, motion, unexplained};
use sigma_srn::{Calibration, Effort, Found, Metadata, Options, Rendering, Seen, View};

use super::files::Picture;
use super::heldout::Heldout;
use super::notation::Notation;
use super::search::{self, On, PoseError, SearchArgs, Starts, render};
use super::symmetry::Symmetries;
use super::views::{self, Views};
use crate::common::{EngineArgs, Result, load_model, print, refuse_to_write, spread};
use crate::progress;
use crate::train::adapt::Fit;

/// Where no search failed: the limits of what is unexplained, over the most that was.
const MARGIN: f64 = 1.5;
/// How far off a search for a new object is lost, in degrees: it is found, but up to so much off, where two views do not say better what it
/// looks like. That is for deviations to tell.
const NEW_LOST_DEG: f64 = 10.0;
/// How far from the truth a search begins that is to lose it, in degrees.
const FAR_DEG: f64 = 90.0;
/// What a search that was made to fail counts beside one that was not: about one pose in five is then wrong, more than in earnest, for
/// trusting a wrong pose is worse than doubting a right one.
const LOST_WEIGHT: f64 = 0.25;
/// Searches of which 95 % are not all: with fewer the largest error of them says where the others end.
const ENOUGH: usize = 19;
/// How many times what half of the few found poses of an object leave unexplained those to come may leave (`docs/accuracy.md`).
const ABOVE_USUAL: f64 = 2.0;
/// Values of each limit that are tried, at most.
const CANDIDATES: usize = 64;

/// Flags of `sigma-pose calibrate`.
#[derive(Args, Debug)]
pub struct Calibrate {
    /// The trained model.
    #[arg(long, value_name = "FILE")]
    model: PathBuf,
    /// Data set in the SRN folder layout, of views that the model has not seen, and that nothing else will be measured on.
    #[arg(long, value_name = "DIR", required_unless_present = "heldout")]
    data: Option<PathBuf>,
    /// Instances of the same kind that the model was not trained on: it is adapted to two views of each, as `sigma-train adapt` does, and the
    /// others tell what poses of such objects are worth. `adapt` then gives that to its models.
    #[arg(long, value_name = "DIR")]
    heldout: Option<PathBuf>,
    /// The model to write: the same, and what was found.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Overwrite --out, which may be the model itself.
    #[arg(long)]
    force: bool,
    /// Where to start; see `evaluate`.
    #[arg(long, value_name = "around2016|around84|fixed24|neighbor4|FILE", default_value = "around84")]
    starts: Starts,
    /// Views of each instance, evenly spread over those that there are.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    views: u32,
    /// Instances, evenly spread over those that there are.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    instances: u32,
    /// Count poses as right from which the object looks the same; see `evaluate`.
    #[arg(long)]
    symmetries: bool,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    engine: EngineArgs,
    // Last, for its heading holds for all flags that follow.
    #[command(flatten)]
    search: SearchArgs,
}

/// A search whose true pose is known.
#[derive(Clone, Debug)]
struct Known {
    instance: String,
    has_failed: bool,
    /// From the estimate to the truth.
    motion: [f64; 6],
    /// See `Estimate::shape`.
    shape: Option<Matrix6>,
    unexplained: f64,
    /// The same, over the most that the true poses of the instance's other views leave; 0 where that is not known.
    over_truth: f64,
    /// Infinite without a rival.
    rival: f64,
    seen: Seen,
}

/// Runs the command.
pub fn run(args: &Calibrate) -> Result<bool> {
    let mut model = load_model(&args.model)?;
    let known = args.data.as_ref().map(|data| views::open(&model, data, u32::MAX, u32::MAX)).transpose()?;
    let open = |heldout: &PathBuf| {
        let side = model.metadata.side.ok_or_else(|| format!("{}: it names no image side", args.model.display()))?;
        Heldout::open(heldout, side, args.instances)
    };
    let heldout = args.heldout.as_ref().map(open).transpose()?;
    refuse_to_write(&args.out, args.force)?;
    let engine = args.search.open(&args.engine)?;
    let mut report = Report::default();
    if let Some((side, all)) = known {
        let on = On { engine: &engine, model: &model, side };
        let at_truth = AtTruth::of(on, &all)?;
        let mut asked = spread(all, args.instances as usize);
        for Views { pictures, truths, .. } in &mut asked {
            *pictures = spread(std::mem::take(pictures), args.views as usize);
            *truths = spread(std::mem::take(truths), args.views as usize);
        }
        let searches = Searches::run(args, on, &asked, &at_truth, PoseError::FAILURE_DEG)?;
        let calibration = searches.calibration(at_truth.most())?;
        report.add("known objects", &searches, &calibration);
        report.calibration = Some(calibration);
    }
    if let Some(heldout) = heldout {
        let adapted = heldout.adapt(&engine, &model, &Fit::default())?;
        let on = On { engine: &engine, model: &adapted, side: heldout.side };
        let searches = Searches::run(args, on, &heldout.others(args.views), &AtTruth::default(), NEW_LOST_DEG)?;
        // Of the next new object only what all of them have in common is known.
        let calibration = Calibration { sizes: BTreeMap::new(), ..searches.calibration(BTreeMap::new())? };
        report.add("new objects, by two views of each", &searches, &calibration);
        report.calibration_of_new = Some(calibration);
    }
    let Metadata { calibration, calibration_of_new, .. } = &mut model.metadata;
    *calibration = report.calibration.clone().or(calibration.take());
    *calibration_of_new = report.calibration_of_new.clone().or(calibration_of_new.take());
    model.save(&args.out)?;
    if args.json {
        print(&serde_json::to_string_pretty(&report)?)?;
    } else {
        print(&format!("{}model: {}", report.text, args.out.display()))?;
    }
    Ok(true)
}

/// What was found, and in words.
#[derive(Default, Serialize)]
struct Report {
    #[serde(skip_serializing_if = "Option::is_none")]
    calibration: Option<Calibration>,
    #[serde(skip_serializing_if = "Option::is_none")]
    calibration_of_new: Option<Calibration>,
    #[serde(skip)]
    text: String,
}

impl Report {
    fn add(&mut self, title: &str, Searches { known, lost, far_deg }: &Searches, calibration: &Calibration) {
        let failures = known.iter().filter(|known| known.has_failed).count();
        let Calibration { curvature, floor, sizes, unexplained, at_truth, above_truth, rival, views, .. } = calibration;
        let lost = lost.len();
        let mut lines = vec![
            format!("{title}:"),
            format!(
                "{views} views, {failures} of them more than {far_deg}° off; {lost} wrong poses by searches begun far from the truth"
            ),
            format!("covariance: {curvature:.2e} × loss × inverse of its second derivatives"),
        ];
        let [a, b, c] = [0, 1, 2].map(|k| floor[k].sqrt().to_degrees());
        let [x, y, z] = [3, 4, 5].map(|k| floor[k].sqrt());
        lines.push(format!(
            "and in all views ± {a:.2}° {b:.2}° {c:.2}° about the camera's axes, ± {x:.4} {y:.4} {z:.4} along them"
        ));
        if let Some((least, most)) = least_and_most(sizes.values()) {
            let [least, most] = [least, most].map(|size| size.sqrt());
            lines.push(format!("of each object by its own errors, {least:.2} to {most:.2} times these deviations"));
        }
        let of_each = if at_truth.is_empty() {
            String::new()
        } else {
            format!(" {above_truth:.1} times what true poses of the object leave,")
        };
        let (unexplained, rival) = (100.0 * unexplained, 100.0 * rival);
        lines.push(format!("trusted: at most {unexplained:.1} % unexplained,{of_each} and a loss {rival:.1} % higher elsewhere"));
        self.text += &(lines.join("\n") + "\n");
    }
}

/// The parts of pictures that their true poses leave unexplained, by instance and view.
#[derive(Default)]
struct AtTruth(BTreeMap<String, BTreeMap<String, f64>>);

impl AtTruth {
    fn of(on: On, all: &[Views]) -> Result<Self> {
        let bar = progress::bar(all.len() as u64, "instances");
        let mut at_truth = BTreeMap::new();
        for Views { name, pictures, truths, .. } in all {
            let true_views: Vec<View> = pictures
                .iter()
                .zip(truths)
                .map(|(picture, truth)| (picture.shot.instance, *truth, picture.shot.intrinsics))
                .collect();
            let renders = render(on, &true_views)?;
            let part = |(picture, render): (&Picture, &Rendering)| {
                (picture.name.clone(), unexplained(&picture.shot.rgb, picture.shot.weights.as_deref(), &render.rgb))
            };
            let parts = pictures.iter().zip(&renders).map(part);
            at_truth.insert(name.clone(), parts.filter(|(_, part)| part.is_finite()).collect());
            bar.inc(1);
        }
        bar.finish_and_clear();
        Ok(AtTruth(at_truth))
    }

    /// The most of each instance; a single view does not say how much they differ.
    fn most(&self) -> BTreeMap<String, f64> {
        self.0
            .iter()
            .filter(|(_, parts)| parts.len() > 1)
            .filter_map(|(name, parts)| Some((name.clone(), most(parts.values())?)))
            .collect()
    }

    /// The most of the instance's other views: a view is not to be held against itself, for those to come will not be either.
    fn of_others(&self, instance: &str, view: &str) -> Option<f64> {
        most(self.0.get(instance)?.iter().filter(|(name, _)| *name != view).map(|(_, part)| part))
    }
}

fn least_and_most<'a>(sizes: impl Iterator<Item = &'a f64> + Clone) -> Option<(f64, f64)> {
    Some((sizes.clone().copied().min_by(f64::total_cmp)?, most(sizes)?))
}

fn most<'a>(parts: impl Iterator<Item = &'a f64>) -> Option<f64> {
    parts.copied().max_by(f64::total_cmp)
}

/// Searches whose true poses are known.
struct Searches {
    known: Vec<Known>,
    /// Wrong poses, as a search ends in that begins on the far side: too few searches fail by themselves to learn from.
    lost: Vec<Known>,
    /// So far off a search has failed.
    far_deg: f64,
}

impl Searches {
    fn run(args: &Calibrate, on: On, asked: &[Views], at_truth: &AtTruth, far_deg: f64) -> Result<Self> {
        let symmetries = |views| Symmetries::of(on, views, args.symmetries);
        let symmetries: Vec<Symmetries> = asked.iter().map(symmetries).collect::<Result<_>>()?;
        let known_of = |(views, symmetries): (&Views, &Symmetries), found: &[Found]| -> Vec<Known> {
            let each = found.iter().zip(&views.truths).zip(&views.pictures);
            let of = |((found, truth), picture): ((&Found, _), &Picture)| {
                let truth = symmetries.nearest(truth, &found.world_from_camera);
                Known {
                    instance: views.name.clone(),
                    has_failed: PoseError::of(&found.world_from_camera, &truth).rotation_deg > far_deg,
                    motion: motion(&found.world_from_camera, &truth),
                    shape: found.estimate.shape(),
                    unexplained: found.unexplained,
                    over_truth: at_truth.of_others(&views.name, &picture.name).map_or(0.0, |most| found.unexplained / most),
                    rival: found.estimate.rival().map_or(f64::INFINITY, |(_, higher)| higher),
                    seen: Seen { distance: found.estimate.pose.distance(), extent: found.estimate.extent },
                }
            };
            each.map(of).collect()
        };
        let found = views::search(asked, on, &args.search.trusting(), &args.starts, &Notation::default(), |_, _| Ok(()))?;
        let known = asked.iter().zip(&symmetries).zip(&found).flat_map(|(views, found)| known_of(views, found)).collect();

        let options = Options { min_starts: 0, ..Options::of(Effort::Fast) };
        let bar = progress::bar(asked.len() as u64, "wrong poses");
        let mut lost = Vec::new();
        for (views, symmetries) in asked.iter().zip(&symmetries) {
            let far = |(picture, truth): (&Picture, &DMat4)| -> Result<Vec<DMat4>> {
                let all = args.search.starts(&Starts::Around84, on.model, &picture.shot, None, &Notation::default())?;
                Ok(all.into_iter().filter(|start| PoseError::of(start, truth).rotation_deg > FAR_DEG).collect())
            };
            let starts = views.pictures.iter().zip(&views.truths).map(far).collect::<Result<Vec<_>>>()?;
            let found = search::run(&args.search.single(options.clone()), on, &views.pictures, &starts, |_| Ok(()))?;
            let failed = known_of((views, symmetries), &found).into_iter().filter(|known| known.has_failed);
            // Rivals are those of a search that is not hindered.
            lost.extend(failed.map(|known| Known { rival: f64::INFINITY, ..known }));
            bar.inc(1);
        }
        bar.finish_and_clear();
        Ok(Searches { known, lost, far_deg })
    }

    /// What they tell of others.
    fn calibration(&self, at_truth: BTreeMap<String, f64>) -> Result<Calibration> {
        let found = self.known.iter().filter(|known| !known.has_failed).count();
        if found < ENOUGH {
            eprintln!("warning: {found} poses were found: too few to say where 95 % of errors end, which takes {ENOUGH} or more");
        }
        Ok(calibration(&self.known, &self.lost, at_truth).ok_or("no search came near enough to the truth to learn from")?)
    }
}

/// What the searches tell of others. `None` if none of them has second derivatives and found its pose.
fn calibration(known: &[Known], lost: &[Known], at_truth: BTreeMap<String, f64>) -> Option<Calibration> {
    let found = || known.iter().filter(|known| !known.has_failed);
    let error = |Known { instance, motion, shape, .. }: &Known| {
        Some(confidence::Known { instance: instance.clone(), motion: *motion, shape: (*shape)? })
    };
    let (curvature, floor, sizes) = fit(&found().filter_map(error).collect::<Vec<_>>())?;
    let Limits { mut unexplained, above_truth, rival } = limits(known, lost);
    // Few say no more of what wrong poses leave than a model without a calibration knows, and one of them may be no measure: by a mask that is wrong, say.
    if found().count() < ENOUGH {
        let mut of_each: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
        found().for_each(|known| of_each.entry(&known.instance).or_default().push(known.unexplained));
        let usual = of_each.into_values().map(median).fold(0.0, f64::max);
        let most = found().map(|known| known.unexplained).fold(UNEXPLAINED, f64::max);
        unexplained = unexplained.min((ABOVE_USUAL * usual).clamp(LEAST_UNEXPLAINED, most));
    }
    let usual = |of: fn(&Seen) -> f64| median(found().map(|known| of(&known.seen)).collect());
    let seen = Some(Seen { distance: usual(|seen| seen.distance), extent: usual(|seen| seen.extent) });
    Some(Calibration { curvature, floor, sizes, unexplained, at_truth, above_truth, rival, views: known.len() as u32, seen })
}

/// Of at least one.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// What an estimate to be trusted keeps to, see [`Calibration`].
#[derive(Clone, Copy, Debug, PartialEq)]
struct Limits {
    unexplained: f64,
    above_truth: f64,
    rival: f64,
}

impl Limits {
    fn trust(&self, known: &Known) -> bool {
        known.unexplained <= self.unexplained && known.over_truth <= self.above_truth && known.rival >= self.rival
    }

    fn is_looser(&self, other: &Limits) -> bool {
        self.unexplained >= other.unexplained && self.above_truth >= other.above_truth && self.rival <= other.rival
    }
}

/// The limits that tell the failures best: by the harmonic mean of precision and recall.
fn limits(known: &[Known], lost: &[Known]) -> Limits {
    let found = || known.iter().filter(|known| !known.has_failed);
    // What failed by far more than anything that was found has does not say how much is too much.
    let most = |value: &dyn Fn(&Known) -> f64| found().map(value).filter(|value| value.is_finite()).fold(0.0, f64::max);
    let unexplained = MARGIN * most(&|known| known.unexplained);
    let loosest = Limits { unexplained, above_truth: MARGIN * most(&|known| known.over_truth), rival: 0.0 };
    let all = || known.iter().map(|known| (known, 1.0)).chain(lost.iter().map(|known| (known, LOST_WEIGHT)));
    let failures: f64 = all().filter(|(known, _)| known.has_failed).map(|(_, weight)| weight).sum();
    if failures == 0.0 {
        return loosest;
    }
    let between = |value: &dyn Fn(&Known) -> f64, loosest: f64| -> Vec<f64> {
        let mut values: Vec<f64> = all().map(|(known, _)| value(known)).filter(|value| value.is_finite()).collect();
        values.sort_by(f64::total_cmp);
        let between = values.windows(2).map(|pair| 0.5 * (pair[0] + pair[1])).collect();
        spread(between, CANDIDATES).into_iter().chain([loosest]).collect()
    };
    let score = |limits: &Limits| {
        let (mut told, mut right) = (0.0, 0.0);
        for (known, weight) in all().filter(|(known, _)| !limits.trust(known)) {
            told += weight;
            right += if known.has_failed { weight } else { 0.0 };
        }
        2.0 * right / (told + failures)
    };
    // By how much the trusted poses that were found could leave more unexplained: those of poorer pictures will.
    let room = |limits: &Limits| {
        let of = |known: &Known| (limits.unexplained / known.unexplained).min(limits.above_truth / known.over_truth);
        found().filter(|known| limits.trust(known)).map(of).min_by(f64::total_cmp).unwrap_or(0.0)
    };
    let mut best = (score(&loosest), room(&loosest), loosest);
    for unexplained in between(&|known| known.unexplained, loosest.unexplained) {
        for above_truth in between(&|known| known.over_truth, loosest.above_truth) {
            for rival in between(&|known| known.rival, loosest.rival) {
                let limits = Limits { unexplained, above_truth, rival };
                let score = score(&limits);
                if score < best.0 {
                    continue;
                }
                // The tightest of equals loses: what was not seen to fail is trusted.
                let room = room(&limits);
                if score > best.0 || room > best.1 || room == best.1 && limits.is_looser(&best.2) {
                    best = (score, room, limits);
                }
            }
        }
    }
    best.2
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_view_is_held_against_the_others_of_its_object() {
        let parts = |values: &[(&str, f64)]| values.iter().map(|(name, part)| (name.to_string(), *part)).collect();
        let chair = parts(&[("0", 0.1), ("1", 0.3), ("2", 0.2)]);
        let at_truth = AtTruth([("chair".to_string(), chair), ("stool".to_string(), parts(&[("0", 0.4)]))].into());
        assert_eq!(["0", "1"].map(|view| at_truth.of_others("chair", view)), [Some(0.3), Some(0.2)]);
        assert_eq!([at_truth.of_others("stool", "0"), at_truth.of_others("table", "0")], [None, None]);
        assert_eq!(at_truth.most(), [("chair".to_string(), 0.3)].into());
    }

    #[test]
    fn of_limits_that_tell_alike_the_one_with_more_room_is_taken() {
        // The wrong pose leaves hardly more than the right ones, but much for its object.
        let mut views: Vec<Known> = (0..20).map(|k| known(1.0, 0.1 + 0.001 * f64::from(k), 0.5)).collect();
        views.push(Known { over_truth: 4.0, ..known(90.0, 0.12, 0.5) });
        let found = limits(&views, &[]);
        assert!(views.iter().all(|view| found.trust(view) != view.has_failed), "{found:?}");
        assert!(found.trust(&known(1.0, 0.15, 0.5)), "{found:?}");
    }

    /// Of an instance whose true poses leave a tenth unexplained at most.
    fn known(rotation_deg: f64, unexplained: f64, rival: f64) -> Known {
        let shape = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(i == j)));
        let (instance, has_failed) = ("chair".to_string(), rotation_deg > 5.0);
        let (motion, seen) = ([0.01; 6], Seen { distance: 1.3, extent: 0.9 });
        Known { instance, has_failed, motion, shape: Some(shape), unexplained, over_truth: unexplained / 0.1, rival, seen }
    }

    #[test]
    fn without_failures_the_limits_are_loose() {
        let views: Vec<Known> = (1..=9).map(|k| known(1.0, 0.01 * f64::from(k), f64::INFINITY)).collect();
        let found = calibration(&views, &[], BTreeMap::new()).unwrap();
        assert!(found.unexplained == LEAST_UNEXPLAINED && found.rival == 0.0 && found.views == 9, "{found:?}");
        assert_eq!(calibration(&[known(90.0, 0.1, 1.0)], &[], BTreeMap::new()), None);
        // But few views do not make them looser than those of a model that is not calibrated.
        let all = |count: usize| calibration(&vec![known(1.0, 0.2, f64::INFINITY); count], &[], BTreeMap::new()).unwrap();
        assert!((all(19).unexplained - 0.3).abs() < 1e-12 && all(18).unexplained == UNEXPLAINED);
        // Nor does one of them that leaves much, as with a wrong mask; but an object that is known badly is.
        let mut eight = vec![known(1.0, 0.1, f64::INFINITY); 7];
        eight.push(known(1.0, 0.23, f64::INFINITY));
        let limit = |views: &[Known]| calibration(views, &[], BTreeMap::new()).unwrap().unexplained;
        assert_eq!(limit(&eight), 0.2);
        eight.extend(vec![Known { instance: "stool".into(), ..known(1.0, 0.4, f64::INFINITY) }; 3]);
        assert_eq!(limit(&eight), 0.4);
    }

    #[test]
    fn limits_tell_failures_by_either_sign() {
        let mut views: Vec<Known> = (0..20).map(|k| known(1.0, 0.1 + 0.002 * f64::from(k), 0.5)).collect();
        views.push(known(90.0, 0.3, 0.5));
        views.push(known(170.0, 0.1, 0.02));
        let found = limits(&views, &[]);
        assert!(views.iter().all(|view| found.trust(view) != view.has_failed), "{found:?}");
    }

    #[test]
    fn limits_tell_failures_by_what_true_poses_of_the_object_leave() {
        // One object is known well, one badly: no limit for both would do.
        let mut views: Vec<Known> = (0..20).map(|k| known(1.0, 0.08 + 0.002 * f64::from(k), 0.5)).collect();
        views.extend((0..20).map(|k| Known { over_truth: 1.0 + 0.01 * f64::from(k), ..known(1.0, 0.4, 0.5) }));
        views.push(known(90.0, 0.3, 0.5));
        let found = limits(&views, &[]);
        assert!(views.iter().all(|view| found.trust(view) != view.has_failed), "{found:?}");
    }
}
