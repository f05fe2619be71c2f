//! `sigma-pose calibrate`: what a model's estimates are worth, from views with known poses.

use std::path::PathBuf;

use clap::Args;
use sigma_srn::Calibration;
use sigma_srn::confidence::{Matrix6, fit, motion};

use super::notation::Notation;
use super::search::{On, PoseError, SearchArgs, Starts};
use super::views;
use crate::common::{EngineArgs, Result, load_model, print, refuse_existing};

/// Where no search failed: the limit of what is unexplained, over the most that was.
const MARGIN: f64 = 1.5;

/// Flags of `sigma-pose calibrate`.
#[derive(Args, Debug)]
pub struct Calibrate {
    /// The trained model.
    #[arg(long, value_name = "FILE")]
    model: PathBuf,
    /// Data set in the SRN folder layout, of views that the model has not seen, and that nothing else will be measured on.
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// The model to write: the same, and what was found.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Overwrite --out, which may be the model itself.
    #[arg(long)]
    force: bool,
    /// Where to start; see `evaluate`.
    #[arg(long, value_name = "around84|fixed24|neighbor4|FILE", default_value = "around84")]
    starts: Starts,
    /// Views of each instance, evenly spread over those that there are.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    views: u32,
    /// Instances, evenly spread over those that there are.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    instances: u32,
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
#[derive(Clone, Copy, Debug)]
struct Known {
    rotation_deg: f64,
    /// From the estimate to the truth.
    motion: [f64; 6],
    /// See `Estimate::shape`.
    shape: Option<Matrix6>,
    unexplained: f64,
    /// Infinite without a rival.
    rival: f64,
}

impl Known {
    fn has_failed(&self) -> bool {
        self.rotation_deg > PoseError::FAILURE_DEG
    }
}

/// Runs the command.
pub fn run(args: &Calibrate) -> Result<bool> {
    let mut model = load_model(&args.model)?;
    let (side, asked) = views::open(&model, &args.data, args.instances, args.views)?;
    refuse_existing([args.out.clone()], args.force)?;
    let engine = args.engine.open()?;
    let on = On { engine: &engine, model: &model, side };
    let found = views::search(&asked, on, &args.search, &args.starts, &Notation::default(), |_, _| Ok(()))?;
    let truths = asked.iter().flat_map(|views| &views.truths);
    let known = found.iter().flatten().zip(truths).map(|(found, truth)| Known {
        rotation_deg: PoseError::of(&found.world_from_camera, truth).rotation_deg,
        motion: motion(&found.world_from_camera, truth),
        shape: found.estimate.shape(),
        unexplained: found.unexplained,
        rival: found.estimate.rival().map_or(f64::INFINITY, |(_, higher)| higher),
    });
    let known: Vec<Known> = known.collect();
    let calibration = calibration(&known).ok_or("no search came near enough to the truth to learn from")?;
    model.metadata.calibration = Some(calibration);
    model.save(&args.out)?;
    if args.json {
        print(&serde_json::to_string_pretty(&calibration)?)?;
    } else {
        let failures = known.iter().filter(|known| known.has_failed()).count();
        let Calibration { curvature, floor, unexplained, rival, views } = calibration;
        print(&format!("{views} views, {failures} of them more than {}° off", PoseError::FAILURE_DEG))?;
        print(&format!("covariance: {curvature:.2e} × loss × inverse of its second derivatives"))?;
        let [a, b, c] = [0, 1, 2].map(|k| floor[k].sqrt().to_degrees());
        let [x, y, z] = [3, 4, 5].map(|k| floor[k].sqrt());
        print(&format!("and in all views ± {a:.2}° {b:.2}° {c:.2}° about the camera's axes, ± {x:.4} {y:.4} {z:.4} along them"))?;
        print(&format!(
            "trusted: at most {:.1} % unexplained, and a loss {:.1} % higher elsewhere",
            100.0 * unexplained,
            100.0 * rival
        ))?;
        print(&format!("model: {}", args.out.display()))?;
    }
    Ok(true)
}

/// What the searches tell of others. `None` if none of them has second derivatives and found its pose.
fn calibration(known: &[Known]) -> Option<Calibration> {
    let found = known.iter().filter(|known| !known.has_failed());
    let errors: Vec<_> = found.filter_map(|known| known.shape.map(|shape| (known.motion, shape))).collect();
    let (curvature, floor) = fit(&errors)?;
    let (unexplained, rival) = limits(known);
    Some(Calibration { curvature, floor, unexplained, rival, views: known.len() as u32 })
}

/// The limits of what is unexplained and of the rival that tell the failures best: by the harmonic mean of precision and recall.
fn limits(known: &[Known]) -> (f64, f64) {
    let failures = known.iter().filter(|known| known.has_failed()).count();
    let between = |values: &dyn Fn(&Known) -> f64| -> Vec<f64> {
        let mut values: Vec<f64> = known.iter().map(values).filter(|value| value.is_finite()).collect();
        values.sort_by(f64::total_cmp);
        values.windows(2).map(|pair| 0.5 * (pair[0] + pair[1])).collect()
    };
    let most = known.iter().map(|known| known.unexplained).filter(|value| value.is_finite()).fold(0.0, f64::max);
    let loosest = (MARGIN * most, 0.0);
    if failures == 0 {
        return loosest;
    }
    let score = |(unexplained, rival): (f64, f64)| {
        let told = |known: &&Known| !(known.unexplained <= unexplained && known.rival >= rival);
        let right = known.iter().filter(|known| known.has_failed()).filter(told).count();
        2.0 * right as f64 / (known.iter().filter(told).count() + failures) as f64
    };
    let mut best = (score(loosest), loosest);
    for unexplained in between(&|known| known.unexplained).into_iter().chain([loosest.0]) {
        for rival in between(&|known| known.rival).into_iter().chain([0.0]) {
            let limits = (unexplained, rival);
            // The tightest of equals loses: what was not seen to fail is trusted.
            let is_looser = unexplained >= best.1.0 && rival <= best.1.1;
            let score = score(limits);
            if score > best.0 || score == best.0 && is_looser {
                best = (score, limits);
            }
        }
    }
    best.1
}

#[cfg(test)]
mod tests {
    use super::*;

    fn known(rotation_deg: f64, unexplained: f64, rival: f64) -> Known {
        let shape = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(i == j)));
        Known { rotation_deg, motion: [0.01; 6], shape: Some(shape), unexplained, rival }
    }

    #[test]
    fn without_failures_the_limits_are_loose() {
        let views: Vec<Known> = (1..=9).map(|k| known(1.0, 0.01 * f64::from(k), f64::INFINITY)).collect();
        let found = calibration(&views).unwrap();
        assert!((found.unexplained - 0.135).abs() < 1e-12 && found.rival == 0.0 && found.views == 9, "{found:?}");
        assert_eq!(calibration(&[known(90.0, 0.1, 1.0)]), None);
    }

    #[test]
    fn limits_tell_failures_by_either_sign() {
        let mut views: Vec<Known> = (0..20).map(|k| known(1.0, 0.1 + 0.002 * f64::from(k), 0.5)).collect();
        views.push(known(90.0, 0.3, 0.5));
        views.push(known(170.0, 0.1, 0.02));
        let (unexplained, rival) = limits(&views);
        assert!((0.14..0.3).contains(&unexplained) && (0.02..0.5).contains(&rival), "{unexplained} {rival}");
    }
}
