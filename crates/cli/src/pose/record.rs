//! What a person wants to see of a search: the way of the winning start, and the losses of all.

use std::path::Path;

use glam::DMat4;
use image::RgbImage;
use sigma_srn::{Engine, Error, Model, Pose6, Progress};
use srn_data::sheet::{self, BLACK, CURVES, Colour, Curve};

use super::draw;
use super::files::{Picture, write_gif, write_png};
use super::search::{Found, PoseError, render};
use crate::common::Result;

/// Side of a view on the pages, pixels.
const SHOWN: u32 = 192;
/// Between the views.
const GAP: u32 = 12;
/// Curves of the starts that did not win.
const FAINT: Colour = [205, 208, 214];
/// Frames of an animation, without the last one's stay.
const FRAMES: usize = 40;

/// Poses and losses of all hypotheses at one evaluation.
struct Moment {
    step: u32,
    hypotheses: Vec<(usize, usize)>,
    losses: Vec<f64>,
    poses: Vec<Pose6>,
}

/// The history of a search over a batch of pictures.
#[derive(Default)]
pub struct Log(Vec<Moment>);

/// One start at one evaluation.
#[derive(Clone, Copy)]
struct Point {
    step: u32,
    loss: f64,
    world_from_camera: DMat4,
}

impl Log {
    /// Notes where all hypotheses are.
    pub fn note(&mut self, progress: &mut Progress) -> std::result::Result<(), Error> {
        let (losses, poses) = (progress.descent.losses()?, progress.descent.poses()?);
        self.0.push(Moment { step: progress.step, hypotheses: progress.hypotheses.to_vec(), losses, poses });
        Ok(())
    }

    /// The way of a start of a picture.
    fn path(&self, picture: usize, start: usize) -> Vec<Point> {
        let point = |moment: &Moment| {
            let i = moment.hypotheses.iter().position(|&name| name == (picture, start))?;
            Some(Point { step: moment.step, loss: moment.losses[i], world_from_camera: moment.poses[i].to_matrix() })
        };
        self.0.iter().filter_map(point).collect()
    }

    /// Writes `NAME.png` and `NAME.gif` of picture number `index` to `dir`.
    pub fn write(
        &self,
        dir: &Path,
        index: usize,
        picture: &Picture,
        found: &Found,
        engine: &Engine,
        model: &Model,
        side: u32,
    ) -> Result<()> {
        let winner = found.estimate.ranking[0].start;
        let mut path = self.path(index, winner);
        let last = path.last().map_or(0, |point| point.step);
        path.push(Point { step: last, loss: found.estimate.loss, world_from_camera: found.world_from_camera });
        let chosen = frames(&path);
        let views: Vec<_> = chosen.iter().map(|&i| (picture.instance, path[i].world_from_camera, picture.intrinsics)).collect();
        let renders = render(engine, model, side, &views)?;
        let page = Page { log: self, index, picture, found, side, path: &path, chosen: &chosen };
        let rgb: Vec<&[f32]> = renders.iter().map(|render| &render.rgb[..]).collect();
        write_png(&dir.join(&picture.name).with_extension("png"), &page.sheet(&rgb))?;
        write_gif(&dir.join(&picture.name).with_extension("gif"), page.animation(&rgb))
    }
}

/// Points of a path between which the camera moves about equally far, the first and the last among them.
fn frames(path: &[Point]) -> Vec<usize> {
    let mut moved = vec![0.0];
    for pair in path.windows(2) {
        let error = PoseError::of(&pair[1].world_from_camera, &pair[0].world_from_camera);
        moved.push(moved[moved.len() - 1] + error.rotation_deg.to_radians() + error.translation);
    }
    let total = moved[moved.len() - 1];
    let at = |k: usize| moved.partition_point(|&m| m < total * k as f64 / (FRAMES - 1) as f64).min(path.len() - 1);
    let mut chosen: Vec<usize> = (0..FRAMES - 1).map(at).chain([path.len() - 1]).collect();
    chosen.dedup();
    chosen
}

/// All that is drawn of one picture.
struct Page<'a> {
    log: &'a Log,
    index: usize,
    picture: &'a Picture,
    found: &'a Found,
    side: u32,
    path: &'a [Point],
    /// Numbers of the points that are rendered.
    chosen: &'a [usize],
}

impl Page<'_> {
    /// Target, start, two steps, estimate and difference above the curves of all losses. `renders`: of the chosen points.
    fn sheet(&self, renders: &[&[f32]]) -> RgbImage {
        let target = &self.picture.rgb[..];
        let last = renders.len() - 1;
        let start = self.found.estimate.ranking[0].start;
        let mut panels = vec![
            ("TARGET".to_string(), draw::view(target, self.side, SHOWN), vec!["the given picture".to_string()]),
            (format!("START {start}"), draw::view(renders[0], self.side, SHOWN), self.captions(0)),
        ];
        for part in [1, 2] {
            let k = last * part / 3;
            panels.push((
                format!("STEP {}", self.path[self.chosen[k]].step),
                draw::view(renders[k], self.side, SHOWN),
                self.captions(k),
            ));
        }
        panels.push(("ESTIMATE".into(), draw::view(renders[last], self.side, SHOWN), self.captions(last)));
        let left = format!("{:.0} % unexplained", 100.0 * self.found.unexplained);
        let difference = draw::difference(target, renders[last], self.side, SHOWN);
        panels.push(("DIFFERENCE".into(), difference, vec!["white: none, black: large".into(), left]));

        let shown = panels[0].1.width();
        let width = GAP + panels.len() as u32 * (shown + GAP);
        let [top, below] = [86, 86 + shown + 6];
        let mut page = sheet::blank(width, below + 40 + 300);
        self.headline(&mut page, 2);
        for (k, (heading, view, captions)) in panels.iter().enumerate() {
            let x = (GAP + k as u32 * (shown + GAP)) as i32;
            sheet::title(&mut page, x, top as i32 - 22, heading, 2, BLACK);
            image::imageops::replace(&mut page, view, x.into(), top.into());
            for (line, caption) in captions.iter().enumerate() {
                sheet::text(&mut page, x, below as i32 + 12 * line as i32, caption, BLACK);
            }
        }
        let plot = self.losses([width - 2 * GAP, 300], u32::MAX);
        image::imageops::replace(&mut page, &plot, GAP.into(), (below + 40).into());
        page
    }

    /// Target, render and their difference, over the loss so far.
    fn animation(&self, renders: &[&[f32]]) -> Vec<(RgbImage, f64)> {
        let last = renders.len() - 1;
        let frame = |k: usize| {
            let point = &self.path[self.chosen[k]];
            let views = [
                ("TARGET".to_string(), draw::view(&self.picture.rgb, self.side, SHOWN)),
                (format!("STEP {}", point.step), draw::view(renders[k], self.side, SHOWN)),
                ("DIFFERENCE".into(), draw::difference(&self.picture.rgb, renders[k], self.side, SHOWN)),
            ];
            let shown = views[0].1.width();
            let width = GAP + 3 * (shown + GAP);
            let top = 68;
            let mut page = sheet::blank(width, top + shown + 22 + 140);
            self.headline(&mut page, 1);
            for (i, (heading, view)) in views.iter().enumerate() {
                let x = GAP + i as u32 * (shown + GAP);
                sheet::title(&mut page, x as i32, top as i32 - 22, heading, 2, BLACK);
                image::imageops::replace(&mut page, view, x.into(), top.into());
            }
            let caption = self.captions(k).join(", ");
            sheet::text(&mut page, (GAP + shown + GAP) as i32, (top + shown + 6) as i32, &caption, BLACK);
            let plot = self.losses([width - 2 * GAP, 140], point.step);
            image::imageops::replace(&mut page, &plot, GAP.into(), (top + shown + 22).into());
            (page, if k == 0 || k == last { 2.0 } else { 0.1 })
        };
        (0..renders.len()).map(frame).collect()
    }

    fn headline(&self, page: &mut RgbImage, scale: u32) {
        let verdict = if self.found.converged { "pose found" } else { "not converged" };
        sheet::title(page, GAP as i32, 12, &format!("{}: {verdict}", self.picture.name), scale, BLACK);
        let starts = self.found.estimate.ranking.len();
        let mut line = format!("start {} of {starts}", self.found.estimate.ranking[0].start);
        if let Some(truth) = &self.picture.truth {
            line += &format!(", {}", off(&PoseError::of(&self.found.world_from_camera, truth)));
        }
        sheet::text(page, GAP as i32, 12 + 8 * scale as i32 + 6, &line, BLACK);
    }

    /// Loss, and error if the truth is known, of a chosen point.
    fn captions(&self, k: usize) -> Vec<String> {
        let point = &self.path[self.chosen[k]];
        let error = self.picture.truth.map(|truth| off(&PoseError::of(&point.world_from_camera, &truth)));
        [Some(format!("loss {:.4}", point.loss)), error].into_iter().flatten().collect()
    }

    /// Losses of all starts, the winner's strong up to `step`.
    fn losses(&self, size: [u32; 2], step: u32) -> RgbImage {
        let ranking = &self.found.estimate.ranking;
        let points = |path: &[Point], until: u32| -> Vec<_> {
            path.iter().filter(|point| point.step <= until).map(|point| (f64::from(point.step), point.loss)).collect()
        };
        let mut paths: Vec<_> = ranking.iter().map(|r| points(&self.log.path(self.index, r.start), u32::MAX)).collect();
        // The winner is drawn last, over the others.
        paths.reverse();
        paths.push(points(self.path, step));
        let curves: Vec<_> = paths
            .iter()
            .enumerate()
            .map(|(i, points)| match i {
                _ if i + 1 == paths.len() => Curve { label: "this start", points, colour: CURVES[0] },
                0 if ranking.len() > 1 => Curve { label: "other starts", points, colour: FAINT },
                _ => Curve { label: "", points, colour: FAINT },
            })
            .collect();
        sheet::plot_curve("loss after each step", &curves, size, true)
    }
}

fn off(error: &PoseError) -> String {
    format!("{:.1}° and {:.3} off", error.rotation_deg, error.translation)
}
