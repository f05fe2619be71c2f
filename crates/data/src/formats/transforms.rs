//! `transforms.json` of nerfstudio, instant-ngp and NeRF: camera to world in OpenGL axes, intrinsics for all frames or for each,
//! pixel centres at one half.

use super::{Collector, Format, ReadOptions, View, WriteOptions, Written, copy_mask, copy_picture, from_json, name_of, rows};
use crate::camera::{Axes, Camera};
use crate::capture::Capture;
use crate::error::{Error, Result, read_text};
use crate::pixels::with_ending;
use glam::{DMat4, DVec4};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// What may stand at the top for all frames, or in one frame for itself.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
struct Lens {
    #[serde(skip_serializing_if = "Option::is_none")]
    camera_model: Option<String>,
    // The older form, radians; read only.
    #[serde(skip_serializing)]
    camera_angle_x: Option<f64>,
    #[serde(skip_serializing)]
    camera_angle_y: Option<f64>,
    #[serde(skip_serializing)]
    is_fisheye: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    fl_x: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    fl_y: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    cx: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    cy: Option<f64>,
    // Some programs write sizes as 640.0.
    #[serde(skip_serializing_if = "Option::is_none")]
    w: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    h: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    k1: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    k2: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    k3: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    k4: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    p1: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    p2: Option<f64>,
}

#[derive(Debug, Serialize, Deserialize)]
struct File {
    #[serde(flatten)]
    lens: Lens,
    #[serde(skip_serializing_if = "Option::is_none")]
    applied_transform: Option<Vec<Vec<f64>>>,
    frames: Vec<FileFrame>,
}

#[derive(Debug, Serialize, Deserialize)]
struct FileFrame {
    file_path: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    mask_path: Option<String>,
    transform_matrix: Vec<Vec<f64>>,
    #[serde(flatten)]
    lens: Lens,
}

/// The file that a path means: itself, or `transforms.json` in it.
pub(crate) fn file(path: &Path) -> Option<PathBuf> {
    [path.to_owned(), path.join("transforms.json")].into_iter().find(|path| path.is_file())
}

/// Reads the file, or the one in a folder.
pub fn read(path: &Path, options: &ReadOptions) -> Result<Capture> {
    let path =
        file(path).ok_or_else(|| Error::Missing { path: path.join("transforms.json"), why: "that format needs it".into() })?;
    let text = read_text(&path)?;
    let content: File = from_json(&path, &text)?;
    let folder = options.images.as_deref().unwrap_or(path.parent().unwrap_or(Path::new("")));
    let mut found = Collector::new(name_of(&path), Format::Transforms, options);
    for (i, frame) in content.frames.iter().enumerate() {
        let field = format!("frames[{i}], {}", frame.file_path);
        let view = || -> Result<View> {
            let image = picture(folder, &frame.file_path);
            let (intrinsics, size, distortion) = frame.lens.or(&content.lens).read(&path, &field, &image)?;
            Ok(View {
                name: image.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
                mask: frame.mask_path.as_ref().map(|mask| folder.join(mask.replace('\\', "/"))),
                world_from_camera: matrix(&path, &field, &frame.transform_matrix)?,
                place: (&path, field.clone()),
                image,
                intrinsics,
                distortion,
                size,
            })
        };
        match view() {
            Ok(view) => found.add(view),
            Err(error) => found.skip(error),
        }
    }
    if let Some(rows) = &content.applied_transform {
        found.capture.applied_transform = Some(matrix(&path, "applied_transform", rows)?);
    }
    Ok(found.capture)
}

/// The picture of a frame; NeRF's own sets leave the ending out.
fn picture(folder: &Path, file_path: &str) -> PathBuf {
    let path = folder.join(file_path.replace('\\', "/"));
    if path.is_file() { path } else { with_ending(&path).unwrap_or(path) }
}

/// Three or four rows of four.
fn matrix(path: &Path, field: &str, rows: &[Vec<f64>]) -> Result<DMat4> {
    let row = |r: usize| rows.get(r).and_then(|row| <[f64; 4]>::try_from(row.as_slice()).ok()).map(DVec4::from_array);
    match (row(0), row(1), row(2), row(3), rows.len()) {
        (Some(a), Some(b), Some(c), d, 3 | 4) if d.is_some() == (rows.len() == 4) => {
            Ok(DMat4::from_cols(a, b, c, d.unwrap_or(DVec4::W)).transpose())
        }
        _ => {
            let found = rows.iter().map(|row| row.len().to_string()).collect::<Vec<_>>().join(", ");
            Err(Error::field(path, field, "a matrix of 4 rows of 4 numbers", format!("rows of {found}")))
        }
    }
}

impl Lens {
    /// A frame's own values where it has some, else those of all frames.
    fn or(&self, all: &Lens) -> Lens {
        macro_rules! pick {
            ($($field:ident),*) => { Lens { $($field: self.$field.clone().or_else(|| all.$field.clone()),)* } };
        }
        pick!(camera_model, camera_angle_x, camera_angle_y, is_fisheye, fl_x, fl_y, cx, cy, w, h, k1, k2, k3, k4, p1, p2)
    }

    /// Intrinsics, size and distortion, as far as they are there.
    #[expect(clippy::type_complexity, reason = "three parts of a view")]
    fn read(&self, path: &Path, field: &str, image: &Path) -> Result<(Option<[f64; 4]>, Option<[usize; 2]>, [f64; 5])> {
        let refuse =
            |what: &str, expected: &str, found: String| Err(Error::field(path, format!("{field}: {what}"), expected, found));
        let model = self.camera_model.as_deref().unwrap_or("OPENCV").to_ascii_uppercase();
        if !["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL"].contains(&model.as_str()) {
            return refuse("camera_model", "OPENCV or PINHOLE; undistort other lenses first", model);
        }
        if self.is_fisheye == Some(true) {
            return refuse("is_fisheye", "false; undistort fisheye pictures first", "true".into());
        }
        if let Some(k4) = self.k4.filter(|&k4| k4 != 0.0) {
            return refuse("k4", "0, as OpenCV's lens has none", k4.to_string());
        }
        let size = match (self.w, self.h) {
            (Some(w), Some(h)) if [w, h].iter().all(|s| (1.0..1e6).contains(s) && s.fract() == 0.0) => {
                Some([w as usize, h as usize])
            }
            (Some(w), Some(h)) => return refuse("w, h", "positive whole numbers", format!("{w}, {h}")),
            _ => None,
        };
        let [k1, k2, p1, p2, k3] = [self.k1, self.k2, self.p1, self.p2, self.k3].map(|k| k.unwrap_or(0.0));
        let needs_size = self.cx.is_none() || self.cy.is_none() || self.fl_x.is_none();
        let [w, h] = match size {
            Some(size) => size,
            None if needs_size => crate::srn::picture_size(image)?,
            None => [0; 2],
        }
        .map(|s| s as f64);
        let angles = [("camera_angle_x", self.camera_angle_x, self.fl_x), ("camera_angle_y", self.camera_angle_y, self.fl_y)];
        for (name, angle, focal) in angles {
            if let Some(angle) = angle.filter(|angle| focal.is_none() && !(0.0 < *angle && *angle < std::f64::consts::PI)) {
                return refuse(name, "radians between 0 and π", angle.to_string());
            }
        }
        let of_angle = |angle: Option<f64>, side: f64| angle.map(|angle| 0.5 * side / (0.5 * angle).tan());
        let fx = self.fl_x.or(of_angle(self.camera_angle_x, w)).or(self.fl_y).or(of_angle(self.camera_angle_y, h));
        let fy = self.fl_y.or(of_angle(self.camera_angle_y, h)).or(fx);
        let intrinsics = fx.zip(fy).map(|(fx, fy)| [fx, fy, self.cx.unwrap_or(0.5 * w), self.cy.unwrap_or(0.5 * h)]);
        Ok((intrinsics, size, [k1, k2, p1, p2, k3]))
    }

    /// All that a camera has.
    fn of(camera: &Camera) -> Self {
        let camera = camera.with_pixel_centre(0.5);
        let ([fl_x, fl_y, cx, cy], [k1, k2, p1, p2, k3]) = (camera.intrinsics.map(Some), camera.distortion.map(Some));
        let [w, h] = camera.size.map(|s| Some(s as f64));
        let k3 = k3.filter(|&k3| k3 != 0.0);
        Self { camera_model: Some("OPENCV".into()), fl_x, fl_y, cx, cy, w, h, k1, k2, p1, p2, k3, ..Self::default() }
    }
}

/// Writes `dir/transforms.json` with `images/` and, where there are some, `masks/`.
pub(super) fn write(capture: &Capture, dir: PathBuf, axes: Axes, options: &WriteOptions) -> Result<Written> {
    super::make_dir(&dir, options.replace)?;
    let lens: Vec<_> = capture.frames.iter().map(|frame| Camera { world_from_camera: DMat4::IDENTITY, ..frame.camera }).collect();
    let shared = lens.first().filter(|first| lens.iter().all(|camera| camera == *first)).map(Lens::of);
    let mut frames = vec![];
    for frame in &capture.frames {
        let (file, camera) = copy_picture(frame, &dir.join("images"), &frame.name, false)?;
        let mask_path = frame.mask.as_ref().map(|_| format!("masks/{}.png", frame.name));
        if let Some(mask) = &mask_path {
            copy_mask(frame, &dir.join(mask), false)?;
        }
        frames.push(FileFrame {
            file_path: format!("images/{file}"),
            mask_path,
            transform_matrix: rows(&axes.of_ours(camera.world_from_camera)).map(Vec::from).to_vec(),
            lens: if shared.is_some() { Lens::default() } else { Lens::of(&camera) },
        });
    }
    let applied_transform = capture.applied_transform.map(|m| rows(&m)[..3].iter().map(|row| row.to_vec()).collect());
    let views = frames.len();
    let content = File { lens: shared.unwrap_or_default(), applied_transform, frames };
    super::write_json(&dir.join("transforms.json"), &content)?;
    Ok(Written { dir, views, ..Written::default() })
}
