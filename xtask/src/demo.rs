//! The shipped model finds the camera poses of pictures that it has never seen.

use std::path::PathBuf;
use std::process::{Command, ExitStatus, Output};
use std::time::Instant;

use crate::shell::{self, root};
use crate::web::SCENES;

const MODEL: &str = "assets/models/compact.safetensors";
const VIEWS: &str = "assets/dataset/test";
/// Where the pictures go.
const OUT: &str = "demo";
/// A picture whose search is drawn, step by step.
const SHOWN: &str = "forklift/rgb/000006";
/// The object that both executors look at.
const SHARED: &str = "chicken";

/// Prints the table, writes the pictures, and compares the executors where there is an adapter.
pub fn run(arguments: &[String]) -> Result<(), String> {
    let model = arguments.first().map_or(MODEL, String::as_str);
    if !root().join(model).exists() {
        return Err(format!("{model} is missing"));
    }
    shell::run(shell::cargo().args(["build", "--release", "--bin", "sigma-pose"]))?;
    let begin = Instant::now();

    for (starts, effort, what) in [
        ("neighbor4", "fast", "searched from 30° beside the true pose"),
        ("fixed24", "normal", "with no idea where the camera is: from 24 places around the object"),
    ] {
        println!("\nUnseen views, {what} ({starts}, effort {effort}):\n");
        let mut evaluate = sigma_pose("evaluate", model, "cpu");
        evaluate.args(["--data", VIEWS, "--starts", starts, "--effort", effort, "--views", "1"]);
        evaluate.args(["--force", "--out", &format!("{OUT}/{starts}")]);
        accept(evaluate.status())?;
    }

    println!("\nOne search in pictures, from all around (around2016):\n");
    let mut estimate = sigma_pose("estimate", model, "cpu");
    estimate.arg(format!("{VIEWS}/{SHOWN}.png"));
    estimate.args(["--starts", "around2016", "--truth", "auto", "--force", "--record", &format!("{OUT}/around2016")]);
    accept(estimate.status())?;

    let (object, fov, bounds) = SCENES[0];
    println!("\nA picture that nobody has cut out, a box around the {object}, from all around:\n");
    let mut estimate = sigma_pose("estimate", model, "cpu");
    estimate.arg(format!("assets/scenes/{object}.png")).args(["--instance", object, "--fov", &fov.to_string()]);
    estimate.arg(format!("--box={}", bounds.map(|pixels| pixels.to_string()).join(",")));
    estimate.args(["--truth", &format!("assets/scenes/{object}.txt"), "--force", "--record", &format!("{OUT}/box")]);
    accept(estimate.status())?;

    println!("\nThe pose found for {SHARED}, refined by both executors:\n");
    compare(model)?;
    println!("\n{:.0} s. Pictures: {}", begin.elapsed().as_secs_f64(), root().join(OUT).display());
    Ok(())
}

/// Goes on from a pose that was found, on the CPU and, where there is an adapter, on the GPU; they must agree to 0.1°.
fn compare(model: &str) -> Result<(), String> {
    let results = read(&format!("{OUT}/neighbor4/results.json"))?;
    let found = results.split(&format!("\"instance\": \"{SHARED}\"")).nth(1).unwrap_or_default();
    let view = found.split('"').skip_while(|&text| text != "view").nth(2).unwrap_or_default();
    let (picture, start) = (format!("{VIEWS}/{SHARED}/rgb/{view}.png"), format!("{OUT}/start.txt"));
    let before = matrix(found)?;
    let text = before.map(|number| number.to_string()).join(" ");
    std::fs::write(root().join(&start), text).map_err(|error| format!("{start}: {error}"))?;
    let refine = |executor: &str| -> Result<Output, String> {
        let mut command = sigma_pose("estimate", model, executor);
        // From there alone, and not from places around it too.
        command.args([&picture, "--starts", &start, "--no-cull", "--truth", "auto", "--json"]);
        command.output().map_err(|error| format!("sigma-pose: {error}"))
    };
    let (cpu, gpu) = (refine("cpu")?, refine("gpu")?);
    if String::from_utf8_lossy(&gpu.stderr).contains("no GPU adapter") {
        println!("only by the CPU executor: there is no GPU adapter here");
        return Ok(());
    }
    let pose = |output: &Output| {
        matrix(&String::from_utf8_lossy(&output.stdout)).map_err(|what| what + &String::from_utf8_lossy(&output.stderr))
    };
    let (cpu, gpu) = (pose(&cpu)?, pose(&gpu)?);
    let (rotation, translation) = difference(&cpu, &gpu);
    println!("the search moved it by {:.2}°;", difference(&before, &cpu).0);
    println!("the CPU executor's pose and the GPU executor's differ by {rotation:.4}° and {translation:.5} object units");
    if rotation < 0.1 { Ok(()) } else { Err(format!("the executors differ by {rotation:.3}°, more than 0.1°")) }
}

fn read(path: &str) -> Result<String, String> {
    std::fs::read_to_string(root().join(path)).map_err(|error| format!("{path}: {error}"))
}

/// The numbers of the first `world_from_camera` in a JSON text.
fn matrix(json: &str) -> Result<[f64; 16], String> {
    let rest = json.split("\"world_from_camera\"").nth(1).unwrap_or_default();
    let numbers = rest.split(|c: char| !(c.is_ascii_digit() || "+-.eE".contains(c))).filter_map(|text| text.parse().ok());
    let numbers: Vec<f64> = numbers.take(16).collect();
    numbers.try_into().map_err(|_| "sigma-pose printed no pose\n".into())
}

/// Angle in degrees between two rotations, distance of two camera centres.
fn difference(a: &[f64; 16], b: &[f64; 16]) -> (f64, f64) {
    let distance = |places: &[usize]| places.iter().map(|&k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt();
    // ‖A - B‖ = 2 √2 sin(angle / 2), which unlike the trace keeps the digits of small angles.
    let rotation = distance(&[0, 1, 2, 4, 5, 6, 8, 9, 10]) / 8f64.sqrt();
    (2.0 * rotation.min(1.0).asin().to_degrees(), distance(&[3, 7, 11]))
}

fn sigma_pose(command: &str, model: &str, executor: &str) -> Command {
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root().join("target"), PathBuf::from);
    let mut program = shell::program(target.join("release").join(format!("sigma-pose{}", std::env::consts::EXE_SUFFIX)));
    program.args([command, "--model", model, "--executor", executor]);
    program
}

/// A pose that was not found, exit code 1, is a result too.
fn accept(status: std::io::Result<ExitStatus>) -> Result<(), String> {
    match status {
        Ok(status) if status.code().is_some_and(|code| code < 2) => Ok(()),
        Ok(status) => Err(format!("sigma-pose: {status}")),
        Err(error) => Err(format!("sigma-pose: {error}")),
    }
}
