//! `sigma-data`: renders meshes into SRN data sets, converts posed pictures from and to other formats, and looks into them.

use clap::{Args, Parser, Subcommand, ValueEnum};
use image::RgbImage;
use sigma_cli::common::{Result, finish};
use sigma_cli::data::{Export, Import, Inspect};
use srn_data::mesh::{Mesh, Up};
use srn_data::srn::{InstanceWriter, Intrinsics};
use srn_data::{camera, ldraw};
use srn_gpu::raster::{self, Rasterizer};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Data sets in the SRN folder layout: SET/INSTANCE/{rgb,pose,intrinsics.txt}.
///
/// Exit status: 0 done, 1 `inspect` found problems, 2 an error.
#[derive(Parser)]
#[command(version, about)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Render meshes to pictures with known cameras, one instance per mesh.
    Render(Render),
    /// Read photographs with known cameras (transforms.json, BOP, COLMAP) or others' SRN folders into a data set.
    Import(Import),
    /// Write a data set, or estimated poses, in another format, in the frame and the units that it was imported from.
    Export(Export),
    /// Count, check and draw posed pictures, or read meshes. Exit status 1 if something is wrong with them.
    Inspect(Inspect),
}

#[derive(Args)]
struct Render {
    /// Meshes: .obj, .stl, .ply, .gltf, .glb, .ac, .acc, .wrl, or LDraw .dat inside a library (parts/, p/, LDConfig.ldr). The
    /// instance is called NAME, or like the file.
    #[arg(required = true, value_name = "[NAME=]MESH", value_parser = named_mesh)]
    meshes: Vec<(String, PathBuf)>,
    /// The data set's folder; instances are made inside.
    #[arg(long)]
    out: PathBuf,
    /// Width and height of the pictures in pixels.
    #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..))]
    side: u32,
    /// Distance of the cameras to the object's centre; the diagonal of its bounding box is 1.
    #[arg(long, default_value_t = 1.3, value_parser = |x: &str| between(x, 0.5, f64::MAX))]
    radius: f64,
    /// Views per object.
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..))]
    views: u32,
    /// Where the cameras stand.
    #[arg(long, value_enum, default_value_t = Cameras::Sphere)]
    cameras: Cameras,
    /// Displaces each camera at random: its distance by up to this fraction, its aim by up to this fraction of the object's
    /// radius. Training views that are all at one distance, with one aim, make poses elsewhere less accurate.
    #[arg(long, default_value_t = 0.0, value_parser = |x: &str| between(x, -f64::MIN_POSITIVE, 0.5))]
    jitter: f64,
    /// Decides the random cameras, together with each instance's name.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Focal length in pixels. Default: the object's bounding sphere just fits into the picture.
    #[arg(long, conflicts_with = "fov", value_parser = |x: &str| between(x, 0.0, f64::MAX))]
    focal: Option<f64>,
    /// Angle of view in degrees, instead of --focal.
    #[arg(long, value_parser = |x: &str| between(x, 0.0, 180.0))]
    fov: Option<f64>,
    /// Which axis points up in the meshes. Default: y; z in .stl and .ply; LDraw has its own.
    #[arg(long, value_enum)]
    up: Option<MeshUp>,
    /// Replace instances that exist in the output folder.
    #[arg(long)]
    force: bool,
    /// Name, or part of it, of the graphics adapter. Default: the fastest kind.
    #[arg(long)]
    adapter: Option<String>,
}

#[derive(Clone, Copy, ValueEnum)]
enum Cameras {
    /// Uniformly random on the sphere.
    Sphere,
    /// Along a spiral from pole to pole.
    Spiral,
}

#[derive(Clone, Copy, ValueEnum)]
enum MeshUp {
    Y,
    Z,
}

fn main() -> ExitCode {
    finish(match Cli::parse().command {
        Command::Render(args) => render(&args).map(|()| true),
        Command::Import(args) => args.run(),
        Command::Export(args) => args.run(),
        Command::Inspect(args) => args.run(),
    })
}

fn render(args: &Render) -> Result<()> {
    let (side, views) = (args.side as usize, args.views as usize);
    let focal = match (args.focal, args.fov) {
        (Some(focal), _) => focal,
        (_, Some(fov)) => 0.5 * side as f64 / (0.5 * fov.to_radians()).tan(),
        _ => camera::fitting_focal_px(side, args.radius),
    };
    // The SRN convention puts the principal point at side / 2 while integer coordinates are pixel centres.
    let half = side as f64 / 2.0;
    let intrinsics = Intrinsics { focal: [focal; 2], centre: [half, half], size: [side, side] };

    let mut names = std::collections::BTreeSet::new();
    for (name, path) in &args.meshes {
        let dir = args.out.join(name);
        if !args.force && dir.exists() {
            return Err(format!("{}: exists already; --force replaces it", dir.display()).into());
        }
        if !names.insert(name) {
            return Err(format!("{}: two meshes have the same name", path.display()).into());
        }
    }
    // All are read before anything is written.
    let meshes = args.meshes.iter().map(|(_, path)| load_mesh(path, args.up)).collect::<Result<Vec<_>>>()?;
    let gpu = srn_gpu::Gpu::open(args.adapter.as_deref())?;
    eprintln!("adapter: {}", gpu.adapter());
    let rasterizer = Rasterizer::new(&gpu)?;
    let progress = indicatif::ProgressBar::new((args.meshes.len() * views) as u64)
        .with_style(indicatif::ProgressStyle::with_template("{bar:30} {pos}/{len} {msg} {eta}")?);
    for ((name, path), mesh) in args.meshes.iter().zip(&meshes) {
        for warning in &mesh.warnings {
            progress.suspend(|| eprintln!("warning: {}: {warning}", path.display()));
        }
        progress.set_message(name.clone());
        let model = upload(&rasterizer, mesh)?;
        let writer = InstanceWriter::create(args.out.join(name), &intrinsics, args.force)?;
        // Each object is seen from other places.
        let seed = args.seed ^ ldraw::name_hash(name);
        let poses = match args.cameras {
            Cameras::Sphere => camera::uniform_sphere(views, args.radius, seed),
            Cameras::Spiral => camera::spiral(views, args.radius),
        };
        let poses = if args.jitter > 0.0 { camera::jittered(&poses, args.jitter, seed) } else { poses };
        for (i, pose) in poses.iter().enumerate() {
            let view = raster::View {
                world_from_camera: pose.transpose().to_cols_array(),
                intrinsics: [focal, focal, half, half],
                side: args.side,
            };
            let rgb =
                RgbImage::from_raw(args.side, args.side, rasterizer.render(&model, &view)?).ok_or("picture of the wrong size")?;
            writer.add(&format!("{i:06}"), &rgb, pose)?;
            progress.inc(1);
        }
    }
    progress.finish_and_clear();
    println!("{} instances of {} views in {}, {focal:.3} px focal length", args.meshes.len(), args.views, args.out.display());
    Ok(())
}

fn between(text: &str, low: f64, high: f64) -> std::result::Result<f64, String> {
    match text.parse() {
        Ok(x) if low < x && x < high => Ok(x),
        _ if high == f64::MAX => Err(format!("expected a number above {low}")),
        _ => Err(format!("expected a number between {low} and {high}")),
    }
}

fn named_mesh(argument: &str) -> std::result::Result<(String, PathBuf), String> {
    let (name, path) = argument.split_once('=').unwrap_or(("", argument));
    let path = PathBuf::from(path);
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    match if name.is_empty() { stem } else { name.into() } {
        name if name.contains(['/', '\\']) || [".", "..", ""].contains(&name.as_str()) => {
            Err(format!("\"{name}\" cannot name a folder"))
        }
        name => Ok((name, path)),
    }
}

fn load_mesh(path: &Path, up: Option<MeshUp>) -> Result<Mesh> {
    let (mut mesh, usual) = srn_data::mesh::load(path)?;
    mesh.normalise(match (usual, up) {
        (Up::MinusY, _) | (_, None) => usual,
        (_, Some(MeshUp::Y)) => Up::Y,
        (_, Some(MeshUp::Z)) => Up::Z,
    });
    Ok(mesh)
}

fn upload(rasterizer: &Rasterizer, mesh: &Mesh) -> Result<raster::Model> {
    let vertex = |v: &srn_data::mesh::Vertex| raster::Vertex {
        position: v.position.to_array(),
        normal: v.normal.to_array(),
        colour: v.colour.to_array(),
        uv: v.uv.to_array(),
    };
    let vertices: Vec<_> = mesh.vertices.iter().map(vertex).collect();
    let part = |part: &srn_data::mesh::Part| (part.vertices.start as u32..part.vertices.end as u32, part.texture);
    let parts: Vec<_> = mesh.parts.iter().map(part).collect();
    let textures = mesh.textures.iter().map(|t| raster::Texture { width: t.width(), height: t.height(), rgba: t.as_raw() });
    let textures: Vec<_> = textures.collect();
    Ok(rasterizer.upload(&vertices, &parts, &textures)?)
}
