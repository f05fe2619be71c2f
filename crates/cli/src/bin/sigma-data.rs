//! `sigma-data`: gets public meshes, renders meshes into SRN data sets, converts posed pictures from and to other formats, and looks
//! into them.

use clap::{Parser, Subcommand};
use sigma_cli::common::{finish, parse};
use sigma_cli::data::{Export, Import, Inspect, Masks};
use sigma_cli::render::Render;
use sigma_cli::sets::Fetch;
use std::process::ExitCode;

/// Data sets in the SRN folder layout: SET/INSTANCE/{rgb,pose,intrinsics.txt}.
///
/// Exit status: 0 done, 1 `inspect` found problems, 2 an error.
#[derive(Parser)]
#[command(name = "sigma-data", version, about)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Get the meshes of a public set, by apt or npm, into the user's cache directory.
    Fetch(Fetch),
    /// Render meshes, or a public set of them, to pictures with known cameras, one instance per mesh.
    Render(Render),
    /// Read photographs with known cameras (transforms.json, BOP, COLMAP) or others' SRN folders into a data set.
    Import(Import),
    /// Find the object in photographs with known cameras that nobody has cut out, and write masks for `import --mask`.
    Masks(Masks),
    /// Write a data set, or estimated poses, in another format, in the frame and the units that it was imported from.
    Export(Export),
    /// Count, check and draw posed pictures, or read meshes. Exit status 1 if something is wrong with them.
    Inspect(Inspect),
}

fn main() -> ExitCode {
    finish(match parse::<Cli>().command {
        Command::Fetch(args) => args.run(),
        Command::Render(args) => args.run(),
        Command::Import(args) => args.run(),
        Command::Masks(args) => args.run(),
        Command::Export(args) => args.run(),
        Command::Inspect(args) => args.run(),
    })
}
