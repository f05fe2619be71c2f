//! `golden DIR`: every golden file of a folder on every executor; exit 1 where a figure exceeds its limit.

use std::path::PathBuf;
use std::process::ExitCode;

use sigma_srn::{Engine, Gpu};
use srn_tests::golden::{Limits, check};

const USAGE: &str = "usage: golden DIR [--executor cpu64|cpu|gpu]";

fn main() -> ExitCode {
    match run() {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(1),
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(2)
        }
    }
}

fn run() -> Result<bool, String> {
    let mut arguments = std::env::args().skip(1);
    let folder = PathBuf::from(arguments.next().ok_or(USAGE)?);
    let mut wanted = Vec::new();
    while let Some(argument) = arguments.next() {
        match (argument.as_str(), arguments.next()) {
            ("--executor", Some(name)) if ["cpu64", "cpu", "gpu"].contains(&name.as_str()) => wanted.push(name),
            _ => return Err(USAGE.into()),
        }
    }
    let mut engines = vec![("cpu64", Engine::cpu_f64(), Limits::F64), ("cpu", Engine::cpu(), Limits::F32)];
    if wanted.is_empty() || wanted.iter().any(|name| name == "gpu") {
        let gpu = Gpu::open(None).map_err(|error| error.to_string())?;
        println!("adapter: {}", gpu.adapter().name);
        engines.push(("gpu", Engine::gpu(gpu), Limits::F32));
    }
    engines.retain(|(name, ..)| wanted.is_empty() || wanted.iter().any(|wanted| wanted == name));
    let entries = std::fs::read_dir(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    let mut files: Vec<PathBuf> = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "safetensors"));
    files.sort();
    if files.is_empty() {
        return Err(format!("{}: no .safetensors files", folder.display()));
    }
    println!("{:<14} {:<6} {:<20} {:>9} {:>9}  worst in", "file", "on", "quantity", "worst", "limit");
    let (mut all_pass, mut by_chance) = (true, 0);
    for file in &files {
        let name = file.file_stem().unwrap_or_default().to_string_lossy();
        for (engine_name, engine, limits) in &engines {
            for figure in check(engine, file, *limits)? {
                all_pass &= figure.passes();
                by_chance += usize::from(figure.passes() && figure.worst > figure.limit);
                println!("{name:<14} {engine_name:<6} {figure}");
            }
        }
    }
    match (all_pass, by_chance) {
        (false, _) => println!("some figures exceed their limits"),
        (true, 0) => println!("every figure is within its limit"),
        (true, _) => println!(
            "{by_chance} figures exceed their limit, but not what f64 makes of weights that are one f32 away; all others are within"
        ),
    }
    Ok(all_pass)
}
