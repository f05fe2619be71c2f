//! `sigma-pose estimate`: poses of pictures.

use std::collections::HashSet;
use std::path::PathBuf;

use clap::Args;
use glam::DMat4;
use serde::Serialize;
use sigma_srn::{Engine, Model};

use super::files::{CameraArgs, Picture, PoseSource, create_dir, model_side};
use super::record::Log;
use super::search::{Found, PoseError, SearchArgs, Starts};
use crate::common::{EngineArgs, Result, load_model, print, progress, refuse_existing};

/// Flags of `sigma-pose estimate`.
#[derive(Args, Debug)]
pub struct Estimate {
    /// Pictures of any size and colour type; transparency becomes white. All are searched for in one batch.
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,
    /// Model, or checkpoint of a training run.
    #[arg(long, value_name = "FILE")]
    model: PathBuf,
    /// Name or number of the object in the pictures. Default: the name of the SRN folder that a picture lies in.
    #[arg(long, value_name = "NAME")]
    instance: Option<String>,
    #[command(flatten)]
    camera: CameraArgs,
    /// Where to start: `around84`, all around; `fixed24`, the paper's fewer; `neighbor4`, 30° to four sides of --rough; or a file
    /// with 16 numbers per line, a `world_from_camera` each. Default: `neighbor4` with --rough, else `around84`.
    #[arg(long, value_name = "around84|fixed24|neighbor4|FILE")]
    starts: Option<Starts>,
    /// Roughly known pose: a pose file, or `auto`, the one in the picture's SRN folder. Once, or once per picture.
    #[arg(long, value_name = "POSE")]
    rough: Vec<PoseSource>,
    /// True pose, to report errors; like --rough. It has no influence on the search.
    #[arg(long, value_name = "POSE")]
    truth: Vec<PoseSource>,
    /// Print everything as JSON.
    #[arg(long)]
    json: bool,
    /// Write a picture and an animation of each search to this folder.
    #[arg(long, value_name = "DIR")]
    record: Option<PathBuf>,
    /// Overwrite pictures in the folder of --record.
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    engine: EngineArgs,
    // Last, for its heading holds for all flags that follow.
    #[command(flatten)]
    search: SearchArgs,
}

/// What `--json` prints.
#[derive(Serialize)]
struct Report {
    /// `cpu`, or the adapter's name.
    executor: String,
    /// Seconds of the search for all pictures.
    seconds: f64,
    images: Vec<ImageReport>,
}

#[derive(Serialize)]
struct ImageReport {
    image: PathBuf,
    instance: String,
    /// Rows of the 4×4 matrix.
    world_from_camera: [[f64; 4]; 4],
    /// θ1, θ2, θ3 of `R = Rx(θ1)·Ry(θ2)·Rz(θ3)`.
    euler_rad: [f64; 3],
    /// Camera centre, object units.
    translation: [f64; 3],
    loss: f64,
    /// See [`Found::unexplained`].
    unexplained: f64,
    converged: bool,
    /// Number of the winning start.
    start: usize,
    error: Option<PoseError>,
    /// All starts, the winner first.
    ranking: Vec<RankedReport>,
    seconds: f64,
}

#[derive(Serialize)]
struct RankedReport {
    start: usize,
    loss: f64,
    phases: usize,
    error: Option<PoseError>,
}

/// Runs the command; false where a picture's search did not converge.
pub fn run(args: &Estimate) -> Result<bool> {
    let model = load_model(&args.model)?;
    let side = model_side(&model, &args.images[0])?;
    let rough = poses("--rough", &args.rough, &args.images)?;
    let pictures = pictures(args, &model, side)?;
    let default = if args.rough.is_empty() { Starts::Around84 } else { Starts::Neighbor4 };
    let starts = args.starts.as_ref().unwrap_or(&default);
    let starts = rough.iter().map(|rough| args.search.starts(starts, &model, rough.as_ref())).collect::<Result<Vec<_>>>()?;
    if let Some(dir) = &args.record {
        let files =
            ["png", "gif"].into_iter().flat_map(|kind| pictures.iter().map(move |p| dir.join(format!("{}.{kind}", p.name))));
        refuse_existing(files, args.force)?;
        create_dir(dir)?;
    }
    let options = args.search.options()?;
    let engine = args.engine.open()?;

    let bar = progress(options.phases.iter().map(|phase| u64::from(phase.steps)).sum(), "steps");
    let mut log = Log::default();
    let found = args.search.run(&engine, &model, side, &pictures, &starts, |mut progress| {
        bar.set_position(progress.step.into());
        if args.record.is_some() { log.note(&mut progress) } else { Ok(()) }
    })?;
    bar.finish_and_clear();

    let report = report(args, &engine, &model, &pictures, &found);
    if args.json {
        print(&serde_json::to_string_pretty(&report)?)?;
    } else {
        report.images.iter().try_for_each(|image| print(&image.line()))?;
    }
    if let Some(dir) = &args.record {
        for (i, (picture, found)) in pictures.iter().zip(&found).enumerate() {
            log.write(dir, i, picture, found, &engine, &model, side)?;
        }
        eprintln!("pictures in {}", dir.display());
    }
    Ok(found.iter().all(|found| found.converged))
}

/// One pose per image from none, one or as many sources.
fn poses(flag: &str, sources: &[PoseSource], images: &[PathBuf]) -> Result<Vec<Option<DMat4>>> {
    if ![0, 1, images.len()].contains(&sources.len()) {
        return Err(format!("{flag}: {} poses for {} pictures; give one, or one for each", sources.len(), images.len()).into());
    }
    let read = |(i, image): (usize, &PathBuf)| sources.get(i % sources.len().max(1)).map(|s| s.read(image)).transpose();
    images.iter().enumerate().map(read).collect()
}

fn pictures(args: &Estimate, model: &Model, side: u32) -> Result<Vec<Picture>> {
    let truths = poses("--truth", &args.truth, &args.images)?;
    let mut names = HashSet::new();
    let mut pictures = Vec::new();
    for (path, truth) in args.images.iter().zip(truths) {
        let mut picture = Picture { truth, ..Picture::open(path, model, side, args.instance.as_deref(), &args.camera)? };
        while !names.insert(picture.name.clone()) {
            picture.name += "-again";
        }
        pictures.push(picture);
    }
    Ok(pictures)
}

fn report(args: &Estimate, engine: &Engine, model: &Model, pictures: &[Picture], found: &[Found]) -> Report {
    let image = |((image, picture), found): ((&PathBuf, &Picture), &Found)| {
        let [a, b, c, x, y, z] = found.estimate.pose.0;
        let error = |pose: &DMat4| picture.truth.map(|truth| PoseError::of(pose, &truth));
        let ranked = |r: &sigma_srn::Ranked| RankedReport {
            start: r.start,
            loss: r.loss,
            phases: r.phases,
            error: error(&r.pose.to_matrix()),
        };
        ImageReport {
            image: image.clone(),
            instance: model.instance_name(picture.instance),
            world_from_camera: found.world_from_camera.transpose().to_cols_array_2d(),
            euler_rad: [a, b, c],
            translation: [x, y, z],
            loss: found.estimate.loss,
            unexplained: found.unexplained,
            converged: found.converged,
            start: found.estimate.ranking[0].start,
            error: error(&found.world_from_camera),
            ranking: found.estimate.ranking.iter().map(ranked).collect(),
            seconds: found.seconds,
        }
    };
    Report {
        executor: engine.to_string(),
        seconds: found.iter().map(|found| found.seconds).sum(),
        images: args.images.iter().zip(pictures).zip(found).map(image).collect(),
    }
}

impl ImageReport {
    /// What is printed without `--json`.
    fn line(&self) -> String {
        let [a, b, c] = self.euler_rad.map(f64::to_degrees);
        let [x, y, z] = self.translation;
        let verdict = if self.converged { "" } else { "  NOT CONVERGED" };
        let error = self.error.map_or(String::new(), |error| format!("  error {error}"));
        format!(
            "{}  {}  rotation {a:.2}° {b:.2}° {c:.2}°  centre {x:.4} {y:.4} {z:.4}  loss {:.4}  unexplained {:.0} %  \
             start {} of {}  {:.1} s{error}{verdict}",
            self.image.display(),
            self.instance,
            self.loss,
            100.0 * self.unexplained,
            self.start,
            self.ranking.len(),
            self.seconds,
        )
    }
}
