//! `sigma-train import` and `export`: checkpoints of the authors' PyTorch code, in and out.

use std::path::PathBuf;

use clap::Args;
use sigma_srn::{Metadata, Model};

use super::settings::{positive, up_to};
use crate::common::{Result, about_model, load_model, print, refuse_to_write};

/// Flags of `sigma-train import`.
#[derive(Args, Debug)]
pub struct ImportArgs {
    /// The checkpoint, as `torch.save` wrote it. Nothing in it is run.
    #[arg(value_name = "CHECKPOINT")]
    checkpoint: PathBuf,
    /// The model to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Marching steps along a ray.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = up_to(1000))]
    tracing_steps: u32,
    /// Side of the training images in pixels.
    #[arg(long, value_name = "PIXELS", default_value_t = 64, value_parser = up_to(4096))]
    side: u32,
    /// Distance of the training cameras from the objects, in object units.
    #[arg(long, value_name = "R", default_value_t = 1.3, value_parser = positive)]
    radius: f64,
    /// File with the name of an instance in each line, in the order of the codes: that of the training set's sorted folders.
    /// Without it instances have numbers.
    #[arg(long, value_name = "FILE")]
    names: Option<PathBuf>,
    /// Overwrite what is there.
    #[arg(long)]
    force: bool,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
}

/// Reads a checkpoint and writes the model.
pub fn import(args: &ImportArgs) -> Result<bool> {
    refuse_to_write(&args.out, args.force)?;
    let instance_names = match &args.names {
        Some(path) => {
            let text = std::fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()))?;
            text.lines().map(str::trim).filter(|line| !line.is_empty()).map(String::from).collect()
        }
        None => vec![],
    };
    let metadata = Metadata { instance_names, side: Some(args.side), orbit_radius: Some(args.radius), ..Metadata::default() };
    let (model, left_out) =
        Model::load_torch(&args.checkpoint, args.tracing_steps, metadata).map_err(|error| match (&error, &args.names) {
            (sigma_srn::Error::Input { input, .. }, Some(names)) if input == "instance names" => about_model(names, error),
            _ => about_model(&args.checkpoint, error),
        })?;
    model.save(&args.out)?;
    left_out.iter().for_each(|name| eprintln!("left out, no part of the network: {name}"));
    let (layout, latent) = (&model.layout, model.hypernetwork()?.latent);
    let kind = if layout.density.is_some() { "σSRN" } else { "plain SRN" };
    print(&if args.json {
        let sizes = serde_json::json!({
            "model": args.out, "density": layout.density.is_some(), "hidden": layout.features(), "latent": latent,
            "instances": layout.instances, "tracing_steps": layout.tracing_steps, "left_out": left_out,
        });
        format!("{sizes:#}")
    } else {
        let sizes =
            format!("{} features, {} codes of {latent}, {} steps", layout.features(), layout.instances, layout.tracing_steps);
        format!("{}: {kind}, {sizes}", args.out.display())
    })?;
    Ok(true)
}

/// Flags of `sigma-train export`.
#[derive(Args, Debug)]
pub struct ExportArgs {
    /// Model, or checkpoint of a training run.
    #[arg(value_name = "MODEL")]
    model: PathBuf,
    /// The checkpoint to write, for `torch.load`.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Overwrite what is there.
    #[arg(long)]
    force: bool,
}

/// Writes a model as a checkpoint.
pub fn export(args: &ExportArgs) -> Result<bool> {
    refuse_to_write(&args.out, args.force)?;
    let model = load_model(&args.model)?;
    model.save_torch(&args.out).map_err(|error| about_model(&args.model, error))?;
    print(&format!("{}: {} tensors", args.out.display(), model.tensors().len()))?;
    Ok(true)
}
