//! `sigma-pose bake`: a few objects' networks without the hypernetwork.

use std::path::PathBuf;

use clap::Args;

use crate::common::{Result, about_model, load_model, print, refuse_to_write};

/// Flags of `sigma-pose bake`.
#[derive(Args, Debug)]
pub struct Bake {
    /// Model, or checkpoint of a training run.
    #[arg(long, value_name = "FILE")]
    model: PathBuf,
    /// Name of the object, or its number where the model has no names; of several, once for each.
    #[arg(long, value_name = "NAME", required = true)]
    instance: Vec<String>,
    /// The model to write: these objects alone.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Overwrite what is there.
    #[arg(long)]
    force: bool,
}

/// Runs the command.
pub fn run(args: &Bake) -> Result<bool> {
    refuse_to_write(&args.out, args.force)?;
    if let Some((_, again)) = args.instance.iter().enumerate().find(|(k, name)| args.instance[..*k].contains(name)) {
        return Err(format!("--instance {again}: given twice").into());
    }
    let model = load_model(&args.model)?;
    let about = |error| about_model(&args.model, error);
    let instances = args.instance.iter().map(|name| model.instance(name)).collect::<std::result::Result<Vec<_>, _>>();
    let baked = model.bake(&instances.map_err(about)?).map_err(about)?;
    baked.save(&args.out)?;
    let bytes = std::fs::metadata(&args.out).map_err(|error| format!("{}: {error}", args.out.display()))?.len();
    let names: Vec<String> = (0..baked.layout.instances).map(|number| baked.instance_name(number)).collect();
    print(&format!("{}: {}, {:.2} MB", args.out.display(), names.join(", "), bytes as f64 / 1e6))?;
    Ok(true)
}
