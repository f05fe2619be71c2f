//! Posed pictures in the formats that people have: read into [`Capture`]s, written from them.
//!
//! Every reader ends with an error that names file and place, or leaves a view out and says so in [`Capture::skipped`]; a pose
//! that is mirrored, scaled or not a number is never passed on.

pub mod bop;
pub mod colmap;
pub mod srn;
pub mod transforms;

use crate::camera::{Axes, Camera};
use crate::capture::{Capture, Frame, UpAxis};
use crate::error::{At, Error, Result};
use crate::picture::Picture;
use crate::pixels::{decode, with_ending};
use crate::srn::{picture_size, rigid, write_png};
use glam::DMat4;
use std::path::{Path, PathBuf};

/// A format of posed pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// SRN folders: `<instance>/{rgb,pose,intrinsics.txt}`.
    Srn,
    /// `transforms.json` of nerfstudio, instant-ngp and NeRF.
    Transforms,
    /// BOP scenes: `scene_camera.json`, `scene_gt.json`, `rgb/`.
    Bop,
    /// COLMAP models in binary: `cameras.bin`, `images.bin`. Reading takes text as well.
    Colmap,
    /// COLMAP models in text: `cameras.txt`, `images.txt`.
    ColmapText,
}

impl Format {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Srn, Self::Transforms, Self::Bop, Self::Colmap, Self::ColmapText];

    /// The name, as flags spell it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Srn => "srn",
            Self::Transforms => "transforms",
            Self::Bop => "bop",
            Self::Colmap => "colmap",
            Self::ColmapText => "colmap-text",
        }
    }

    /// The axes of its cameras.
    pub fn axes(self) -> Axes {
        if self == Self::Transforms { Axes::OpenGl } else { Axes::OpenCv }
    }

    /// What is up in its world, where it does not say: COLMAP's axes mean nothing.
    pub fn up(self) -> UpAxis {
        if matches!(self, Self::Colmap | Self::ColmapText) { UpAxis::Cameras } else { UpAxis::Axis(2, false) }
    }

    /// The format of a file or folder, by the files that only one format has.
    pub fn detect(path: &Path) -> Result<Self> {
        if path.is_file() && path.extension().is_some_and(|extension| extension == "json") || transforms::file(path).is_some() {
            return Ok(Self::Transforms);
        }
        if !bop::scenes(path)?.is_empty() {
            return Ok(Self::Bop);
        }
        if colmap::model(path).is_some() {
            return Ok(Self::Colmap);
        }
        if crate::SrnSet::open(path).is_ok() {
            return Ok(Self::Srn);
        }
        if let Some(error) = colmap::missing(path) {
            return Err(error);
        }
        let expected =
            "an SRN folder (rgb/, pose/), transforms.json, a BOP scene (scene_camera.json) or a COLMAP model (cameras.bin)";
        let found = match std::fs::read_dir(path).at(path)?.filter_map(|entry| entry.ok()).map(|entry| entry.file_name()).min() {
            Some(name) => format!("none of them, but {}", name.to_string_lossy()),
            None => "nothing".into(),
        };
        Err(Error::field(path, "folder", expected, found))
    }
}

/// How a source differs from what its format says, and where to find what it lacks.
#[derive(Debug, Clone, Default)]
pub struct ReadOptions {
    /// The axes of the cameras, where they are not those of the format.
    pub axes: Option<Axes>,
    /// The poses are the inverse of what the format says.
    pub inverted: bool,
    /// Angle of view across the width, in degrees; replaces the source's intrinsics and distortion.
    pub fov_deg: Option<f64>,
    /// Folder of masks, named like the pictures; replaces the source's masks.
    pub masks: Option<PathBuf>,
    /// Folder that the names of pictures are relative to; COLMAP does not store it.
    pub images: Option<PathBuf>,
    /// BOP: only the object of this number.
    pub object: Option<u32>,
}

/// Reads a file or folder; one capture per object, at least one, each with at least one view.
pub fn read(path: &Path, format: Format, options: &ReadOptions) -> Result<Vec<Capture>> {
    let captures = match format {
        Format::Srn => srn::read(path, options)?,
        Format::Transforms => vec![transforms::read(path, options)?],
        Format::Bop => bop::read(path, options)?,
        Format::Colmap | Format::ColmapText => vec![colmap::read(path, options)?],
    };
    for capture in &captures {
        if capture.frames.is_empty() {
            let expected = "at least one usable view";
            let found = match &capture.skipped[..] {
                [] => "none".into(),
                [only] => format!("none; {only}"),
                [first, rest @ ..] => format!("none; {first} (and {} more)", rest.len()),
            };
            return Err(Error::field(path, capture.name.clone(), expected, found));
        }
    }
    Ok(captures)
}

/// What writing does beside writing.
#[derive(Debug, Clone, Default)]
pub struct WriteOptions {
    /// The axes of the cameras, where they are not those of the format.
    pub axes: Option<Axes>,
    /// SRN only: squares of this side, cut around the object; else pictures stay whole.
    pub side: Option<usize>,
    /// The capture is in our frame: where no mask tells the object, the unit sphere does. Else squares are cut from the middle.
    pub placed: bool,
    /// Room around the object on each side of a square, as a share of its extent.
    pub margin: f64,
    /// Replace what is there.
    pub replace: bool,
}

/// What was written.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Written {
    /// The folder.
    pub dir: PathBuf,
    /// Number of views.
    pub views: usize,
    /// What was left out, one line each.
    pub skipped: Vec<String>,
    /// What is odd but was written, one line each.
    pub warnings: Vec<String>,
}

/// The folder that [`write()`] makes for a capture: `out/<name>`; for BOP `out/<scene>`, where the capture has no number of a scene
/// that of its object, as BOP names the training pictures of an object.
pub fn folder(capture: &Capture, format: Format, out: &Path) -> PathBuf {
    match format {
        Format::Bop => out.join(format!("{:06}", capture.scene_id.or(capture.object_id).unwrap_or(1))),
        _ => out.join(&capture.name),
    }
}

/// Fails if a picture or mask lies in one of the folders, which are to be written to: it would be gone before it is read.
pub fn refuse_sources(captures: &[Capture], folders: &[PathBuf]) -> Result<()> {
    let entries = |dir: &PathBuf| std::fs::read_dir(dir).into_iter().flatten().flatten().map(|entry| entry.path());
    let mut reached = std::collections::HashMap::new();
    for dir in folders {
        // What is to be replaced, or the folder that it is in, may be a link to elsewhere.
        let inside: Vec<_> = entries(dir).collect();
        let files = inside.iter().flat_map(entries);
        let all = inside.iter().cloned().chain(files).chain([dir.clone()]);
        reached.extend(all.filter_map(|path| Some((std::fs::canonicalize(path).ok()?, dir))));
    }
    let frames = captures.iter().flat_map(|capture| &capture.frames);
    for file in frames.flat_map(|frame| [Some(&frame.image), frame.mask.as_ref()]).flatten() {
        let whole = std::fs::canonicalize(file).unwrap_or_default();
        if let Some(dir) = whole.ancestors().find_map(|path| reached.get(path)) {
            return Err(Error::field(dir, "folder to write to", "one without pictures of the source", whole.display()));
        }
    }
    Ok(())
}

/// Writes a capture into its [`folder`].
pub fn write(capture: &Capture, format: Format, out: &Path, options: &WriteOptions) -> Result<Written> {
    let axes = options.axes.unwrap_or(format.axes());
    if axes != Axes::OpenCv && matches!(format, Format::Bop | Format::Colmap | Format::ColmapText) {
        let expected = format!("opencv, the axes of every {} file", format.name());
        return Err(Error::field(out, "convention", expected, axes.name()));
    }
    let dir = folder(capture, format, out);
    refuse_sources(std::slice::from_ref(capture), std::slice::from_ref(&dir))?;
    match format {
        Format::Srn => srn::write(capture, dir, axes, options),
        Format::Transforms => transforms::write(capture, dir, axes, options),
        Format::Bop => bop::write(capture, dir, options),
        Format::Colmap => colmap::write(capture, dir, true, options),
        Format::ColmapText => colmap::write(capture, dir, false, options),
    }
}

/// What a reader knows of a view before the picture was looked at.
struct View<'a> {
    /// For messages: where the view is described.
    place: (&'a Path, String),
    name: String,
    image: PathBuf,
    mask: Option<PathBuf>,
    /// In the axes and the direction of the format: camera to world, in any axes.
    world_from_camera: DMat4,
    /// fx, fy, cx, cy; `None` where the source has none.
    intrinsics: Option<[f64; 4]>,
    distortion: [f64; 5],
    /// The size that the intrinsics belong to, if the source says it.
    size: Option<[usize; 2]>,
}

/// Gathers the views of a capture; a view that cannot be used is noted and left out.
struct Collector<'a> {
    options: &'a ReadOptions,
    axes: Axes,
    pixel_centre: f64,
    names: std::collections::HashSet<String>,
    capture: Capture,
}

impl<'a> Collector<'a> {
    fn new(name: String, format: Format, options: &'a ReadOptions) -> Self {
        let pixel_centre = if matches!(format, Format::Srn | Format::Bop) { 0.0 } else { 0.5 };
        let capture = Capture { name, ..Capture::default() };
        Self { options, axes: options.axes.unwrap_or(format.axes()), pixel_centre, names: Default::default(), capture }
    }

    fn skip(&mut self, why: impl ToString) {
        // A name in a file may hold anything, a line break for one.
        let line = why.to_string().chars().map(|c| if c.is_control() { '\u{fffd}' } else { c }).collect();
        self.capture.skipped.push(line);
    }

    fn add(&mut self, view: View) {
        match self.frame(view) {
            Ok(frame) => self.capture.frames.push(frame),
            Err(error) => self.skip(error),
        }
    }

    fn frame(&mut self, view: View) -> Result<Frame> {
        let (path, field) = view.place;
        let pose = if self.options.inverted { view.world_from_camera.inverse() } else { view.world_from_camera };
        let world_from_camera = rigid(path, &field, self.axes.to_ours(pose))?;
        let size = picture_size(&view.image)?;
        let (intrinsics, distortion) = match (self.options.fov_deg, view.intrinsics) {
            (None, Some([fx, fy, cx, cy])) => {
                let [w, h] = view.size.unwrap_or(size);
                if size[0] * h != size[1] * w {
                    let expected = format!("the shape of {}, {}×{}", view.image.display(), size[0], size[1]);
                    return Err(Error::field(path, field, expected, format!("{w}×{h}")));
                }
                let scale = size[0] as f64 / w as f64;
                ([fx, fy, cx, cy].map(|x| x * scale), view.distortion)
            }
            (Some(fov), _) => {
                let [w, h] = size.map(|s| s as f64);
                let focal = 0.5 * w / (0.5 * fov.to_radians()).tan();
                ([focal, focal, 0.5 * w, 0.5 * h], [0.0; 5])
            }
            (None, None) => return Err(Error::field(path, field, "intrinsics, or --fov", "none")),
        };
        let all = || intrinsics.iter().chain(&distortion);
        if !all().all(|x| x.is_finite()) || intrinsics[..2].iter().any(|&f| f <= 0.0) {
            let found = all().map(f64::to_string).collect::<Vec<_>>().join(" ");
            return Err(Error::field(path, field, "finite intrinsics, focal lengths above 0", found));
        }
        // Pictures of the same name in different folders are told apart by a number.
        let plain = view.name.replace(['/', '\\'], "_");
        let mut name = plain.clone();
        for i in 2.. {
            if self.names.insert(name.clone()) {
                break;
            }
            name = format!("{plain}-{i}");
        }
        let mask = match &self.options.masks {
            Some(folder) => Some(mask_in(folder, &view.image)?),
            None => view.mask,
        };
        if let Some(path) = mask.as_ref().filter(|path| !path.is_file()) {
            return Err(Error::Missing { path: path.clone(), why: format!("the mask of {}", view.image.display()) });
        }
        let camera = Camera { world_from_camera, intrinsics, size, pixel_centre: self.pixel_centre, distortion };
        Ok(Frame { name, image: view.image, mask, camera })
    }
}

/// The mask of a picture in a folder of masks: `NAME.png` or, as COLMAP has it, `NAME.jpg.png`; below the folders that the picture
/// is in, as far as there are such. The picture itself is none.
pub fn mask_in(folder: &Path, image: &Path) -> Result<PathBuf> {
    let [stem, whole] =
        [image.file_stem(), image.file_name()].map(|name| name.unwrap_or_default().to_string_lossy().into_owned());
    let names = [format!("{stem}.png"), format!("{whole}.png"), format!("{stem}.jpg"), whole];
    let above = image.parent().into_iter().flat_map(Path::components);
    let above: Vec<_> = above.filter(|part| matches!(part, std::path::Component::Normal(_))).collect();
    let folders = (0..=above.len()).map(|k| folder.join(above[k..].iter().collect::<PathBuf>()));
    folders
        .flat_map(|folder| names.each_ref().map(|name| folder.join(name)))
        .find(|path| path.is_file() && !is_same_file(path, image))
        .ok_or_else(|| Error::Missing { path: folder.join(&names[0]), why: format!("the mask of {}", image.display()) })
}

fn is_same_file(a: &Path, b: &Path) -> bool {
    std::fs::canonicalize(a).is_ok_and(|a| std::fs::canonicalize(b).is_ok_and(|b| a == b))
}

/// The name of a folder or of the file's folder, fit to name a folder.
fn name_of(path: &Path) -> String {
    let path = std::fs::canonicalize(path).unwrap_or_else(|_| path.into());
    let folder = if path.is_file() { path.parent().unwrap_or(&path) } else { &path };
    folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_else(|| "object".into())
}

/// Makes a new folder; one that is there is refused, or used where it may be replaced.
fn make_dir(dir: &Path, replace: bool) -> Result<()> {
    if dir.exists() && !replace {
        return Err(Error::Exists { path: dir.into() });
    }
    std::fs::create_dir_all(dir).at(dir)
}

/// Removes pictures of this name, with whatever ending, that an earlier export has left: one of those may be read before what is written now.
fn remove_earlier(path: &Path) -> Result<()> {
    while let Some(earlier) = with_ending(path) {
        std::fs::remove_file(&earlier).at(&earlier)?;
    }
    Ok(())
}

/// Copies a view's picture to `folder/name` with its own ending; undistorted, as PNG, where `pinhole` asks for it. Gives the
/// file's name and the camera that belongs to it.
fn copy_picture(frame: &Frame, folder: &Path, name: &str, pinhole: bool) -> Result<(String, Camera)> {
    std::fs::create_dir_all(folder).at(folder)?;
    remove_earlier(&folder.join(name))?;
    if pinhole && !frame.camera.is_pinhole() {
        let camera = Camera { distortion: [0.0; 5], ..frame.camera };
        let file = format!("{name}.png");
        write_png(&folder.join(&file), &Picture::open(&frame.image, None)?.resample(&frame.camera, &camera))?;
        return Ok((file, camera));
    }
    let extension = frame.image.extension().unwrap_or_default().to_string_lossy();
    let file = format!("{name}.{extension}");
    std::fs::copy(&frame.image, folder.join(&file)).at(&frame.image)?;
    Ok((file, frame.camera))
}

/// Copies a view's mask, likewise; where it has none, there is none afterwards.
fn copy_mask(frame: &Frame, path: &Path, pinhole: bool) -> Result<()> {
    remove_earlier(&path.with_extension(""))?;
    let Some(mask) = &frame.mask else { return Ok(()) };
    let folder = path.parent().unwrap_or(path);
    std::fs::create_dir_all(folder).at(folder)?;
    if pinhole && !frame.camera.is_pinhole() {
        // Drawn as black on white, so that what comes from outside is background as well.
        let camera = Camera { distortion: [0.0; 5], ..frame.camera };
        let mut inverse = decode(mask)?.into_luma8();
        image::imageops::invert(&mut inverse);
        let mut rgb = Picture::from_luma(inverse).resample(&frame.camera, &camera);
        image::imageops::invert(&mut rgb);
        return image::DynamicImage::from(rgb).into_luma8().save(path).at(path);
    }
    match image::ImageReader::open(mask).at(mask)?.with_guessed_format().at(mask)?.format() {
        Some(image::ImageFormat::Png) => std::fs::copy(mask, path).map(|_| ()).at(mask),
        _ => decode(mask)?.save(path).at(path),
    }
}

/// Reads JSON; an error names line and column.
pub(crate) fn from_json<T: serde::de::DeserializeOwned>(path: &Path, text: &str) -> Result<T> {
    serde_json::from_str(text).map_err(|error| {
        let place = format!("line {}, column {}", error.line(), error.column());
        let whole = error.to_string();
        let what = whole.rsplit_once(" at line ").map_or(whole.as_str(), |(what, _)| what);
        // What some write for numbers that are none.
        let line = text.lines().nth(error.line().saturating_sub(1)).unwrap_or_default().as_bytes();
        let rest = line.get(error.column().saturating_sub(1)..).unwrap_or_default();
        let what = ["NaN", "Infinity"].into_iter().find(|word| rest.starts_with(word.as_bytes())).unwrap_or(what);
        Error::field(path, place, "the fields of this format in JSON", what)
    })
}

/// Writes JSON for people and machines.
pub(crate) fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<()> {
    let text = serde_json::to_string_pretty(value).map_err(|error| Error::field(path, "JSON", "plain values", error))?;
    std::fs::write(path, text + "\n").at(path)
}

/// A matrix as rows.
pub(crate) fn rows(matrix: &DMat4) -> [[f64; 4]; 4] {
    matrix.transpose().to_cols_array_2d()
}
