//! Running other programs in the repository's root.

use std::ffi::OsStr;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// The repository that cargo runs us for: clones that share a target folder share this program, too.
pub fn root() -> PathBuf {
    let xtask = std::env::var_os("CARGO_MANIFEST_DIR").unwrap_or_else(|| env!("CARGO_MANIFEST_DIR").into());
    Path::new(&xtask).parent().expect("xtask/ lies in the repository").to_path_buf()
}

/// A program that runs in the repository.
pub fn program(path: impl AsRef<OsStr>) -> Command {
    let mut command = Command::new(path);
    command.current_dir(root());
    // Mesa's device selection looks for a Wayland display, and without this says on stderr that there can be none.
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        command.env("XDG_RUNTIME_DIR", std::env::temp_dir());
    }
    command
}

/// The cargo that runs us.
pub fn cargo() -> Command {
    program(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
}

/// Runs a command; its failure is an error that names it.
pub fn run(command: &mut Command) -> Result<(), String> {
    let line = text(command);
    let status = command.status().map_err(|error| format!("{line}: {error}"))?;
    if status.success() { Ok(()) } else { Err(format!("{line}: {status}")) }
}

/// Runs a binary of the workspace.
///
/// Without `--package`, so that cargo unifies the features of the whole workspace: nothing is built twice.
pub fn bin(name: &str, arguments: &[impl AsRef<str>]) -> Result<(), String> {
    let mut command = cargo();
    command.args(["run", "--release", "--bin", name, "--"]).args(arguments.iter().map(AsRef::as_ref));
    run(&mut command)
}

/// Tests that passed and failed.
#[derive(Clone, Copy, Default)]
pub struct Count {
    pub passed: u32,
    pub failed: u32,
}

impl std::fmt::Display for Count {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} passed, {} failed", self.passed, self.failed)
    }
}

/// Runs `cargo test`, shows what it prints, and adds the summaries of the test programs to `count`.
pub fn count_tests(command: &mut Command, count: &mut Count) -> Result<(), String> {
    let line = text(command);
    let failed = |error: std::io::Error| format!("{line}: {error}");
    let mut child = command.stdout(Stdio::piped()).spawn().map_err(failed)?;
    for text in BufReader::new(child.stdout.take().expect("stdout is piped")).lines() {
        let text = text.map_err(failed)?;
        println!("{text}");
        if text.starts_with("test result: ") {
            count.passed += number_before(&text, " passed");
            count.failed += number_before(&text, " failed");
        }
    }
    let status = child.wait().map_err(failed)?;
    if status.success() { Ok(()) } else { Err(format!("{line}: {status}")) }
}

fn number_before(text: &str, word: &str) -> u32 {
    let before = text.split(word).next().unwrap_or_default();
    before.rsplit(' ').next().and_then(|number| number.parse().ok()).unwrap_or(0)
}

fn text(command: &Command) -> String {
    let program = Path::new(command.get_program()).file_stem().unwrap_or_default().to_string_lossy();
    let arguments = command.get_args().map(|argument| argument.to_string_lossy());
    std::iter::once(program).chain(arguments).collect::<Vec<_>>().join(" ")
}
