//! `sigma-pose render`: an object from any side.

use std::path::PathBuf;

use clap::Args;
use glam::{DMat4, DVec3};
use image::RgbImage;
use sigma_srn::{Intrinsics, Rendering};
use srn_data::camera::{fitting_focal_px, look_at_origin};
use srn_data::pixels::rgb8;
use srn_data::sheet::VIRIDIS;
use srn_data::srn::{self, InstanceWriter, read_pose};

use super::files::{CameraArgs, instance_of, write_gif};
use super::notation::NotationArgs;
use super::search::{On, render};
use super::{draw, positive};
use crate::common::{EngineArgs, Result, load_model, print, refuse_existing, refuse_to_write, write_picture};
use crate::progress;

/// Side of a view where neither the flags nor the model say it, pixels.
const SIDE: u32 = 64;
/// Distance of the camera where neither the flags nor the model say it.
const RADIUS: f64 = 1.3;

/// Views that are rendered before progress is shown.
const AT_ONCE: usize = 32;

/// Flags of `sigma-pose render`.
#[derive(Args, Debug)]
pub struct Render {
    /// Model, or checkpoint of a training run.
    #[arg(long, value_name = "FILE")]
    model: PathBuf,
    /// Name of the object, or its number where the model has no names. Default: the model's only one.
    #[arg(long, value_name = "NAME")]
    instance: Option<String>,
    /// Picture (.png), animation (.gif), or folder: an SRN instance with pictures, poses and intrinsics.
    #[arg(long, value_name = "FILE|DIR")]
    out: PathBuf,
    /// Views once around the object, instead of one view.
    #[arg(long, value_name = "N", conflicts_with = "pose", value_parser = clap::value_parser!(u32).range(1..))]
    orbit: Option<u32>,
    /// Pose file with the camera's `world_from_camera`, instead of --azimuth, --elevation and --radius.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["azimuth", "elevation", "radius"])]
    pose: Option<PathBuf>,
    /// Direction of the (first) camera in degrees, from the world's x axis towards y.
    #[arg(long, value_name = "DEG", default_value_t = 30.0, allow_negative_numbers = true, value_parser = angle)]
    azimuth: f64,
    /// Height of the camera over the horizon in degrees.
    #[arg(long, value_name = "DEG", default_value_t = 30.0, allow_negative_numbers = true, value_parser = angle)]
    elevation: f64,
    /// Distance of the camera from the object's centre. Default: as the model was trained, or 1.3.
    #[arg(long, value_name = "R", value_parser = positive)]
    radius: Option<f64>,
    /// Draw how far things are instead of their colours: from dark, half an object's size before its centre, to light, as far
    /// behind it.
    #[arg(long)]
    depth: bool,
    /// Width and height of a view in pixels. Default: as the model was trained, or 64.
    #[arg(long, value_name = "S", value_parser = clap::value_parser!(u32).range(1..=4096))]
    side: Option<u32>,
    #[command(flatten)]
    camera: CameraArgs,
    /// Overwrite what is there.
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    engine: EngineArgs,
    #[command(flatten)]
    poses: NotationArgs,
}

fn angle(text: &str) -> std::result::Result<f64, String> {
    text.parse().ok().filter(|x: &f64| x.is_finite()).ok_or("expected a number of degrees".into())
}

/// Runs the command.
pub fn run(args: &Render) -> Result<bool> {
    let model = load_model(&args.model)?;
    let instance = instance_of(&model, args.instance.as_deref())?;
    let kind = args.out.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    match (kind.as_str(), args.orbit) {
        ("gif", None) => return Err(format!("{}: an animation needs --orbit", args.out.display()).into()),
        ("png", Some(_)) => return Err(format!("{}: an orbit is written to a .gif or a folder", args.out.display()).into()),
        ("png" | "gif", _) => refuse_to_write(&args.out, args.force)?,
        ("", _) => refuse_existing([args.out.clone()], args.force)?,
        _ => return Err(format!("{}: expected a .png, a .gif or a folder", args.out.display()).into()),
    }

    let trained_side = model.metadata.side.unwrap_or(SIDE);
    let side = args.side.unwrap_or(trained_side);
    let radius = args.radius.or(model.metadata.orbit_radius).unwrap_or(RADIUS);
    let poses = match &args.pose {
        Some(path) => vec![args.poses.open()?.ours(read_pose(path)?)],
        None => orbit(args.orbit.unwrap_or(1), args.azimuth, args.elevation, radius),
    };
    let files_intrinsics = match args.camera.intrinsics([side as usize; 2])? {
        Some(given) => given.of_square(side as usize),
        None => {
            // The angle of view of the data sets that `sigma-data` makes.
            let focal = fitting_focal_px(trained_side as usize, radius.max(0.51)) * f64::from(side) / f64::from(trained_side);
            srn::Intrinsics { focal: [focal; 2], centre: [f64::from(side) / 2.0; 2], size: [side as usize; 2] }
        }
    };
    let srn::Intrinsics { focal: [fx, fy], centre: [cx, cy], .. } = files_intrinsics;
    let intrinsics = Intrinsics { fx, fy, cx, cy, pixel_center: 0.0 };

    let engine = args.engine.open()?;
    let views: Vec<_> = poses.iter().map(|&pose| (instance, pose, intrinsics)).collect();
    let draw = |(view, pose): (&Rendering, &DMat4)| {
        let distance = pose.w_axis.truncate().length();
        match args.depth {
            true => draw::mapped(&view.depth, side, &VIRIDIS, [distance - 0.5, distance + 0.5]),
            false => rgb8(&view.rgb, side as usize, side as usize),
        }
    };
    let bar = progress::bar(views.len() as u64, "views");
    let mut pictures: Vec<RgbImage> = vec![];
    for (views, poses) in views.chunks(AT_ONCE).zip(poses.chunks(AT_ONCE)) {
        pictures.extend(render(On { engine: &engine, model: &model, side }, views)?.iter().zip(poses).map(draw));
        bar.inc(views.len() as u64);
    }
    bar.finish_and_clear();
    match kind.as_str() {
        "png" => write_picture(&args.out, &pictures[0])?,
        "gif" => write_gif(&args.out, pictures.into_iter().map(|picture| (picture, 0.08)))?,
        _ => {
            let writer = InstanceWriter::create(&args.out, &files_intrinsics, args.force)?;
            for (i, (picture, pose)) in pictures.iter().zip(&poses).enumerate() {
                writer.add(&format!("{i:06}"), picture, pose)?;
            }
            writer.finish()?;
        }
    }
    print(&format!("{}: {} of {}, {side}×{side}", args.out.display(), poses.len(), model.instance_name(instance)))?;
    Ok(true)
}

/// `n` cameras once around the object.
fn orbit(n: u32, azimuth_deg: f64, elevation_deg: f64, radius: f64) -> Vec<DMat4> {
    let elevation = elevation_deg.to_radians();
    let camera = |k: u32| {
        let azimuth = (azimuth_deg + 360.0 * f64::from(k) / f64::from(n)).to_radians();
        look_at_origin(radius * DVec3::new(elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()))
    };
    (0..n).map(camera).collect()
}
