//! BOP: scenes with `scene_camera.json` and `scene_gt.json`, millimetres, the object in the camera; results as CSV.
//!
//! Captures read from here are in metres, in the object's own frame. Model-free onboarding (`onboarding_static/obj_000001_up`
//! and so on) has the same files.

use super::{Collector, Format, ReadOptions, View, WriteOptions, Written, copy_mask, copy_picture, from_json};
use crate::capture::{Bounds, Capture};
use crate::error::{At, Error, Result, read_text};
use crate::pixels::with_ending;
use glam::{DMat3, DMat4, DVec3};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Millimetres in the unit of captures.
const MM: f64 = 1000.0;

#[derive(Serialize, Deserialize)]
#[expect(non_snake_case, reason = "the names of the format")]
struct SceneCamera {
    #[serde(skip_serializing_if = "Option::is_none")]
    cam_K: Option<[f64; 9]>,
    // Written because BOP's own tools ask for it; there is no depth here.
    #[serde(default)]
    depth_scale: f64,
}

#[derive(Serialize, Deserialize)]
#[expect(non_snake_case, reason = "the names of the format")]
struct SceneGt {
    cam_R_m2c: [f64; 9],
    cam_t_m2c: [f64; 3],
    obj_id: u32,
}

/// What `models_info.json` says of one object, in metres.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ModelInfo {
    /// Centre and diagonal of the bounding box, if it is there.
    pub bounds: Option<Bounds>,
    /// Motions that leave the object as it looks.
    pub discrete: Vec<DMat4>,
    /// Axes, each a direction and a point on it, about which every turn leaves the object as it looks.
    pub continuous: Vec<[DVec3; 2]>,
}

#[derive(Deserialize)]
struct RawModelInfo {
    min_x: Option<f64>,
    min_y: Option<f64>,
    min_z: Option<f64>,
    size_x: Option<f64>,
    size_y: Option<f64>,
    size_z: Option<f64>,
    #[serde(default)]
    symmetries_discrete: Vec<[f64; 16]>,
    #[serde(default)]
    symmetries_continuous: Vec<RawAxis>,
}

#[derive(Deserialize)]
struct RawAxis {
    axis: [f64; 3],
    offset: [f64; 3],
}

/// Reads `models_info.json`: box and symmetries of each object.
pub fn read_models_info(path: &Path) -> Result<BTreeMap<u32, ModelInfo>> {
    let raw: BTreeMap<u32, RawModelInfo> = from_json(path, &read_text(path)?)?;
    let read = |(id, raw): (u32, RawModelInfo)| {
        let vector = |x: Option<f64>, y: Option<f64>, z: Option<f64>| Some(DVec3::new(x?, y?, z?) / MM);
        let box_ = vector(raw.min_x, raw.min_y, raw.min_z).zip(vector(raw.size_x, raw.size_y, raw.size_z));
        let bounds = box_.map(|(low, size)| Bounds { centre: low + 0.5 * size, diagonal: size.length() });
        if let Some(bounds) = bounds.filter(|b| !(b.diagonal > 0.0 && b.diagonal.is_finite())) {
            return Err(Error::field(path, format!("object {id}: size"), "a box with an extent", bounds.diagonal));
        }
        let motion = |rows: &[f64; 16]| {
            let mut motion = DMat4::from_cols_array(rows).transpose();
            motion.w_axis = (motion.w_axis.truncate() / MM).extend(motion.w_axis.w);
            crate::srn::rigid(path, &format!("object {id}: symmetries_discrete"), motion)
        };
        let discrete = raw.symmetries_discrete.iter().map(motion).collect::<Result<_>>()?;
        let axis = |a: &RawAxis| [DVec3::from_array(a.axis), DVec3::from_array(a.offset) / MM];
        let continuous = raw.symmetries_continuous.iter().map(axis).collect();
        Ok((id, ModelInfo { bounds, discrete, continuous }))
    };
    raw.into_iter().map(read).collect()
}

/// The scene folders that a path means: itself, or those in it; none if it is not BOP.
pub(crate) fn scenes(path: &Path) -> Result<Vec<PathBuf>> {
    let is_scene = |path: &Path| path.join("scene_camera.json").is_file();
    if is_scene(path) || !path.is_dir() {
        return Ok(if is_scene(path) { vec![path.into()] } else { vec![] });
    }
    let entries = std::fs::read_dir(path).at(path)?.map(|entry| Ok(entry.at(path)?.path())).collect::<Result<Vec<_>>>()?;
    let mut found: Vec<_> = entries.into_iter().filter(|path| is_scene(path)).collect();
    found.sort();
    Ok(found)
}

/// Reads a scene, or all scenes in a folder: one capture for each scene and object. An image that shows an object twice gives
/// two views.
pub fn read(path: &Path, options: &ReadOptions) -> Result<Vec<Capture>> {
    let mut captures = vec![];
    for scene in scenes(path)? {
        captures.extend(read_scene(&scene, options)?);
    }
    match (captures.is_empty(), options.object) {
        (false, _) => Ok(captures),
        (true, Some(object)) => Err(Error::field(path, "obj_id", object, "other objects only")),
        (true, None) => Err(Error::field(path, "folder", "scenes with scene_camera.json, and objects in scene_gt.json", "none")),
    }
}

fn read_scene(dir: &Path, options: &ReadOptions) -> Result<Vec<Capture>> {
    let (cameras_file, poses_file) = (dir.join("scene_camera.json"), dir.join("scene_gt.json"));
    let cameras: BTreeMap<u32, SceneCamera> = from_json(&cameras_file, &read_text(&cameras_file)?)?;
    let poses: BTreeMap<u32, Vec<SceneGt>> = from_json(&poses_file, &read_text(&poses_file)?)?;
    let mut ids: Vec<_> = poses.values().flatten().map(|pose| pose.obj_id).collect();
    ids.sort();
    ids.dedup();
    // models/ lies beside the split that the scene lies in.
    let info_file = dir.ancestors().skip(1).take(3).map(|dir| dir.join("models").join("models_info.json")).find(|p| p.is_file());
    let infos = info_file.map(|path| read_models_info(&path)).transpose()?.unwrap_or_default();
    let mut captures = vec![];
    for &id in ids.iter().filter(|&&id| options.object.is_none_or(|wanted| wanted == id)) {
        let folder = super::name_of(dir);
        let name = if ids.len() == 1 { folder } else { format!("{folder}-obj_{id:06}") };
        let mut found = Collector::new(name, Format::Bop, options);
        for (&image, poses) in &poses {
            let several = poses.iter().filter(|pose| pose.obj_id == id).count() > 1;
            for (k, pose) in poses.iter().enumerate().filter(|(_, pose)| pose.obj_id == id) {
                let field = format!("image {image}, entry {k}");
                let Some(cam_k) = cameras.get(&image).map(|camera| camera.cam_K) else {
                    found.skip(Error::field(&cameras_file, format!("image {image}"), "a camera", "none"));
                    continue;
                };
                let of_image = |folder: &str, name: String| with_ending(&dir.join(folder).join(name));
                let missing = || dir.join("rgb").join(format!("{image:06}.png"));
                let mask = |folder| of_image(folder, format!("{image:06}_{k:06}"));
                let rotation = DMat3::from_cols_array(&pose.cam_R_m2c).transpose();
                let camera_from_object = DMat4::from_mat3_translation(rotation, DVec3::from_array(pose.cam_t_m2c) / MM);
                found.add(View {
                    place: (&poses_file, field),
                    name: if several { format!("{image:06}_{k:06}") } else { format!("{image:06}") },
                    image: ["rgb", "gray"].iter().find_map(|f| of_image(f, format!("{image:06}"))).unwrap_or_else(missing),
                    mask: mask("mask_visib").or_else(|| mask("mask")),
                    world_from_camera: camera_from_object.inverse(),
                    intrinsics: cam_k.map(|k| [k[0], k[4], k[2], k[5]]),
                    distortion: [0.0; 5],
                    size: None,
                });
            }
        }
        found.capture.object_id = Some(id);
        found.capture.scene_id = super::name_of(dir).parse().ok();
        found.capture.bounds = infos.get(&id).and_then(|info| info.bounds);
        captures.push(found.capture);
    }
    Ok(captures)
}

/// Gives captures numbers of scene and object that tell them apart: those that they came with; else the scene has its object's, as
/// BOP numbers the training pictures of objects, or the first that is free. Of captures from one scene, each becomes its own.
pub fn number(captures: &mut [Capture]) {
    let free =
        |taken: &mut BTreeSet<u32>, wanted: u32| std::iter::once(wanted).chain(1..=u32::MAX).find(|number| taken.insert(*number));
    let mut shared = BTreeMap::new();
    captures.iter().filter_map(|capture| capture.scene_id).for_each(|scene| *shared.entry(scene).or_insert(0) += 1);
    let own = |capture: &Capture| capture.scene_id.filter(|scene| shared[scene] == 1);
    let mut scenes: BTreeSet<_> = captures.iter().filter_map(|capture| capture.scene_id).collect();
    let mut objects: BTreeSet<_> = captures.iter().filter_map(|capture| capture.object_id).collect();
    for capture in captures {
        capture.object_id = capture.object_id.or_else(|| free(&mut objects, 1));
        capture.scene_id = own(capture).or_else(|| free(&mut scenes, capture.object_id.unwrap_or(1)));
    }
}

/// Writes a scene. A unit of the capture is a metre; lenses are undone, for BOP has none.
pub(super) fn write(capture: &Capture, dir: PathBuf, options: &WriteOptions) -> Result<Written> {
    let object = capture.object_id.unwrap_or(1);
    super::make_dir(&dir, options.replace)?;
    let (mut cameras, mut poses) = (BTreeMap::new(), BTreeMap::new());
    // Names that are numbers stay; if one is not, all are counted.
    let numbers: Option<Vec<u32>> = capture.frames.iter().map(|frame| frame.name.parse().ok()).collect();
    let distinct = |numbers: &Vec<u32>| numbers.iter().collect::<BTreeSet<_>>().len() == numbers.len();
    let numbers = numbers.filter(distinct).unwrap_or_else(|| (0..capture.frames.len() as u32).collect());
    for (frame, &number) in capture.frames.iter().zip(&numbers) {
        let (_, camera) = copy_picture(frame, &dir.join("rgb"), &format!("{number:06}"), true)?;
        copy_mask(frame, &dir.join("mask_visib").join(format!("{number:06}_000000.png")), true)?;
        let [fx, fy, cx, cy] = camera.with_pixel_centre(0.0).intrinsics;
        cameras.insert(number, SceneCamera { cam_K: Some([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]), depth_scale: 1.0 });
        let camera_from_object = camera.world_from_camera.inverse();
        poses.insert(
            number,
            [SceneGt {
                cam_R_m2c: DMat3::from_mat4(camera_from_object).transpose().to_cols_array(),
                cam_t_m2c: (camera_from_object.w_axis.truncate() * MM).to_array(),
                obj_id: object,
            }],
        );
    }
    super::write_json(&dir.join("scene_camera.json"), &cameras)?;
    super::write_json(&dir.join("scene_gt.json"), &poses)?;
    Ok(Written { dir, views: numbers.len(), ..Written::default() })
}

/// One line of a results file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Number of the scene.
    pub scene_id: u32,
    /// Number of the image in the scene.
    pub im_id: u32,
    /// Number of the object.
    pub obj_id: u32,
    /// Confidence, the higher the better.
    pub score: f64,
    /// Our camera axes; metres.
    pub camera_from_object: DMat4,
    /// Seconds for the whole image; −1 if not known.
    pub time: f64,
}

/// The first line of a results file.
const HEADER: &str = "scene_id,im_id,obj_id,score,R,t,time";

/// Writes results for BOP's evaluation.
pub fn write_results(path: &Path, estimates: &[Estimate], replace: bool) -> Result<()> {
    if path.exists() && !replace {
        return Err(Error::Exists { path: path.into() });
    }
    let mut text = HEADER.to_owned() + "\n";
    for e in estimates {
        let words = |numbers: &[f64]| numbers.iter().map(|x| format!("{x:?}")).collect::<Vec<_>>().join(" ");
        let rotation = words(&DMat3::from_mat4(e.camera_from_object).transpose().to_cols_array());
        let translation = words(&(e.camera_from_object.w_axis.truncate() * MM).to_array());
        let Estimate { scene_id, im_id, obj_id, score, time, .. } = e;
        text += &format!("{scene_id},{im_id},{obj_id},{score:?},{rotation},{translation},{time:?}\n");
    }
    std::fs::write(path, text).at(path)
}

/// Reads a results file.
pub fn read_results(path: &Path) -> Result<Vec<Estimate>> {
    let text = read_text(path)?;
    let mut estimates = vec![];
    for (i, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        if i == 0 && line.trim() == HEADER {
            continue;
        }
        let place = |name: &str| format!("line {}: {name}", i + 1);
        let values: Vec<_> = line.split(',').collect();
        let [scene, image, object, score, rotation, translation, time] = values[..] else {
            return Err(Error::field(path, format!("line {}", i + 1), "7 values with commas between", values.len()));
        };
        let whole = |name, word: &str| {
            word.trim().parse::<u32>().map_err(|_| Error::field(path, place(name), "a whole number", format!("\"{word}\"")))
        };
        let numbers = |name: &str, words: &str, count: usize| {
            let read: Option<Vec<f64>> =
                words.split_whitespace().map(|w| w.parse().ok().filter(|x: &f64| x.is_finite())).collect();
            let expected = format!("{count} finite numbers");
            read.filter(|read| read.len() == count)
                .ok_or_else(|| Error::field(path, place(name), expected, format!("\"{words}\"")))
        };
        let r = numbers("R", rotation, 9)?;
        let t = numbers("t", translation, 3)?;
        let row = |k: usize| DVec3::new(r[3 * k], r[3 * k + 1], r[3 * k + 2]);
        let matrix =
            DMat4::from_mat3_translation(DMat3::from_cols(row(0), row(1), row(2)).transpose(), DVec3::new(t[0], t[1], t[2]) / MM);
        estimates.push(Estimate {
            scene_id: whole("scene_id", scene)?,
            im_id: whole("im_id", image)?,
            obj_id: whole("obj_id", object)?,
            score: numbers("score", score, 1)?[0],
            camera_from_object: crate::srn::rigid(path, &place("R"), matrix)?,
            time: numbers("time", time, 1)?[0],
        });
    }
    Ok(estimates)
}
