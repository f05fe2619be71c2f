//! `sigma-data import`, `export` and `inspect`: posed pictures in and out, and a look at them.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use clap::Args;
use glam::{DMat4, DVec3};
use serde::Deserialize;
use sigma_srn::photo::MARGIN;
use srn_data::camera::Axes;
use srn_data::capture::{Bounds, Capture, Frame, FrameRecord, UpAxis};
use srn_data::formats::{self, Format, ReadOptions, WriteOptions, Written, bop};
use srn_data::inspect::{self, Origin};
use srn_data::masks;
use srn_data::srn;

use crate::common::{Result, axes, named, print, refuse_existing, refuse_to_write, write_picture};
use crate::meshes;
use crate::progress;

/// Flags that say what a source is, and how it differs from what its format promises.
#[derive(Args, Debug)]
struct Source {
    /// srn, transforms, bop or colmap; `auto` looks.
    #[arg(long, value_name = "FORMAT", default_value = "auto", value_parser = source_format)]
    format: SourceFormat,
    /// Axes of the cameras: opencv (x right, y down, z forward), opengl (x right, y up, z back), pytorch3d (x left, y up, z
    /// forward) or ros (x forward, y left, z up). Default: those of the format.
    #[arg(long, value_name = "AXES", value_parser = axes)]
    convention: Option<Axes>,
    /// The poses are the inverse of what the format says: world to camera where it has camera to world, or the other way.
    #[arg(long)]
    inverted: bool,
    /// Angle of view across the width in degrees, where the source has no intrinsics or wrong ones.
    #[arg(long, value_name = "DEG", value_parser = angle_of_view)]
    fov: Option<f64>,
    /// Folder with masks, white where the object is, named like the pictures. Default: what the source has, and transparency.
    #[arg(long, value_name = "DIR")]
    mask: Option<PathBuf>,
    /// Folder that the pictures' names are relative to. Default: beside the source.
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    /// BOP: only the object of this number.
    #[arg(long, value_name = "ID")]
    object: Option<u32>,
}

#[derive(Clone, Copy, Debug)]
struct SourceFormat(Option<Format>);

fn source_format(text: &str) -> std::result::Result<SourceFormat, String> {
    if text == "auto" { Ok(SourceFormat(None)) } else { target_format(text).map(|format| SourceFormat(Some(format))) }
}

fn target_format(text: &str) -> std::result::Result<Format, String> {
    named(text, &Format::ALL, Format::name)
}

/// So many of an object's diagonals a camera can be away from its centre in earnest.
const SANE_DISTANCES: RangeInclusive<f64> = 1e-3..=1e4;

fn above_zero(text: &str) -> std::result::Result<f64, String> {
    text.parse().ok().filter(|x: &f64| *x > 0.0 && x.is_finite()).ok_or("expected a number above 0".into())
}

fn angle_of_view(text: &str) -> std::result::Result<f64, String> {
    above_zero(text).ok().filter(|&degrees| degrees < 180.0).ok_or("expected a number between 0 and 180".into())
}

fn share(text: &str) -> std::result::Result<f64, String> {
    text.parse().ok().filter(|x| (0.0..10.0).contains(x)).ok_or("expected a share, 0 or more".into())
}

fn point(text: &str) -> std::result::Result<DVec3, String> {
    let values: Option<Vec<f64>> = text.split(',').map(|word| word.trim().parse().ok().filter(|x: &f64| x.is_finite())).collect();
    match values.as_deref() {
        Some(&[x, y, z]) => Ok(DVec3::new(x, y, z)),
        _ => Err("expected X,Y,Z".into()),
    }
}

fn up(text: &str) -> std::result::Result<UpAxis, String> {
    let (axis, negative) = text.strip_prefix('-').map_or((text, false), |axis| (axis, true));
    match (["x", "y", "z"].iter().position(|name| *name == axis), text) {
        (Some(axis), _) => Ok(UpAxis::Axis(axis, negative)),
        (None, "cameras") => Ok(UpAxis::Cameras),
        _ => Err("expected x, -x, y, -y, z, -z or cameras".into()),
    }
}

impl Source {
    fn read(&self, path: &Path) -> Result<(Format, Vec<Capture>)> {
        let format = match self.format.0 {
            Some(format) => format,
            None => Format::detect(path)?,
        };
        if self.object.is_some() && format != Format::Bop {
            return Err(format!("--object is for BOP: {} is {}", path.display(), format.name()).into());
        }
        let options = ReadOptions {
            axes: self.convention,
            inverted: self.inverted,
            fov_deg: self.fov,
            masks: self.mask.clone(),
            images: self.images.clone(),
            object: self.object,
        };
        Ok((format, formats::read(path, format, &options)?))
    }
}

/// Flags that say where in its source the object is.
#[derive(Args, Debug)]
struct Place {
    /// Centre of the object in the source's units. Default: BOP's box, or where the silhouettes' middles meet; without masks, where the cameras look.
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true, value_parser = point)]
    centre: Option<DVec3>,
    /// Diagonal of the object's box in the source's units; an import makes it 1. Default: BOP's box, or the longest silhouette.
    #[arg(long, value_name = "LENGTH", value_parser = above_zero)]
    diagonal: Option<f64>,
    /// Without --diagonal, a box and silhouettes: how many diagonals the cameras are away on average.
    #[arg(long, value_name = "R", default_value_t = 1.3, conflicts_with = "diagonal", value_parser = above_zero)]
    radius: f64,
}

impl Place {
    fn bounds(&self, capture: &Capture) -> Result<(Bounds, String)> {
        Ok(capture.find_bounds(self.centre, self.diagonal, self.radius)?)
    }
}

/// Flags of `sigma-data import`.
#[derive(Args, Debug)]
pub struct Import {
    /// SRN set or instance, transforms.json or its folder, BOP scene or folder of scenes, COLMAP model or its folder.
    #[arg(value_name = "SRC")]
    path: PathBuf,
    #[command(flatten)]
    source: Source,
    /// The data set's folder; instances are made inside.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// The instance's name. Default: that of the source's folder.
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// Cut squares of this many pixels around the object. Default: whole pictures.
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(1..=4096))]
    side: Option<u32>,
    /// Room around the object in a square, on each side, as a share of its extent.
    #[arg(long, value_name = "SHARE", default_value_t = MARGIN, value_parser = share)]
    margin: f64,
    #[command(flatten)]
    place: Place,
    /// What is up in the source: x, -x, y, -y, z, -z, or `cameras`, what is up in the pictures. Default: z; COLMAP: cameras.
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true, value_parser = up)]
    up: Option<UpAxis>,
    /// Write every N-th view to OUT/test and the others to OUT/train, to train on the ones and measure on the others.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..))]
    hold_out: Option<u32>,
    /// Leave frame and units as they are. The default for SRN folders.
    #[arg(long, conflicts_with_all = ["centre", "diagonal", "up"])]
    keep_frame: bool,
    /// Replace instances that exist in the output folder.
    #[arg(long)]
    force: bool,
}

impl Import {
    /// Runs the command.
    pub fn run(&self) -> Result<bool> {
        let (format, mut captures) = self.source.read(&self.path)?;
        match (&self.name, &mut captures[..]) {
            (Some(name), [only]) => only.name = folder_name(name)?,
            (Some(_), several) => return Err(format!("--name: {} objects cannot have one name", several.len()).into()),
            _ => {}
        }
        let asked = self.place.centre.is_some() || self.place.diagonal.is_some() || self.up.is_some();
        let keep = self.keep_frame || format == Format::Srn && !asked;
        let options = WriteOptions {
            axes: None,
            side: self.side.map(|s| s as usize),
            placed: !keep || format == Format::Srn,
            margin: self.margin,
            replace: self.force,
        };
        for Capture { name, frames, .. } in &captures {
            let turned = frames.iter().filter(|frame| srn::is_turned(&frame.image)).count();
            if turned > 0 {
                eprintln!(
                    "warning: {name}: by their EXIF {turned} pictures are to be turned; pixels are taken as they are stored"
                );
            }
        }
        let folders = if self.hold_out.is_some() { &["train", "test"][..] } else { &[""] };
        let outs = folders.iter().map(|folder| self.out.join(folder));
        let dirs = outs.flat_map(|out| captures.iter().map(move |capture| formats::folder(capture, Format::Srn, &out)));
        let dirs: Vec<_> = dirs.collect();
        formats::refuse_sources(&captures, &dirs)?;
        refuse_existing(dirs, self.force)?;
        if let Some(n) = self.hold_out
            && let Some(few) = captures.iter().find(|capture| capture.frames.len() < n as usize)
        {
            return Err(format!("{}: --hold-out {n} takes {n} usable views or more, not {}", few.name, few.frames.len()).into());
        }
        let bar = progress::bar(captures.len() as u64, "objects");
        for capture in &mut captures {
            bar.set_message(capture.name.clone());
            let (placed, found_by) = if keep { (DMat4::IDENTITY, "kept as it was".into()) } else { self.place(format, capture)? };
            let root = std::fs::canonicalize(&self.path)?;
            let root = if root.is_file() { root.parent().unwrap_or(&root) } else { &root };
            let relative = |image: &Path| {
                let image = std::fs::canonicalize(image).unwrap_or_else(|_| image.into());
                let inside = image.strip_prefix(root).ok().or(image.file_name().map(Path::new));
                inside.unwrap_or(&image).to_string_lossy().replace('\\', "/")
            };
            // A second import adds to what the first did.
            let before = capture.record.take();
            let images = capture.frames.iter().map(|frame| (frame.name.clone(), relative(&frame.image))).collect();
            let made = FrameRecord {
                world_from_source: [[0.0; 4]; 4],
                format: format.name().into(),
                found_by,
                object_id: capture.object_id,
                scene_id: capture.scene_id,
                images,
            };
            let total = placed * before.as_ref().map_or(DMat4::IDENTITY, FrameRecord::matrix);
            let record = FrameRecord { world_from_source: total.transpose().to_cols_array_2d(), ..before.unwrap_or(made) };
            capture.transform(&placed);
            let far = |frame: &Frame| frame.camera.world_from_camera.w_axis.truncate().length();
            if let Some(frame) = capture.frames.iter().find(|frame| !keep && !SANE_DISTANCES.contains(&far(frame))) {
                let (name, distance) = (frame.image.display(), far(frame));
                let found_by = &record.found_by;
                return Err(format!(
                    "{name}: its camera is {distance:.1e} diagonals from the object's centre ({found_by}); nothing was changed"
                )
                .into());
            }
            for folder in folders {
                let part = match (self.hold_out, *folder) {
                    (Some(n), folder) => every(capture, n as usize, folder == "test"),
                    (None, _) => std::mem::take(capture),
                };
                let written = formats::write(&part, Format::Srn, &self.out.join(folder), &options)?;
                bar.suspend(|| report(&part, &written, &format!("frame: {}", record.found_by)))?;
                if written.views == 0 {
                    return Err(format!("{}: no view could be written, nothing was changed", written.dir.display()).into());
                }
                record.write(&written.dir)?;
            }
            bar.inc(1);
        }
        bar.finish_and_clear();
        Ok(true)
    }

    fn place(&self, format: Format, capture: &Capture) -> Result<(DMat4, String)> {
        let (bounds, how) = self.place.bounds(capture)?;
        let Bounds { centre: c, diagonal } = bounds;
        Ok((
            capture.placement(bounds, self.up.unwrap_or(format.up())),
            format!("centre {:.4} {:.4} {:.4}, diagonal {diagonal:.4} ({how})", c.x, c.y, c.z),
        ))
    }
}

/// Every n-th view of a capture, or the others. What was skipped is told with the others.
fn every(capture: &Capture, n: usize, these: bool) -> Capture {
    let numbered = capture.frames.iter().enumerate().filter(|(i, _)| (i % n == n - 1) == these);
    let skipped = if these { vec![] } else { capture.skipped.clone() };
    Capture { frames: numbered.map(|(_, frame)| frame.clone()).collect(), skipped, ..capture.clone() }
}

/// One line on stdout about what was written; what was left out, on stderr.
fn report(capture: &Capture, written: &Written, note: &str) -> Result<()> {
    let skipped: Vec<_> = capture.skipped.iter().chain(&written.skipped).collect();
    skipped.iter().for_each(|why| eprintln!("skipped: {why}"));
    written.warnings.iter().for_each(|what| eprintln!("warning: {what}"));
    print(&format!("{}: {} views written, {} skipped; {note}", written.dir.display(), written.views, skipped.len()))
}

fn folder_name(name: &str) -> Result<String> {
    match name {
        "" | "." | ".." => Err(format!("\"{name}\" cannot name a folder").into()),
        name if name.contains(['/', '\\']) => Err(format!("\"{name}\" cannot name a folder").into()),
        name => Ok(name.into()),
    }
}

/// Flags of `sigma-data masks`.
#[derive(Args, Debug)]
pub struct Masks {
    /// transforms.json or its folder, BOP scene, COLMAP model or its folder; an SRN instance.
    #[arg(value_name = "SRC")]
    path: PathBuf,
    #[command(flatten)]
    source: Source,
    /// The folder of the masks, and of sheet.png, on which they can be looked at. `sigma-data import SRC --mask DIR` takes it.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    place: Place,
    /// Write over masks that are there.
    #[arg(long)]
    force: bool,
}

impl Masks {
    /// Runs the command.
    pub fn run(&self) -> Result<bool> {
        if self.source.mask.is_some() {
            return Err("--mask: masks are what this command makes, in --out".into());
        }
        let (_, mut captures) = self.source.read(&self.path)?;
        let [capture] = &mut captures[..] else {
            let path = self.path.display();
            return Err(
                format!("{path}: {} objects, and masks are made for one: name its folder, or --object", captures.len()).into()
            );
        };
        refuse_existing([self.out.clone()], self.force)?;
        // What others cut out is not asked.
        capture.frames.iter_mut().for_each(|frame| frame.mask = None);
        formats::refuse_sources(std::slice::from_ref(capture), std::slice::from_ref(&self.out))?;
        let (bounds, _) = self.place.bounds(capture)?;
        let bar = progress::bar(masks::steps(capture), "steps");
        let written = masks::write(capture, bounds, &self.out, &mut || bar.inc(1))?;
        bar.finish_and_clear();
        capture.skipped.iter().chain(&written.skipped).for_each(|why| eprintln!("skipped: {why}"));
        let sheet = self.out.join("sheet.png");
        write_picture(&sheet, &written.sheet)?;
        let Bounds { centre: c, diagonal } = written.bounds;
        print(&format!(
            "{}: {} masks; centre {:.4} {:.4} {:.4}, diagonal {diagonal:.4} at most, on {}\n{}: look at it",
            self.out.display(),
            written.masks,
            c.x,
            c.y,
            c.z,
            written.ground,
            sheet.display()
        ))?;
        Ok(true)
    }
}

/// Flags of `sigma-data export`.
#[derive(Args, Debug)]
pub struct Export {
    /// A data set or an instance of one; any other source of posed pictures will do, too.
    #[arg(value_name = "SRC")]
    path: PathBuf,
    /// srn, transforms, bop, colmap or colmap-text; or `bop-results`, the CSV of estimates.
    #[arg(long, value_name = "FORMAT", value_parser = target)]
    format: Target,
    /// Folder in which to write; for bop-results, the file.
    #[arg(long, value_name = "DIR|FILE")]
    out: PathBuf,
    /// Axes of the cameras in the output, for srn and transforms: opencv, opengl, pytorch3d or ros. Default: the format's.
    #[arg(long, value_name = "AXES", value_parser = axes)]
    convention: Option<Axes>,
    /// Poses to write in place of those of SRC: what `sigma-pose estimate --json` prints. Views without one are left out.
    #[arg(long, value_name = "FILE")]
    poses: Option<PathBuf>,
    /// Stay in the data set's frame: do not go back to that of the source it was imported from.
    #[arg(long)]
    keep_frame: bool,
    /// bop-results: number of the scene. Default: that which the pictures came from, else as --format bop numbers it.
    #[arg(long, value_name = "ID")]
    scene: Option<u32>,
    /// Write over what is there.
    #[arg(long)]
    force: bool,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Target {
    Format(Format),
    BopResults,
}

fn target(text: &str) -> std::result::Result<Target, String> {
    let refused = |error| format!("{error}, bop-results");
    if text == "bop-results" { Ok(Target::BopResults) } else { target_format(text).map(Target::Format).map_err(refused) }
}

/// What is needed of the output of `sigma-pose estimate --json`.
#[derive(Deserialize)]
struct Estimates {
    /// The axes of the poses.
    convention: Axes,
    images: Vec<Estimate>,
}

#[derive(Deserialize)]
struct Estimate {
    image: PathBuf,
    instance: String,
    world_from_camera: [[f64; 4]; 4],
    /// Not known where the picture shows nothing.
    unexplained: Option<f64>,
    seconds: f64,
}

impl Estimate {
    /// The name of the instance's folder that the picture lies in.
    fn folder(&self) -> Option<OsString> {
        let image = std::fs::canonicalize(&self.image).unwrap_or_else(|_| self.image.clone());
        image.ancestors().nth(2)?.file_name().map(OsString::from)
    }
}

impl Export {
    /// Runs the command.
    pub fn run(&self) -> Result<bool> {
        if self.scene.is_some() && self.format != Target::BopResults {
            return Err("--scene is for --format bop-results".into());
        }
        let format = Format::detect(&self.path)?;
        let mut captures = formats::read(&self.path, format, &ReadOptions::default())?;
        let estimates = self.poses.as_ref().map(|path| read_estimates(path)).transpose()?;
        let scenes: Vec<_> = captures.iter().map(|capture| self.scene.or(capture.scene_id)).collect();
        bop::number(&mut captures);
        if let Target::Format(format) = self.format {
            let dirs: Vec<_> = captures.iter().map(|capture| formats::folder(capture, format, &self.out)).collect();
            formats::refuse_sources(&captures, &dirs)?;
        }
        let mut results = vec![];
        let only = captures.len() == 1;
        for (capture, scene) in captures.iter_mut().zip(scenes) {
            let instance = capture.name.clone();
            // A model may call the only object otherwise; then its pictures say whose poses these are.
            let is_of_it = |e: &&Estimate| e.instance == instance || only && e.folder().is_some_and(|name| *name == *instance);
            let of_it: Vec<_> = estimates.iter().flatten().filter(is_of_it).collect();
            let of_view = |name: &str| of_it.iter().find(|e| e.image.file_stem() == Some(name.as_ref()));
            let number = |frame: &Frame| frame.name.split('_').next()?.parse().ok();
            let numbers: Option<Vec<u32>> = capture.frames.iter().map(number).collect();
            let numbers = numbers.unwrap_or_else(|| (0..capture.frames.len() as u32).collect());
            let numbers: BTreeMap<_, _> = capture.frames.iter().map(|frame| frame.name.clone()).zip(numbers).collect();
            // Estimates are in the data set's frame, so they are put in before the frame is left.
            if estimates.is_some() {
                capture.frames.retain_mut(|frame| {
                    let found = of_view(&frame.name);
                    if let Some(estimate) = found {
                        frame.camera.world_from_camera = DMat4::from_cols_array_2d(&estimate.world_from_camera).transpose();
                    }
                    found.is_some()
                });
            }
            if !self.keep_frame {
                capture.restore();
            }
            let (scene_id, obj_id) = (scene.or(capture.scene_id).unwrap_or(1), capture.object_id.unwrap_or(1));
            for frame in &capture.frames {
                let (estimate, im_id) = (of_view(&frame.name), numbers[&frame.name]);
                let result = bop::Estimate {
                    scene_id,
                    im_id,
                    obj_id,
                    score: estimate.map_or(1.0, |estimate| estimate.unexplained.map_or(0.0, |part| 1.0 - part)),
                    camera_from_object: frame.camera.world_from_camera.inverse(),
                    time: estimate.map_or(-1.0, |estimate| estimate.seconds),
                };
                results.push((instance.clone(), result));
            }
        }
        captures.retain(|capture| !capture.frames.is_empty());
        if captures.is_empty() {
            let first = estimates.iter().flatten().next();
            let found = first.map_or("none".into(), |e| format!("{} of {}", e.image.display(), e.instance));
            let poses = self.poses.as_deref().unwrap_or(&self.path).display();
            return Err(format!("{poses}: images: expected some of {}, found {found}", self.path.display()).into());
        }
        let Target::Format(format) = self.format else {
            refuse_to_write(&self.out, self.force)?;
            let mut rows = BTreeMap::new();
            for (name, bop::Estimate { scene_id, im_id, obj_id, .. }) in &results {
                if let Some(other) = rows.insert((scene_id, im_id, obj_id), name).filter(|other| *other != name) {
                    let what = format!("object {obj_id} in image {im_id} of scene {scene_id}");
                    return Err(
                        format!("{}: {other} and {name} both have {what}; export them one by one", self.path.display()).into()
                    );
                }
            }
            if self.poses.is_none() {
                let (out, path) = (self.out.display(), self.path.display());
                eprintln!("warning: {out}: the poses of {path} itself, with a score of 1; --poses puts estimates in their place");
            }
            let results: Vec<_> = results.into_iter().map(|(_, result)| result).collect();
            bop::write_results(&self.out, &results, self.force)?;
            print(&format!("{}: {} estimates", self.out.display(), results.len()))?;
            return Ok(true);
        };
        refuse_existing(captures.iter().map(|capture| formats::folder(capture, format, &self.out)), self.force)?;
        let options = WriteOptions { axes: self.convention, replace: self.force, ..WriteOptions::default() };
        for capture in &captures {
            let written = formats::write(capture, format, &self.out, &options)?;
            report(capture, &written, &capture.name)?;
        }
        Ok(true)
    }
}

fn read_estimates(path: &Path) -> Result<Vec<Estimate>> {
    let about = |error: &dyn std::fmt::Display| format!("{}: {error}", path.display());
    let text = std::fs::read_to_string(path).map_err(|error| about(&error))?;
    let estimates: Estimates = serde_json::from_str(&text).map_err(|error| about(&error))?;
    let ours = |found: Estimate| {
        let pose = DMat4::from_cols_array_2d(&found.world_from_camera).transpose();
        Estimate { world_from_camera: estimates.convention.to_ours(pose).transpose().to_cols_array_2d(), ..found }
    };
    Ok(estimates.images.into_iter().map(ours).collect())
}

/// Flags of `sigma-data inspect`.
#[derive(Args, Debug)]
pub struct Inspect {
    /// SRN set or instance, transforms.json or its folder, BOP scene or folder of scenes, COLMAP model or its folder.
    #[arg(value_name = "SRC", required_unless_present = "meshes")]
    path: Option<PathBuf>,
    /// Instead of posed pictures: mesh files, and folders of them. Reads each, says what is in it and what was left out. Exit
    /// status 1 if a file was refused.
    #[arg(long, value_name = "PATH", num_args = 1.., conflicts_with_all = ["path", "Source", "out", "force"])]
    meshes: Vec<PathBuf>,
    #[command(flatten)]
    source: Source,
    /// Print the findings as JSON.
    #[arg(long)]
    json: bool,
    /// Write a contact sheet with the axes and a drawing of the cameras to this picture, a .png, .jpg or .bmp.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Overwrite the picture.
    #[arg(long)]
    force: bool,
}

impl Inspect {
    /// Runs the command; false where something is wrong.
    pub fn run(&self) -> Result<bool> {
        let Some(path) = &self.path else { return meshes::inspect(&self.meshes, self.json) };
        self.out.iter().try_for_each(|out| refuse_to_write(out, self.force))?;
        let (format, mut captures) = self.source.read(path)?;
        if let Some(out) = self.out.as_ref().filter(|out| out.exists()) {
            let is_out = |path: &PathBuf| std::fs::canonicalize(path).ok() == std::fs::canonicalize(out).ok();
            let frames = captures.iter().flat_map(|capture| &capture.frames);
            if frames.flat_map(|frame| frame.mask.iter().chain([&frame.image])).any(is_out) {
                return Err(format!("{}: one of the pictures that are read", out.display()).into());
            }
        }
        let origin = if format == Format::Srn { Origin::Given } else { Origin::Found };
        if origin == Origin::Found {
            inspect::place_all(&mut captures, format.up())?;
        }
        let axes = self.source.convention.unwrap_or(format.axes());
        let report = inspect::inspect(&captures, axes, self.source.inverted, origin);
        if self.json {
            print(&serde_json::to_string_pretty(&report)?)?;
        } else {
            let head = ["instance", "views", "size", "focal px", "distance", "off axis", "facing"];
            print(&format!(
                "{:<24} {:>6} {:>12} {:>17} {:>15} {:>9} {:>6}",
                head[0], head[1], head[2], head[3], head[4], head[5], head[6]
            ))?;
            for i in &report.instances {
                let sizes = i.sizes.keys().cloned().collect::<Vec<_>>().join(" ");
                let range = |[low, high]: [f64; 2]| {
                    if high - low < 1e-6 * high { format!("{low:.3}") } else { format!("{low:.3} … {high:.3}") }
                };
                let (focal, radius, off) = (range(i.focal_px), range(i.radius), i.off_axis_deg);
                print(&format!(
                    "{:<24} {:>6} {sizes:>12} {focal:>17} {radius:>15} {off:>8.2}° {:>6}",
                    i.name, i.views, i.facing
                ))?;
            }
            let views: usize = report.instances.iter().map(|i| i.views).sum();
            print(&format!("{} instances, {views} views, {} problems", report.instances.len(), report.problems.len()))?;
            report.problems.iter().try_for_each(|problem| print(&format!("problem: {problem}")))?;
            report.notes.iter().try_for_each(|note| print(&format!("note: {note}")))?;
        }
        if let Some(out) = &self.out {
            write_picture(out, &inspect::contact_sheet(&captures, 8, 16))?;
        }
        Ok(report.problems.is_empty())
    }
}
