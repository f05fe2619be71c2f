//! `sigma-pose evaluate --tables`: the paper's tables and its figure of convergence, for any model and data.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::Instant;

use sigma_srn::{Engine, Found, Loss, Model};
use srn_data::camera::Axes;
use srn_data::sheet::{self, CURVES, Curve};

use super::evaluate::{Evaluate, ViewReport, pictures_sheet, view_report};
use super::files::Picture;
use super::heldout::Heldout;
use super::notation::Notation;
use super::search::{LOSSES, On, PoseError, Preset, SearchArgs, Starts};
use super::summary::{Statistics, Summary, markdown};
use super::symmetry::Symmetries;
use super::views::{self, Views};
use crate::common::{Result, create_dir, load_model, refuse_existing, write_picture};
use crate::progress;
use crate::train::adapt::Fit;

/// Files that are written.
const FILES: [&str; 5] = ["tables.md", "views.csv", "convergence.csv", "convergence.png", "worst.png"];
/// The paper's.
const PAPER_STARTS: [Starts; 2] = [Starts::Neighbor4, Starts::Fixed24];
/// In the order of the tables.
const STARTS: [Starts; 3] = [Starts::Neighbor4, Starts::Fixed24, Starts::Around84];
/// Of a range, the part by which steps cover it most evenly, however many they are.
const GOLDEN: f64 = 0.618_033_988_749_894_9;
/// Searches on the page of the worst.
const WORST: usize = 24;

/// What a table's line tells about.
#[derive(Clone)]
struct Setting {
    table: u32,
    /// None: one-shot.
    preset: Option<Preset>,
    /// Of the paper's preset.
    loss: Option<(&'static str, Loss)>,
    starts: Starts,
}

impl Setting {
    fn preset(&self) -> &'static str {
        match self.preset {
            Some(Preset::Default) => "default",
            Some(Preset::Paper) => "paper",
            None => "one-shot",
        }
    }

    fn loss(&self) -> &'static str {
        self.loss.map_or("charbonnier", |(name, _)| name)
    }
}

/// Poses that were the best so far, at one evaluation: over all views.
#[derive(Default)]
struct Moment {
    step: u32,
    /// Since the search began, for one view.
    seconds: f64,
    errors: Vec<f64>,
}

/// All searches of a setting.
struct Outcome {
    setting: Setting,
    views: Vec<ViewReport>,
    moments: Vec<Moment>,
}

/// Everything that the searches share.
struct Bench<'a> {
    args: &'a Evaluate,
    engine: Engine,
    dir: &'a Path,
    /// Of the instances, held out or not.
    symmetries: Vec<(bool, String, Symmetries)>,
    outcomes: Vec<Outcome>,
}

/// Measures, and writes the folder.
pub fn write(args: &Evaluate, dir: &Path) -> Result<bool> {
    let model = load_model(&args.model)?;
    let (side, asked) = views::open(&model, &args.data, args.instances, args.views)?;
    args.search.with(Preset::Default, None)?;
    let heldout = args.heldout.as_ref().map(|heldout| Heldout::open(heldout, side, args.instances)).transpose()?;
    let paths = FILES.map(|file| dir.join(file));
    refuse_existing(paths.clone(), args.force)?;
    create_dir(dir)?;

    let mut bench = Bench { args, engine: args.search.open(&args.engine)?, dir, symmetries: vec![], outcomes: vec![] };
    let mae = LOSSES[0];
    let setting = |table, preset, starts: &Starts| Setting {
        table,
        preset: Some(preset),
        loss: (preset == Preset::Paper).then_some(mae),
        starts: starts.clone(),
    };
    // A search costs as many descents as it has starts, four or twenty-four: every line about as many minutes.
    let few = |asked: &[Views], starts: &Starts| match starts {
        Starts::Fixed24 => few(asked, args.paper_views.map(|count| count.div_ceil(6))),
        _ => few(asked, args.paper_views),
    };
    let mut worst = Vec::new();
    for starts in STARTS {
        worst.extend(bench.search(&model, side, &asked, setting(1, Preset::Default, &starts))?);
    }
    // Each view once, from where it came out worst.
    worst.sort_by(|(a, ..), (b, ..)| b.error.rotation_deg.total_cmp(&a.error.rotation_deg));
    let mut shown = BTreeSet::new();
    worst.retain(|(report, ..)| shown.insert((report.instance.clone(), report.view.clone())));
    let pictures: Vec<(ViewReport, &Picture, Found)> =
        worst.iter().map(|(report, picture, found)| (report.clone(), picture, found.clone())).collect();
    write_picture(&paths[4], &pictures_sheet(&pictures, side, WORST))?;
    let adapted = |heldout: &Heldout| -> Result<_> {
        let by = |fit: Fit| heldout.adapt(&bench.engine, &model, &fit);
        // The paper fits codes alone.
        Ok((by(Fit::default())?, by(Fit::default().of_codes())?, heldout.others(args.views)))
    };
    let unknown = heldout.as_ref().map(adapted).transpose()?;
    if let Some((ours, _, unseen)) = &unknown {
        for starts in STARTS {
            bench.search(ours, side, unseen, setting(2, Preset::Default, &starts))?;
        }
        let one_shot = Setting { preset: None, ..setting(2, Preset::Default, &Starts::Around84) };
        bench.search(&model, side, &few(unseen, &Starts::Neighbor4), one_shot)?;
    }
    // The paper's preset takes longest: table after table, so that a run that is stopped has whole ones.
    for starts in PAPER_STARTS {
        bench.search(&model, side, &few(&asked, &starts), setting(1, Preset::Paper, &starts))?;
    }
    if let Some((_, paper, unseen)) = &unknown {
        for starts in PAPER_STARTS {
            bench.search(paper, side, &few(unseen, &starts), setting(2, Preset::Paper, &starts))?;
        }
    }
    for loss in LOSSES.into_iter().filter(|loss| *loss != mae) {
        let setting = Setting { loss: Some(loss), ..setting(3, Preset::Paper, &Starts::Neighbor4) };
        bench.search(&model, side, &few(&asked, &Starts::Neighbor4), setting)?;
    }
    eprintln!("{} in {}", FILES.join(", "), dir.display());
    Ok(true)
}

/// A line of a table.
fn row(preset: &str, setting: &Setting, views: &[&ViewReport]) -> Vec<String> {
    let s = Summary::of("", views);
    let interval = |[low, high]: [f64; 2], digits: usize| format!("{low:.digits$} to {high:.digits$}");
    vec![
        preset.into(),
        setting.loss().into(),
        setting.starts.to_string(),
        s.views.to_string(),
        format!("{:.2}°", s.rotation_deg.mean),
        interval(s.rotation_deg.mean_95, 2),
        format!("{:.2}°", s.rotation_deg.median),
        format!("{:.2}", s.recall_5_deg),
        format!("{:.2}", s.recall_10_deg),
        format!("{:.2}°", s.oracle_deg.mean),
        format!("{:.3}", s.translation.mean),
        interval(s.translation.mean_95, 3),
        format!("{:.3}", s.translation.median),
        format!("{:.2}", s.seconds_per_view),
    ]
}

/// Searches for views of objects that the model does not know, each for itself.
fn one_shot(on: On, asked: &[Views], search: &SearchArgs, starts: &Starts) -> Result<Vec<Vec<Found>>> {
    let bar = progress::bar(asked.iter().map(|views| views.pictures.len() as u64).sum(), "views");
    let mut all = Vec::new();
    for Views { name, pictures, truths, .. } in asked {
        bar.set_message(name.clone());
        let mut found = Vec::new();
        for (picture, truth) in pictures.iter().zip(truths) {
            let starts = search.starts(starts, on.model, &picture.shot, Some(truth), &Notation::default())?;
            found.push(search.run_unseen(on, picture, &starts, |_, _| Ok(()))?.0);
            bar.inc(1);
        }
        all.push(found);
    }
    bar.finish_and_clear();
    Ok(all)
}

/// As many of the views: one of each instance before the second of any. Views are often in the order in which a camera went about
/// the object, so those of neighbouring instances are steps of the golden section apart.
fn few(asked: &[Views], count: Option<u32>) -> Vec<Views> {
    let count = count.map_or(usize::MAX, |count| count as usize);
    let mut order: Vec<(usize, usize)> = Vec::new();
    let longest = asked.iter().map(|views| views.pictures.len()).max().unwrap_or(0);
    for round in 0..longest {
        for (i, views) in asked.iter().enumerate().filter(|(_, views)| round < views.pictures.len()) {
            let count = views.pictures.len();
            let first = ((i as f64 * GOLDEN).fract() * count as f64) as usize;
            order.push((i, (first + round) % count));
        }
    }
    order.truncate(count);
    let chosen = asked.iter().enumerate().map(|(i, views)| {
        let own = |k: &usize| order.contains(&(i, *k));
        let of = (0..views.pictures.len()).filter(own);
        let (pictures, truths) = of.map(|k| (views.pictures[k].clone(), views.truths[k])).unzip();
        Views { name: views.name.clone(), dir: views.dir.clone(), pictures, truths }
    });
    chosen.filter(|views| !views.pictures.is_empty()).collect()
}

impl Bench<'_> {
    /// Searches with a setting, and writes all files anew: hours of work are not lost with the last of them.
    fn search(
        &mut self,
        model: &Model,
        side: u32,
        asked: &[Views],
        setting: Setting,
    ) -> Result<Vec<(ViewReport, Picture, Found)>> {
        let preset = setting.preset.unwrap_or(Preset::Default);
        let search: SearchArgs = self.args.search.with(preset, setting.loss.map(|(_, loss)| loss))?;
        let on = On { engine: &self.engine, model, side };
        let notation = Notation::default();
        let mut symmetries = Vec::new();
        for views in asked {
            // Found once: the same for all presets. Of an unknown object the model can show no views.
            let is_it = |known: &&(bool, String, Symmetries)| (known.0, &known.1) == (setting.table == 2, &views.name);
            symmetries.push(match self.symmetries.iter().find(is_it) {
                _ if setting.preset.is_none() => Symmetries::none(),
                Some((.., symmetries)) => symmetries.clone(),
                None => {
                    let found = Symmetries::of(on, views, self.args.symmetries)?;
                    self.symmetries.push((setting.table == 2, views.name.clone(), found.clone()));
                    found
                }
            });
        }
        let mut moments = Vec::<Moment>::new();
        let found = if setting.preset.is_none() {
            one_shot(on, asked, &search, &setting.starts)?
        } else {
            // Each search begins when the one before has ended: before its first evaluation.
            let (mut last, mut began) = (Instant::now(), Instant::now());
            // Of each instance's search: how many moments it has had, and errors and seconds at the last of them.
            let mut ways: Vec<_> = asked.iter().map(|views| (0, vec![f64::NAN; views.truths.len()], 0.0)).collect();
            let found = views::search(asked, on, &search, &setting.starts, &notation, |i, progress| {
                // The figure is one of single searches.
                if progress.search > 0 {
                    last = Instant::now();
                    return Ok(());
                }
                let (number, errors, seconds) = &mut ways[i];
                if *number == 0 {
                    began = last;
                }
                let standing = progress.descent.standing()?;
                if moments.len() == *number {
                    moments.push(Moment { step: progress.step, ..Moment::default() });
                }
                for (query, (truth, error)) in asked[i].truths.iter().zip(&mut *errors).enumerate() {
                    let own = standing.iter().zip(progress.hypotheses).filter(|(_, name)| name.0 == query);
                    // None where the last phase begins anew for others.
                    if let Some(((_, pose), _)) = own.min_by(|(a, _), (b, _)| a.0.total_cmp(&b.0)) {
                        let pose = pose.to_matrix();
                        *error = PoseError::of(&pose, &symmetries[i].nearest(truth, &pose)).rotation_deg;
                    }
                }
                last = Instant::now();
                *seconds = last.duration_since(began).as_secs_f64();
                moments[*number].errors.extend(&*errors);
                moments[*number].seconds += *seconds;
                *number += 1;
                Ok(())
            })?;
            // Whose search has ended stays where it is.
            for (number, errors, seconds) in &ways {
                for moment in &mut moments[*number..] {
                    moment.errors.extend(errors);
                    moment.seconds += seconds;
                }
            }
            found
        };
        let mut results = Vec::new();
        for ((Views { name, pictures, truths, .. }, symmetries), found) in asked.iter().zip(&symmetries).zip(found) {
            for ((picture, truth), found) in pictures.iter().zip(truths).zip(found) {
                let report = view_report(model, name, picture, (truth, symmetries), &found, Axes::OpenCv, None);
                results.push((report, picture.clone(), found));
            }
        }
        moments.iter_mut().for_each(|moment| moment.seconds /= moment.errors.len() as f64);
        let views: Vec<ViewReport> = results.iter().map(|(report, ..)| report.clone()).collect();
        let summary = Summary::of("", &views.iter().collect::<Vec<_>>());
        eprintln!(
            "table {}: {}, {}, {}: {} views, {:.2}° mean, {:.2}° median, {:.1} s a view",
            setting.table,
            setting.preset(),
            setting.loss(),
            setting.starts,
            views.len(),
            summary.rotation_deg.mean,
            summary.rotation_deg.median,
            summary.seconds_per_view
        );
        self.outcomes.push(Outcome { setting, views, moments });
        self.write_files()?;
        Ok(results)
    }

    fn write_files(&self) -> Result<()> {
        let write = |file: &str, text: String| sigma_srn::write_atomically(&self.dir.join(file), text.as_bytes());
        write(FILES[0], self.tables())?;
        let mut rows =
            "table,preset,loss,starts,instance,view,rotation_deg,translation,oracle_deg,unexplained,trusted,within_95,seconds\n"
                .to_string();
        let mut curves = "preset,loss,starts,step,seconds,rotation_deg_mean,rotation_deg_median\n".to_string();
        for Outcome { setting, views, moments } in &self.outcomes {
            let what = format!("{},{},{}", setting.preset(), setting.loss(), setting.starts);
            for ViewReport { instance, view, error, oracle, unexplained, trusted, within_95, seconds, .. } in views {
                let (rotation, translation, oracle) = (error.rotation_deg, error.translation, oracle.rotation_deg);
                let within_95 = within_95.map_or(String::new(), |within| within.to_string());
                let numbers = format!("{rotation},{translation},{oracle},{unexplained},{trusted},{within_95},{seconds}");
                rows += &format!("{},{what},{instance},{view},{numbers}\n", setting.table);
            }
            for moment in moments.iter().filter(|_| setting.table != 2) {
                let Statistics { mean, median, .. } = Statistics::of(moment.errors.iter().copied());
                curves += &format!("{what},{},{},{mean},{median}\n", moment.step, moment.seconds);
            }
        }
        write(FILES[1], rows)?;
        write(FILES[2], curves)?;
        write_picture(&self.dir.join(FILES[3]), &self.convergence())
    }

    /// The tables in Markdown.
    fn tables(&self) -> String {
        let titles = [
            "Table 1: unseen views of known objects",
            "Table 2: objects that the model was not trained on, fitted to two views (paper: codes alone), or with the pose to one",
            "Table 3: losses, from `neighbor4`",
        ];
        let command: Vec<String> = std::env::args().skip(1).collect();
        let mut text = format!("`sigma-pose {}`, {}.\n", command.join(" "), self.engine);
        for (number, title) in (1..).zip(titles) {
            let is_in = |setting: &Setting| {
                // The lines of `neighbor4` with the presets' own losses are in two tables.
                let shared = setting.table != 2 && setting.starts == Starts::Neighbor4;
                setting.table == number || shared && (number == 3 || number == 1 && setting.loss() == "mae")
            };
            let mut outcomes: Vec<&Outcome> = self.outcomes.iter().filter(|outcome| is_in(&outcome.setting)).collect();
            if outcomes.is_empty() {
                continue;
            }
            let order = |starts: &Starts| STARTS.iter().position(|known| known == starts);
            outcomes.sort_by_key(|outcome| (order(&outcome.setting.starts), outcome.setting.preset()));
            let head =
                "preset,loss,starts,views,rotation mean,95 %,median,<= 5°,<= 10°,oracle mean,translation mean,95 %,median,s/view";
            let mut rows: Vec<Vec<String>> = vec![head.split(',').map(String::from).collect()];
            for Outcome { setting, views, .. } in &outcomes {
                rows.push(row(setting.preset(), setting, &views.iter().collect::<Vec<_>>()));
                // Ours on the views that the paper's preset was given, where those are fewer.
                let same =
                    |other: &&&Outcome| (other.setting.preset, &other.setting.starts) == (Some(Preset::Default), &setting.starts);
                if let (Some(Preset::Paper), Some(ours)) = (setting.preset, outcomes.iter().find(same)) {
                    let is_there = |view: &&ViewReport| {
                        views.iter().any(|other| (&other.instance, &other.view) == (&view.instance, &view.view))
                    };
                    let there: Vec<&ViewReport> = ours.views.iter().filter(is_there).collect();
                    let row = row("default, same views", &ours.setting, &there);
                    // Once for all losses.
                    if there.len() < ours.views.len() && !rows.contains(&row) {
                        rows.push(row);
                    }
                }
            }
            text += &format!("\n{title}\n\n{}\n", markdown(&rows));
        }
        text
    }

    /// Median of the rotation error against steps, and against seconds.
    fn convergence(&self) -> image::RgbImage {
        let is_drawn = |setting: &Setting| setting.table != 2 && ["charbonnier", "mae"].contains(&setting.loss());
        let outcomes: Vec<&Outcome> = self.outcomes.iter().filter(|outcome| is_drawn(&outcome.setting)).collect();
        let plot = |title: &str, x: &dyn Fn(&Moment) -> f64, log_x: bool| {
            let points = |outcome: &&Outcome| -> Vec<(f64, f64)> {
                let median = |moment: &Moment| Statistics::of(moment.errors.iter().copied()).median;
                outcome.moments.iter().map(|moment| (x(moment), median(moment))).collect()
            };
            let lines: Vec<_> = outcomes.iter().map(points).collect();
            let labels: Vec<String> =
                outcomes.iter().map(|outcome| format!("{} {}", outcome.setting.preset(), outcome.setting.starts)).collect();
            let curve = |(k, points): (usize, _)| Curve { label: labels[k].as_str(), points, colour: CURVES[k % CURVES.len()] };
            let curves: Vec<Curve> = lines.iter().map(Vec::as_slice).enumerate().map(curve).collect();
            sheet::plot_curve(title, &curves, [800, 400], [log_x, true])
        };
        let by_step = plot("median rotation error in degrees, against steps", &|moment| moment.step.into(), false);
        let by_time = plot("the same against seconds a view", &|moment| moment.seconds, true);
        sheet::grid(&[(&by_step, ""), (&by_time, "")], 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat4;
    use sigma_srn::Intrinsics;
    use sigma_srn::photo::Shot;

    #[test]
    fn few_views_come_from_all_instances_and_places() {
        let intrinsics = Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, pixel_center: 0.0 };
        let shot = Shot::whole(vec![], intrinsics, 0, 1);
        let picture = |name: usize| Picture { name: name.to_string(), truth: None, shot: shot.clone() };
        let views = |name: &str| Views {
            name: name.into(),
            dir: name.into(),
            pictures: (0..3).map(picture).collect(),
            truths: vec![DMat4::IDENTITY; 3],
        };
        let asked = [views("a"), views("b")];
        let names = |count| -> Vec<String> {
            let of = |views: &Views| views.pictures.iter().map(|p| format!("{}{}", views.name, p.name)).collect::<Vec<_>>();
            few(&asked, count).iter().flat_map(of).collect()
        };
        assert_eq!(names(Some(1)), ["a0"]);
        assert_eq!(names(Some(3)), ["a0", "a1", "b1"]);
        assert_eq!(names(None).len(), 6);
    }
}
