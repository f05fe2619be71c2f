//! The folder layout of the SRN data sets:
//! `<set>/<instance>/{rgb/*.png, pose/*.txt, intrinsics.txt}`.
//!
//! A pose file holds the 4×4 `world_from_camera`, row-major, in any line breaks, or, in `pose/` of an instance and with 12 numbers,
//! the first three rows of its inverse (the object in the camera). `intrinsics.txt` holds `f cx cy 0.`, the grid's barycentre `0. 0. 0.`, the near plane
//! `1.` and `height width`, in that order; or the nine numbers of a 3×3 matrix, which belong to the pictures as they are. Where
//! views differ, `intrinsics/NAME.txt` holds those of one view.

use crate::camera::rigid_error;
use crate::capture::FrameRecord;
use crate::error::{At, Error, Result, read_text};
use crate::pixels::{ENDINGS, ends_like, open};
use glam::DMat4;
use image::metadata::Orientation;
use image::{ImageDecoder, RgbImage};
use srn_photo::Pixels;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The largest rigid error of a pose that is still read (poses in six decimals, or stored as f32, lie far below).
pub const RIGID_TOLERANCE: f64 = 1e-3;
/// Places and intrinsics beyond this are no measurements, and the network's single precision could not work with them.
const LARGEST: f64 = 1e12;

/// A data set on disk: names and files; pictures are read by [`SrnSet::load`].
#[derive(Debug, Clone)]
pub struct SrnSet {
    /// The folder that was opened.
    pub dir: PathBuf,
    /// The instances, sorted by name; at least one.
    pub instances: Vec<InstanceFiles>,
}

/// The files of one instance.
#[derive(Debug, Clone)]
pub struct InstanceFiles {
    /// The folder's name.
    pub name: String,
    /// The folder.
    pub dir: PathBuf,
    /// The views, sorted by name.
    pub views: Vec<ViewFiles>,
}

/// The files of one view; an instance in order has both.
#[derive(Debug, Clone)]
pub struct ViewFiles {
    /// The file name without its extension.
    pub name: String,
    /// The picture.
    pub rgb: Option<PathBuf>,
    /// The pose.
    pub pose: Option<PathBuf>,
}

/// The content of `intrinsics.txt`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    /// Focal length in pixels along x and y.
    pub focal: [f64; 2],
    /// Principal point `[cx, cy]` in pixels.
    pub centre: [f64; 2],
    /// Image width and height, in pixels, that the values above belong to.
    pub size: [usize; 2],
}

/// A data set in memory, every picture square and of the same side.
#[derive(Debug, Clone, PartialEq)]
pub struct Dataset {
    /// Width and height of every picture in pixels.
    pub side: usize,
    /// The instances, sorted by name.
    pub instances: Vec<Instance>,
}

/// One object and its views.
#[derive(Debug, Clone, PartialEq)]
pub struct Instance {
    /// The folder's name.
    pub name: String,
    /// The views, sorted by name.
    pub views: Vec<LoadedView>,
}

/// One picture and its camera.
#[derive(Debug, Clone, PartialEq)]
pub struct LoadedView {
    /// The file name without its extension.
    pub name: String,
    /// RGB in [-1, 1], row-major `[side · side, 3]`.
    pub rgb: Vec<f32>,
    /// 4×4, row-major: camera axes x right, y down, z forward to the world; the last column is the camera centre.
    pub world_from_camera: [f64; 16],
    /// `fx, fy, cx, cy` in pixels of this picture; integer coordinates are pixel centres.
    pub intrinsics: [f32; 4],
}

impl SrnSet {
    /// Lists a data set, or a single instance, without reading the pictures. Views whose picture or pose is missing are
    /// listed too; [`SrnSet::load`] refuses them.
    ///
    /// Fails if the folder cannot be read or holds no instance (a folder with `rgb/` or `pose/` in it).
    pub fn open(dir: impl AsRef<Path>) -> Result<Self> {
        let dir = dir.as_ref();
        let is_instance = |path: &Path| path.join("rgb").is_dir() || path.join("pose").is_dir();
        let mut folders = vec![];
        if is_instance(dir) {
            folders.push(std::fs::canonicalize(dir).at(dir)?);
        } else {
            for entry in std::fs::read_dir(dir).at(dir)? {
                folders.push(entry.at(dir)?.path());
            }
            folders.retain(|path| is_instance(path));
            folders.sort();
        }
        if folders.is_empty() {
            return Err(Error::field(dir, "folder", "instances, each with rgb/ and pose/", "none"));
        }
        let instances = folders.into_iter().map(InstanceFiles::open).collect::<Result<_>>()?;
        Ok(Self { dir: dir.into(), instances })
    }

    /// Reads everything as squares of `side` pixels: the centre square, resampled by area.
    pub fn load(&self, side: usize) -> Result<Dataset> {
        let instances = self.instances.iter().map(|instance| instance.load(side)).collect::<Result<_>>()?;
        Ok(Dataset { side, instances })
    }
}

impl InstanceFiles {
    fn open(dir: PathBuf) -> Result<Self> {
        let mut views = BTreeMap::<String, [Option<PathBuf>; 2]>::new();
        for (slot, (folder, endings)) in [("rgb", &ENDINGS[..]), ("pose", &["txt"])].into_iter().enumerate() {
            let folder = dir.join(folder);
            for entry in std::fs::read_dir(&folder).at(&folder)? {
                let entry = entry.at(&folder)?;
                let path = entry.path();
                // macOS leaves `._NAME.png` beside pictures, which is none.
                let is_hidden = entry.file_name().to_string_lossy().starts_with('.');
                if ends_like(&path, endings) && !is_hidden && !entry.file_type().at(&path)?.is_dir() {
                    let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
                    views.entry(name).or_default()[slot] = Some(path);
                }
            }
        }
        let name = dir.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let views = views.into_iter().map(|(name, [rgb, pose])| ViewFiles { name, rgb, pose }).collect();
        Ok(Self { name, dir, views })
    }

    /// The file with a view's intrinsics: its own, or that of the instance.
    pub fn intrinsics_file(&self, view: &str) -> PathBuf {
        intrinsics_file(&self.dir, view)
    }

    /// Reads the instance's views as squares of `side` pixels.
    pub fn load(&self, side: usize) -> Result<Instance> {
        if self.views.is_empty() {
            return Err(Error::field(&self.dir, "rgb/", "pictures", "none"));
        }
        let views = self.views.iter().map(|view| view.load(&self.dir, side)).collect::<Result<_>>()?;
        Ok(Instance { name: self.name.clone(), views })
    }
}

impl ViewFiles {
    fn load(&self, dir: &Path, side: usize) -> Result<LoadedView> {
        let missing = |folder: &str, extension: &str, other: &Option<PathBuf>| Error::Missing {
            path: dir.join(folder).join(&self.name).with_extension(extension),
            why: format!("{} needs it", other.as_deref().unwrap_or(dir).display()),
        };
        let rgb = self.rgb.as_ref().ok_or_else(|| missing("rgb", "png", &self.pose))?;
        let pose = self.pose.as_ref().ok_or_else(|| missing("pose", "txt", &self.rgb))?;
        let world_from_camera = read_pose(pose)?;
        let intrinsics = Intrinsics::read(&intrinsics_file(dir, &self.name), picture_size(rgb)?)?;
        let (pixels, intrinsics) = load_square(rgb, &intrinsics, side)?;
        let world_from_camera = world_from_camera.transpose().to_cols_array();
        Ok(LoadedView { name: self.name.clone(), rgb: pixels.data, world_from_camera, intrinsics })
    }
}

/// The file with the intrinsics of a view in an instance's folder: its own, or that of all views.
pub fn intrinsics_file(dir: &Path, view: &str) -> PathBuf {
    let own = dir.join("intrinsics").join(format!("{view}.txt"));
    if own.is_file() { own } else { dir.join("intrinsics.txt") }
}

/// Width and height of a picture, without decoding it.
pub fn picture_size(path: &Path) -> Result<[usize; 2]> {
    let reader = image::ImageReader::open(path).at(path)?.with_guessed_format().at(path)?;
    let (width, height) = reader.into_dimensions().at(path)?;
    Ok([width as usize, height as usize])
}

/// Whether a picture has a note (EXIF) that it is to be turned, which nothing here does; not so where it cannot be read.
pub fn is_turned(path: &Path) -> bool {
    let reader = image::ImageReader::open(path).and_then(image::ImageReader::with_guessed_format).ok();
    let orientation = reader.and_then(|reader| reader.into_decoder().ok()?.orientation().ok());
    orientation.is_some_and(|orientation| orientation != Orientation::NoTransforms)
}

/// Reads one picture as a square of `side` pixels, and the `[fx, fy, cx, cy]` that belong to it: the crop shifts the principal
/// point, the resampling scales all four by `side / height` (as SRN does; the half-pixel shift of pixel centres that remains at
/// other sizes is the convention's, not corrected here).
pub fn load_square(path: &Path, intrinsics: &Intrinsics, side: usize) -> Result<(Pixels, [f32; 4])> {
    let image = open(path)?;
    let in_file = intrinsics.of_picture(path, [image.width, image.height])?;
    let Intrinsics { focal: [fx, fy], centre: [cx, cy], .. } = in_file.of_square(side);
    Ok((image.centre_square().area_resample(side, side), [fx, fy, cx, cy].map(|x| x as f32)))
}

/// Reads a pose file: 16 numbers, a rigid `world_from_camera`; or, in an instance's folder, 12, three rows of its inverse.
pub fn read_pose(path: &Path) -> Result<DMat4> {
    rigid(path, "pose", read_pose_unchecked(path)?)
}

/// Reads a file of poses, one per line as in a pose file, or each as four lines of four numbers; empty lines and those that begin with `#` are left out.
/// At least one.
pub fn read_poses(path: &Path) -> Result<Vec<DMat4>> {
    let text = read_text(path)?;
    let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty() && !line.starts_with('#'));
    let lines: Vec<(usize, &str)> = lines.collect();
    let are_rows = lines.iter().all(|(_, line)| line.split_whitespace().count() == 4);
    let pose = |lines: &[(usize, &str)]| {
        let field = format!("line {}", lines[0].0 + 1);
        let text: Vec<&str> = lines.iter().map(|(_, line)| *line).collect();
        rigid(path, &field, matrix(path, &field, &text.join(" "))?)
    };
    let poses: Vec<_> = lines.chunks(if are_rows { 4 } else { 1 }).map(pose).collect::<Result<_>>()?;
    if poses.is_empty() { Err(Error::field(path, "poses", "at least one line of 16 numbers", "none")) } else { Ok(poses) }
}

/// Refuses what is no rigid motion.
pub fn rigid(path: &Path, field: &str, pose: DMat4) -> Result<DMat4> {
    match rigid_error(&pose) {
        error if error <= RIGID_TOLERANCE && pose.w_axis.abs().max_element() <= LARGEST => Ok(pose),
        error if error <= RIGID_TOLERANCE => Err(Error::field(path, field, format!("a place within {LARGEST:e}"), pose.w_axis)),
        error if error >= 2.0 => Err(Error::field(path, field, "a right-handed rotation", "a mirrored or scaled one")),
        error => Err(Error::field(path, field, format!("a rigid motion within {RIGID_TOLERANCE}"), format!("{error:.3} off"))),
    }
}

/// Reads a pose file: 16 finite numbers, no more is asked of them.
pub(crate) fn read_pose_unchecked(path: &Path) -> Result<DMat4> {
    matrix(path, "pose", &read_text(path)?)
}

/// 16 finite numbers, row-major, or, in an instance's folder, 12 of the inverse.
fn matrix(path: &Path, field: &str, text: &str) -> Result<DMat4> {
    let mut values = numbers(path, field, text)?;
    // Archives of SRN sets have such; in a file from elsewhere three rows may as well be those of the pose itself.
    let in_instance = path.parent().is_some_and(|folder| folder.ends_with("pose"));
    let is_inverse = values.len() == 12 && in_instance;
    if is_inverse {
        values.extend([0.0, 0.0, 0.0, 1.0]);
    }
    let expected = if in_instance { "16 numbers, or 12 of the inverse" } else { "16 numbers" };
    let rows: [f64; 16] = values.as_slice().try_into().map_err(|_| Error::field(path, field, expected, values.len()))?;
    let matrix = DMat4::from_cols_array(&rows).transpose();
    Ok(if is_inverse { matrix.inverse() } else { matrix })
}

fn numbers(path: &Path, field: &str, text: &str) -> Result<Vec<f64>> {
    let number = |word: &str| match word.parse() {
        Ok(x) if f64::is_finite(x) => Ok(x),
        _ => Err(Error::field(path, field, "finite numbers", format!("\"{}\"", word.chars().take(40).collect::<String>()))),
    };
    text.split_whitespace().map(number).collect()
}

impl Intrinsics {
    /// Reads `intrinsics.txt`; a file that does not say to which size it belongs is one for `picture`, width and height.
    pub fn read(path: &Path, picture: [usize; 2]) -> Result<Self> {
        match Self::parse(path, &read_text(path)?, picture)? {
            (_, true) => Err(Error::field(path, "world2cam_poses", "0: `sigma-data import` turns such poses round", 1)),
            (intrinsics, false) => Ok(intrinsics),
        }
    }

    /// The content of the file, and whether it says that the poses are inverted.
    pub(crate) fn parse(path: &Path, text: &str, picture: [usize; 2]) -> Result<(Self, bool)> {
        let lines: Vec<_> = text.lines().filter(|line| !line.trim().is_empty()).collect();
        let line = |i: usize, field: &str, at_least: usize| {
            let values = numbers(path, field, lines.get(i).copied().unwrap_or_default())?;
            let expected = || format!("{at_least} numbers in line {}", i + 1);
            if values.len() < at_least { Err(Error::field(path, field, expected(), values.len())) } else { Ok(values) }
        };
        let whole = || numbers(path, "3×3 matrix", text).ok().filter(|values| values.len() == 9);
        let is_matrix = |k: &Vec<f64>| [k[1], k[3], k[6], k[7]] == [0.0; 4] && k[8] == 1.0;
        let (intrinsics, inverted) = if let Some(k) = whole().filter(is_matrix) {
            (Self { focal: [k[0], k[4]], centre: [k[2], k[5]], size: picture }, false)
        } else if lines.len() == 3 && whole().is_some() {
            let found = text.split_whitespace().collect::<Vec<_>>().join(" ");
            return Err(Error::field(path, "3×3 matrix", "fx 0 cx, 0 fy cy, 0 0 1 row by row, without skew", found));
        } else {
            let camera = line(0, "f cx cy", 3)?;
            let size = line(3, "height width", 2)?;
            if size.iter().any(|&s| !(1.0..=1e6).contains(&s) || s.fract() != 0.0) {
                return Err(Error::field(path, "height width", "positive whole numbers", format!("{size:?}")));
            }
            let size = [size[1] as usize, size[0] as usize];
            let flag = lines.get(4).is_some_and(|line| line.trim().parse() == Ok(1.0));
            (Self { focal: [camera[0]; 2], centre: [camera[1], camera[2]], size }, flag)
        };
        if let Some(pixels) = intrinsics.centre.into_iter().chain(intrinsics.focal).find(|pixels| pixels.abs() > LARGEST) {
            return Err(Error::field(path, "f cx cy", format!("at most {LARGEST:e} pixels"), format!("{pixels:e}")));
        }
        if let Some(focal) = intrinsics.focal.into_iter().find(|&focal| focal <= 0.0) {
            return Err(Error::field(path, "f", "a positive focal length", focal));
        }
        // One of the archives of cars has the values for 512 pixels beside pictures of 128. Cuts have their principal point
        // anywhere, but not straight beyond the corner.
        let [x, y] = [0, 1].map(|i| 2.0 * intrinsics.centre[i] / intrinsics.size[i] as f64);
        if x >= 1.9 && (x / y - 1.0).abs() < 1e-3 && path.file_name() == Some("intrinsics.txt".as_ref()) {
            let ([cx, cy], [w, h]) = (intrinsics.centre, intrinsics.size);
            let expected =
                format!("a point in the picture of {w}×{h}; if all are for {0}×{1}, write so: {1} {0}", 2.0 * cx, 2.0 * cy);
            return Err(Error::field(path, "cx cy", expected, format!("{cx}, {cy}")));
        }
        Ok((intrinsics, inverted))
    }

    /// The same for this picture of that size, which must have the shape that they belong to.
    pub(crate) fn of_picture(&self, path: &Path, [width, height]: [usize; 2]) -> Result<Self> {
        let [w, h] = self.size;
        if width * h != height * w {
            return Err(Error::field(
                path,
                "size",
                format!("the aspect of intrinsics.txt, {w}×{h}"),
                format!("{width}×{height}"),
            ));
        }
        Ok(self.of_size([width, height]))
    }

    /// The same for the whole picture at another size.
    pub fn of_size(&self, size: [usize; 2]) -> Self {
        let scale = [0, 1].map(|i| size[i] as f64 / self.size[i] as f64);
        Self { focal: [0, 1].map(|i| self.focal[i] * scale[i]), centre: [0, 1].map(|i| self.centre[i] * scale[i]), size }
    }

    /// The intrinsics of the centre square, resampled to `side` pixels (see [`load_square`]).
    pub fn of_square(&self, side: usize) -> Self {
        let [width, height] = self.size;
        let square = width.min(height);
        let scale = side as f64 / square as f64;
        let cut = self.size.map(|s| ((s - square) / 2) as f64);
        let centre = [0, 1].map(|i| (self.centre[i] - cut[i]) * scale);
        Self { focal: self.focal.map(|focal| focal * scale), centre, size: [side, side] }
    }
}

impl std::fmt::Display for Intrinsics {
    /// The text of `intrinsics.txt`; a matrix where the focal lengths differ, which the other form cannot say.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { focal: [fx, fy], centre: [cx, cy], size: [width, height] } = self;
        if fx == fy {
            writeln!(f, "{fx:?} {cx:?} {cy:?} 0.\n0. 0. 0.\n1.\n{height} {width}")
        } else {
            writeln!(f, "{fx:?} 0. {cx:?}\n0. {fy:?} {cy:?}\n0. 0. 1.")
        }
    }
}

/// Where in an instance's folder what is new waits until all of it is there.
const NEW: &str = ".new";

/// Writes one instance folder, view by view. Nothing of it is there, and what was there before stays, until [`InstanceWriter::finish`].
#[derive(Debug)]
pub struct InstanceWriter {
    dir: PathBuf,
    new: PathBuf,
}

impl InstanceWriter {
    /// For a `dir` with an `intrinsics.txt`. If `dir` exists it is refused, or, with `replace`, its pictures, poses,
    /// intrinsics and `frame.json` are removed in the end; files of other kinds stay.
    pub fn create(dir: impl Into<PathBuf>, intrinsics: &Intrinsics, replace: bool) -> Result<Self> {
        let writer = Self::bare(dir, replace)?;
        writer.intrinsics(intrinsics)?;
        Ok(writer)
    }

    /// The same without intrinsics of all views.
    pub fn bare(dir: impl Into<PathBuf>, replace: bool) -> Result<Self> {
        let dir = dir.into();
        if dir.exists() && !replace {
            return Err(Error::Exists { path: dir });
        }
        let new = dir.join(NEW);
        if new.exists() {
            // Of one that was killed.
            std::fs::remove_dir_all(&new).at(&new)?;
        }
        let writer = Self { dir, new };
        for folder in ["rgb", "pose"].map(|name| writer.new.join(name)) {
            std::fs::create_dir_all(&folder).at(&folder)?;
        }
        Ok(writer)
    }

    /// Where pictures of views are to be written, `NAME.png` or with another ending.
    pub(crate) fn pictures(&self) -> PathBuf {
        self.new.join("rgb")
    }

    /// Puts what was written in the place of what was there.
    pub fn finish(self) -> Result<()> {
        let Self { dir, new } = &self;
        let views = InstanceFiles::open(dir.clone()).map(|files| files.views).unwrap_or_default();
        let of_views = std::fs::read_dir(dir.join("intrinsics")).into_iter().flatten().flatten().map(|entry| entry.path());
        let is_own = |path: &PathBuf| path.extension().is_some_and(|ending| ending == "txt");
        // The frame that the views before were in, too.
        let whole = [dir.join("intrinsics.txt"), dir.join(FrameRecord::FILE)].into_iter().filter(|path| path.exists());
        let others: Vec<_> = of_views.filter(is_own).chain(whole).collect();
        for path in views.into_iter().flat_map(|view| [view.rgb, view.pose]).flatten().chain(others) {
            std::fs::remove_file(&path).at(&path)?;
        }
        for folder in ["", "intrinsics", "pose", "rgb"] {
            let (from, to) = (new.join(folder), dir.join(folder));
            for entry in std::fs::read_dir(&from).into_iter().flatten().flatten().filter(|entry| entry.path().is_file()) {
                std::fs::create_dir_all(&to).at(&to)?;
                let to = to.join(entry.file_name());
                std::fs::rename(entry.path(), &to).at(&to)?;
            }
        }
        Ok(())
    }

    /// Writes the intrinsics of all views.
    pub(crate) fn intrinsics(&self, intrinsics: &Intrinsics) -> Result<()> {
        let path = self.new.join("intrinsics.txt");
        std::fs::write(&path, intrinsics.to_string()).at(&path)
    }

    /// Writes the intrinsics of one view.
    pub fn view_intrinsics(&self, view: &str, intrinsics: &Intrinsics) -> Result<()> {
        let folder = self.new.join("intrinsics");
        std::fs::create_dir_all(&folder).at(&folder)?;
        let path = folder.join(format!("{view}.txt"));
        std::fs::write(&path, intrinsics.to_string()).at(&path)
    }

    /// Writes `rgb/<name>.png` and `pose/<name>.txt`.
    pub fn add(&self, name: &str, rgb: &RgbImage, world_from_camera: &DMat4) -> Result<()> {
        write_png(&self.pictures().join(format!("{name}.png")), rgb)?;
        self.pose(name, world_from_camera)
    }

    /// Writes `pose/<name>.txt`, every digit of it.
    pub(crate) fn pose(&self, name: &str, world_from_camera: &DMat4) -> Result<()> {
        let path = self.new.join("pose").join(format!("{name}.txt"));
        let row = |r: usize| world_from_camera.row(r).to_array().map(|x| format!("{x:?}")).join(" ");
        std::fs::write(&path, [0, 1, 2, 3].map(row).join("\n") + "\n").at(&path)
    }
}

impl Drop for InstanceWriter {
    /// What was not finished leaves nothing; nor does an object without views.
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.new);
        let _ = std::fs::remove_dir(&self.dir);
    }
}

/// Writes a picture with the best compression: data sets are written once and kept.
pub(crate) fn write_png(path: &Path, rgb: &RgbImage) -> Result<()> {
    let file = std::io::BufWriter::new(std::fs::File::create(path).at(path)?);
    let (kind, filter) = (image::codecs::png::CompressionType::Best, image::codecs::png::FilterType::Adaptive);
    rgb.write_with_encoder(image::codecs::png::PngEncoder::new_with_quality(file, kind, filter)).at(path)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::uniform_sphere;
    use std::fs::write;

    const INTRINSICS: Intrinsics = Intrinsics { focal: [74.4; 2], centre: [4.0, 4.0], size: [8, 8] };

    /// A set of one instance, its poses and pictures.
    fn made(views: usize) -> (tempfile::TempDir, Vec<DMat4>, Vec<RgbImage>) {
        let dir = tempfile::tempdir().unwrap();
        let poses = uniform_sphere(views, 1.3, 1);
        let pictures: Vec<_> = (0..views as u32)
            .map(|k| RgbImage::from_fn(8, 8, |x, y| image::Rgb([(x * 30 + k) as u8, (y * 30) as u8, (x * y) as u8])))
            .collect();
        let writer = InstanceWriter::create(dir.path().join("thing"), &INTRINSICS, false).unwrap();
        for (i, (pose, picture)) in poses.iter().zip(&pictures).enumerate() {
            writer.add(&format!("{i:06}"), picture, pose).unwrap();
        }
        writer.finish().unwrap();
        (dir, poses, pictures)
    }

    #[test]
    fn what_is_written_is_read() {
        let (dir, poses, pictures) = made(12);
        let set = SrnSet::open(dir.path()).unwrap().load(8).unwrap();
        let [instance] = &set.instances[..] else { panic!("{} instances", set.instances.len()) };
        assert_eq!((instance.name.as_str(), instance.views.len()), ("thing", 12));
        for ((view, pose), picture) in instance.views.iter().zip(&poses).zip(&pictures) {
            let rows = pose.transpose().to_cols_array();
            assert!(view.world_from_camera.iter().zip(rows).all(|(a, b)| (a - b).abs() < 1e-6), "{}", view.name);
            assert_eq!(view.intrinsics, [74.4, 74.4, 4.0, 4.0]);
            assert_eq!(crate::pixels::rgb8(&view.rgb, 8, 8), *picture);
        }
        // The last column is the camera centre, 1.3 away; a transposed pose would have zeros there.
        let m = set.instances[0].views[0].world_from_camera;
        assert!((m[3].hypot(m[7]).hypot(m[11]) - 1.3).abs() < 1e-6);
        // A single instance is a set as well.
        assert_eq!(SrnSet::open(dir.path().join("thing")).unwrap().load(8).unwrap(), set);
    }

    #[test]
    fn intrinsics_follow_crop_and_size() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("wide.png");
        RgbImage::from_pixel(24, 16, image::Rgb([0, 255, 0])).save(&path).unwrap();
        // The file's values are for twice the picture's size.
        let intrinsics = Intrinsics { focal: [60.0; 2], centre: [25.0, 14.0], size: [48, 32] };
        let (pixels, values) = load_square(&path, &intrinsics, 8).unwrap();
        assert_eq!((pixels.width, pixels.height), (8, 8));
        assert_eq!(values, [15.0, 15.0, (12.5 - 4.0) / 2.0, 3.5]);
        let error = load_square(&path, &INTRINSICS, 8).unwrap_err().to_string();
        assert!(error.contains("wide.png") && error.contains("8×8") && error.contains("24×16"), "{error}");
    }

    #[test]
    fn poses_are_read_in_any_line_breaks() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("pose.txt");
        write(&path, "0 0 1 -2  1 0 0 0\t0 -1 0 0 0 0 0 1").unwrap();
        let pose = read_pose(&path).unwrap_err().to_string();
        assert!(pose.contains("right-handed"), "{pose}");
        write(&path, "0 0 1 -2\n-1 0 0 0\n0 -1 0 0\n0 0 0 1\n").unwrap();
        assert_eq!(read_pose(&path).unwrap().w_axis.to_array(), [-2.0, 0.0, 0.0, 1.0]);

        let line = "0 0 1 -2 -1 0 0 0 0 -1 0 0 0 0 0 1";
        write(&path, format!("# two poses\n{line}\n\n  {line}\n")).unwrap();
        let poses = read_poses(&path).unwrap();
        assert_eq!(poses.len(), 2);
        let rows = "0 0 1 -2\n-1 0 0 0\n0 -1 0 0\n0 0 0 1\n";
        write(&path, format!("{rows}\n# the other\n{rows}")).unwrap();
        assert_eq!(read_poses(&path).unwrap(), poses);
        // Three rows in a file from anywhere may be those of the pose; only sets have the object in the camera so.
        let three = "0 0 1 -2\n-1 0 0 0\n0 -1 0 0\n";
        write(&path, three).unwrap();
        for error in [read_pose(&path).unwrap_err(), read_poses(&path).unwrap_err()] {
            assert!(error.to_string().contains("expected 16 numbers, found 12"), "{error}");
        }
        let in_set = dir.path().join("pose/0.txt");
        std::fs::create_dir(dir.path().join("pose")).unwrap();
        write(&in_set, three).unwrap();
        assert_eq!(read_pose(&in_set).unwrap().w_axis.to_array(), [0.0, 0.0, 2.0, 1.0]);
        for (text, words) in [
            ("# none", "at least one"),
            ("1 2 3", "line 1: expected 16"),
            (&line.replace("-2", "NaN"), "finite"),
            (&format!("{rows}1 2 3 4"), "line 5: expected 16"),
        ] {
            write(&path, text).unwrap();
            let error = read_poses(&path).unwrap_err().to_string();
            assert!(error.contains("pose.txt") && error.contains(words), "{error}");
        }
    }

    /// Breaks one file of a good set; the error must name that file and hold the given words.
    fn broken(file: &str, spoil: impl Fn(&Path), words: &[&str]) {
        let (dir, ..) = made(3);
        let path = dir.path().join("thing").join(file);
        spoil(&path);
        let error = SrnSet::open(dir.path()).and_then(|set| set.load(8)).map(|_| ()).unwrap_err().to_string();
        let named = Path::new(file).file_name().unwrap().to_str().unwrap();
        assert!(error.contains(named) && words.iter().all(|word| error.contains(word)), "{error}");
        assert!(!error.contains('\n'), "{error}");
    }

    #[test]
    fn bad_files_are_named() {
        let remove = |path: &Path| std::fs::remove_file(path).unwrap();
        let text = |text: &'static str| move |path: &Path| write(path, text).unwrap();
        let halve = |path: &Path| write(path, &std::fs::read(path).unwrap()[..60]).unwrap();
        broken("pose/000001.txt", remove, &["missing", "rgb"]);
        broken("rgb/000001.png", remove, &["missing", "pose"]);
        broken("intrinsics.txt", remove, &[]);
        // What single precision cannot hold: found by the fuzzer.
        broken("intrinsics.txt", text("74.4 -1e308 4. 0.\n0. 0. 0.\n1.\n8 8\n"), &["f cx cy", "-1e308"]);
        broken("pose/000000.txt", text("1 0 0 0 0 1 0 0 0 0 1 1e99 0 0 0 1"), &["a place within 1e12"]);
        broken("rgb/000002.png", halve, &["not a readable image"]);
        broken("rgb/000002.png", text("no picture"), &["not a readable image"]);
        broken("pose/000000.txt", text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0"), &["16 numbers", "15"]);
        broken("pose/000000.txt", text("1 0 0 0 0 1 0 0 0 0 1 NaN 0 0 0 1"), &["finite", "NaN"]);
        broken("pose/000000.txt", text("1 0 0 0 0 1 0 0 0 0 1 x 0 0 0 1"), &["\"x\""]);
        broken("pose/000000.txt", text("1.1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"), &["rigid", "0.210"]);
        broken("pose/000000.txt", text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 2"), &["rigid"]);
        broken("intrinsics.txt", text("50 4\n0 0 0\n1\n8 8\n"), &["f cx cy", "3 numbers", "2"]);
        broken("intrinsics.txt", text("50 4 4\n0 0 0\n1\n"), &["height width"]);
        broken("intrinsics.txt", text("-50 4 4\n0 0 0\n1\n8 8"), &["positive", "-50"]);
        broken("intrinsics.txt", text("50 4 4\n0 0 0\n1\n8 0"), &["positive"]);
    }

    #[test]
    fn a_note_that_a_picture_is_turned_is_seen() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("photo.jpg");
        RgbImage::new(8, 4).save(&path).unwrap();
        let whole = std::fs::read(&path).unwrap();
        // One entry, the orientation, in little-endian TIFF.
        let exif = |orientation: u8| {
            [b"\xff\xe1\0\x22Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0", &[orientation, 0, 0, 0, 0, 0, 0, 0][..]]
                .concat()
        };
        let noted = |orientation| {
            write(&path, [&whole[..2], &exif(orientation), &whole[2..]].concat()).unwrap();
            is_turned(&path)
        };
        assert_eq!([1, 3, 6].map(noted), [false, true, true]);
        write(&path, &whole).unwrap();
        assert_eq!([path, dir.path().join("none.jpg")].map(|path| is_turned(&path)), [false, false]);
    }

    #[test]
    fn what_is_no_picture_is_not_listed() {
        let (dir, ..) = made(3);
        let thing = dir.path().join("thing");
        for file in ["rgb/._000001.png", "rgb/.000002.png", "pose/._000001.txt"] {
            write(thing.join(file), "no picture").unwrap();
        }
        std::fs::create_dir(thing.join("rgb/small.png")).unwrap();
        let views = SrnSet::open(&thing).unwrap().load(8).unwrap().instances.remove(0).views;
        assert_eq!(views.iter().map(|view| view.name.as_str()).collect::<Vec<_>>(), ["000000", "000001", "000002"]);
    }

    #[test]
    fn folders_without_a_set_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let error = |path: &Path| SrnSet::open(path).unwrap_err().to_string();
        assert!(error(dir.path()).contains("rgb/"));
        assert!(error(&dir.path().join("nowhere")).contains("nowhere"));
        for folder in ["rgb", "pose"] {
            std::fs::create_dir_all(dir.path().join("empty").join(folder)).unwrap();
        }
        write(dir.path().join("empty/intrinsics.txt"), INTRINSICS.to_string()).unwrap();
        let error = SrnSet::open(dir.path()).unwrap().load(8).unwrap_err().to_string();
        assert!(error.contains("empty") && error.contains("none"), "{error}");
    }

    #[test]
    fn nothing_is_overwritten_unasked() {
        let (dir, _, pictures) = made(3);
        let thing = dir.path().join("thing");
        let notes = thing.join("notes.txt");
        write(&notes, "mine").unwrap();
        std::fs::create_dir(thing.join("intrinsics")).unwrap();
        let old = ["frame.json", "intrinsics/another.txt"].map(|name| thing.join(name));
        old.iter().for_each(|path| write(path, "of the old views").unwrap());
        assert!(matches!(InstanceWriter::create(&thing, &INTRINSICS, false), Err(Error::Exists { .. })));
        assert_eq!(SrnSet::open(&thing).unwrap().instances[0].views.len(), 3);
        // What ends before it is done changes nothing.
        let new = || {
            let writer = InstanceWriter::create(&thing, &INTRINSICS, true).unwrap();
            writer.add("new", &pictures[0], &uniform_sphere(1, 1.0, 0)[0]).unwrap();
            writer
        };
        drop(new());
        assert_eq!(SrnSet::open(&thing).unwrap().instances[0].views.len(), 3);
        assert!(old.iter().all(|path| path.exists()) && !thing.join(NEW).exists());
        new().finish().unwrap();
        assert_eq!(SrnSet::open(&thing).unwrap().instances[0].views.len(), 1, "old views stayed");
        assert!(old.iter().all(|path| !path.exists()));
        assert_eq!(std::fs::read_to_string(notes).unwrap(), "mine");
    }
}
