//! What a data set on disk holds and what is wrong with it.

use crate::camera::{off_axis_deg, rigid_error};
use crate::error::{At, Result};
use crate::sheet;
use crate::srn::{Intrinsics, RIGID_TOLERANCE, SrnSet, read_pose_unchecked};
use glam::DMat4;
use image::RgbImage;
use serde::Serialize;
use std::collections::BTreeMap;

/// Cameras further than this from looking at the origin are a problem, in degrees.
pub const OFF_AXIS_LIMIT_DEG: f64 = 1.0;
/// Distances to the origin that differ by more than this share of their mean are a problem.
pub const RADIUS_SPREAD_LIMIT: f64 = 0.01;

/// What [`inspect`] found.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// The instances, sorted by name.
    pub instances: Vec<InstanceReport>,
    /// What is wrong, one line each, beginning with the file; none if the set is in order.
    pub problems: Vec<String>,
}

/// Facts about one instance.
#[derive(Debug, Clone, Serialize)]
pub struct InstanceReport {
    /// The folder's name.
    pub name: String,
    /// Pairs of picture and pose.
    pub views: usize,
    /// How many pictures there are of each `width×height`.
    pub sizes: BTreeMap<String, usize>,
    /// Focal length in pixels of the intrinsics' own size, if they can be read.
    pub focal_px: Option<f64>,
    /// Principal point in pixels.
    pub centre_px: Option<[f64; 2]>,
    /// Least and greatest distance of a camera to the origin, in object units.
    pub radius: Option<[f64; 2]>,
    /// The largest angle between a camera's axis and the direction to the origin.
    pub off_axis_deg: f64,
    /// The poses that can be read.
    #[serde(skip)]
    pub world_from_camera: Vec<DMat4>,
}

/// Reads every file of a set. Only a folder that is no data set is an error; all else is a line among the problems.
pub fn inspect(set: &SrnSet) -> Result<Report> {
    let mut problems = vec![];
    let mut shared: Option<(String, Intrinsics)> = None;
    let mut instances = vec![];
    for files in &set.instances {
        let intrinsics = Intrinsics::read(&files.dir.join("intrinsics.txt")).map_err(|e| problems.push(e.to_string())).ok();
        match (&shared, intrinsics) {
            (None, Some(own)) => shared = Some((files.name.clone(), own)),
            (Some((other, expected)), Some(own)) if own != *expected => {
                problems.push(format!("{}: intrinsics differ from those of {other}", files.dir.join("intrinsics.txt").display()));
            }
            _ => {}
        }
        let mut sizes = BTreeMap::new();
        let mut poses = vec![];
        for view in &files.views {
            let at = files.dir.join(&view.name);
            match (&view.rgb, &view.pose) {
                (Some(_), None) => problems.push(format!("{}: picture without a pose", at.display())),
                (None, Some(_)) => problems.push(format!("{}: pose without a picture", at.display())),
                _ => {}
            }
            if let Some(path) = &view.rgb {
                match image::open(path).at(path) {
                    Ok(picture) => {
                        let size = [picture.width(), picture.height()];
                        *sizes.entry(format!("{}×{}", size[0], size[1])).or_insert(0) += 1;
                        let expected = intrinsics.map(|i| i.size.map(|n| n as u32)).unwrap_or(size);
                        if size != expected {
                            let [w, h] = expected;
                            problems.push(format!(
                                "{}: {}×{}, but intrinsics.txt is for {w}×{h}",
                                path.display(),
                                size[0],
                                size[1]
                            ));
                        }
                    }
                    Err(error) => problems.push(error.to_string()),
                }
            }
            if let Some(path) = &view.pose {
                match read_pose_unchecked(path) {
                    Ok(pose) => {
                        let error = rigid_error(&pose);
                        if error >= 2.0 {
                            problems.push(format!("{}: the rotation is left-handed or scaled", path.display()));
                        } else if error.is_nan() || error > RIGID_TOLERANCE {
                            problems.push(format!("{}: not rigid: {error:.1e} off", path.display()));
                        } else if off_axis_deg(&pose) > OFF_AXIS_LIMIT_DEG {
                            problems.push(format!("{}: looks {:.1}° past the origin", path.display(), off_axis_deg(&pose)));
                        }
                        poses.push(pose);
                    }
                    Err(error) => problems.push(error.to_string()),
                }
            }
        }
        if files.views.is_empty() {
            problems.push(format!("{}: no views", files.dir.display()));
        }
        let radii = || poses.iter().map(|m| m.w_axis.truncate().length());
        let radius = (!poses.is_empty()).then(|| [radii().fold(f64::MAX, f64::min), radii().fold(0.0, f64::max)]);
        if let Some([near, far]) = radius.filter(|[near, far]| far - near > RADIUS_SPREAD_LIMIT * 0.5 * (near + far)) {
            problems.push(format!("{}: camera distances spread from {near:.3} to {far:.3}", files.dir.display()));
        }
        instances.push(InstanceReport {
            name: files.name.clone(),
            views: files.views.iter().filter(|view| view.rgb.is_some() && view.pose.is_some()).count(),
            sizes,
            focal_px: intrinsics.map(|i| i.focal),
            centre_px: intrinsics.map(|i| i.centre),
            radius,
            off_axis_deg: poses.iter().map(off_axis_deg).fold(0.0, f64::max),
            world_from_camera: poses,
        });
    }
    Ok(Report { instances, problems })
}

/// A picture of a set: a row of up to `columns` evenly chosen views for each of the first `rows` instances, and below it the
/// cameras of all instances. Pictures that cannot be read are left white.
pub fn contact_sheet(set: &SrnSet, report: &Report, columns: usize, rows: usize) -> RgbImage {
    const THUMBNAIL: u32 = 128;
    let mut cells = vec![];
    for instance in set.instances.iter().take(rows) {
        let pictures: Vec<_> = instance.views.iter().filter_map(|view| Some((&view.name, view.rgb.as_ref()?))).collect();
        for i in 0..columns {
            let picked = pictures.get(i * pictures.len() / columns).filter(|_| i < pictures.len());
            let picture = picked
                .and_then(|(_, path)| image::open(path).ok())
                .map(|picture| picture.resize(THUMBNAIL, THUMBNAIL, image::imageops::FilterType::Triangle).into_rgb8());
            let label = match (i, picked) {
                (0, _) => instance.name.clone(),
                (_, Some((name, _))) => name.to_string(),
                _ => String::new(),
            };
            cells.push((picture.unwrap_or_else(|| sheet::blank(THUMBNAIL, THUMBNAIL)), label));
        }
    }
    let cells: Vec<_> = cells.iter().map(|(picture, label)| (picture, label.as_str())).collect();
    let views = sheet::grid(&cells, columns);
    let poses: Vec<_> = report.instances.iter().flat_map(|i| i.world_from_camera.iter().copied()).collect();
    let drawing = sheet::cameras(&poses, (views.width() / 2).clamp(200, 500));
    let mut whole = sheet::blank(views.width().max(drawing.width()), views.height() + drawing.height());
    image::imageops::replace(&mut whole, &views, 0, 0);
    image::imageops::replace(&mut whole, &drawing, 0, views.height().into());
    whole
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{look_at_origin, uniform_sphere};
    use crate::srn::InstanceWriter;
    use glam::DVec3;
    use std::path::Path;

    const INTRINSICS: Intrinsics = Intrinsics { focal: 10.0, centre: [4.0, 4.0], size: [8, 8] };

    fn set(names: &[&str]) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        for name in names {
            let writer = InstanceWriter::create(dir.path().join(name), &INTRINSICS, false).unwrap();
            for (i, pose) in uniform_sphere(4, 1.3, 1).iter().enumerate() {
                writer.add(&format!("{i}"), &sheet::blank(8, 8), pose).unwrap();
            }
        }
        dir
    }

    fn inspected(dir: &Path) -> (SrnSet, Report) {
        let set = SrnSet::open(dir).unwrap();
        let report = inspect(&set).unwrap();
        (set, report)
    }

    #[test]
    fn a_good_set_has_no_problems() {
        let dir = set(&["a", "b"]);
        let (set, report) = inspected(dir.path());
        assert!(report.problems.is_empty(), "{:?}", report.problems);
        assert_eq!(report.instances.iter().map(|i| (i.name.as_str(), i.views)).collect::<Vec<_>>(), [("a", 4), ("b", 4)]);
        assert_eq!(report.instances[0].sizes, BTreeMap::from([("8×8".into(), 4)]));
        assert!(report.instances[0].radius.unwrap().iter().all(|r| (r - 1.3).abs() < 1e-6));
        let json = serde_json::to_string(&report).unwrap();
        assert!(json.contains("\"views\":4") && json.contains("\"problems\":[]"), "{json}");
        let sheet = contact_sheet(&set, &report, 3, 9);
        assert!(sheet.pixels().any(|p| p.0 == [40, 60, 230]), "no camera is drawn");
    }

    #[test]
    fn every_problem_is_found_and_named() {
        let remove = |path: &Path| std::fs::remove_file(path).unwrap();
        let text = |text: &'static str| move |path: &Path| std::fs::write(path, text).unwrap();
        let pose = |pose: DMat4| {
            let rows: Vec<_> = pose.transpose().to_cols_array().iter().map(f64::to_string).collect();
            move |path: &Path| std::fs::write(path, rows.join(" ")).unwrap()
        };
        let picture = |path: &Path| sheet::blank(9, 8).save(path).unwrap();
        let good = look_at_origin(1.3 * DVec3::X);
        let scaled = |x| DMat4::from_scale(DVec3::new(x, 1.0, 1.0));
        type Spoil = Box<dyn Fn(&Path)>;
        let cases: [(&str, Spoil, &str); 11] = [
            ("pose/2.txt", Box::new(remove), "picture without a pose"),
            ("rgb/2.png", Box::new(remove), "pose without a picture"),
            ("rgb/2.png", Box::new(text("not a picture")), "not a readable image"),
            ("rgb/2.png", Box::new(picture), "9×8, but intrinsics.txt is for 8×8"),
            ("pose/2.txt", Box::new(text("1 2 3")), "16 numbers"),
            ("pose/2.txt", Box::new(pose(good * scaled(1.01))), "not rigid"),
            ("pose/2.txt", Box::new(pose(good * scaled(-1.0))), "left-handed"),
            ("pose/2.txt", Box::new(pose(good * DMat4::from_rotation_x(0.1))), "5.7° past the origin"),
            ("pose/2.txt", Box::new(pose(look_at_origin(1.4 * DVec3::X))), "from 1.300 to 1.400"),
            ("intrinsics.txt", Box::new(remove), "No such file"),
            ("intrinsics.txt", Box::new(text("10 4.5 4\n0 0 0\n1\n8 8\n")), "differ from those of a"),
        ];
        for (file, spoil, expected) in cases {
            let dir = set(&["a", "b"]);
            spoil(&dir.path().join("b").join(file));
            let (set, report) = inspected(dir.path());
            let [problem] = &report.problems[..] else { panic!("{expected}: {:?}", report.problems) };
            assert!(problem.contains(expected) && problem.contains("/b"), "{expected}: {problem}");
            contact_sheet(&set, &report, 2, 2);
        }
    }
}
