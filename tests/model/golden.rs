//! The golden files of `tests/golden` on every executor: what the authors' released code computed.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use sigma_srn::Engine;
use srn_tests::golden::{Figure, Limits, check};
use srn_tests::gpu;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("golden")
}

fn passes(file: &str, engine: Engine, limits: Limits) {
    let figures = check(&engine, &folder().join(file).with_extension("safetensors"), limits).unwrap();
    let lines: Vec<String> = figures.iter().map(|figure| format!("{file} on {engine}: {figure}")).collect();
    println!("{}", lines.join("\n"));
    assert!(figures.iter().all(Figure::passes), "{}", lines.join("\n"));
}

macro_rules! files {
    ($($file:ident)*) => {
        $(mod $file {
            use super::*;

            #[test]
            fn on_cpu64() {
                passes(stringify!($file), Engine::cpu_f64(), Limits::F64);
            }

            #[test]
            fn on_cpu() {
                passes(stringify!($file), Engine::cpu(), Limits::F32);
            }

            #[test]
            fn on_gpu() {
                passes(stringify!($file), Engine::gpu(gpu().clone()), Limits::F32);
            }
        })*

        const FILES: &[&str] = &[$(stringify!($file)),*];
    };
}

files! { tiny small small_srn clamped }

#[test]
fn no_file_is_left_out() {
    let found = std::fs::read_dir(folder()).unwrap().map(|entry| entry.unwrap().path());
    let found: BTreeSet<String> = found.map(|path| path.file_stem().unwrap().to_str().unwrap().to_owned()).collect();
    assert_eq!(found, FILES.iter().map(|&name| name.to_owned()).collect());
}
