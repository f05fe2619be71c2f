//! Pictures of one object with their cameras, whatever format they came in, and the frame that the object is put into.

use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::picture::{Picture, middle};
use glam::{DMat3, DMat4, DVec3};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Pictures of one object and where they were taken from.
#[derive(Debug, Clone, Default)]
pub struct Capture {
    /// The object's name; fit to name a folder.
    pub name: String,
    /// The views, in the order of their source.
    pub frames: Vec<Frame>,
    /// What was left out, one line each that names file and place.
    pub skipped: Vec<String>,
    /// The object's bounding box in source units, if the source knows it.
    pub bounds: Option<Bounds>,
    /// nerfstudio's note of how its frame arose from that of the reconstruction before; carried, never applied.
    pub applied_transform: Option<DMat4>,
    /// BOP's number of the object.
    pub object_id: Option<u32>,
    /// BOP's number of the scene.
    pub scene_id: Option<u32>,
    /// What an import before did to the world.
    pub record: Option<FrameRecord>,
}

/// One picture and its camera.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Unique in its capture, and fit to name a file.
    pub name: String,
    /// The picture.
    pub image: PathBuf,
    /// White where the object is, of the picture's size. Besides it, a picture's own transparency counts.
    pub mask: Option<PathBuf>,
    /// The camera, axes and pixel centre as [`Camera`] says.
    pub camera: Camera,
}

/// A bounding box, as centre and length of its diagonal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// The centre, source units.
    pub centre: DVec3,
    /// The diagonal, source units.
    pub diagonal: f64,
}

/// Which direction of the source becomes the world's z.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UpAxis {
    /// An axis, 0 to 2, and whether its negative is meant.
    Axis(usize, bool),
    /// The mean of what is up in the pictures: for sources whose axes mean nothing, like COLMAP's.
    Cameras,
}

impl Capture {
    /// Moves and scales the world: `similarity` is `new_world_from_old_world`.
    pub fn transform(&mut self, similarity: &DMat4) {
        let scale = similarity.x_axis.truncate().length();
        for frame in &mut self.frames {
            frame.camera.world_from_camera = moved(similarity, &frame.camera.world_from_camera);
        }
        // What is carried and not applied holds no longer.
        self.applied_transform = None;
        self.bounds = self.bounds.map(|b| Bounds { centre: similarity.transform_point3(b.centre), diagonal: scale * b.diagonal });
    }

    /// Where the object is, if that is not known, and how large, from its silhouettes: the point nearest to the rays through their middles, and the
    /// longest silhouette. Where no picture tells the object from its background, the middles of the pictures are taken, and
    /// no diagonal is found.
    fn survey(&self, centre: Option<DVec3>) -> Result<(DVec3, Option<f64>)> {
        let mut silhouettes = vec![];
        for frame in &self.frames {
            // A picture that cannot be read tells nothing; who writes it will say so.
            let points = Picture::open(&frame.image, frame.mask.as_deref()).map_or(vec![], |mut picture| {
                picture.guess_background();
                if picture.is_masked() { picture.contour(&frame.camera) } else { vec![] }
            });
            // A few hundred points are as good, and all pairs of them are compared. Left and right ends alternate: an odd step
            // takes both.
            silhouettes.push(points.iter().copied().step_by((points.len() / 500) | 1).collect::<Vec<_>>());
        }
        let known = silhouettes.iter().any(|points| !points.is_empty());
        let rays: Vec<_> = (self.frames.iter().zip(&silhouettes))
            .filter(|(_, points)| !known || !points.is_empty())
            .map(|(frame, points)| {
                let axis = middle(points).unwrap_or_default();
                let pose = frame.camera.world_from_camera;
                (pose.w_axis.truncate(), pose.transform_vector3(axis.extend(1.0)))
            })
            .collect();
        let place = self.frames.first().map(|frame| frame.image.clone()).unwrap_or_default();
        let centre = centre.or_else(|| nearest_point(&rays)).ok_or_else(|| {
            Error::field(&place, "cameras", "views from different sides; else say where the object is", "parallel ones")
        })?;
        let diagonal = self.frames.iter().zip(&silhouettes).map(|(frame, points)| {
            let depth = frame.camera.world_from_camera.inverse().transform_point3(centre).z;
            let pairs = points.iter().enumerate().flat_map(|(i, a)| points[i..].iter().map(move |b| a.distance_squared(*b)));
            depth * pairs.fold(0.0, f64::max).sqrt()
        });
        Ok((centre, Some(diagonal.fold(0.0, f64::max)).filter(|&d| d > 0.0)))
    }

    /// Puts the world back as it was before the import that `record` tells of, if there was one.
    pub fn restore(&mut self) {
        if let Some(record) = self.record.take() {
            self.transform(&record.matrix().inverse());
        }
    }

    /// The object's box, and in words how it was found: what the caller knows, else what the source knows, else what the
    /// silhouettes show; without these the mean distance of the cameras becomes `radius`.
    pub fn find_bounds(&self, centre: Option<DVec3>, diagonal: Option<f64>, radius: f64) -> Result<(Bounds, String)> {
        if let (Some(centre), Some(diagonal)) = (centre, diagonal) {
            return Ok((Bounds { centre, diagonal }, "as given".into()));
        }
        if let Some(bounds) = self.bounds {
            let found = Bounds { centre: centre.unwrap_or(bounds.centre), diagonal: diagonal.unwrap_or(bounds.diagonal) };
            return Ok((found, "the box in models_info.json".into()));
        }
        let silhouettes = self.survey(centre)?;
        let cameras = || self.frames.iter().map(|frame| frame.camera.world_from_camera.w_axis.truncate());
        let (middle, how) = match centre {
            Some(centre) => (centre, "as given"),
            None if silhouettes.1.is_some() => (silhouettes.0, "where the silhouettes' middles meet"),
            None => (silhouettes.0, "where the cameras look"),
        };
        let distance = cameras().map(|eye| eye.distance(middle)).sum::<f64>() / self.frames.len().max(1) as f64;
        let (length, why) = match (diagonal, silhouettes.1) {
            (Some(diagonal), _) => (diagonal, "as given".into()),
            (None, Some(diagonal)) => (diagonal, "the longest silhouette".into()),
            (None, None) => (distance / radius, format!("such that cameras stand {radius} away on average")),
        };
        Ok((Bounds { centre: middle, diagonal: length }, format!("centre {how}; diagonal {why}")))
    }

    /// The similarity that puts an object with these bounds upright into our frame: the box's centre at the origin, its
    /// diagonal 1, `up` along z.
    pub fn placement(&self, bounds: Bounds, up: UpAxis) -> DMat4 {
        let up = match up {
            UpAxis::Axis(axis, negative) => DVec3::AXES[axis] * if negative { -1.0 } else { 1.0 },
            UpAxis::Cameras => {
                let sum: DVec3 = self.frames.iter().map(|frame| -frame.camera.world_from_camera.y_axis.truncate()).sum();
                sum.try_normalize().unwrap_or(DVec3::Z)
            }
        };
        let turn = glam::DQuat::from_rotation_arc(up, DVec3::Z);
        DMat4::from_scale_rotation_translation(DVec3::splat(1.0 / bounds.diagonal), turn, DVec3::ZERO)
            * DMat4::from_translation(-bounds.centre)
    }
}

/// The pose of a camera after the world was moved and scaled: `similarity` is `new_world_from_old_world`.
pub fn moved(similarity: &DMat4, world_from_camera: &DMat4) -> DMat4 {
    let scale = similarity.x_axis.truncate().length();
    let mut pose = *similarity * *world_from_camera;
    for axis in [&mut pose.x_axis, &mut pose.y_axis, &mut pose.z_axis] {
        *axis /= scale;
    }
    pose
}

/// The point with the least sum of squared distances to lines, each a point and a direction; none if all are parallel.
pub(crate) fn nearest_point(lines: &[(DVec3, DVec3)]) -> Option<DVec3> {
    let (mut a, mut b) = (DMat3::ZERO, DVec3::ZERO);
    for (point, direction) in lines {
        let d = direction.try_normalize()?;
        let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        a += across;
        b += across * *point;
    }
    // Two rays one degree apart still have a determinant of 1e-4.
    let n = lines.len().max(1) as f64;
    let found = (a / n).determinant().abs() > 1e-7;
    found.then(|| a.inverse() * b).filter(|p| p.is_finite())
}

/// What an import did to the world: lies as `frame.json` beside `rgb/`, so that poses can be written back as they came.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    /// Rows of the similarity that maps points of the source to points of the data set.
    pub world_from_source: [[f64; 4]; 4],
    /// Name of the source's format.
    pub format: String,
    /// How centre and scale were found, in words.
    pub found_by: String,
    /// BOP's number of the object.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub object_id: Option<u32>,
    /// BOP's number of the scene.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub scene_id: Option<u32>,
    /// Of each view: the picture in the source, relative to it where it lies inside.
    pub images: std::collections::BTreeMap<String, String>,
}

impl FrameRecord {
    /// The file's name.
    pub const FILE: &str = "frame.json";

    /// Reads the record of an instance's folder; `None` if there is none.
    pub fn read(dir: &Path) -> Result<Option<Self>> {
        let path = dir.join(Self::FILE);
        if path.exists() { Self::open(&path).map(Some) } else { Ok(None) }
    }

    /// Reads a record.
    pub fn open(path: &Path) -> Result<Self> {
        let record: Self = crate::formats::from_json(path, &crate::error::read_text(path)?)?;
        crate::srn::rigid(path, "world_from_source", moved(&record.matrix(), &DMat4::IDENTITY))?;
        Ok(record)
    }

    /// Writes the record into an instance's folder.
    pub fn write(&self, dir: &Path) -> Result<()> {
        crate::formats::write_json(&dir.join(Self::FILE), self)
    }

    /// `world_from_source`.
    pub fn matrix(&self) -> DMat4 {
        DMat4::from_cols_array_2d(&self.world_from_source).transpose()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{look_at_origin, uniform_sphere};

    fn capture(poses: &[DMat4]) -> Capture {
        let camera = |&world_from_camera| Camera {
            world_from_camera,
            intrinsics: [50.0, 50.0, 32.0, 32.0],
            size: [64, 64],
            pixel_centre: 0.0,
            distortion: [0.0; 5],
        };
        let frame = |pose| Frame { name: String::new(), image: PathBuf::new(), mask: None, camera: camera(pose) };
        Capture { frames: poses.iter().map(frame).collect(), ..Capture::default() }
    }

    #[test]
    fn placing_centres_scales_turns_and_can_be_undone() {
        let poses = uniform_sphere(9, 1.3, 2);
        let mut capture = capture(&poses);
        // The object in millimetres, y up, off the origin.
        let messed = DMat4::from_scale_rotation_translation(
            DVec3::splat(250.0),
            glam::DQuat::from_rotation_x(-std::f64::consts::FRAC_PI_2),
            DVec3::new(100.0, -40.0, 7.0),
        );
        capture.transform(&messed);
        let bounds = Bounds { centre: DVec3::new(100.0, -40.0, 7.0), diagonal: 250.0 };
        let placed = capture.placement(bounds, UpAxis::Axis(1, false));
        capture.transform(&placed);
        for (frame, pose) in capture.frames.iter().zip(&poses) {
            assert!(frame.camera.world_from_camera.abs_diff_eq(*pose, 1e-12), "{}", frame.camera.world_from_camera);
        }
        capture.transform(&placed.inverse());
        capture.transform(&messed.inverse());
        assert!(capture.frames.iter().zip(&poses).all(|(f, p)| f.camera.world_from_camera.abs_diff_eq(*p, 1e-12)));
    }

    #[test]
    fn up_is_what_the_cameras_say() {
        // Cameras around the equator of a world whose up is −x.
        let ring = |k: u32| look_at_origin(DVec3::new(f64::from(k).cos(), f64::from(k).sin(), 0.2));
        let mut capture = capture(&(0..12).map(ring).collect::<Vec<_>>());
        capture.transform(&DMat4::from_quat(glam::DQuat::from_rotation_arc(DVec3::Z, DVec3::NEG_X)));
        let placed = capture.placement(Bounds { centre: DVec3::ZERO, diagonal: 1.0 }, UpAxis::Cameras);
        assert!(placed.transform_vector3(DVec3::NEG_X).distance(DVec3::Z) < 0.05, "{placed}");
    }

    #[test]
    fn silhouettes_say_where_the_object_is() {
        let dir = tempfile::tempdir().unwrap();
        let (ball, radius) = (DVec3::new(0.1, -0.2, 0.05), 0.35);
        // Small, and so large that not every row is looked at.
        for side in [40usize, 700] {
            let mut capture = capture(&uniform_sphere(6, 1.5, 2));
            for (k, frame) in capture.frames.iter_mut().enumerate() {
                let s = side as f64;
                frame.camera = Camera { intrinsics: [s, s, 0.5 * s, 0.5 * s], size: [side; 2], ..frame.camera };
                let centre = frame.camera.world_from_camera.inverse().transform_point3(ball);
                let edge = (radius / centre.length()).asin();
                let picture = image::RgbImage::from_fn(side as u32, side as u32, |u, v| {
                    let ray = frame.camera.plane(glam::DVec2::new(u.into(), v.into())).extend(1.0);
                    image::Rgb([if ray.angle_between(centre) < edge { 30 } else { 255 }; 3])
                });
                frame.image = dir.path().join(format!("{side}-{k}.png"));
                picture.save(&frame.image).unwrap();
            }
            let (bounds, how) = capture.find_bounds(None, None, 1.3).unwrap();
            // Perspective widens a ball a little, and moves the middle of its box.
            assert!(bounds.centre.distance(ball) < 0.02, "{side}: {bounds:?}");
            assert!((bounds.diagonal / 0.7 - 1.04).abs() < 0.06, "{side}: {bounds:?}");
            assert!(how.contains("silhouette"), "{how}");
            let (given, _) = capture.find_bounds(Some(ball), Some(0.7), 1.3).unwrap();
            assert_eq!(given, Bounds { centre: ball, diagonal: 0.7 });
        }
    }

    #[test]
    fn lines_meet_where_they_meet() {
        let p = DVec3::new(0.3, -2.0, 5.0);
        let lines: Vec<_> = uniform_sphere(7, 4.0, 5).iter().map(|m| (m.w_axis.truncate(), p - m.w_axis.truncate())).collect();
        assert!(nearest_point(&lines).unwrap().distance(p) < 1e-12);
        assert_eq!(nearest_point(&[(DVec3::ZERO, DVec3::Z), (DVec3::X, DVec3::Z)]), None);
        assert_eq!(nearest_point(&[]), None);
    }
}
