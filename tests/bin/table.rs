//! `table`: prints the table of kernels into `shaders/README.md`; `table --check` compares, exit 1 where they differ.

use std::path::Path;
use std::process::ExitCode;

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(what) => {
            eprintln!("error: {what}");
            ExitCode::FAILURE
        }
    }
}

fn run() -> Result<(), String> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shaders/README.md");
    let failed = |error: std::io::Error| format!("{}: {error}", path.display());
    let old = std::fs::read_to_string(&path).map_err(failed)?;
    let new = srn_tests::table::update(&old)?;
    match std::env::args().nth(1).as_deref() {
        None => std::fs::write(&path, new).map_err(failed),
        Some("--check") if old == new => Ok(()),
        Some("--check") => Err("shaders/README.md is out of date: cargo xtask table".into()),
        Some(other) => Err(format!("usage: table [--check], not {other}")),
    }
}
