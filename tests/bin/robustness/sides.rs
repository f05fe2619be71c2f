//! Models that have learnt an object from a walk around it, and which poses they trust of views from everywhere.

use std::path::{Path, PathBuf};
use std::{fs, io};

use serde_json::Value;

use crate::{OBJECTS, OUT, Programs, Result, said};

/// Cameras all around, of which those between these heights above the horizon, in degrees, are the walk.
const VIEWS: usize = 170;
const WALK: std::ops::Range<f64> = 10.0..60.0;
/// Where the views that are asked for lie.
const TEST: &str = "assets/dataset/test";
/// What the training goes on from: networks that know none of the objects.
const FROM: &str = "assets/models/chairs.safetensors";
/// Up to this far off, in degrees, a pose is right, and from here on elsewhere.
const RIGHT: f64 = 5.0;
const ELSEWHERE: f64 = 10.0;

/// Renders what the walks see, a data set for each object.
pub fn walks(programs: &Programs, seed: u64) -> Result<Vec<PathBuf>> {
    let all = Path::new(OUT).join("walks");
    let [views, seed] = [VIEWS.to_string(), seed.to_string()];
    let flags = [("--cameras", "sphere"), ("--jitter", "0.1"), ("--views", &*views), ("--seed", &seed)];
    programs.rendered(&all, 64, &flags)?;
    let walk = |name: &str| -> Result<PathBuf> {
        let (from, set) = (all.join(name), Path::new(OUT).join("walk").join(name));
        let to = set.join(name);
        cleared(&set)?;
        for kind in ["rgb", "pose"] {
            fs::create_dir_all(to.join(kind))?;
        }
        fs::copy(from.join("intrinsics.txt"), to.join("intrinsics.txt"))?;
        for view in 0..VIEWS {
            let pose = format!("pose/{view:06}.txt");
            let text = fs::read_to_string(from.join(&pose))?;
            let numbers = text.split_whitespace().map(str::parse).collect::<std::result::Result<Vec<f64>, _>>()?;
            let at = [3, 7, 11].map(|place| numbers.get(place).copied().unwrap_or(f64::NAN));
            let height = (at[2] / at.iter().map(|x| x * x).sum::<f64>().sqrt()).asin().to_degrees();
            if WALK.contains(&height) {
                for file in [pose, format!("rgb/{view:06}.png")] {
                    fs::copy(from.join(&file), to.join(&file))?;
                }
            }
        }
        Ok(set)
    };
    OBJECTS.iter().map(|(name, _)| walk(name)).collect()
}

fn cleared(folder: &Path) -> io::Result<()> {
    match fs::remove_dir_all(folder) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        done => done,
    }
}

/// Poses that end so far off, how many of them are trusted, and how many would be where only a quarter of a picture may be unexplained.
#[derive(Clone, Copy, Default)]
pub struct Told {
    all: usize,
    trusted: usize,
    explained: usize,
}

/// Trains on a walk around an object and asks for views from everywhere: those within 5°, up to 10° off, and further off.
pub fn told(programs: &Programs, walk: &Path, name: &str, effort: &str) -> Result<[Told; 3]> {
    let run = walk.join("run");
    let mut fit = programs.command("sigma-train");
    fit.args(["fit", "--executor", "cpu", "--from", FROM, "--batch", "8", "--steps", "1500", "--data"]);
    let output = fit.arg(walk).arg("--out").arg(&run).output()?;
    if !output.status.success() {
        return Err(said(&output));
    }
    let mut pictures: Vec<PathBuf> = Vec::new();
    for entry in fs::read_dir(Path::new(TEST).join(name).join("rgb"))? {
        pictures.push(entry?.path());
    }
    pictures.sort();
    let mut estimate = programs.command("sigma-pose");
    estimate.args([
        "estimate",
        "--json",
        "--executor",
        "cpu",
        "--truth",
        "auto",
        "--effort",
        effort,
        "--instance",
        name,
        "--model",
    ]);
    let output = estimate.arg(run.join("model.safetensors")).args(pictures).arg("--starts").arg(&programs.starts).output()?;
    let report: Value = serde_json::from_slice(&output.stdout).map_err(|_| said(&output))?;
    let mut told = [Told::default(); 3];
    for image in report["images"].as_array().ok_or("sigma-pose printed no images")? {
        let off = image["error"]["rotation_deg"].as_f64().ok_or("sigma-pose printed no number")?;
        let kind = &mut told[usize::from(off > RIGHT) + usize::from(off > ELSEWHERE)];
        kind.all += 1;
        kind.trusted += usize::from(image["trusted"] == true);
        kind.explained += usize::from(image["unexplained"].as_f64().is_some_and(|part| part <= 0.25));
    }
    Ok(told)
}

/// The cells of a table.
pub fn cells(told: [Told; 3]) -> String {
    told.map(|Told { all, trusted, explained }| format!("{trusted} of {all} ({explained})")).join(" | ")
}

/// Of all objects.
pub fn sum(all: &[[Told; 3]]) -> [Told; 3] {
    std::array::from_fn(|kind| {
        let of = |count: fn(&Told) -> usize| all.iter().map(|told| count(&told[kind])).sum();
        Told { all: of(|told| told.all), trusted: of(|told| told.trusted), explained: of(|told| told.explained) }
    })
}
