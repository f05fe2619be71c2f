//! COLMAP models, binary and text: world to camera, quaternions `w x y z`, pixel centres at one half. Points are not read.

use super::{Collector, Format, ReadOptions, View, WriteOptions, Written, copy_mask, copy_picture, name_of};
use crate::camera::Camera;
use crate::capture::Capture;
use crate::error::{At, Error, Result, read_bytes, read_text};
use glam::{DMat3, DMat4, DQuat, DVec3};
use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};

/// COLMAP's lens models: number, name, and where each parameter goes: `f` is both focal lengths, then the names of
/// [`Camera::intrinsics`] and [`Camera::distortion`]; `0` must be 0.
const MODELS: &[(i32, &str, &[&str])] = &[
    (0, "SIMPLE_PINHOLE", &["f", "cx", "cy"]),
    (1, "PINHOLE", &["fx", "fy", "cx", "cy"]),
    (2, "SIMPLE_RADIAL", &["f", "cx", "cy", "k1"]),
    (3, "RADIAL", &["f", "cx", "cy", "k1", "k2"]),
    (4, "OPENCV", &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"]),
    (6, "FULL_OPENCV", &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "0", "0", "0"]),
];

/// Names of the models that are recognised but not read, by their numbers.
const OTHERS: &[(i32, &str)] =
    &[(5, "OPENCV_FISHEYE"), (7, "FOV"), (8, "SIMPLE_RADIAL_FISHEYE"), (9, "RADIAL_FISHEYE"), (10, "THIN_PRISM_FISHEYE")];

/// Where values lie in `[fx, fy, cx, cy, k1, k2, p1, p2, k3]`.
const SLOTS: [&str; 9] = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"];

#[derive(Debug, Clone, PartialEq)]
struct ModelCamera {
    size: [usize; 2],
    values: [f64; 9],
}

#[derive(Debug, Clone, PartialEq)]
struct ModelImage {
    /// w x y z, then the translation; world to camera.
    pose: [f64; 7],
    camera: u32,
    name: String,
}

/// The endings of a model's files, and whether those are binary. As COLMAP does, binary is preferred.
const ENDINGS: [(&str, bool); 2] = [("bin", true), ("txt", false)];

/// The files of a model with cameras and images.
fn files(folder: &Path, ending: &str) -> [PathBuf; 2] {
    ["cameras", "images"].map(|name| folder.join(name).with_extension(ending))
}

/// The folders in which a path may have models, those of one reconstruction together: COLMAP numbers the pieces that it could not
/// join.
fn folders(path: &Path) -> [Vec<PathBuf>; 5] {
    let numbered = |folder: &str| {
        let entries = std::fs::read_dir(path.join(folder)).into_iter().flatten().flatten();
        let number = |entry: std::fs::DirEntry| Some((entry.file_name().to_str()?.parse::<u32>().ok()?, entry.path()));
        let found: BTreeMap<_, _> = entries.filter_map(number).collect();
        found.into_values().collect()
    };
    [vec![path.into()], numbered("sparse"), vec![path.join("sparse")], numbered("colmap/sparse"), numbered("")]
}

/// The folder with a model that a path means, and whether it is binary; of several pieces that with the most images.
pub(crate) fn model(path: &Path) -> Option<(PathBuf, bool)> {
    folders(path).into_iter().find_map(|pieces| {
        let complete = pieces.into_iter().filter_map(|folder| {
            let ending = ENDINGS.into_iter().find(|(ending, _)| files(&folder, ending).iter().all(|file| file.is_file()));
            ending.map(|(_, binary)| (folder, binary))
        });
        let mut complete: Vec<_> = complete.collect();
        // Of equal ones the first.
        complete.sort_by_cached_key(|(folder, binary)| std::cmp::Reverse(registered(folder, *binary)));
        complete.into_iter().next()
    })
}

/// The number of images in a model; a file that cannot be read has none.
fn registered(folder: &Path, binary: bool) -> u64 {
    let [_, images] = files(folder, if binary { "bin" } else { "txt" });
    if binary {
        let mut count = [0; 8];
        let read = std::fs::File::open(images).and_then(|mut file| file.read_exact(&mut count));
        return read.map_or(0, |()| u64::from_le_bytes(count));
    }
    read_text(&images).and_then(|text| images_txt(&images, &text)).map_or(0, |images| images.len() as u64)
}

/// Where there is one of a model's two files, that the other is missing.
pub(crate) fn missing(path: &Path) -> Option<Error> {
    let models = folders(path).into_iter().flatten().flat_map(|folder| ENDINGS.map(|(ending, _)| files(&folder, ending)));
    models.into_iter().find_map(|files| {
        let (there, path) = match files.each_ref().map(|file| file.is_file()) {
            [true, false] => (&files[0], &files[1]),
            [false, true] => (&files[1], &files[0]),
            _ => return None,
        };
        Some(Error::Missing { path: path.clone(), why: format!("the COLMAP model of {} needs it", there.display()) })
    })
}

/// Reads a model. Pictures are looked for in `options.images`, else in `images/` of the path given.
pub fn read(path: &Path, options: &ReadOptions) -> Result<Capture> {
    let none =
        || Error::Missing { path: path.join("cameras.bin"), why: "a COLMAP model has it, or cameras.txt, and images".into() };
    let (folder, binary) = model(path).ok_or_else(|| missing(path).unwrap_or_else(none))?;
    let [cameras_file, images_file] = files(&folder, if binary { "bin" } else { "txt" });
    let (cameras, images) = if binary {
        (cameras_bin(&cameras_file, &read_bytes(&cameras_file)?)?, images_bin(&images_file, &read_bytes(&images_file)?)?)
    } else {
        (cameras_txt(&cameras_file, &read_text(&cameras_file)?)?, images_txt(&images_file, &read_text(&images_file)?)?)
    };
    // A model given as sparse/0 lies two folders below its pictures.
    let beside = || path.ancestors().take(4).map(|dir| dir.join("images")).find(|dir| dir.is_dir());
    let pictures = options.images.clone().or_else(beside).unwrap_or_else(|| path.join("images"));
    let mut found = Collector::new(name_of(path), Format::Colmap, options);
    for (id, image) in &images {
        let field = format!("image {id}, {}", image.name);
        let Some(camera) = cameras.get(&image.camera) else {
            found.skip(Error::field(&images_file, field, format!("a camera {}", image.camera), "none"));
            continue;
        };
        let [w, x, y, z, tx, ty, tz] = image.pose;
        let rotation = DQuat::from_xyzw(x, y, z, w);
        // COLMAP normalises when it reads; zero is no rotation, and neither is what is not a number.
        let length = rotation.length();
        if !(length > 1e-6 && length.is_finite()) {
            found.skip(Error::field(&images_file, field, "a quaternion with a length", length));
            continue;
        }
        let camera_from_world = DMat4::from_rotation_translation(rotation.normalize(), DVec3::new(tx, ty, tz));
        let [fx, fy, cx, cy, k1, k2, p1, p2, k3] = camera.values;
        let picture = pictures.join(image.name.replace('\\', "/"));
        let masks = pictures.parent().unwrap_or(Path::new("")).join("masks");
        found.add(View {
            place: (&images_file, field),
            name: Path::new(&image.name).file_stem().unwrap_or_default().to_string_lossy().into_owned(),
            mask: super::mask_in(&masks, &picture).ok(),
            image: picture,
            world_from_camera: camera_from_world.inverse(),
            intrinsics: Some([fx, fy, cx, cy]),
            distortion: [k1, k2, p1, p2, k3],
            size: Some(camera.size),
        });
    }
    found.capture.frames.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(found.capture)
}

fn camera(path: &Path, field: &str, model: &str, size: [u64; 2], params: &[f64]) -> Result<ModelCamera> {
    let Some((_, _, names)) = MODELS.iter().find(|(_, name, _)| *name == model) else {
        let known = MODELS.iter().map(|(_, name, _)| *name).collect::<Vec<_>>().join(", ");
        return Err(Error::field(path, format!("{field}: model"), format!("{known} (or COLMAP's image_undistorter)"), model));
    };
    if params.len() != names.len() {
        return Err(Error::field(path, format!("{field}: parameters of {model}"), names.len(), params.len()));
    }
    if size.iter().any(|s| !(1..1_000_000).contains(s)) {
        return Err(Error::field(path, format!("{field}: width height"), "between 1 and a million", format!("{size:?}")));
    }
    let mut values = [0.0; 9];
    for (name, &value) in names.iter().zip(params) {
        match (*name, SLOTS.iter().position(|slot| slot == name)) {
            ("f", _) => values[..2].fill(value),
            (_, Some(slot)) => values[slot] = value,
            _ if value == 0.0 => {}
            _ => return Err(Error::field(path, format!("{field}: k4, k5, k6"), 0, value)),
        }
    }
    Ok(ModelCamera { size: size.map(|s| s as usize), values })
}

/// The words of one line of a text model.
struct Line<'a> {
    path: &'a Path,
    number: usize,
    words: std::iter::Peekable<std::str::SplitWhitespace<'a>>,
}

impl<'a> Line<'a> {
    fn new(path: &'a Path, index: usize, text: &'a str) -> Self {
        Self { path, number: index + 1, words: text.split_whitespace().peekable() }
    }

    fn next<T: std::str::FromStr>(&mut self, name: &str) -> Result<T> {
        let word = self.words.next();
        word.and_then(|word| word.parse().ok()).ok_or_else(|| {
            let found =
                word.map_or("the end of the line".into(), |word| format!("\"{}\"", word.chars().take(40).collect::<String>()));
            Error::field(self.path, format!("line {}: {name}", self.number), "a number", found)
        })
    }
}

fn cameras_txt(path: &Path, text: &str) -> Result<BTreeMap<u32, ModelCamera>> {
    let mut cameras = BTreeMap::new();
    for (i, text) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty() && !line.starts_with('#')) {
        let mut line = Line::new(path, i, text);
        let id: u32 = line.next("CAMERA_ID")?;
        let model = line.words.next().unwrap_or_default();
        let size = [line.next("WIDTH")?, line.next("HEIGHT")?];
        let mut params = vec![];
        while line.words.peek().is_some() {
            params.push(line.next("PARAMS")?);
        }
        cameras.insert(id, camera(path, &format!("camera {id}"), model, size, &params)?);
    }
    Ok(cameras)
}

fn images_txt(path: &Path, text: &str) -> Result<BTreeMap<u32, ModelImage>> {
    let mut images = BTreeMap::new();
    // Two lines an image; the second, its points, may be empty, so empty lines count.
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.starts_with('#'));
    while let Some((i, text)) = lines.next() {
        if text.trim().is_empty() {
            continue;
        }
        let mut line = Line::new(path, i, text);
        let id: u32 = line.next("IMAGE_ID")?;
        let mut pose = [0.0; 7];
        for (value, name) in pose.iter_mut().zip(["QW", "QX", "QY", "QZ", "TX", "TY", "TZ"]) {
            *value = line.next(name)?;
        }
        let camera = line.next("CAMERA_ID")?;
        // A name may hold spaces: it is what follows the ninth word.
        let name =
            (0..9).try_fold(text.trim(), |rest, _| rest.split_once(char::is_whitespace).map(|(_, rest)| rest.trim_start()));
        let name = name.filter(|name| !name.is_empty());
        let name =
            name.ok_or_else(|| Error::field(path, format!("line {}: NAME", i + 1), "a file name", "the end of the line"))?;
        images.insert(id, ModelImage { pose, camera, name: name.into() });
        lines.next();
    }
    Ok(images)
}

/// Little-endian values one after the other; an end too early is an error that says where.
struct Bytes<'a> {
    path: &'a Path,
    all: &'a [u8],
    at: usize,
}

impl<'a> Bytes<'a> {
    fn take(&mut self, count: u64, what: &str) -> Result<&'a [u8]> {
        let rest = &self.all[self.at..];
        let taken = usize::try_from(count).ok().and_then(|count| rest.get(..count));
        let taken = taken.ok_or_else(|| {
            Error::field(
                self.path,
                format!("byte {}: {what}", self.at),
                format!("{count} bytes"),
                format!("{} until the end", rest.len()),
            )
        })?;
        self.at += taken.len();
        Ok(taken)
    }

    fn array<const N: usize>(&mut self, what: &str) -> Result<[u8; N]> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N as u64, what)?);
        Ok(array)
    }

    fn u32(&mut self, what: &str) -> Result<u32> {
        Ok(u32::from_le_bytes(self.array(what)?))
    }

    fn u64(&mut self, what: &str) -> Result<u64> {
        Ok(u64::from_le_bytes(self.array(what)?))
    }

    fn f64(&mut self, what: &str) -> Result<f64> {
        Ok(f64::from_le_bytes(self.array(what)?))
    }
}

fn cameras_bin(path: &Path, all: &[u8]) -> Result<BTreeMap<u32, ModelCamera>> {
    let mut bytes = Bytes { path, all, at: 0 };
    let mut cameras = BTreeMap::new();
    for _ in 0..bytes.u64("number of cameras")? {
        let id = bytes.u32("camera_id")?;
        let field = format!("camera {id}");
        let model = bytes.u32("model_id")? as i32;
        let size = [bytes.u64("width")?, bytes.u64("height")?];
        let Some((_, name, names)) = MODELS.iter().find(|(number, ..)| *number == model) else {
            let name = OTHERS.iter().find(|(number, _)| *number == model).map_or(model.to_string(), |(_, name)| name.to_string());
            return Err(camera(path, &field, &name, size, &[]).err().unwrap_or(Error::field(path, field, "a model", name)));
        };
        let params = names.iter().map(|_| bytes.f64("params")).collect::<Result<Vec<_>>>()?;
        cameras.insert(id, camera(path, &field, name, size, &params)?);
    }
    Ok(cameras)
}

fn images_bin(path: &Path, all: &[u8]) -> Result<BTreeMap<u32, ModelImage>> {
    let mut bytes = Bytes { path, all, at: 0 };
    let mut images = BTreeMap::new();
    for _ in 0..bytes.u64("number of images")? {
        let id = bytes.u32("image_id")?;
        let mut pose = [0.0; 7];
        for value in &mut pose {
            *value = bytes.f64("quaternion and translation")?;
        }
        let camera = bytes.u32("camera_id")?;
        let start = bytes.at;
        while bytes.array::<1>("name")? != [0] {}
        let name = String::from_utf8_lossy(&all[start..bytes.at - 1]).into_owned();
        // x, y and the number of a point: 24 bytes each, not needed.
        let points = bytes.u64("number of points")?;
        bytes.take(points.saturating_mul(24), "points")?;
        images.insert(id, ModelImage { pose, camera, name });
    }
    Ok(images)
}

/// The least of COLMAP's models that holds a camera, and its parameters.
fn least_model(camera: &Camera) -> (i32, &'static str, Vec<f64>) {
    let ([fx, fy, cx, cy], [k1, k2, p1, p2, k3]) = (camera.intrinsics, camera.distortion);
    let values = [fx, fy, cx, cy, k1, k2, p1, p2, k3];
    let holds = |names: &[&str]| {
        let has_focal = fx == fy || names.contains(&"fx");
        has_focal && SLOTS.iter().zip(values).skip(4).all(|(slot, value)| value == 0.0 || names.contains(slot))
    };
    let (number, name, names) = MODELS.iter().find(|(_, _, names)| holds(names)).unwrap_or(&MODELS[MODELS.len() - 1]);
    let value =
        |name: &&str| SLOTS.iter().position(|slot| slot == name).map_or(if *name == "f" { fx } else { 0.0 }, |i| values[i]);
    (*number, name, names.iter().map(value).collect())
}

/// Writes `dir` with `sparse/0/`, `images/` and, where there are some, `masks/`.
pub(super) fn write(capture: &Capture, dir: PathBuf, binary: bool, options: &WriteOptions) -> Result<Written> {
    super::make_dir(&dir, options.replace)?;
    let model = dir.join("sparse").join("0");
    std::fs::create_dir_all(&model).at(&model)?;
    let mut cameras: Vec<Camera> = vec![];
    let mut images = vec![];
    for frame in &capture.frames {
        let (file, camera) = copy_picture(frame, &dir.join("images"), &frame.name, false)?;
        copy_mask(frame, &dir.join("masks").join(format!("{file}.png")), false)?;
        let lens = Camera { world_from_camera: DMat4::IDENTITY, ..camera.with_pixel_centre(0.5) };
        let id = cameras.iter().position(|known| *known == lens).unwrap_or_else(|| {
            cameras.push(lens);
            cameras.len() - 1
        });
        let pose = camera.world_from_camera;
        let rotation = DQuat::from_mat3(&DMat3::from_mat4(pose)).normalize().inverse();
        // The quaternion is exactly a rotation; this translation keeps the centre of the camera where it is.
        let translation = -(rotation * pose.w_axis.truncate());
        let [x, y, z, w] = rotation.to_array();
        images.push(ModelImage {
            pose: [w, x, y, z, translation.x, translation.y, translation.z],
            camera: id as u32 + 1,
            name: file,
        });
    }
    let write = |name: &str, content: Vec<u8>| {
        for (ending, is_binary) in ENDINGS {
            let path = model.join(name).with_extension(ending);
            // A model of the other kind, by an earlier export, might be read before this one.
            match is_binary == binary {
                true => std::fs::write(&path, &content).at(&path)?,
                false if path.exists() => std::fs::remove_file(&path).at(&path)?,
                false => {}
            }
        }
        Ok(())
    };
    if binary {
        let mut bytes = (cameras.len() as u64).to_le_bytes().to_vec();
        for (i, camera) in cameras.iter().enumerate() {
            let (number, _, params) = least_model(camera);
            bytes.extend((i as u32 + 1).to_le_bytes());
            bytes.extend(number.to_le_bytes());
            bytes.extend(camera.size.iter().flat_map(|&s| (s as u64).to_le_bytes()));
            bytes.extend(params.iter().flat_map(|x| x.to_le_bytes()));
        }
        write("cameras", bytes)?;
        let mut bytes = (images.len() as u64).to_le_bytes().to_vec();
        for (i, image) in images.iter().enumerate() {
            bytes.extend((i as u32 + 1).to_le_bytes());
            bytes.extend(image.pose.iter().flat_map(|x| x.to_le_bytes()));
            bytes.extend(image.camera.to_le_bytes());
            bytes.extend(image.name.bytes().chain([0]));
            bytes.extend(0u64.to_le_bytes());
        }
        write("images", bytes)?;
        write("points3D", 0u64.to_le_bytes().to_vec())?;
    } else {
        let words = |values: &[f64]| values.iter().map(|x| format!("{x:?}")).collect::<Vec<_>>().join(" ");
        let mut text = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n".to_owned();
        for (i, camera) in cameras.iter().enumerate() {
            let (_, name, params) = least_model(camera);
            text += &format!("{} {name} {} {} {}\n", i + 1, camera.size[0], camera.size[1], words(&params));
        }
        write("cameras", text.into())?;
        let mut text = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then a line of points, here none\n".to_owned();
        for (i, image) in images.iter().enumerate() {
            text += &format!("{} {} {} {}\n\n", i + 1, words(&image.pose), image.camera, image.name);
        }
        write("images", text.into())?;
        write("points3D", "# no points\n".into())?;
    }
    Ok(Written { dir, views: images.len(), ..Written::default() })
}
