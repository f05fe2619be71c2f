//! What a source of posed pictures holds and what is probably wrong with it.

use crate::camera::{Axes, unit_sphere_seen_from};
use crate::capture::{Capture, Frame, UpAxis, nearest_point};
use crate::error::Result;
use crate::picture::{Picture, middle};
use crate::sheet::{self, Colour};
use glam::{DMat4, DVec2, DVec3};
use image::RgbImage;
use serde::Serialize;
use std::collections::BTreeMap;

/// An object that reaches further than this many radii out of the sphere that should hold it is a problem.
const OUTSIDE_LIMIT: f64 = 1.1;
/// An object that fills less than this share of its sphere in every view is worth a note.
const SMALL_LIMIT: f64 = 0.35;
/// Angles of view that a photograph of an object can have, in degrees.
const FOV_LIMITS_DEG: [f64; 2] = [2.0, 120.0];
/// Cameras further than this from looking at the origin are worth a note, in degrees.
pub const OFF_AXIS_LIMIT_DEG: f64 = 1.0;
/// Distances to the origin that differ by more than this share of their mean are worth a note.
pub const RADIUS_SPREAD_LIMIT: f64 = 0.01;

/// What [`inspect`] found.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// The captures, in their order.
    pub instances: Vec<InstanceReport>,
    /// What is wrong, one line each; none if all is in order.
    pub problems: Vec<String>,
    /// What is unusual, but may be meant.
    pub notes: Vec<String>,
}

/// Facts about one capture.
#[derive(Debug, Clone, Serialize)]
pub struct InstanceReport {
    /// Its name.
    pub name: String,
    /// Views that can be used.
    pub views: usize,
    /// How many pictures there are of each `width×height`.
    pub sizes: BTreeMap<String, usize>,
    /// Least and greatest focal length along x, in pixels.
    pub focal_px: [f64; 2],
    /// Least and greatest distance of a camera to the origin, in object units.
    pub radius: [f64; 2],
    /// The largest angle between a camera's axis and the direction to the origin.
    pub off_axis_deg: f64,
    /// Cameras in whose pictures the origin lies.
    pub facing: usize,
    /// The object's extent in the view where it is largest, as a share of the unit sphere's; if it can be told from the
    /// background.
    pub filled: Option<f64>,
}

/// A view as far as the checks need it.
struct Seen<'a> {
    frame: &'a Frame,
    /// The object's outline on the image plane; empty where nothing tells it from the background.
    outline: Vec<DVec2>,
    /// Nothing but background.
    blank: bool,
}

/// How captures came into our frame, with the object at the origin and its diagonal 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// They say so themselves: SRN folders.
    Given,
    /// [`place_all`] found the object where the cameras look.
    Found,
}

/// Looks at every picture and camera of captures in our frame. `assumed` are the axes that their poses were read with, `is_inverted` whether as the inverse.
pub fn inspect(captures: &[Capture], assumed: Axes, is_inverted: bool, origin: Origin) -> Report {
    let mut report = Report { instances: vec![], problems: vec![], notes: vec![] };
    let mut shared: Option<(&str, [f64; 4])> = None;
    for capture in captures {
        report.problems.extend(capture.skipped.iter().cloned());
        let mut seen = vec![];
        for frame in &capture.frames {
            match Picture::open(&frame.image, frame.mask.as_deref()) {
                Ok(mut picture) => {
                    picture.guess_background();
                    let masked = picture.is_masked();
                    let outline = if masked { picture.contour(&frame.camera) } else { vec![] };
                    seen.push(Seen { frame, blank: masked && outline.is_empty(), outline });
                }
                Err(error) => report.problems.push(error.to_string()),
            }
        }
        let intrinsics = seen.first().map(|view| view.frame.camera.intrinsics).unwrap_or_default();
        let (other, expected) = *shared.get_or_insert((&capture.name, intrinsics));
        if intrinsics != expected && seen.iter().all(|view| view.frame.camera.intrinsics == intrinsics) {
            report.notes.push(format!("{}: intrinsics differ from those of {other}", capture.name));
        }
        report.check(&capture.name, &seen, assumed, is_inverted, origin);
    }
    report
}

/// Whether a point lies before a camera and inside its picture, or at most half a picture outside.
fn sees(point: DVec3, frame: &Frame, world_from_camera: &DMat4) -> bool {
    let camera = crate::Camera { world_from_camera: *world_from_camera, ..frame.camera };
    let (pixel, depth) = camera.project(point);
    let size = DVec2::from(camera.size.map(|s| s as f64));
    depth > 0.0 && (pixel / size - 0.5).abs().max_element() < 1.0
}

impl Seen<'_> {
    /// The direction of the object's middle in the camera, or of the camera's axis where that is not known.
    fn middle(&self) -> DVec3 {
        middle(&self.outline).unwrap_or_default().extend(1.0)
    }

    /// The line of sight to the middle, in the world.
    fn line(&self) -> (DVec3, DVec3) {
        let pose = self.frame.camera.world_from_camera;
        (pose.w_axis.truncate(), pose.transform_vector3(self.middle()))
    }
}

impl Report {
    fn check(&mut self, name: &str, seen: &[Seen], assumed: Axes, is_inverted: bool, origin: Origin) {
        let sees_origin = |view: &Seen| sees(DVec3::ZERO, view.frame, &view.frame.camera.world_from_camera);
        let n = seen.len();
        let pose = |view: &Seen| view.frame.camera.world_from_camera;
        let distances = || seen.iter().map(|view| pose(view).w_axis.truncate().length());
        let range = |values: &mut dyn Iterator<Item = f64>| {
            values.fold([f64::MAX, 0.0], |[low, high]: [f64; 2], x| [low.min(x), high.max(x)])
        };
        let radius = range(&mut distances());
        let facing = seen.iter().filter(|view| sees_origin(view)).count();
        let off_axis_deg = seen.iter().map(|view| crate::camera::off_axis_deg(&pose(view))).fold(0.0, f64::max);
        let mut sizes = BTreeMap::new();
        for [w, h] in seen.iter().map(|view| view.frame.camera.size) {
            *sizes.entry(format!("{w}×{h}")).or_insert(0) += 1;
        }
        let filled = self.scale(name, seen);
        self.instances.push(InstanceReport {
            name: name.into(),
            views: n,
            sizes,
            focal_px: range(&mut seen.iter().map(|view| view.frame.camera.intrinsics[0])),
            radius,
            off_axis_deg,
            facing,
            filled,
        });
        if n == 0 {
            return self.problems.push(format!("{name}: no views"));
        }
        for view in seen.iter().filter(|view| view.blank) {
            self.problems.push(format!("{}: nothing but background", view.frame.image.display()));
        }
        for view in seen {
            let camera = &view.frame.camera;
            let fov = 2.0 * (0.5 * camera.size[0] as f64 / camera.intrinsics[0]).atan().to_degrees();
            if !(FOV_LIMITS_DEG[0]..=FOV_LIMITS_DEG[1]).contains(&fov) {
                self.problems.push(format!(
                    "{}: an angle of view of {fov:.1}°: is the focal length of {:.1} px meant for {} px of width?",
                    view.frame.image.display(),
                    camera.intrinsics[0],
                    camera.size[0]
                ));
            }
        }
        let same = (1..n).filter(|&i| pose(&seen[i]).abs_diff_eq(pose(&seen[i - 1]), 1e-9)).count();
        if same > 0 && 2 * same >= n {
            self.problems.push(format!("{name}: {} of {n} cameras stand where the one before stands", same));
        }
        if facing * 10 < n * 8 {
            self.problems.push(diagnosis(name, seen, assumed, is_inverted, origin, facing));
        } else {
            for view in seen.iter().filter(|view| !sees_origin(view)) {
                let angle = crate::camera::off_axis_deg(&pose(view));
                self.problems.push(format!("{}: looks {angle:.1}° past the origin", view.frame.image.display()));
            }
            let upright = seen.iter().filter(|view| pose(view).y_axis.z <= 0.05).count();
            if n >= 4 && upright * 10 < n {
                self.notes.push(format!(
                    "{name}: {} of {n} cameras are upside down; if the pictures are not: is up another axis (--up), or are the \
                     axes PyTorch3D's (--convention pytorch3d)?",
                    n - upright
                ));
            }
            if off_axis_deg > OFF_AXIS_LIMIT_DEG {
                self.notes.push(format!("{name}: cameras look up to {off_axis_deg:.1}° past the origin"));
            }
        }
        let [near, far] = radius;
        if near <= 0.5 {
            self.problems.push(format!(
                "{name}: a camera stands {near:.3} from the origin, inside of the object (radius 0.5); is the scale right?"
            ));
        }
        if far - near > RADIUS_SPREAD_LIMIT * 0.5 * (near + far) {
            self.notes.push(format!("{name}: camera distances spread from {near:.3} to {far:.3}"));
        }
    }

    /// How much of the unit sphere's image the object fills at most; says so where it is too much or too little.
    fn scale(&mut self, name: &str, seen: &[Seen]) -> Option<f64> {
        let reach = |view: &Seen| {
            let pose = view.frame.camera.world_from_camera;
            let origin = pose.inverse().transform_point3(DVec3::ZERO);
            let sphere = (0.5 / origin.length()).min(1.0).asin().tan();
            let angles = view.outline.iter().map(|p| p.extend(1.0).angle_between(origin).tan().abs());
            (origin.z > 0.0 && !view.outline.is_empty()).then(|| angles.fold(0.0, f64::max) / sphere)
        };
        let reaches: Vec<_> = seen.iter().filter_map(reach).collect();
        let most = reaches.iter().copied().reduce(f64::max)?;
        let outside = reaches.iter().filter(|&&reach| reach > OUTSIDE_LIMIT).count();
        if outside > 0 {
            let lines = seen.iter().filter(|view| !view.outline.is_empty()).map(Seen::line);
            let advice = match nearest_point(&lines.collect::<Vec<_>>()) {
                Some(p) if p.length() > 0.15 => format!("the silhouettes meet at ({:.2}, {:.2}, {:.2}) instead", p.x, p.y, p.z),
                _ => format!("the scale, or the focal length, seems wrong by a factor of {most:.2}"),
            };
            self.problems.push(format!(
                "{name}: in {outside} of {} views the object reaches out of the unit sphere around the origin, to {most:.2} of its \
                 radius; {advice}",
                reaches.len()
            ));
        } else if most < SMALL_LIMIT {
            self.notes
                .push(format!("{name}: the object reaches only to {most:.2} of the unit sphere's radius; is the scale right?"));
        }
        Some(most)
    }
}

/// What is probably wrong where cameras do not see the object: the reading of the poses under which they would.
fn diagnosis(name: &str, seen: &[Seen], assumed: Axes, is_inverted: bool, origin: Origin, facing: usize) -> String {
    let n = seen.len();
    let depth = |view: &&Seen| view.frame.camera.world_from_camera.inverse().w_axis.z;
    let away = seen.iter().filter(|view| depth(view) <= 0.0).count();
    let what = match away {
        0 => format!("{} of {n} cameras look past the origin", n - facing),
        _ => format!("{away} of {n} cameras face away from the object"),
    };
    let readings = [false, true].into_iter().flat_map(|inverted| Axes::ALL.map(|axes| (axes, inverted)));
    let found = readings.filter(|&reading| reading != (assumed, false)).map(|(axes, inverted)| {
        let poses: Vec<_> = seen
            .iter()
            .map(|view| {
                let raw = assumed.of_ours(view.frame.camera.world_from_camera);
                axes.to_ours(if inverted { raw.inverse() } else { raw })
            })
            .collect();
        // Where the object was found under the wrong reading means nothing under another.
        let lines =
            || seen.iter().zip(&poses).map(|(view, pose)| (pose.w_axis.truncate(), pose.transform_vector3(view.middle())));
        let point = match origin {
            Origin::Given => Some(DVec3::ZERO),
            Origin::Found => nearest_point(&lines().collect::<Vec<_>>()),
        };
        let all = || seen.iter().zip(&poses);
        let facing = point.map_or(0, |point| all().filter(|(view, pose)| sees(point, view.frame, pose)).count());
        let upright = poses.iter().filter(|pose| pose.y_axis.z <= 0.05).count();
        (facing, upright, axes, inverted)
    });
    // The first of equals: simple readings come first.
    let best = found.reduce(|best, next| if (next.0, next.1) > (best.0, best.1) { next } else { best });
    match best.filter(|(facing, ..)| facing * 10 >= n * 9) {
        Some((_, _, axes, inverted)) => {
            let (mut looks, mut tries) = (vec![], vec![]);
            if inverted {
                looks.push("inverted (world to camera)".to_owned());
                tries.push(if is_inverted { "without `--inverted`".to_owned() } else { "`--inverted`".into() });
            }
            if axes != assumed {
                looks.push(format!("in {} axes", axes.title()));
                tries.push(format!("`--convention {}`", axes.name()));
            }
            format!("{name}: the poses look {}: {what}; try {}", looks.join(", "), tries.join(" "))
        }
        None => format!("{name}: {what}; is the object at the origin? `sigma-data import` moves it there"),
    }
}

/// Brings captures that are not in our frame into it, for looking at them: by the box that the source knows, else by silhouettes.
pub fn place_all(captures: &mut [Capture], up: UpAxis) -> Result<()> {
    for capture in captures {
        let (bounds, _) = capture.find_bounds(None, None, 1.3)?;
        let placed = capture.placement(bounds, up);
        capture.transform(&placed);
    }
    Ok(())
}

/// A picture of captures in our frame: a row of up to `columns` evenly chosen views for each of the first `rows`, each with the
/// unit sphere and the world's axes as its camera sees them (x red, y green, z blue); below, all cameras. Pictures that cannot
/// be read are left white.
pub fn contact_sheet(captures: &[Capture], columns: usize, rows: usize) -> RgbImage {
    const THUMBNAIL: u32 = 128;
    let mut cells = vec![];
    for capture in captures.iter().take(rows) {
        let shown = columns.min(capture.frames.len());
        for i in 0..columns {
            let picked = (i < shown).then(|| &capture.frames[i * capture.frames.len() / shown]);
            let picture = picked.and_then(|frame| {
                let thumbnail =
                    image::open(&frame.image).ok()?.resize(THUMBNAIL, THUMBNAIL, image::imageops::FilterType::Triangle);
                let mut thumbnail = thumbnail.into_rgb8();
                draw_axes(&mut thumbnail, frame);
                Some(thumbnail)
            });
            let label = match (i, picked) {
                (0, _) => capture.name.clone(),
                (_, Some(frame)) => frame.name.clone(),
                _ => String::new(),
            };
            cells.push((picture.unwrap_or_else(|| sheet::blank(THUMBNAIL, THUMBNAIL)), label));
        }
    }
    let cells: Vec<_> = cells.iter().map(|(picture, label)| (picture, label.as_str())).collect();
    let views = sheet::grid(&cells, columns);
    let poses: Vec<_> = captures.iter().flat_map(|c| &c.frames).map(|frame| frame.camera.world_from_camera).collect();
    let drawing = sheet::cameras(&poses, (views.width() / 2).clamp(200, 500));
    let mut whole = sheet::blank(views.width().max(drawing.width()), views.height() + drawing.height());
    image::imageops::replace(&mut whole, &views, 0, 0);
    image::imageops::replace(&mut whole, &drawing, 0, views.height().into());
    whole
}

/// The unit sphere's outline and the world's axes, half a unit long, as the camera sees them.
fn draw_axes(picture: &mut RgbImage, frame: &Frame) {
    let camera = &frame.camera;
    let scale = f64::from(picture.width()) / camera.size[0] as f64;
    let mut draw = |from: DVec3, to: DVec3, colour: Colour| {
        let ends = [from, to].map(|point| camera.project(point));
        if ends.iter().all(|(pixel, depth)| *depth > 1e-6 && pixel.is_finite()) {
            let [from, to] = ends.map(|(pixel, _)| (pixel + 0.5) * scale - 0.5);
            sheet::line(picture, from, to, colour);
        }
    };
    let outline = unit_sphere_seen_from(camera.world_from_camera.w_axis.truncate());
    outline.iter().zip(outline.iter().cycle().skip(1)).for_each(|(from, to)| draw(*from, *to, sheet::GREY));
    for (axis, colour) in DVec3::AXES.into_iter().zip(sheet::AXES) {
        draw(DVec3::ZERO, 0.5 * axis, colour);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SrnSet;
    use crate::camera::{look_at_origin, uniform_sphere};
    use crate::formats::{Format, ReadOptions, read};
    use crate::srn::{InstanceWriter, Intrinsics};
    use std::path::Path;

    // The unit sphere fits: 32 px are 0.5 at a distance of 1.3, or a little less.
    const INTRINSICS: Intrinsics = Intrinsics { focal: [72.0; 2], centre: [32.0; 2], size: [64, 64] };

    /// A dark ball of radius 0.35 at the origin.
    fn ball(pose: &DMat4) -> RgbImage {
        let camera = crate::Camera {
            world_from_camera: *pose,
            intrinsics: [72.0, 72.0, 32.0, 32.0],
            size: [64; 2],
            pixel_centre: 0.0,
            distortion: [0.0; 5],
        };
        let origin = pose.inverse().transform_point3(DVec3::ZERO);
        RgbImage::from_fn(64, 64, |u, v| {
            let ray = camera.plane(DVec2::new(u.into(), v.into())).extend(1.0);
            image::Rgb(if ray.angle_between(origin) < (0.35 / origin.length()).asin() { [60, 90, 40] } else { [255; 3] })
        })
    }

    fn set(names: &[&str]) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        for name in names {
            let writer = InstanceWriter::create(dir.path().join(name), &INTRINSICS, false).unwrap();
            for (i, pose) in uniform_sphere(4, 1.3, 1).iter().enumerate() {
                writer.add(&format!("{i}"), &ball(pose), pose).unwrap();
            }
            writer.finish().unwrap();
        }
        dir
    }

    fn inspected(dir: &Path) -> (Vec<Capture>, Report) {
        let captures = read(dir, Format::Srn, &ReadOptions::default()).unwrap();
        let report = inspect(&captures, Axes::OpenCv, false, Origin::Given);
        (captures, report)
    }

    #[test]
    fn a_good_set_has_no_problems() {
        let dir = set(&["a", "b"]);
        assert_eq!(SrnSet::open(dir.path()).unwrap().load(64).unwrap().instances.len(), 2);
        let (captures, report) = inspected(dir.path());
        assert!(report.problems.is_empty() && report.notes.is_empty(), "{:?} {:?}", report.problems, report.notes);
        assert_eq!(report.instances.iter().map(|i| (i.name.as_str(), i.views)).collect::<Vec<_>>(), [("a", 4), ("b", 4)]);
        let first = &report.instances[0];
        assert_eq!((first.sizes.clone(), first.facing), (BTreeMap::from([("64×64".into(), 4)]), 4));
        assert!(first.radius.iter().all(|r| (r - 1.3).abs() < 1e-6));
        // tan(asin(0.35 / 1.3)) / tan(asin(0.5 / 1.3)) = 0.671.
        assert!((first.filled.unwrap() - 0.671).abs() < 0.03, "{:?}", first.filled);
        let json = serde_json::to_string(&report).unwrap();
        assert!(json.contains("\"views\":4") && json.contains("\"problems\":[]"), "{json}");
        let sheet = contact_sheet(&captures, 3, 9);
        for colour in sheet::AXES {
            assert!(sheet.pixels().any(|p| p.0 == colour), "{colour:?}: no camera is drawn");
        }
    }

    #[test]
    fn every_problem_is_found_and_named() {
        let remove = |path: &Path| std::fs::remove_file(path).unwrap();
        let text = |text: &'static str| move |path: &Path| std::fs::write(path, text).unwrap();
        let pose = |pose: DMat4| {
            let rows: Vec<_> = pose.transpose().to_cols_array().iter().map(f64::to_string).collect();
            move |path: &Path| std::fs::write(path, rows.join(" ")).unwrap()
        };
        let picture = |w, h| move |path: &Path| sheet::blank(w, h).save(path).unwrap();
        let good = look_at_origin(1.3 * DVec3::X);
        let scaled = |x| DMat4::from_scale(DVec3::new(x, 1.0, 1.0));
        type Spoil = Box<dyn Fn(&Path)>;
        let cases: [(&str, Spoil, &str); 13] = [
            ("pose/2.txt", Box::new(remove), "picture without a pose"),
            ("rgb/2.png", Box::new(remove), "pose without a picture"),
            ("rgb/2.png", Box::new(text("not a picture")), "not a readable image"),
            ("rgb/2.png", Box::new(picture(65, 64)), "64×64"),
            ("rgb/2.png", Box::new(picture(64, 64)), "nothing but background"),
            ("pose/2.txt", Box::new(text("1 2 3")), "16 numbers"),
            ("pose/2.txt", Box::new(pose(good * scaled(1.01))), "rigid"),
            ("pose/2.txt", Box::new(pose(good * scaled(-1.0))), "right-handed"),
            ("pose/2.txt", Box::new(pose(DMat4::from_translation(3.0 * DVec3::Z) * good)), "out of the unit sphere"),
            ("pose/2.txt", Box::new(pose(look_at_origin(0.4 * DVec3::X))), "inside of the object"),
            ("intrinsics.txt", Box::new(remove), "--fov"),
            ("intrinsics.txt", Box::new(text("72 32 32 0\n0 0 0\n1\n512 512\n")), "angle of view"),
            ("intrinsics.txt", Box::new(text("288 128 128 0\n0 0 0\n1\n64 64\n")), "256×256"),
        ];
        for (file, spoil, expected) in cases {
            let dir = set(&["a", "b"]);
            let in_folder = dir.path().join("b").display().to_string();
            spoil(&dir.path().join("b").join(file));
            match read(dir.path(), Format::Srn, &ReadOptions::default()) {
                Ok(captures) => {
                    let report = inspect(&captures, Axes::OpenCv, false, Origin::Given);
                    let found = report.problems.iter().find(|problem| problem.contains(expected));
                    let named = found.is_some_and(|problem| problem.contains(&in_folder) || problem.starts_with("b:"));
                    assert!(named, "{expected}: {:?}", report.problems);
                    contact_sheet(&captures, 2, 2);
                }
                Err(error) => assert!(error.to_string().contains(expected), "{expected}: {error}"),
            }
        }
    }

    #[test]
    fn the_doctor_names_the_convention() {
        for (axes, inverted, expected) in [
            (Axes::OpenGl, false, "4 of 4 cameras face away from the object; try `--convention opengl`"),
            (Axes::Ros, false, "--convention ros"),
            (Axes::OpenCv, true, "try `--inverted`"),
        ] {
            let dir = set(&["thing"]);
            for (i, pose) in uniform_sphere(4, 1.3, 1).iter().enumerate() {
                let written = axes.of_ours(*pose);
                let written = if inverted { written.inverse() } else { written };
                let rows: Vec<_> = written.transpose().to_cols_array().iter().map(f64::to_string).collect();
                std::fs::write(dir.path().join(format!("thing/pose/{i}.txt")), rows.join(" ")).unwrap();
            }
            let (_, report) = inspected(dir.path());
            assert!(report.problems.iter().any(|p| p.contains(expected)), "{expected}: {:?}", report.problems);
            // What the doctor says helps.
            let options = ReadOptions { axes: Some(axes), inverted, ..ReadOptions::default() };
            let report = inspect(&read(dir.path(), Format::Srn, &options).unwrap(), axes, false, Origin::Given);
            assert!(report.problems.is_empty(), "{:?}", report.problems);
        }
    }
}
