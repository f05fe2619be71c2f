//! What the binaries share: choice of the executor, exit codes, data sets as the network takes them.

use std::error::Error;
use std::fs::{File, TryLockError};
use std::io::{self, IsTerminal};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::builder::NonEmptyStringValueParser;
use clap::{Arg, Args, Parser, ValueEnum};
use glam::DMat4;
use image::{ImageFormat, Rgb, RgbImage};
use sigma_srn::{Engine, Gpu, Intrinsics, Model, write_atomically};
use srn_data::camera::Axes;
use srn_data::{Dataset, LoadedView, SrnSet, sheet};
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::prelude::*;

/// Results of the binaries: an error is one line for the user.
pub type Result<T> = std::result::Result<T, Box<dyn Error + Send + Sync>>;

/// Flags that choose what computes, and how much it says.
#[derive(Args, Clone, Debug)]
pub struct EngineArgs {
    /// What computes. `auto`: a GPU if there is one, else the faster of CPU and software adapter.
    #[arg(long, value_enum, default_value_t = Executor::Auto)]
    executor: Executor,
    /// The graphics adapter, by words of its name or backend (`intel`, `geforce dx12`); implies `--executor gpu`.
    #[arg(long, value_name = "NAME", value_parser = NonEmptyStringValueParser::new())]
    adapter: Option<String>,
    /// Memory budget, as bytes or with a unit: 512MiB, 2GB. Default: from the adapter, 2 GiB on the CPU.
    #[arg(long, value_name = "SIZE", value_parser = memory)]
    memory: Option<u64>,
    /// Say more on stderr.
    #[arg(short, long)]
    verbose: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Executor {
    Auto,
    Gpu,
    Cpu,
}

impl EngineArgs {
    /// Opens the executor, and says on stderr which it is and why.
    pub fn open(&self) -> Result<Engine> {
        log(self.verbose);
        let (engine, reason) = match (self.executor, &self.adapter) {
            (Executor::Cpu, Some(_)) => return Err("--adapter chooses a GPU, --executor cpu does without".into()),
            (Executor::Cpu, None) => (Engine::cpu(), "CPU executor, as asked".into()),
            (Executor::Auto, None) => Engine::automatic(),
            (_, adapter) => {
                let gpu = Gpu::open(adapter.as_deref())?;
                let reason = format!("GPU executor on {}, as asked", gpu.adapter());
                (Engine::gpu(gpu), reason)
            }
        };
        eprintln!("{reason}");
        Ok(self.budgeted(engine))
    }

    /// The same with cooperative matrices, on a GPU.
    pub fn open_cooperative(&self) -> Result<Engine> {
        log(self.verbose);
        if self.executor == Executor::Cpu {
            return Err("--cooperative is for GPUs: the CPU executor has no cooperative matrices".into());
        }
        let gpu = Gpu::open_cooperative(self.adapter.as_deref())?;
        eprintln!("GPU executor on {}, as --cooperative asks", gpu.adapter());
        Ok(self.budgeted(Engine::gpu(gpu)))
    }

    fn budgeted(&self, engine: Engine) -> Engine {
        match self.memory {
            Some(bytes) => engine.with_budget(bytes),
            None => engine,
        }
    }

    /// The same, but what no flag says is as in an earlier call: the executor by its name, and the memory budget, since both
    /// decide the order of sums.
    pub fn open_like(&self, executor: &str, memory: u64) -> Result<Engine> {
        let mut like = EngineArgs { memory: self.memory.or(Some(memory)), ..self.clone() };
        match (self.executor, &self.adapter) {
            (Executor::Auto, None) if executor == Engine::cpu().to_string() => like.executor = Executor::Cpu,
            (Executor::Auto, None) => like.adapter = Some(executor.into()),
            _ => {}
        }
        like.open()
    }
}

/// Warnings of all crates on stderr; details, where `verbose`, of ours alone: wgpu's would bury them.
fn log(verbose: bool) {
    let level = if verbose { LevelFilter::DEBUG } else { LevelFilter::WARN };
    let ours = ["sigma", "srn"].map(|prefix| (prefix, level));
    let filter = Targets::new().with_default(LevelFilter::WARN).with_targets(ours);
    let lines = tracing_subscriber::fmt::layer().with_writer(io::stderr).with_ansi(io::stderr().is_terminal());
    // A second call in one process keeps the first one's setting.
    tracing_subscriber::registry().with(lines).with(filter).try_init().ok();
}

/// Bytes of `512MiB`, `2GB` and the like.
fn memory(text: &str) -> std::result::Result<u64, String> {
    let digits = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let unit = match text[digits..].trim().to_ascii_lowercase().as_str() {
        "" | "b" => 1.0,
        "kib" | "k" => 1024.0,
        "mib" | "m" => 1024.0 * 1024.0,
        "gib" | "g" => 1024.0 * 1024.0 * 1024.0,
        "kb" => 1e3,
        "mb" => 1e6,
        "gb" => 1e9,
        _ => return Err("expected bytes, or a number with KiB, MiB, GiB, kB, MB or GB".into()),
    };
    match text[..digits].parse::<f64>() {
        Ok(number) if number * unit >= 1.0 => Ok((number * unit) as u64),
        _ => Err("expected a positive number of bytes".into()),
    }
}

/// The axes of a camera by their name.
pub(crate) fn axes(text: &str) -> std::result::Result<Axes, String> {
    named(text, &Axes::ALL, Axes::name)
}

/// One of `all` by its name.
pub(crate) fn named<T: Copy>(text: &str, all: &[T], name: fn(T) -> &'static str) -> std::result::Result<T, String> {
    let names = || all.iter().map(|&one| name(one)).collect::<Vec<_>>().join(", ");
    all.iter().copied().find(|&one| name(one) == text).ok_or_else(|| format!("expected one of {}", names()))
}

/// The flags of a program. A value that begins like a number below zero is a value, and what it is for says what is wrong with it.
pub fn parse<T: Parser>() -> T {
    let takes = |argument: Arg| {
        let is_value = argument.get_action().takes_values() && !argument.is_positional();
        argument.allow_negative_numbers(is_value)
    };
    let command = T::command().mut_subcommands(|command| command.mut_args(takes));
    T::from_arg_matches(&command.get_matches()).unwrap_or_else(|error| error.exit())
}

/// The exit code of a binary: 0 done, 1 did not converge or was stopped, 2 an error, which is printed in one line.
pub fn finish(result: Result<bool>) -> ExitCode {
    match result {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(1),
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(2)
        }
    }
}

/// Reads a model; every error names the file.
pub fn load_model(path: &Path) -> Result<Model> {
    Model::load(path).map_err(|error| about_model(path, error))
}

/// An error about the model in a file, with the file's name.
pub fn about_model(path: &Path, error: sigma_srn::Error) -> Box<dyn Error + Send + Sync> {
    match error {
        error @ (sigma_srn::Error::Io { .. } | sigma_srn::Error::Format { .. }) => error.into(),
        error => format!("{}: {error}", path.display()).into(),
    }
}

/// Fails if one of the files is there already.
pub fn refuse_existing(paths: impl IntoIterator<Item = PathBuf>, force: bool) -> Result<()> {
    match paths.into_iter().find(|path| !force && path.exists()) {
        Some(path) => Err(format!("{}: exists already; --force overwrites it", path.display()).into()),
        None => Ok(()),
    }
}

/// Fails if a file is there already, or a folder in its place, or it has no folder to be in that can be written to: found out now rather than after the work.
pub fn refuse_to_write(path: &Path, force: bool) -> Result<()> {
    refuse_existing([path.to_owned()], force)?;
    if path.is_dir() {
        return Err(format!("{}: a folder, and is to be a file", path.display()).into());
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if !folder.is_dir() {
        return Err(format!("{}: its folder does not exist", path.display()).into());
    }
    try_to_write(folder).map_err(|error| format!("{}: {error}", path.display()).into())
}

/// Makes a folder with its parents; fails if it cannot be written to.
pub fn create_dir(path: &Path) -> Result<()> {
    std::fs::create_dir_all(path).and_then(|()| try_to_write(path)).map_err(|error| format!("{}: {error}", path.display()).into())
}

/// Permissions say little of who may write where; a file does.
fn try_to_write(folder: &Path) -> io::Result<()> {
    let probe = folder.join(format!(".sigma-srn-{}", std::process::id()));
    File::create(&probe).and_then(|_| std::fs::remove_file(&probe))
}

/// Takes a lock that one process at a time holds, until the file is dropped; an error that says `busy` where another has it. The file stays, and is empty.
pub fn lock(path: &Path, busy: &str) -> Result<File> {
    let file = File::create(path).map_err(|error| format!("{}: {error}", path.display()))?;
    match file.try_lock() {
        Err(TryLockError::WouldBlock) => Err(busy.into()),
        // Not every file system has locks.
        Ok(()) | Err(TryLockError::Error(_)) => Ok(file),
    }
}

/// Prints a result on stdout; a full disk or a closed pipe is an error, not a panic.
pub fn print(text: &str) -> Result<()> {
    use std::io::Write;
    writeln!(io::stdout(), "{text}").map_err(|error| format!("stdout: {error}").into())
}

/// A path as text, also one that is no UTF-8.
pub fn lossy<S: serde::Serializer>(path: &impl AsRef<Path>, serializer: S) -> std::result::Result<S::Ok, S::Error> {
    serializer.collect_str(&path.as_ref().display())
}

/// Writes a picture in the format that its ending names, else as PNG; whole or not at all.
pub fn write_picture(path: &Path, picture: &RgbImage) -> Result<()> {
    let format = ImageFormat::from_path(path).unwrap_or(ImageFormat::Png);
    let mut bytes = io::Cursor::new(Vec::new());
    picture.write_to(&mut bytes, format).map_err(|error| format!("{}: {error}", path.display()))?;
    Ok(write_atomically(path, bytes.get_ref())?)
}

/// Reads a set of SRN instance folders as squares of `side` pixels.
pub fn load_set(dir: &Path, side: u32) -> Result<Dataset> {
    Ok(SrnSet::open(dir)?.load(side as usize)?)
}

/// `world_from_camera` and intrinsics of a view, as the library takes them.
pub fn camera(view: &LoadedView) -> (DMat4, Intrinsics) {
    let [fx, fy, cx, cy] = view.intrinsics.map(f64::from);
    let world_from_camera = DMat4::from_cols_array(&view.world_from_camera).transpose();
    (world_from_camera, Intrinsics { fx, fy, cx, cy, pixel_center: 0.0 })
}

/// A picture of depths, from 0.6 object units before the origin (dark) to 0.6 behind it (light), for a camera that is
/// `distance` away from it.
pub fn depth_picture(depth: &[f32], side: u32, distance: f64) -> RgbImage {
    let colour = |z: f32| Rgb(sheet::ramp(&sheet::VIRIDIS, 0.5 + (f64::from(z) - distance) / 1.2));
    RgbImage::from_fn(side, side, |u, v| colour(depth[(v * side + u) as usize]))
}

/// Peak signal-to-noise ratio in dB of colours in [-1, 1], the rendered ones clamped to that range as a picture would be.
pub fn psnr(rendered: &[f32], target: &[f32]) -> f64 {
    let squares = rendered.iter().zip(target).map(|(r, t)| f64::from(r.clamp(-1.0, 1.0) - t).powi(2));
    10.0 * (4.0 * target.len() as f64 / squares.sum::<f64>()).log10()
}

/// `n` of the items, evenly spaced; the first among them.
pub fn spread<T>(items: Vec<T>, n: usize) -> Vec<T> {
    let (len, n) = (items.len(), n.min(items.len()));
    let chosen: Vec<usize> = (0..n).map(|k| k * len / n).collect();
    items.into_iter().enumerate().filter(|(i, _)| chosen.contains(i)).map(|(_, item)| item).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_are_spread_evenly() {
        assert_eq!(spread((0..20).collect(), 4), [0, 5, 10, 15]);
        assert_eq!(spread((0..3).collect(), 10), [0, 1, 2]);
        assert_eq!(spread((0..7).collect(), 3), [0, 2, 4]);
        assert!(spread(Vec::<u8>::new(), 3).is_empty());
    }

    #[test]
    fn memory_sizes() {
        assert_eq!(
            ["4096", "512MiB", "2GB", "1.5 GiB"].map(|text| memory(text).unwrap()),
            [4096, 512 << 20, 2_000_000_000, 3 << 29]
        );
        for bad in ["", "MiB", "-1", "0", "12 parsecs", "1.2.3"] {
            assert!(memory(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn psnr_of_a_known_error() {
        assert!((psnr(&[0.0, 0.2, 3.0], &[0.2, 0.0, 1.0]) - 10.0 * (4.0 * 3.0 / 0.08f64).log10()).abs() < 1e-5);
        assert_eq!(psnr(&[1.0], &[1.0]), f64::INFINITY);
    }
}
