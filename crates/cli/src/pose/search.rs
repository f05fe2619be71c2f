//! The search for poses: its flags, and what it found.

use std::path::PathBuf;

use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, ValueEnum};
use glam::DMat4;
use serde::Serialize;
use sigma_srn::camera::{around84, around2016, fixed24, neighbor4, pose_error};
use sigma_srn::photo::Shot;
use sigma_srn::{
    Confidence, Effort, Engine, Error, Found, Loss, Method, Model, Options, Progress, Rendering, Search, View, render_views,
};

use super::files::Picture;
use super::notation::Notation;
use super::positive;
use crate::common::{EngineArgs, Result};

/// What views are rendered by: an executor and a model, for pictures of `side` × `side` pixels.
#[derive(Clone, Copy)]
pub struct On<'a> {
    pub engine: &'a Engine,
    pub model: &'a Model,
    pub side: u32,
}

/// How poses are searched for: the same flags for a picture and for a data set.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Search")]
pub struct SearchArgs {
    /// `default`: BFGS about the object, all starts on few rays, then only the most promising on more. `paper`: 300
    /// steps of Adam on the camera's six numbers for every start, on all pixels; the last step counts.
    #[arg(long, value_enum, default_value_t = Preset::Default)]
    preset: Preset,
    /// How hard the default preset tries: for poses that are roughly known, in general, for what that has lost. `normal` is followed by
    /// `exhaustive` for a picture whose pose is not to be trusted, but not in `track`, nor with `--box`.
    #[arg(long, value_enum, default_value_t = HowHard::Normal)]
    effort: HowHard,
    /// How `--preset paper` compares picture and render. Default: mae. `gmsd` implies `--stride 1`.
    #[arg(long, value_parser = PossibleValuesParser::new(LOSSES.map(|(name, _)| name)).map(loss))]
    loss: Option<Loss>,
    /// Steps in all; the phases of the preset keep their shares.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    steps: Option<u32>,
    /// Learning rate of `--preset paper`. Default: 0.1.
    #[arg(long, value_name = "X", value_parser = positive)]
    lr: Option<f64>,
    /// Drop the less promising starts on the way: what the default preset does; the paper's goes on with 6 after a fifth.
    #[arg(long, overrides_with = "no_cull")]
    cull: bool,
    /// Follow all starts to the end.
    #[arg(long, overrides_with = "cull")]
    no_cull: bool,
    /// Compare every N-th pixel of every N-th row, in all phases. Default: the preset's.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    stride: Option<u32>,
    /// Multiply cooperative matrices (tensor cores) on a GPU that has them, where they are faster: f32 as sums of two numbers in f16. The pose
    /// gradients of the first starts are compared with those in f32, which is said; beyond 1 % of the largest, f32 it is.
    #[arg(long)]
    cooperative: bool,
    /// Decides the random initial depths of the rays: of `--preset paper`, and where the code of an unknown object is fitted.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// A pose is trusted if the view from there leaves at most this part of the picture unexplained: the sum of absolute differences, over
    /// that to an empty picture. Default: what `calibrate` has found for the model, else 0.25. With the default, what looks alike from two
    /// sides is not trusted either if `calibrate` saw the search mistake them, or if the object is not one of the model's, nor is a camera
    /// that is nearer or farther than the model knows, nor an object half as large in the picture as when the model was calibrated.
    #[arg(long, value_name = "X", value_parser = positive)]
    accept: Option<f64>,
    /// Distance of the starts of `around2016`, `around84` and `fixed24` from the object's centre, in object units. Default: by the size of the object in a
    /// photograph that is cut around it, else as the model was trained.
    #[arg(long, value_name = "R", value_parser = positive)]
    radius: Option<f64>,
}

/// Settings of a search.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Preset {
    Default,
    Paper,
}

/// [`Effort`] as a flag.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum HowHard {
    Fast,
    Normal,
    Exhaustive,
}

impl From<HowHard> for Effort {
    fn from(effort: HowHard) -> Self {
        match effort {
            HowHard::Fast => Effort::Fast,
            HowHard::Normal => Effort::Normal,
            HowHard::Exhaustive => Effort::Exhaustive,
        }
    }
}

/// The paper's losses, and two that the authors' code adds.
pub const LOSSES: [(&str, Loss); 5] =
    [("mae", Loss::Mae), ("mse", Loss::Mse), ("norm_l1", Loss::NormL1), ("norm_l2", Loss::NormL2), ("gmsd", Loss::Gmsd)];

fn loss(name: String) -> Loss {
    LOSSES.into_iter().find(|(known, _)| *known == name).map_or(Loss::Mae, |(_, loss)| loss)
}

/// Where searches start.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Starts {
    /// 84 places around the object × 24 rolls.
    Around2016,
    /// 12 azimuths × 7 elevations around the object, the camera upright.
    Around84,
    /// 8 azimuths × 3 elevations around the object, the paper's.
    Fixed24,
    /// A rough pose, turned by 30° to four sides.
    Neighbor4,
    /// The poses in a file.
    File(PathBuf),
}

impl From<&str> for Starts {
    fn from(text: &str) -> Self {
        match text {
            "around2016" => Starts::Around2016,
            "around84" => Starts::Around84,
            "fixed24" => Starts::Fixed24,
            "neighbor4" => Starts::Neighbor4,
            path => Starts::File(path.into()),
        }
    }
}

impl std::fmt::Display for Starts {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Starts::Around2016 => "around2016",
            Starts::Around84 => "around84",
            Starts::Fixed24 => "fixed24",
            Starts::Neighbor4 => "neighbor4",
            Starts::File(path) => return write!(f, "{}", path.display()),
        })
    }
}

impl SearchArgs {
    /// The same radius, seed and limit of acceptance, with the settings of a preset; an error if other flags were given.
    pub fn with(&self, preset: Preset, loss: Option<Loss>) -> Result<Self> {
        let is_plain = self.preset == Preset::Default && self.loss.is_none() && self.lr.is_none() && self.steps.is_none();
        if !is_plain || self.effort != HowHard::Normal || self.cull || self.no_cull || self.stride.is_some() {
            return Err(
                "--tables compares the presets as they are: of the flags of the search it takes --radius, --seed and --accept"
                    .into(),
            );
        }
        Ok(SearchArgs { preset, loss, ..self.clone() })
    }

    /// The same, with every pose trusted that has a loss: for those who have yet to learn what to trust.
    pub fn trusting(&self) -> Self {
        SearchArgs { accept: Some(f64::INFINITY), ..self.clone() }
    }

    /// The executor, with cooperative matrices where they are asked for.
    pub fn open(&self, engine: &EngineArgs) -> Result<Engine> {
        if self.cooperative { engine.open_cooperative() } else { engine.open() }
    }

    /// The settings of the estimator.
    pub fn options(&self) -> Result<Options> {
        let mut options = match self.preset {
            Preset::Default => Options::of(self.effort.into()),
            Preset::Paper if self.effort == HowHard::Normal => Options::paper(),
            Preset::Paper => return Err("--effort is for the default preset: the paper's has one".into()),
        };
        match (&mut options.method, self.loss, self.lr) {
            (Method::Adam { loss, learning_rate }, wanted_loss, wanted_rate) => {
                *loss = wanted_loss.unwrap_or(*loss);
                *learning_rate = wanted_rate.unwrap_or(*learning_rate);
            }
            (_, None, None) => {}
            _ => return Err("--loss and --lr are for --preset paper: the default has one loss and no learning rate".into()),
        }
        if self.no_cull {
            options = options.without_culling();
        } else if self.cull {
            options = options.with_culling();
        }
        if let Some(steps) = self.steps {
            options = options.with_steps(steps);
        }
        if let Some(stride) = self.stride.or((self.loss == Some(Loss::Gmsd)).then_some(1)) {
            options = options.with_stride(stride);
        }
        Ok(Options { seed: self.seed, ..options })
    }

    /// The searches: a single one with the settings of [`SearchArgs::options`], unless the normal effort is asked for as it is.
    pub fn search(&self) -> Result<Search> {
        let options = self.options()?;
        let mut normal = Search::of(Effort::Normal);
        normal.tries.iter_mut().for_each(|options| options.seed = self.seed);
        let search = if options == normal.tries[0] { normal } else { options.into() };
        Ok(Search { accept: self.accept, ..search })
    }

    /// One alone, with these settings and the same limit of acceptance.
    pub fn single(&self, options: Options) -> Search {
        Search { accept: self.accept, ..options.into() }
    }

    /// Estimates the pose of an object that the model was not trained on. The model with the object is returned too.
    pub fn run_unseen(
        &self,
        On { engine, model, .. }: On,
        picture: &Picture,
        starts: &[DMat4],
        observe: impl FnMut(usize, usize) -> std::result::Result<(), Error>,
    ) -> Result<(Found, Model)> {
        let search = self.single(Options { seed: self.seed, ..Options::default() });
        Ok(search.run_unseen(engine, model, &picture.shot.query(starts.to_vec()), observe)?)
    }

    /// Where to start where nothing is known of the pose.
    pub fn all_around(&self) -> Starts {
        match self.preset {
            // Thousands are for looking at, not for following.
            Preset::Default if self.no_cull => Starts::Around84,
            Preset::Default => Starts::Around2016,
            Preset::Paper => Starts::Fixed24,
        }
    }

    /// Starts all around the object, which appears in the middle of the picture.
    fn around(&self, starts: fn(f64) -> Vec<DMat4>, model: &Model, shot: &Shot) -> Result<Vec<DMat4>> {
        shot.around(model, starts, self.radius)
            .map_err(|_| "the model does not say how far its cameras were: give --radius".into())
    }

    /// The poses to start from; `rough` is the one that `neighbor4` turns.
    pub fn starts(
        &self,
        starts: &Starts,
        model: &Model,
        shot: &Shot,
        rough: Option<&DMat4>,
        notation: &Notation,
    ) -> Result<Vec<DMat4>> {
        match starts {
            Starts::Around2016 => self.around(around2016, model, shot),
            Starts::Around84 => self.around(around84, model, shot),
            Starts::Fixed24 => self.around(fixed24, model, shot),
            Starts::Neighbor4 => Ok(neighbor4(rough.ok_or("--starts neighbor4 turns a rough pose: give --rough")?)),
            Starts::File(path) if !path.exists() => Err(format!(
                "--starts {}: no such file; expected around2016, around84, fixed24, neighbor4 or a file",
                path.display()
            )
            .into()),
            Starts::File(path) => Ok(srn_data::srn::read_poses(path)?.into_iter().map(|pose| notation.ours(pose)).collect()),
        }
    }
}

/// Estimates the poses of `pictures`, each from its own starts.
pub fn run(
    search: &Search,
    On { engine, model, .. }: On,
    pictures: &[Picture],
    starts: &[Vec<DMat4>],
    observe: impl FnMut(Progress) -> std::result::Result<(), Error>,
) -> Result<Vec<Found>> {
    let queries: Vec<_> = pictures.iter().zip(starts).map(|(picture, starts)| picture.shot.query(starts.clone())).collect();
    with_cooperative_said(engine, || {
        search.run(engine, model, &queries, observe).map_err(|error| match error {
            Error::Query { number, what } => Error::Input { input: pictures[number].name.clone(), what }.into(),
            error => error.into(),
        })
    })
}

/// What is done, and then on stderr what cooperative matrices were found to be worth, if that was now.
pub fn with_cooperative_said<T>(engine: &Engine, run: impl FnOnce() -> Result<T>) -> Result<T> {
    let is_checked = engine.cooperative_difference().is_some();
    let found = run()?;
    if let Some(difference) = engine.cooperative_difference().filter(|_| !is_checked) {
        let so = if engine.is_cooperative() { "wherever they are faster" } else { "are not used" };
        eprintln!("cooperative matrices {so}: with them pose gradients differ by {difference:.1e} of the largest");
    }
    Ok(found)
}

/// Distance of a pose from the truth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PoseError {
    /// Angle of the rotation between them, degrees.
    pub rotation_deg: f64,
    /// Distance of the camera centres, object units.
    pub translation: f64,
    /// The same in percent of the true camera's distance from the object's centre.
    pub translation_percent: f64,
}

impl PoseError {
    /// Rotation error above which a search has failed, degrees: the paper's first recall.
    pub const FAILURE_DEG: f64 = 5.0;

    /// Of `pose` against `truth`.
    pub fn of(pose: &DMat4, truth: &DMat4) -> Self {
        let (rotation_deg, translation) = pose_error(pose, truth);
        let translation_percent = 100.0 * translation / truth.w_axis.truncate().length();
        PoseError { rotation_deg, translation, translation_percent }
    }
}

/// Whether the true pose lies within the ellipsoid that a calibrated model states for 95 % of all.
pub fn within_95(model: &Model, instance: u32, found: &Found, truth: &DMat4) -> Option<bool> {
    let calibration = model.metadata.calibration.as_ref()?;
    found.estimate.states(truth, &model.instance_name(instance), calibration)
}

impl std::fmt::Display for PoseError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.2}° {:.3}", self.rotation_deg, self.translation)
    }
}

/// A stated deviation as it is printed, if there is one; one that takes in all turns says nothing.
pub fn deviation(stated: Option<Confidence>) -> String {
    match stated {
        Some(Confidence { rotation_deg, translation, .. }) if rotation_deg < 180.0 => {
            format!("  ± {rotation_deg:.2}° {translation:.4}")
        }
        Some(_) => "  ± anything".into(),
        None => String::new(),
    }
}

/// Renders views, a few at a time.
pub fn render(On { engine, model, side }: On, views: &[View]) -> Result<Vec<Rendering>> {
    Ok(render_views(engine, model, [side, side], views)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use glam::DVec3;
    use sigma_srn::{Intrinsics, ModelConfig};

    #[derive(Parser)]
    struct Flags {
        #[command(flatten)]
        search: SearchArgs,
    }

    #[test]
    fn starts_see_the_object_in_the_middle_of_a_cut() {
        let model = Model::init(&ModelConfig { hidden: 4, latent: 2, instances: 1, tracing_steps: 1, density: true }, 0).unwrap();
        let search = Flags::parse_from(["sigma-pose"]).search;
        let starts =
            |shot: &Shot| search.starts(&Starts::Around84, &model, shot, None, &Notation::default()).map_err(|e| e.to_string());
        let shot = |intrinsics| Shot::whole(vec![], intrinsics, 0, 64);
        let cut = shot(Intrinsics { fx: 150.0, fy: 140.0, cx: -40.0, cy: 90.0, pixel_center: 0.0 });
        assert!(starts(&cut).unwrap_err().contains("--radius"));
        for start in starts(&Shot { distance: Some(2.5), ..cut }).unwrap() {
            let DVec3 { x, y, z } = start.inverse().transform_point3(DVec3::ZERO);
            assert!((150.0 * x / z - 40.0 - 32.0).abs() < 1e-9 && (140.0 * y / z + 90.0 - 32.0).abs() < 1e-9, "{start}");
            assert!((start.w_axis.truncate().length() - 2.5).abs() < 1e-12);
        }
        // Pictures of data sets have their principal point there: nothing is turned.
        let whole = shot(Intrinsics { fx: 74.4, fy: 74.4, cx: 32.0, cy: 32.0, pixel_center: 0.0 });
        assert_eq!(starts(&Shot { distance: Some(1.3), ..whole }).unwrap(), around84(1.3));
    }

    #[test]
    fn only_the_normal_effort_as_it_is_searches_once_more() {
        let tries = |flags: &str| {
            let search = Flags::parse_from(format!("sigma-pose --seed 3 {flags}").split_whitespace()).search.search().unwrap();
            assert!(search.tries.iter().all(|options| options.seed == 3), "{flags}");
            search.tries.len()
        };
        assert_eq!([tries(""), tries("--accept 0.1"), tries("--radius 2")], [2; 3]);
        for plain in ["--effort fast", "--effort exhaustive", "--steps 9", "--no-cull", "--preset paper --steps 9"] {
            assert_eq!(tries(plain), 1, "{plain}");
        }
    }
}
