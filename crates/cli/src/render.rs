//! `sigma-data render`: meshes to pictures with known cameras.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use clap::builder::NonEmptyStringValueParser;
use clap::{Args, ValueEnum};
use glam::{DMat4, DVec3};
use image::RgbImage;
use indicatif::ProgressBar;
use srn_data::mesh::{self, Mesh, Up};
use srn_data::srn::{InstanceWriter, Intrinsics};
use srn_data::{camera, ldraw, sheet};
use srn_gpu::raster::{self, Rasterizer};

use crate::common::{Result, print, refuse_existing};
use crate::progress;
use crate::sets::{Cache, Set};

/// Flags of `sigma-data render`.
#[derive(Args, Debug)]
pub struct Render {
    /// A public set that was fetched: parts107, parts1157, chairs or cars, into OUT/train, OUT/test (the same objects) and OUT/heldout.
    ///
    /// Or meshes: .obj, .stl, .ply, .gltf, .glb, .ac, .acc, .wrl, or LDraw .dat inside a library (parts/, p/,
    /// LDConfig.ldr). The instance is called NAME, or like the file.
    #[arg(required = true, value_name = "SET|[NAME=]MESH", value_parser = subject)]
    what: Vec<Subject>,
    /// The data set's folder; instances are made inside.
    #[arg(long)]
    out: PathBuf,
    /// Width and height of the pictures in pixels.
    #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u32).range(8..))]
    side: u32,
    /// Distance of the cameras to the object's centre; the diagonal of its bounding box is 1. Default: 1.3; of a set, the paper's.
    #[arg(long, value_parser = |x: &str| between(x, 0.5, f64::MAX))]
    radius: Option<f64>,
    /// Views per object; of a set, training views.
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..))]
    views: u32,
    /// Views per object in OUT/test and OUT/heldout of a set. Default: 50.
    #[arg(long, value_name = "VIEWS", value_parser = clap::value_parser!(u32).range(1..))]
    test_views: Option<u32>,
    /// Of a set: each training object, and others made of it, stretched, tapered and recoloured at random; so many in all. A model of
    /// more objects is better at new ones.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    variants: u32,
    /// Where the cameras stand. Default: sphere. A set has a sphere for training and a spiral for the others.
    #[arg(long, value_enum)]
    cameras: Option<Cameras>,
    /// Displaces each camera at random: its distance by up to this fraction, its aim by up to this fraction of the object's
    /// radius. Training views that are all at one distance, with one aim, make poses elsewhere less accurate. Of a set, only the
    /// training views are displaced.
    #[arg(long, default_value_t = 0.0, value_parser = jitter)]
    jitter: f64,
    /// Turns each camera about its optical axis at random: pictures as a hand or a robot's arm takes them, to find poses in. A model needs none to learn from.
    #[arg(long)]
    roll: bool,
    /// Decides the random cameras, together with each instance's name.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Focal length in pixels. Default: the object's bounding sphere just fits into the picture.
    #[arg(long, conflicts_with = "fov", value_parser = |x: &str| between(x, 0.0, f64::MAX))]
    focal: Option<f64>,
    /// Angle of view in degrees, instead of --focal.
    #[arg(long, value_parser = |x: &str| between(x, 0.0, 180.0))]
    fov: Option<f64>,
    /// Which axis points up in the meshes. Default: y; z in .stl and .ply; LDraw and sets have their own.
    #[arg(long, value_enum)]
    up: Option<MeshUp>,
    /// Where the packages of sets are kept. Default: as `sigma-data fetch`.
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
    /// Replace instances that exist in the output folder.
    #[arg(long)]
    force: bool,
    /// The graphics adapter, by words of its name or backend (`intel`, `geforce dx12`). Default: the fastest kind.
    #[arg(long, value_parser = NonEmptyStringValueParser::new())]
    adapter: Option<String>,
}

#[derive(Clone, Debug)]
enum Subject {
    Set(Set),
    Mesh(String, PathBuf),
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Cameras {
    /// Uniformly random on the sphere.
    Sphere,
    /// Along a spiral from pole to pole.
    Spiral,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum MeshUp {
    Y,
    Z,
}

/// A folder of views of one object.
struct Folder {
    dir: PathBuf,
    cameras: Cameras,
    views: usize,
    jitter: f64,
}

/// What draws.
struct Studio<'a> {
    args: &'a Render,
    rasterizer: Rasterizer,
    radius: f64,
    intrinsics: Intrinsics,
    bar: ProgressBar,
}

impl Render {
    /// Runs the command.
    pub fn run(&self) -> Result<bool> {
        let sets = self.what.iter().filter(|what| matches!(what, Subject::Set(_))).count();
        match (&self.what[..], sets) {
            (&[Subject::Set(set)], _) => self.set(set)?,
            (_, 0) => self.meshes()?,
            _ => return Err("a set is rendered alone: it has its own distance and folders".into()),
        }
        Ok(true)
    }

    fn meshes(&self) -> Result<()> {
        if self.test_views.is_some() {
            return Err("--test-views: only a set has test views".into());
        }
        if self.variants > 1 {
            return Err("--variants: only of a set".into());
        }
        let folder = |name: &String| Folder {
            dir: self.out.join(name),
            cameras: self.cameras.unwrap_or(Cameras::Sphere),
            views: self.views as usize,
            jitter: self.jitter,
        };
        let mut jobs = vec![];
        let mut names = BTreeSet::new();
        for what in &self.what {
            let Subject::Mesh(name, path) = what else { continue };
            if !names.insert(name) {
                return Err(format!("{}: two meshes have the same name", path.display()).into());
            }
            jobs.push((name, path, [folder(name)]));
        }
        refuse_existing(jobs.iter().map(|(.., [folder])| folder.dir.clone()), self.force)?;
        // All are read before anything is written.
        let meshes = jobs.iter().map(|(_, path, _)| load_mesh(path, self.up)).collect::<Result<Vec<_>>>()?;
        let studio = self.studio(1.3, jobs.len() * self.views as usize)?;
        for ((name, path, folders), mesh) in jobs.iter().zip(&meshes) {
            studio.warn(&path.display().to_string(), mesh);
            studio.draw(name, mesh, folders)?;
        }
        studio.bar.finish_and_clear();
        let focal = studio.intrinsics.focal[0];
        print(&format!(
            "{} instances of {} views in {}, {focal:.3} px focal length",
            jobs.len(),
            self.views,
            self.out.display()
        ))?;
        Ok(())
    }

    fn set(&self, set: Set) -> Result<()> {
        if self.cameras.is_some() || self.up.is_some() {
            return Err(format!("{} has its own cameras and axes: no --cameras, no --up", set.name()).into());
        }
        let cache = Cache::open(self.cache.as_deref())?;
        let (views, test_views) = (self.views as usize, self.test_views.unwrap_or(50) as usize);
        let mut jobs = vec![];
        for object in set.objects()? {
            let package = cache.find(object.package)?;
            let package = package.ok_or_else(|| format!("{0} is not there: `sigma-data fetch {0}`", set.name()))?;
            let folder = |part: &str, cameras, views, jitter| {
                let dir = self.out.join(part).join(&object.name);
                Folder { dir, cameras, views, jitter }
            };
            let folders = if object.held_out {
                vec![folder("heldout", Cameras::Spiral, test_views, 0.0)]
            } else {
                let train = folder("train", Cameras::Sphere, views, self.jitter);
                vec![train, folder("test", Cameras::Spiral, test_views, 0.0)]
            };
            // The variants have training views alone.
            let variants = if object.held_out { 1 } else { self.variants };
            let others = (1..variants).map(|k| {
                let name = format!("{}~{k}", object.name);
                let dir = self.out.join("train").join(&name);
                Folder { dir, cameras: Cameras::Sphere, views, jitter: self.jitter }
            });
            let others: Vec<_> = others.collect();
            jobs.push((package.join(&object.path), folders, others, object));
        }
        let sheet_file = self.out.join("sheet.png");
        let all = || jobs.iter().flat_map(|(_, folders, others, _)| folders.iter().chain(others));
        let dirs = all().map(|folder| &folder.dir);
        refuse_existing(dirs.chain([&sheet_file]).cloned(), self.force)?;
        let pictures = all().map(|folder| folder.views).sum();
        let studio = self.studio(set.radius(), pictures)?;
        let (mut counts, mut skipped, mut cells) = ([0; 2], 0, vec![]);
        for (path, folders, others, object) in &jobs {
            match mesh::load(path) {
                Ok((mut mesh, _)) => {
                    mesh.normalise(object.turn);
                    studio.warn(&object.name, &mesh);
                    let picture = studio.draw(&object.name, &mesh, folders)?;
                    cells.push((picture, object.name.clone()));
                    counts[usize::from(object.held_out)] += 1;
                    for other in others {
                        let name = other.dir.file_name().unwrap_or_default().to_string_lossy();
                        let mut varied = mesh.clone();
                        varied.vary(self.seed ^ ldraw::name_hash(&name));
                        studio.draw(&name, &varied, std::slice::from_ref(other))?;
                    }
                }
                Err(error) => {
                    studio.bar.suspend(|| eprintln!("skipped: {}: {error}", object.name));
                    studio.bar.inc(folders.iter().chain(others).map(|folder| folder.views as u64).sum());
                    skipped += 1;
                }
            }
        }
        studio.bar.finish_and_clear();
        let cells: Vec<_> = cells.iter().map(|(picture, name)| (picture, name.as_str())).collect();
        // Made beside and renamed: a sheet is there whole or not at all.
        let new = self.out.join("sheet.new.png");
        let saved = sheet::grid(&cells, 12).save(&new).map_err(|error| error.to_string());
        let saved = saved.and_then(|()| std::fs::rename(&new, &sheet_file).map_err(|error| error.to_string()));
        saved.map_err(|error| format!("{}: {error}", sheet_file.display()))?;
        let [train, held_out] = counts;
        let (out, focal) = (self.out.display(), studio.intrinsics.focal[0]);
        print(&format!("{out}/train: {} instances of {views} views, {focal:.3} px focal length", train * self.variants))?;
        print(&format!("{out}/test: {train} instances of {test_views} views"))?;
        print(&format!("{out}/heldout: {held_out} instances of {test_views} views"))?;
        print(&format!("{}: a view of each object; {skipped} skipped", sheet_file.display()))?;
        Ok(())
    }

    fn studio(&self, usual_radius: f64, pictures: usize) -> Result<Studio<'_>> {
        let (side, radius) = (self.side as usize, self.radius.unwrap_or(usual_radius));
        let focal = match (self.focal, self.fov) {
            (Some(focal), _) => focal,
            (_, Some(fov)) => 0.5 * side as f64 / (0.5 * fov.to_radians()).tan(),
            _ => camera::fitting_focal_px(side, radius),
        };
        let sane = [0.01, 1000.0].map(|times| times * side as f64);
        if !(sane[0]..=sane[1]).contains(&focal) {
            let [low, high] = sane;
            return Err(format!("a focal length of {focal:e} px: expected {low} to {high} for pictures {side} px wide").into());
        }
        // The SRN convention puts the principal point at side / 2 while integer coordinates are pixel centres.
        let half = side as f64 / 2.0;
        let intrinsics = Intrinsics { focal: [focal; 2], centre: [half, half], size: [side, side] };
        let gpu = srn_gpu::Gpu::open(self.adapter.as_deref())?;
        eprintln!("adapter: {}", gpu.adapter());
        let rasterizer = Rasterizer::new(&gpu)?;
        Ok(Studio { args: self, rasterizer, radius, intrinsics, bar: progress::bar(pictures as u64, "pictures") })
    }
}

impl Studio<'_> {
    fn warn(&self, name: &str, mesh: &Mesh) {
        mesh.warnings.iter().for_each(|warning| self.bar.suspend(|| eprintln!("warning: {name}: {warning}")));
    }

    /// Writes the views of an object. Returns one that shows it from obliquely above: the same for all objects.
    fn draw(&self, name: &str, mesh: &Mesh, folders: &[Folder]) -> Result<RgbImage> {
        self.bar.set_message(name.to_owned());
        let model = upload(&self.rasterizer, mesh)?;
        // Each object is seen from other places.
        let seed = self.args.seed ^ ldraw::name_hash(name);
        for folder in folders {
            let writer = InstanceWriter::create(&folder.dir, &self.intrinsics, self.args.force)?;
            let poses = match folder.cameras {
                Cameras::Sphere => camera::uniform_sphere(folder.views, self.radius, seed),
                Cameras::Spiral => camera::spiral(folder.views, self.radius),
            };
            let poses = if folder.jitter > 0.0 { camera::jittered(&poses, folder.jitter, seed) } else { poses };
            let poses = if self.args.roll { camera::rolled(&poses, seed) } else { poses };
            for (i, pose) in poses.iter().enumerate() {
                writer.add(&format!("{i:06}"), &self.picture(&model, pose)?, pose)?;
                self.bar.inc(1);
            }
            writer.finish()?;
        }
        self.picture(&model, &camera::look_at_origin(self.radius * DVec3::new(0.5, -0.7, 0.5).normalize()))
    }

    fn picture(&self, model: &raster::Model, pose: &DMat4) -> Result<RgbImage> {
        let Intrinsics { focal: [fx, fy], centre: [cx, cy], .. } = self.intrinsics;
        let side = self.args.side;
        let view = raster::View { world_from_camera: pose.transpose().to_cols_array(), intrinsics: [fx, fy, cx, cy], side };
        Ok(RgbImage::from_raw(side, side, self.rasterizer.render(model, &view)?).ok_or("picture of the wrong size")?)
    }
}

fn between(text: &str, low: f64, high: f64) -> std::result::Result<f64, String> {
    match text.parse() {
        Ok(x) if low < x && x < high => Ok(x),
        _ if high == f64::MAX => Err(format!("expected a number above {low}")),
        _ => Err(format!("expected a number between {low} and {high}")),
    }
}

fn jitter(text: &str) -> std::result::Result<f64, String> {
    text.parse().ok().filter(|x| (0.0..0.5).contains(x)).ok_or("expected a number from 0 to below 0.5".into())
}

fn subject(argument: &str) -> std::result::Result<Subject, String> {
    // A mesh has an ending, so none can be called like a set.
    if let Ok(set) = Set::from_str(argument, false) {
        return Ok(Subject::Set(set));
    }
    let (name, path) = argument.split_once('=').unwrap_or(("", argument));
    let path = PathBuf::from(path);
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    match if name.is_empty() { stem } else { name.into() } {
        name if name.contains(['/', '\\']) || [".", "..", ""].contains(&name.as_str()) => {
            Err(format!("\"{name}\" cannot name a folder"))
        }
        name => Ok(Subject::Mesh(name, path)),
    }
}

fn load_mesh(path: &Path, up: Option<MeshUp>) -> Result<Mesh> {
    let (mut mesh, usual) = mesh::load(path)?;
    mesh.normalise(match (usual, up) {
        (Up::MinusY, _) | (_, None) => usual,
        (_, Some(MeshUp::Y)) => Up::Y,
        (_, Some(MeshUp::Z)) => Up::Z,
    });
    Ok(mesh)
}

fn upload(rasterizer: &Rasterizer, mesh: &Mesh) -> Result<raster::Model> {
    let vertex = |v: &mesh::Vertex| raster::Vertex {
        position: v.position.to_array(),
        normal: v.normal.to_array(),
        colour: v.colour.to_array(),
        uv: v.uv.to_array(),
    };
    let vertices: Vec<_> = mesh.vertices.iter().map(vertex).collect();
    let part = |part: &mesh::Part| (part.vertices.start as u32..part.vertices.end as u32, part.texture);
    let parts: Vec<_> = mesh.parts.iter().map(part).collect();
    let textures = mesh.textures.iter().map(|t| raster::Texture { width: t.width(), height: t.height(), rgba: t.as_raw() });
    let textures: Vec<_> = textures.collect();
    Ok(rasterizer.upload(&vertices, &parts, &textures)?)
}
