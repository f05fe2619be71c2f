//! `sigma-pose`: finds the camera poses of pictures with a trained model.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use sigma_cli::common::{finish, parse};
use sigma_cli::pose::{bake, calibrate, estimate, evaluate, render, track};

/// Camera poses of pictures by gradient descent through a neural renderer.
///
/// Exit status: 0 done, 1 `estimate` or `track` found a pose that is not to be trusted, 2 an error.
#[derive(Parser)]
#[command(name = "sigma-pose", version, about)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Find the poses of pictures. Exit status 1 if one of them is not to be trusted; see --accept.
    Estimate(estimate::Estimate),
    /// Follow an object from frame to frame. Exit status 1 if the last pose is not to be trusted.
    Track(track::Track),
    /// Measure the errors on a data set, by the paper's protocol.
    Evaluate(evaluate::Evaluate),
    /// Compare estimates with known poses, so that others come with standard deviations and a verdict.
    Calibrate(calibrate::Calibrate),
    /// Render an object from any side.
    Render(render::Render),
    /// Write a few objects' networks to a small file of their own, a model for `estimate`, `track`, `evaluate` and `render`.
    Bake(bake::Bake),
}

fn main() -> ExitCode {
    finish(match parse::<Cli>().command {
        Command::Estimate(args) => estimate::run(&args),
        Command::Track(args) => track::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Calibrate(args) => calibrate::run(&args),
        Command::Render(args) => render::run(&args),
        Command::Bake(args) => bake::run(&args),
    })
}
