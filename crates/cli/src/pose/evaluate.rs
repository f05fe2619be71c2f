//! `sigma-pose evaluate`: the paper's protocol (spec 4) on a data set.

use std::path::PathBuf;

use clap::Args;
use glam::DMat4;
use serde::Serialize;
use srn_data::camera::Axes;
use srn_data::sheet;
use srn_data::srn::{InstanceFiles, SrnSet};

use super::draw;
use super::files::{Picture, create_dir, model_side, write_png};
use super::notation::{Notation, NotationArgs};
use super::search::{Found, PoseError, SearchArgs, Starts};
use crate::common::{EngineArgs, Result, camera, load_model, print, progress, refuse_existing};

/// Side of a view on the sheet, pixels.
const SHOWN: u32 = 128;
/// Searches side by side on the sheet.
const COLUMNS: usize = 4;

/// Flags of `sigma-pose evaluate`.
#[derive(Args, Debug)]
pub struct Evaluate {
    /// Model, or checkpoint of a training run.
    #[arg(long, value_name = "FILE")]
    model: PathBuf,
    /// Data set in the SRN folder layout, of views that the model has not seen; instances are matched by name.
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Where to start: `neighbor4`, the true pose turned by 30° to four sides; `around84`, all around; `fixed24`, the paper's fewer;
    /// or a file with 16 numbers per line, a `world_from_camera` each.
    #[arg(long, value_name = "neighbor4|around84|fixed24|FILE", default_value = "neighbor4")]
    starts: Starts,
    /// Views of each instance, evenly spread over those that there are.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    views: u32,
    /// Instances, the first by name.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    instances: u32,
    /// Print everything as JSON.
    #[arg(long)]
    json: bool,
    /// Write results.json and pictures.png, worst first, to this folder.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Overwrite the files in the folder of --out.
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    engine: EngineArgs,
    #[command(flatten)]
    poses: NotationArgs,
    // Last, for its heading holds for all flags that follow.
    #[command(flatten)]
    search: SearchArgs,
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

/// Errors of several views.
#[derive(Serialize)]
struct Summary {
    name: String,
    views: usize,
    converged: usize,
    rotation_deg: Statistics,
    translation: Statistics,
    translation_percent: Statistics,
    /// Translation in units of the source; where all instances were imported.
    translation_source: Option<Statistics>,
    /// Parts of the views with a rotation error of at most 5° and 10°.
    recall_5_deg: f64,
    recall_10_deg: f64,
    /// Rotation error of the start that came nearest to the truth, the winner or not: what a perfect choice would reach.
    oracle_deg: Statistics,
    seconds_per_view: f64,
}

#[derive(Clone, Copy, Serialize)]
struct Statistics {
    mean: f64,
    median: f64,
}

#[derive(Serialize)]
struct ViewReport {
    instance: String,
    view: String,
    error: PoseError,
    /// The error of the translation in units of the source, if the instance was imported.
    translation_source: Option<f64>,
    /// Errors of the start that came nearest in rotation.
    oracle: PoseError,
    start: usize,
    loss: f64,
    unexplained: f64,
    converged: bool,
    seconds: f64,
    /// Rows of the estimate.
    world_from_camera: [[f64; 4]; 4],
    /// The same in frame and units of the source, if the instance was imported.
    source_from_camera: Option<[[f64; 4]; 4]>,
}

/// Runs the command.
pub fn run(args: &Evaluate) -> Result<bool> {
    let model = load_model(&args.model)?;
    let mut instances = SrnSet::open(&args.data)?.instances;
    let found = instances.len();
    instances.retain(|files| model.instance(&files.name).is_ok());
    if instances.is_empty() {
        let known = model.metadata.instance_names.join(", ");
        return Err(format!("{}: none of its {found} instances is in the model, which knows {known}", args.data.display()).into());
    }
    if instances.len() < found {
        eprintln!("{} of {found} instances are not in the model and are left out", found - instances.len());
    }
    instances.truncate(args.instances as usize);
    for files in &mut instances {
        files.views = spread(std::mem::take(&mut files.views), args.views as usize);
    }
    let first = instances.iter().flat_map(|files| &files.views).find_map(|view| view.rgb.as_deref());
    let side = model_side(&model, first.unwrap_or(&args.data))?;
    let pictures = |files: &InstanceFiles| -> Result<Vec<(Picture, DMat4)>> {
        let instance = model.instance(&files.name)?;
        let picture = |view: srn_data::LoadedView| {
            let (truth, intrinsics) = camera(&view);
            let square = ([0; 2], side as usize);
            let (name, rgb) = (view.name, view.rgb);
            (Picture { name, instance, rgb, weights: None, intrinsics, truth: Some(truth), distance: None, square }, truth)
        };
        Ok(files.load(side as usize)?.views.into_iter().map(picture).collect())
    };
    let notation = args.poses.open()?;
    // All are read, and the starts known, before the first is searched for.
    let mut queries = Vec::new();
    for files in &instances {
        let (pictures, truths): (Vec<_>, Vec<_>) = pictures(files)?.into_iter().unzip();
        let starts = |(picture, truth)| args.search.starts(&args.starts, &model, picture, side, Some(truth), &notation);
        let starts = pictures.iter().zip(&truths).map(starts).collect::<Result<Vec<_>>>()?;
        queries.push((&files.name, args.poses.source(Some(&files.dir))?, pictures, truths, starts));
    }
    let files = ["results.json", "pictures.png"];
    if let Some(dir) = &args.out {
        refuse_existing(files.map(|file| dir.join(file)), args.force)?;
        create_dir(dir)?;
    }
    let options = args.search.options()?;
    let engine = args.engine.open()?;

    let steps: u64 = options.phases.iter().map(|phase| u64::from(phase.steps)).sum();
    let bar = progress(steps * instances.len() as u64, "steps");
    let mut results: Vec<(ViewReport, &Picture, Found)> = Vec::new();
    for (i, (name, source, pictures, truths, starts)) in queries.iter().enumerate() {
        bar.set_message(name.to_string());
        let found = args.search.run(&engine, &model, side, pictures, starts, |progress| {
            bar.set_position(i as u64 * steps + u64::from(progress.step));
            Ok(())
        })?;
        let reports = pictures.iter().zip(truths).zip(found);
        for ((picture, truth), found) in reports {
            let report = view_report(name, picture, truth, &found, notation.axes, source.as_ref());
            results.push((report, picture, found));
        }
    }
    bar.finish_and_clear();

    let sheet = args.out.as_ref().map(|_| pictures_sheet(&results, side));
    let views: Vec<ViewReport> = results.into_iter().map(|(report, ..)| report).collect();
    let of = |name: &str| Summary::of(name, &views.iter().filter(|view| view.instance == name).collect::<Vec<_>>());
    let report = Report {
        command: std::env::args().collect(),
        executor: engine.to_string(),
        convention: notation.axes,
        overall: Summary::of("all", &views.iter().collect::<Vec<_>>()),
        instances: instances.iter().map(|files| of(&files.name)).collect(),
        views,
    };
    let json = serde_json::to_string_pretty(&report)?;
    print(&if args.json { json.clone() } else { report.table() })?;
    if let (Some(dir), Some(sheet)) = (&args.out, sheet) {
        sigma_srn::write_atomically(&dir.join(files[0]), json.as_bytes())?;
        write_png(&dir.join(files[1]), &sheet)?;
        eprintln!("{} in {}", files.join(" and "), dir.display());
    }
    Ok(true)
}

/// `n` of the items, evenly spaced; the first among them.
fn spread<T>(items: Vec<T>, n: usize) -> Vec<T> {
    let (len, n) = (items.len(), n.min(items.len()));
    let chosen: Vec<usize> = (0..n).map(|k| k * len / n).collect();
    items.into_iter().enumerate().filter(|(i, _)| chosen.contains(i)).map(|(_, item)| item).collect()
}

fn view_report(
    instance: &str,
    picture: &Picture,
    truth: &DMat4,
    found: &Found,
    convention: Axes,
    source: Option<&Notation>,
) -> ViewReport {
    let errors = found.estimate.ranking.iter().map(|r| PoseError::of(&r.pose.to_matrix(), truth));
    let error = PoseError::of(&found.world_from_camera, truth);
    ViewReport {
        instance: instance.into(),
        view: picture.name.clone(),
        error,
        translation_source: source.map(|source| error.translation * source.unit()),
        oracle: errors.min_by(|a, b| a.rotation_deg.total_cmp(&b.rotation_deg)).unwrap_or(error),
        start: found.estimate.ranking[0].start,
        loss: found.estimate.loss,
        unexplained: found.unexplained,
        converged: found.converged,
        seconds: found.seconds,
        world_from_camera: convention.of_ours(found.world_from_camera).transpose().to_cols_array_2d(),
        source_from_camera: source.map(|source| source.rows(&found.world_from_camera)),
    }
}

/// Target, estimate and difference of every view, the largest rotation error first.
fn pictures_sheet(results: &[(ViewReport, &Picture, Found)], side: u32) -> image::RgbImage {
    let mut order: Vec<_> = results.iter().collect();
    order.sort_by(|a, b| b.0.error.rotation_deg.total_cmp(&a.0.error.rotation_deg));
    let mut cells = Vec::new();
    for (report, picture, found) in order {
        let views = [
            draw::view(&picture.rgb, side, SHOWN),
            draw::view(&found.rgb, side, SHOWN),
            draw::difference(&picture.rgb, &found.rgb, side, SHOWN),
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

impl Statistics {
    fn of(values: impl Iterator<Item = f64>) -> Self {
        let mut values: Vec<f64> = values.collect();
        values.sort_by(f64::total_cmp);
        let n = values.len();
        let median = 0.5 * (values[(n - 1) / 2] + values[n / 2]);
        Statistics { mean: values.iter().sum::<f64>() / n as f64, median }
    }
}

impl Summary {
    /// Of at least one view.
    fn of(name: &str, views: &[&ViewReport]) -> Self {
        let n = views.len() as f64;
        let in_source: Option<Vec<f64>> = views.iter().map(|view| view.translation_source).collect();
        let part = |limit: f64| views.iter().filter(|view| view.error.rotation_deg <= limit).count() as f64 / n;
        Summary {
            name: name.into(),
            views: views.len(),
            converged: views.iter().filter(|view| view.converged).count(),
            rotation_deg: Statistics::of(views.iter().map(|view| view.error.rotation_deg)),
            translation: Statistics::of(views.iter().map(|view| view.error.translation)),
            translation_percent: Statistics::of(views.iter().map(|view| view.error.translation_percent)),
            translation_source: in_source.map(|errors| Statistics::of(errors.into_iter())),
            recall_5_deg: part(5.0),
            recall_10_deg: part(10.0),
            oracle_deg: Statistics::of(views.iter().map(|view| view.oracle.rotation_deg)),
            seconds_per_view: views.iter().map(|view| view.seconds).sum::<f64>() / n,
        }
    }
}

impl Report {
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
            ("converged", Box::new(|s| s.converged.to_string())),
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
        let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
        let widths: Vec<usize> = (0..columns.len()).map(width).collect();
        let line = |row: &Vec<String>| {
            let cells: Vec<_> = row.iter().zip(&widths).map(|(cell, width)| format!(" {cell:>width$} ")).collect();
            format!("|{}|", cells.join("|"))
        };
        let mut lines: Vec<_> = rows.iter().map(line).collect();
        let rule: Vec<_> = widths.iter().map(|width| "-".repeat(width + 1) + ":").collect();
        lines.insert(1, format!("|{}|", rule.join("|")));
        lines.join("\n")
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
    fn views_are_spread_evenly() {
        assert_eq!(spread((0..20).collect(), 4), [0, 5, 10, 15]);
        assert_eq!(spread((0..3).collect(), 10), [0, 1, 2]);
        assert_eq!(spread((0..7).collect(), 3), [0, 2, 4]);
        assert!(spread(Vec::<u8>::new(), 3).is_empty());
    }

    #[test]
    fn three_digits_count() {
        assert_eq!([0.009_123, 9.123, 912.3, 0.0].map(significant), ["0.00912", "9.12", "912", "0"]);
    }

    #[test]
    fn statistics_of_odd_and_even_counts() {
        let of = |values: &[f64]| Statistics::of(values.iter().copied());
        assert_eq!((of(&[3.0, 1.0, 8.0]).mean, of(&[3.0, 1.0, 8.0]).median), (4.0, 3.0));
        assert_eq!(of(&[4.0, 1.0, 2.0, 9.0]).median, 3.0);
    }
}
