//! `sigma-train`: trains σSRN models on SRN data sets, fits trained ones to new instances, exchanges them with PyTorch.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use sigma_cli::common;
use sigma_cli::train::{adapt, fit, torch};

/// Trains σSRN models on SRN data sets.
///
/// Results go to stdout, progress to stderr. Exit status: 0 done, 1 `fit` was stopped before the end, 2 an error.
#[derive(Parser)]
#[command(name = "sigma-train", version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Train a model from nothing, or go on with a run that was stopped.
    Fit(fit::FitArgs),
    /// Fit new instances to a few views of each: their latent codes, then the networks, too.
    Adapt(adapt::AdaptArgs),
    /// Make a model of a checkpoint of the authors' PyTorch code.
    Import(torch::ImportArgs),
    /// Make a checkpoint for that code of a model.
    Export(torch::ExportArgs),
}

fn main() -> ExitCode {
    common::finish(match common::parse::<Cli>().command {
        Command::Fit(args) => fit::fit(&args),
        Command::Adapt(args) => adapt::adapt(&args),
        Command::Import(args) => torch::import(&args),
        Command::Export(args) => torch::export(&args),
    })
}
