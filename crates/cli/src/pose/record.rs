//! What a person wants to see of a search: the way of the winning start, and the losses of all.

use std::path::Path;

use glam::DMat4;
use image::RgbImage;
use sigma_srn::{Error, Found, Pose6, Progress};
use srn_data::sheet::{self, BLACK, CURVES, Colour, Curve};

use super::draw;
use super::files::{Picture, write_gif};
use super::mask::MadeRight;
use super::search::{On, PoseError, render};
use crate::common::{Result, write_picture};

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
    /// See [`Progress::search`].
    search: usize,
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
        let (losses, poses) = progress.descent.standing()?.into_iter().unzip();
        self.0.push(Moment {
            search: progress.search,
            step: progress.step,
            hypotheses: progress.hypotheses.to_vec(),
            losses,
            poses,
        });
        Ok(())
    }

    /// The way of a start of a picture, in the search that has found its pose. Steps count from where that begins with the picture.
    fn path(&self, picture: usize, start: usize, found: &Found) -> Vec<Point> {
        let search = || self.0.iter().filter(|moment| moment.search + 1 == found.searches);
        let is_of = |moment: &&Moment| moment.hypotheses.iter().any(|&(of, _)| of == picture);
        let first = search().find(is_of).map_or(0, |moment| moment.step);
        let point = |moment: &Moment| {
            let i = moment.hypotheses.iter().position(|&name| name == (picture, start))?;
            Some(Point { step: moment.step - first, loss: moment.losses[i], world_from_camera: moment.poses[i].to_matrix() })
        };
        search().filter_map(point).collect()
    }

    /// Writes `NAME.png` and `NAME.gif` of picture number `index` to `dir`.
    pub fn write(&self, dir: &Path, index: usize, picture: &Picture, found: &Found, on: On) -> Result<()> {
        let winner = found.estimate.ranking[0].start;
        let mut path = self.path(index, winner, found);
        let last = path.last().map_or(0, |point| point.step);
        path.push(Point { step: last, loss: found.estimate.loss, world_from_camera: found.world_from_camera });
        let chosen = frames(&path);
        let views: Vec<_> =
            chosen.iter().map(|&i| (picture.shot.instance, path[i].world_from_camera, picture.shot.intrinsics)).collect();
        let renders = render(on, &views)?;
        let page = Page { log: self, index, picture, found, side: on.side, path: &path, chosen: &chosen };
        let rgb: Vec<&[f32]> = renders.iter().map(|render| &render.rgb[..]).collect();
        write_picture(&dir.join(format!("{}.png", picture.name)), &page.sheet(&rgb))?;
        write_gif(&dir.join(format!("{}.gif", picture.name)), page.animation(&rgb))
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

/// A view with its heading, and the lines below it.
struct Panel {
    heading: String,
    view: RgbImage,
    captions: Vec<String>,
}

impl Page<'_> {
    /// Target, start, two steps, estimate and difference above the curves of all losses. `renders`: of the chosen points.
    fn sheet(&self, renders: &[&[f32]]) -> RgbImage {
        let last = renders.len() - 1;
        let step = |k: usize| format!("STEP {}", self.path[self.chosen[k]].step);
        let start = format!("START {}", self.found.estimate.ranking[0].start);
        let headings = [(start, 0), (step(last / 3), last / 3), (step(last * 2 / 3), last * 2 / 3), ("ESTIMATE".into(), last)];
        let mut panels = vec![self.target()];
        panels.extend(headings.map(|(heading, k)| self.step(heading, renders[k], k)));
        panels.push(self.difference(renders[last]));
        panels[5].captions.push(format!("{:.0} % unexplained", 100.0 * self.found.unexplained));
        panels[5].captions.extend(self.found.estimate.light.map(|_| "the light made up for".into()));
        self.page(&panels, 2, 300, u32::MAX)
    }

    /// Target, render and their difference, over the loss so far; with the seconds that each frame stays.
    fn animation(&self, renders: &[&[f32]]) -> Vec<(RgbImage, f64)> {
        let frame = |(k, render): (usize, &&[f32])| {
            let step = self.path[self.chosen[k]].step;
            let panels = [self.target(), self.step(format!("STEP {step}"), render, k), self.difference(render)];
            (self.page(&panels, 1, 140, step), if k == 0 || k + 1 == renders.len() { 2.0 } else { 0.1 })
        };
        renders.iter().enumerate().map(frame).collect()
    }

    fn target(&self) -> Panel {
        let rgb = self.counted(&self.picture.shot.rgb, [-0.2, -0.2, 0.2]);
        let mut captions = vec!["the picture given".into()];
        captions.extend(self.found.estimate.weights.as_ref().map(|_| "blue-grey: not counted".into()));
        captions.extend(MadeRight::of(&self.found.estimate, self.picture.shot.pixels_of_photo()).captions());
        Panel { heading: "TARGET".into(), view: draw::view(&rgb, self.side, SHOWN), captions }
    }

    /// Colours, `instead` where pixels do not count.
    fn counted(&self, rgb: &[f32], instead: [f32; 3]) -> Vec<f32> {
        let weight = |pixel: usize| self.found.estimate.weights.as_ref().map_or(1.0, |weights| weights[pixel]);
        let mix = |(value, &colour): (usize, &f32)| weight(value / 3) * colour + (1.0 - weight(value / 3)) * instead[value % 3];
        rgb.iter().enumerate().map(mix).collect()
    }

    fn step(&self, heading: String, render: &[f32], k: usize) -> Panel {
        Panel { heading, view: draw::view(render, self.side, SHOWN), captions: self.captions(k) }
    }

    fn difference(&self, render: &[f32]) -> Panel {
        let [picture, render] = [&self.found.estimate.target, render].map(|rgb| self.counted(rgb, [1.0; 3]));
        let view = draw::difference(&picture, &render, self.side, SHOWN);
        Panel { heading: "DIFFERENCE".into(), view, captions: vec!["white: none, black: much".into()] }
    }

    /// Headline, panels, and the losses with the winner's up to `step`.
    fn page(&self, panels: &[Panel], scale: u32, plot_height: u32, step: u32) -> RgbImage {
        let shown = panels[0].view.width();
        let width = GAP + panels.len() as u32 * (shown + GAP);
        let top = 52 + 16 * scale;
        let below = top + shown + 6;
        let mut page = sheet::blank(width, below + 36 + plot_height);
        let verdict = self.found.doubt.map_or("pose found".into(), |doubt| format!("not to be trusted: {doubt}"));
        sheet::title(&mut page, GAP as i32, 12, &format!("{}: {verdict}", self.picture.name), scale, BLACK);
        let ranking = &self.found.estimate.ranking;
        let mut line = format!("start {} of {}", ranking[0].start, ranking.len());
        if let Some(truth) = &self.picture.truth {
            line += &format!(", {}", off(&PoseError::of(&self.found.world_from_camera, truth)));
        }
        sheet::text(&mut page, GAP as i32, 18 + 8 * scale as i32, &line, BLACK);
        for (k, Panel { heading, view, captions }) in panels.iter().enumerate() {
            let x = GAP + k as u32 * (shown + GAP);
            sheet::title(&mut page, x as i32, top as i32 - 22, heading, 2, BLACK);
            image::imageops::replace(&mut page, view, x.into(), top.into());
            for (line, caption) in captions.iter().enumerate() {
                sheet::text(&mut page, x as i32, below as i32 + 12 * line as i32, caption, BLACK);
            }
        }
        let plot = self.losses([width - 2 * GAP, plot_height], step);
        image::imageops::replace(&mut page, &plot, GAP.into(), (below + 36).into());
        page
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
        let mut paths: Vec<_> =
            ranking.iter().map(|r| points(&self.log.path(self.index, r.start, self.found), u32::MAX)).collect();
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
        sheet::plot_curve("loss at each step; starts that promise little are dropped", &curves, size, [false, true])
    }
}

fn off(error: &PoseError) -> String {
    format!("{:.1}° and {:.3} off", error.rotation_deg, error.translation)
}
