//! What `sigma-pose` reads and writes: pictures with their cameras, PNG and GIF.

use std::fs::File;
use std::io::{BufRead, Write};
use std::path::{Path, PathBuf};

use clap::Args;
use glam::DMat4;
use image::codecs::gif::{GifEncoder, Repeat};
use image::{Delay, Frame, RgbImage};
use sigma_srn::photo::{BoundingBox, Shot};
use sigma_srn::{Model, write_atomically};
use srn_data::formats::mask_in;
use srn_data::srn::{self, picture_size};
use srn_data::target::{self, Cutout};

use super::notation::Notation;
use super::positive;
use crate::common::Result;

/// Where all channels are at least this (of [-1, 1]) a picture shows background.
const WHITE: f32 = 0.98;

/// Flags that say what is looked for in pictures.
#[derive(Args, Debug)]
pub struct ObjectArgs {
    /// Model, or checkpoint of a training run.
    #[arg(long, value_name = "FILE")]
    pub model: PathBuf,
    /// Name of the object in the pictures, or its number where the model has no names. Default: the name of the SRN folder that a picture lies in, else the model's
    /// only one, or, with `estimate --box auto`, all.
    #[arg(long, value_name = "NAME")]
    pub instance: Option<String>,
    #[command(flatten)]
    pub camera: CameraArgs,
}

/// Masks of a picture: files, or folders with files called like the picture.
#[derive(Clone, Copy, Default)]
pub struct Masks<'a> {
    /// What it leaves out is background, as if it were transparent.
    pub cutout: Option<Cutout<'a>>,
    /// What is black there does not count.
    pub mask: Option<&'a Path>,
}

/// Flags that describe the camera; at most one of them.
#[derive(Args, Clone, Debug)]
#[group(multiple = false)]
pub struct CameraArgs {
    /// File with `f cx cy 0.`, `0. 0. 0.`, `1.` and `height width` (SRN's intrinsics.txt).
    #[arg(long, value_name = "FILE")]
    intrinsics: Option<PathBuf>,
    /// Focal length in pixels of the picture; the principal point is its middle.
    #[arg(long, value_name = "PX", value_parser = positive)]
    focal: Option<f64>,
    /// Angle of view across the picture's width in degrees, instead of --focal.
    #[arg(long, value_name = "DEG", value_parser = angle_of_view)]
    fov: Option<f64>,
}

fn angle_of_view(text: &str) -> std::result::Result<f64, String> {
    positive(text).ok().filter(|&degrees| degrees < 180.0).ok_or("expected a number between 0 and 180".into())
}

impl CameraArgs {
    /// What the flags say about a picture of `size` pixels, width then height; `None` where there is no flag.
    pub fn intrinsics(&self, size: [usize; 2]) -> Result<Option<srn::Intrinsics>> {
        if let Some(path) = &self.intrinsics {
            return Ok(Some(srn::Intrinsics::read(path, size)?));
        }
        let [width, height] = size.map(|side| side as f64);
        let focal = self.focal.or_else(|| self.fov.map(|degrees| 0.5 * width / (0.5 * degrees.to_radians()).tan()));
        Ok(focal.map(|focal| srn::Intrinsics { focal: [focal; 2], centre: [width / 2.0, height / 2.0], size }))
    }
}

/// Where in a picture the object is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Bounds {
    /// In this box.
    Box(BoundingBox),
    /// It is looked for.
    Anywhere,
}

/// The value of --box.
pub fn bounds(text: &str) -> std::result::Result<Bounds, String> {
    if text == "auto" {
        return Ok(Bounds::Anywhere);
    }
    let numbers: Vec<f64> =
        text.split(',').filter_map(|number| number.trim().parse().ok()).filter(|n: &f64| n.is_finite()).collect();
    match (&numbers[..], text.matches(',').count()) {
        (&[x, y, width, height], 3) if width > 0.0 && height > 0.0 => {
            Ok(Bounds::Box(BoundingBox { corner: [x, y], size: [width, height] }))
        }
        _ => Err("expected `auto`, or left edge, top edge, width and height in pixels: `120,80,200,160`".into()),
    }
}

/// A pose file, or the one that belongs to a picture in an SRN folder, which is as data sets are.
#[derive(Clone, Debug)]
pub enum PoseSource {
    /// `../pose/NAME.txt` of `rgb/NAME.png`.
    Auto,
    /// This file.
    File(PathBuf),
}

impl From<&str> for PoseSource {
    fn from(text: &str) -> Self {
        if text == "auto" { PoseSource::Auto } else { PoseSource::File(text.into()) }
    }
}

impl PoseSource {
    /// Reads the pose for a picture.
    pub fn read(&self, picture: &Path, notation: &Notation) -> Result<DMat4> {
        let path = match self {
            PoseSource::File(path) => return Ok(notation.ours(srn::read_pose(path)?)),
            PoseSource::Auto => {
                let name = picture.with_extension("txt");
                let dir = srn_instance(picture).ok_or_else(|| {
                    format!("{}: its pose is found only in an SRN folder (INSTANCE/rgb, INSTANCE/pose)", picture.display())
                })?;
                dir.join("pose").join(name.file_name().unwrap_or_default())
            }
        };
        Ok(srn::read_pose(&path)?)
    }
}

/// Number of the instance that is named, or of the model's only one.
pub fn instance_of(model: &Model, name: Option<&str>) -> Result<u32> {
    match name {
        Some(name) => Ok(model.instance(name)?),
        None if model.layout.instances == 1 => Ok(0),
        None => Err(format!("which object is it? Give --instance; the model knows {}", model.known_instances()).into()),
    }
}

/// The instance folder of a picture `INSTANCE/rgb/NAME.png`.
pub fn srn_instance(picture: &Path) -> Option<PathBuf> {
    let path = std::fs::canonicalize(picture).ok()?;
    let folder = path.parent()?;
    let is_rgb = folder.file_name()? == "rgb";
    folder.parent().filter(|_| is_rgb).map(PathBuf::from)
}

/// A picture that is searched for.
#[derive(Clone, Debug)]
pub struct Picture {
    /// Short name, unique among the pictures of a run.
    pub name: String,
    /// Its true `world_from_camera`, if known.
    pub truth: Option<DMat4>,
    /// What the model takes of it.
    pub shot: Shot,
}

impl Picture {
    /// Reads a picture as a square of `side` pixels. In an SRN folder the intrinsics and the instance's name are found beside it; a
    /// picture from elsewhere, or with a mask that cuts it out, is cut around what masks and transparency leave.
    pub fn open(
        path: &Path,
        masks: Masks,
        model: &Model,
        side: u32,
        instance: Option<&str>,
        camera: &CameraArgs,
    ) -> Result<Self> {
        let about = |what: &str| format!("{}: {what}", path.display());
        let dir = srn_instance(path);
        let size = picture_size(path)?;
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        let beside = dir.as_ref().map(|dir| srn::intrinsics_file(dir, &stem)).filter(|file| file.exists());
        let intrinsics = match (camera.intrinsics(size)?, beside) {
            (Some(given), _) => given,
            (None, Some(file)) => srn::Intrinsics::read(&file, size)?,
            (None, None) => return Err(about("no intrinsics: give --focal, --fov or --intrinsics").into()),
        };
        let folder = dir.as_deref().and_then(Path::file_name).map(|name| name.to_string_lossy().into_owned());
        let instance = instance_of(model, instance.or(folder.as_deref())).map_err(|error| about(&error.to_string()))?;
        let file = |mask: Option<&Path>| mask.map(|mask| mask_of(mask, path)).transpose();
        let mask = file(masks.mask)?;
        let segmentation = file(if let Some(Cutout::Mask(mask)) = masks.cutout { Some(mask) } else { None })?;
        let cutout = segmentation.as_deref().map(Cutout::Mask).or(masks.cutout);
        let square = match (&dir, cutout) {
            (Some(_), None) => target::of_view(path, mask.as_deref(), &intrinsics, side as usize)?,
            _ => target::of_photo(path, cutout, mask.as_deref(), &intrinsics, side as usize)?,
        };
        if square.rgb.iter().all(|&colour| colour >= WHITE) {
            let (field, expected) = ("pixels".into(), "an object".into());
            return Err(srn_data::Error::Empty { path: path.into(), field, expected, found: "nothing but white".into() }.into());
        }
        let name = format!("{}-{stem}", model.instance_name(instance));
        Ok(Picture { name, truth: None, shot: Shot::of(square, instance) })
    }
}

/// The mask of a picture: this file, or the one in this folder that is called like the picture.
fn mask_of(mask: &Path, picture: &Path) -> Result<PathBuf> {
    if mask.is_dir() { Ok(mask_in(mask, picture)?) } else { Ok(mask.into()) }
}

/// Side of the pictures that a model takes: as it was trained, or else the shorter side of `picture`.
pub fn model_side(model: &Model, picture: &Path) -> Result<u32> {
    match model.metadata.side {
        Some(side) => Ok(side),
        None => Ok(picture_size(picture)?.into_iter().min().unwrap_or(0) as u32),
    }
}

/// Says so where a photograph is to be turned before it is looked at: its camera and its masks may be those of either.
pub fn warn_of_turned(picture: &Path) {
    if srn::is_turned(picture) {
        eprintln!("warning: {}: by its EXIF it is to be turned; its pixels are taken as they are stored", picture.display());
    }
}

/// Lines as they come, without blanks around them; blank ones are none.
pub fn lines_on_stdin() -> impl Iterator<Item = Result<Vec<u8>>> {
    let line = |line: std::io::Result<Vec<u8>>| match line {
        Ok(line) if line.trim_ascii().is_empty() => None,
        Ok(line) => Some(Ok(line.trim_ascii().to_vec())),
        Err(error) => Some(Err(format!("stdin: {error}").into())),
    };
    std::io::stdin().lock().split(b'\n').filter_map(line)
}

/// Paths are what the system takes for one, UTF-8 or not.
#[cfg(unix)]
pub fn path_of(bytes: &[u8]) -> PathBuf {
    use std::os::unix::ffi::OsStrExt;
    std::ffi::OsStr::from_bytes(bytes).into()
}

/// Paths are what the system takes for one.
#[cfg(not(unix))]
pub fn path_of(bytes: &[u8]) -> PathBuf {
    String::from_utf8_lossy(bytes).into_owned().into()
}

/// Writes an endless animation, whole or not at all; each frame with the seconds that it stays.
pub fn write_gif(path: &Path, frames: impl IntoIterator<Item = (RgbImage, f64)>) -> Result<()> {
    let mut bytes = Vec::new();
    let mut encoder = endless(&mut bytes)?;
    for (picture, seconds) in frames {
        encoder.encode_frame(shown(picture, seconds))?;
    }
    drop(encoder);
    Ok(write_atomically(path, &bytes)?)
}

/// An endless animation that is in its file as far as it has come, however the program ends.
pub struct Animation {
    path: PathBuf,
    encoder: GifEncoder<File>,
}

impl Animation {
    /// An empty file.
    pub fn create(path: &Path) -> Result<Self> {
        let file = File::create(path).map_err(|error| format!("{}: {error}", path.display()))?;
        Ok(Animation { path: path.into(), encoder: endless(file)? })
    }

    /// One frame more, which stays for so many seconds.
    pub fn push(&mut self, picture: RgbImage, seconds: f64) -> Result<()> {
        let written = self.encoder.encode_frame(shown(picture, seconds));
        written.map_err(|error| format!("{}: {error}", self.path.display()).into())
    }
}

fn endless<W: Write>(out: W) -> Result<GifEncoder<W>> {
    let mut encoder = GifEncoder::new_with_speed(out, 10);
    encoder.set_repeat(Repeat::Infinite)?;
    Ok(encoder)
}

fn shown(picture: RgbImage, seconds: f64) -> Frame {
    let delay = Delay::from_numer_denom_ms((1000.0 * seconds) as u32, 1);
    Frame::from_parts(image::DynamicImage::from(picture).into_rgba8(), 0, 0, delay)
}
