//! The golden files of `tests/golden` on every executor: what the authors' released code computed.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use sigma_srn::{Engine, Metadata, Model};
use srn_gpu::Choice;
use srn_tests::golden::{Figure, Limits, check, check_model};
use srn_tests::gpu;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("golden")
}

fn path(file: &str, kind: &str) -> PathBuf {
    folder().join(file).with_extension(kind)
}

fn passes(file: &str, engine: Engine, limits: Limits) {
    report(file, &engine, check(&engine, &path(file, "safetensors"), limits).unwrap());
}

fn report(file: &str, engine: &Engine, figures: Vec<Figure>) {
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

            #[test]
            fn on_gpu_with_joined_layers() {
                let gpu = gpu().with_choice(Choice::Named("hidden_layer".into()));
                passes(stringify!($file), Engine::gpu(gpu), Limits::F32);
            }
        })*

        const FILES: &[&str] = &[$(stringify!($file)),*];
    };
}

files! { tiny small small_srn clamped }

/// `small.pth` and `tiny.pth`: the same weights as parameters of nested modules, saved by PyTorch 2.15 with
/// `torch.save({"model": module.state_dict(), "optimizer": adam.state_dict()}, path)`, the latter in the format before 1.6. Two
/// parameters share a storage, one lies in memory column by column, and Adam has done a step on the codes.
#[test]
fn checkpoints_of_torch_are_the_same_models() {
    for file in ["small", "tiny"] {
        let (model, left_out) = Model::load_torch(&path(file, "pth"), 10, Metadata::default()).unwrap();
        assert_eq!(left_out, [""; 0]);
        let bytes = std::fs::read(path(file, "safetensors")).unwrap();
        let golden = Model::from_bytes(&bytes, "model.", &path(file, "safetensors")).unwrap();
        assert!(model.layout == golden.layout && model.parameters == golden.parameters, "{file}");
        let engine = Engine::cpu_f64();
        report(file, &engine, check_model(&engine, &path(file, "safetensors"), model, Limits::F64).unwrap());
    }
}

#[test]
fn no_file_is_left_out() {
    let found = std::fs::read_dir(folder()).unwrap().map(|entry| entry.unwrap().path());
    let found: BTreeSet<String> = found.map(|path| path.file_stem().unwrap().to_str().unwrap().to_owned()).collect();
    assert_eq!(found, FILES.iter().map(|&name| name.to_owned()).collect());
}
