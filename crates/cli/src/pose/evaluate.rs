//! `sigma-pose evaluate`: the paper's protocol (spec 4) on a data set.

use std::path::PathBuf;

use clap::Args;
use glam::DMat4;
use serde::Serialize;
use sigma_srn::{Confidence, Found, Model};
use srn_data::camera::Axes;
use srn_data::sheet;

use super::draw;
use super::files::Picture;
use super::notation::{Notation, NotationArgs};
use super::search::{On, PoseError, SearchArgs, Starts, within_95};
use super::summary::{Statistics, Summary, markdown};
use super::symmetry::Symmetries;
use super::tables;
use super::views;
use crate::common::{EngineArgs, Result, create_dir, load_model, print, refuse_existing, refuse_to_write, write_picture};

/// Side of a view on the sheet, pixels.
const SHOWN: u32 = 128;
/// Searches side by side on the sheet.
const COLUMNS: usize = 4;

/// Flags of `sigma-pose evaluate`.
#[derive(Args, Debug)]
pub struct Evaluate {
    /// Model, or checkpoint of a training run.
    #[arg(long, value_name = "FILE")]
    pub(super) model: PathBuf,
    /// Data set in the SRN folder layout, of views that the model has not seen; instances are matched by name.
    #[arg(long, value_name = "DIR")]
    pub(super) data: PathBuf,
    /// Where to start: `neighbor4`, the true pose turned by 30° to four sides; `around2016`, all around, with every roll; `around84`, all around, the camera upright; `fixed24`, the paper's fewer;
    /// or a file with 16 numbers per line, or in four lines, a `world_from_camera` each.
    #[arg(long, value_name = "neighbor4|around2016|around84|fixed24|FILE", default_value = "neighbor4")]
    pub(super) starts: Starts,
    /// Views of each instance, evenly spread over those that there are.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) views: u32,
    /// Instances, evenly spread over those that there are.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) instances: u32,
    /// Instead, measure both presets from `neighbor4` and `fixed24`, the default one from `around84` too, and write to this folder the
    /// paper's tables for this model and data, with 95 % intervals: tables.md, views.csv, convergence.csv and .png, and pictures of the
    /// worst searches.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["starts", "json", "out"])]
    pub(super) tables: Option<PathBuf>,
    /// For --tables: instances that the model was not trained on; they are fitted to two views each (the paper's Table 2).
    #[arg(long, value_name = "DIR")]
    pub(super) heldout: Option<PathBuf>,
    /// For --tables: for how many of the views the paper's preset searches from `neighbor4`, half a minute a view on a CPU; from
    /// `fixed24`, six times the work, for a sixth of them. Default: all.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) paper_views: Option<u32>,
    /// Count poses as right from which the object looks the same: turns about its axes that the model's own views do not show. Some
    /// seconds per instance on a CPU.
    #[arg(long)]
    pub(super) symmetries: bool,
    /// Print everything as JSON.
    #[arg(long)]
    pub(super) json: bool,
    /// Write results.json and pictures.png, worst first, to this folder.
    #[arg(long, value_name = "DIR")]
    pub(super) out: Option<PathBuf>,
    /// Overwrite the files in the folder of --out.
    #[arg(long)]
    pub(super) force: bool,
    #[command(flatten)]
    pub(super) engine: EngineArgs,
    #[command(flatten)]
    pub(super) poses: NotationArgs,
    // Last, for its heading holds for all flags that follow.
    #[command(flatten)]
    pub(super) search: SearchArgs,
}

/// What `--json` prints and `results.json` holds.
#[derive(Serialize)]
struct Report {
    /// The call, word by word.
    command: Vec<String>,
    /// `cpu`, or the adapter's name.
    executor: String,
    /// Axes of the cameras in all poses.
    convention: Axes,
    overall: Summary,
    instances: Vec<Summary>,
    views: Vec<ViewReport>,
}

/// One search.
#[derive(Clone, Serialize)]
pub(super) struct ViewReport {
    pub instance: String,
    pub view: String,
    pub error: PoseError,
    /// The error of the translation in units of the source, if the instance was imported.
    pub translation_source: Option<f64>,
    /// Errors of the start that came nearest in rotation.
    pub oracle: PoseError,
    pub start: usize,
    pub loss: f64,
    pub unexplained: f64,
    pub trusted: bool,
    pub confidence: Option<Confidence>,
    /// Whether the true pose lies within the stated 95 % ellipsoid.
    pub within_95: Option<bool>,
    /// By which part the loss is higher at the best pose elsewhere.
    pub rival_higher: Option<f64>,
    /// 2 if a second, exhaustive search has found the pose, for the first one's was not to be trusted.
    pub searches: usize,
    pub seconds: f64,
    /// Rows of the estimate.
    pub world_from_camera: [[f64; 4]; 4],
    /// The same in frame and units of the source, if the instance was imported.
    pub source_from_camera: Option<[[f64; 4]; 4]>,
}

/// Runs the command.
pub fn run(args: &Evaluate) -> Result<bool> {
    if let Some(dir) = &args.tables {
        return tables::write(args, dir);
    }
    if args.heldout.is_some() || args.paper_views.is_some() {
        return Err("--heldout and --paper-views are for --tables".into());
    }
    let model = load_model(&args.model)?;
    let (side, asked) = views::open(&model, &args.data, args.instances, args.views)?;
    let notation = args.poses.open()?;
    let sources = asked.iter().map(|views| args.poses.source(Some(&views.dir))).collect::<Result<Vec<_>>>()?;
    let files = ["results.json", "pictures.png"];
    if let Some(dir) = &args.out {
        refuse_existing(files.map(|file| dir.join(file)), args.force)?;
        create_dir(dir)?;
        files.iter().try_for_each(|file| refuse_to_write(&dir.join(file), args.force))?;
    }
    let engine = args.search.open(&args.engine)?;
    let on = On { engine: &engine, model: &model, side };
    let found = views::search(&asked, on, &args.search, &args.starts, &notation, |_, _| Ok(()))?;

    let mut results: Vec<(ViewReport, &Picture, Found)> = Vec::new();
    for ((views, source), found) in asked.iter().zip(sources).zip(found) {
        let symmetries = Symmetries::of(on, views, args.symmetries)?;
        for ((picture, truth), found) in views.pictures.iter().zip(&views.truths).zip(found) {
            let truth = (truth, &symmetries);
            results.push((
                view_report(&model, &views.name, picture, truth, &found, notation.axes, source.as_ref()),
                picture,
                found,
            ));
        }
    }

    let sheet = args.out.as_ref().map(|_| pictures_sheet(&results, side, usize::MAX));
    let views: Vec<ViewReport> = results.into_iter().map(|(report, ..)| report).collect();
    let of = |name: &str| Summary::of(name, &views.iter().filter(|view| view.instance == name).collect::<Vec<_>>());
    let report = Report {
        command: std::env::args().collect(),
        executor: engine.to_string(),
        convention: notation.axes,
        overall: Summary::of("all", &views.iter().collect::<Vec<_>>()),
        instances: asked.iter().map(|views| of(&views.name)).collect(),
        views,
    };
    let json = serde_json::to_string_pretty(&report)?;
    print(&if args.json { json.clone() } else { report.table() })?;
    if let (Some(dir), Some(sheet)) = (&args.out, sheet) {
        sigma_srn::write_atomically(&dir.join(files[0]), json.as_bytes())?;
        write_picture(&dir.join(files[1]), &sheet)?;
        eprintln!("{} in {}", files.join(" and "), dir.display());
    }
    Ok(true)
}

/// What there is to say about a search.
pub(super) fn view_report(
    model: &Model,
    instance: &str,
    picture: &Picture,
    (truth, symmetries): (&DMat4, &Symmetries),
    found: &Found,
    convention: Axes,
    source: Option<&Notation>,
) -> ViewReport {
    let error_of = |pose: &DMat4| PoseError::of(pose, &symmetries.nearest(truth, pose));
    let errors = found.estimate.ranking.iter().map(|r| error_of(&r.pose.to_matrix()));
    let truth = &symmetries.nearest(truth, &found.world_from_camera);
    let error = error_of(&found.world_from_camera);
    ViewReport {
        instance: instance.into(),
        view: picture.name.clone(),
        error,
        translation_source: source.map(|source| error.translation * source.unit()),
        oracle: errors.min_by(|a, b| a.rotation_deg.total_cmp(&b.rotation_deg)).unwrap_or(error),
        start: found.estimate.ranking[0].start,
        loss: found.estimate.loss,
        unexplained: found.unexplained,
        trusted: found.is_trusted(),
        confidence: found.confidence,
        within_95: within_95(model, picture.shot.instance, found, truth),
        rival_higher: found.estimate.rival().map(|(_, higher)| higher),
        searches: found.searches,
        seconds: found.seconds,
        world_from_camera: convention.of_ours(found.world_from_camera).transpose().to_cols_array_2d(),
        source_from_camera: source.map(|source| source.rows(&found.world_from_camera)),
    }
}

/// Target, estimate and difference of the views, at most so many, the largest rotation error first.
pub(super) fn pictures_sheet(results: &[(ViewReport, &Picture, Found)], side: u32, most: usize) -> image::RgbImage {
    let mut order: Vec<_> = results.iter().collect();
    order.sort_by(|a, b| b.0.error.rotation_deg.total_cmp(&a.0.error.rotation_deg));
    let mut cells = Vec::new();
    for (report, picture, found) in order.into_iter().take(most) {
        let views = [
            draw::view(&picture.shot.rgb, side, SHOWN),
            draw::view(&found.view, side, SHOWN),
            draw::difference(&picture.shot.rgb, &found.view, side, SHOWN),
        ];
        let mut row = sheet::blank(3 * views[0].width() + 16, views[0].height() + 8);
        for (view, k) in views.iter().zip(0i64..) {
            image::imageops::replace(&mut row, view, k * (i64::from(view.width()) + 4), 0);
        }
        cells.push((row, format!("{} {}: {} off", report.instance, report.view, report.error)));
    }
    let cells: Vec<_> = cells.iter().map(|(row, label)| (row, label.as_str())).collect();
    let grid = sheet::grid(&cells, COLUMNS);
    let mut page = sheet::blank(grid.width(), grid.height() + 24);
    sheet::text(&mut page, 4, 8, "target | view from the estimated pose | difference; the worst first", sheet::BLACK);
    image::imageops::replace(&mut page, &grid, 0, 24);
    page
}

impl ViewReport {
    /// More than 5° off, which the paper's protocol does not count as found.
    pub(super) fn is_failure(&self) -> bool {
        self.error.rotation_deg > PoseError::FAILURE_DEG
    }
}

impl Report {
    /// What the verdicts and the stated deviations were worth.
    fn verdicts(&self) -> String {
        let Summary { views, trusted, failures, failures_told, stated, within_95, .. } = self.overall;
        let (not, failure) = (views - trusted, PoseError::FAILURE_DEG);
        let mut text = format!(
            "{failures} of {views} are more than {failure}° off; {not} are not trusted, {failures_told} of them with reason"
        );
        if stated > 0 {
            text += &format!("; the truth lies within the stated 95 % ellipsoid of {within_95} of {stated}");
        }
        text
    }

    /// A table in Markdown, aligned; with errors in the source's unit where it is known.
    fn table(&self) -> String {
        let degrees = |x: f64| format!("{x:.2}°");
        type Cell = Box<dyn Fn(&Summary) -> String>;
        let mut columns: Vec<(&str, Cell)> = vec![
            ("instance", Box::new(|s| s.name.clone())),
            ("views", Box::new(|s| s.views.to_string())),
            ("rot mean", Box::new(move |s| degrees(s.rotation_deg.mean))),
            ("median", Box::new(move |s| degrees(s.rotation_deg.median))),
            ("<= 5°", Box::new(|s| format!("{:.2}", s.recall_5_deg))),
            ("<= 10°", Box::new(|s| format!("{:.2}", s.recall_10_deg))),
            ("oracle mean", Box::new(move |s| degrees(s.oracle_deg.mean))),
            ("median", Box::new(move |s| degrees(s.oracle_deg.median))),
            ("tra mean", Box::new(|s| format!("{:.3}", s.translation.mean))),
            ("median", Box::new(|s| format!("{:.3}", s.translation.median))),
            ("% of distance", Box::new(|s| format!("{:.2}", s.translation_percent.median))),
            ("trusted", Box::new(|s| s.trusted.to_string())),
            ("s/view", Box::new(|s| format!("{:.2}", s.seconds_per_view))),
        ];
        if self.overall.translation_source.is_some() {
            let in_source = |pick: fn(Statistics) -> f64| -> Cell {
                Box::new(move |s| s.translation_source.map_or("-".into(), |s| significant(pick(s))))
            };
            columns.splice(
                11..11,
                [("in source: mean", in_source(|s: Statistics| s.mean)), ("median", in_source(|s: Statistics| s.median))],
            );
        }
        let row = |s: &Summary| columns.iter().map(|(_, cell)| cell(s)).collect::<Vec<_>>();
        let mut rows = vec![columns.iter().map(|(head, _)| head.to_string()).collect()];
        rows.extend(self.instances.iter().chain([&self.overall]).map(row));
        markdown(&rows) + "\n\n" + &self.verdicts()
    }
}

/// Three digits that count: units of sources are anything from metres to millimetres.
fn significant(x: f64) -> String {
    let digits = if x > 0.0 { (2.0 - x.log10().floor()).clamp(0.0, 6.0) as usize } else { 0 };
    format!("{x:.digits$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_digits_count() {
        assert_eq!([0.009_123, 9.123, 912.3, 0.0].map(significant), ["0.00912", "9.12", "912", "0"]);
    }
}
