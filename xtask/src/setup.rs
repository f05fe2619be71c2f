//! What a fresh machine needs beside Rust: on Linux a Vulkan loader and a driver, if only Mesa's software one.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::shell;

const PACKAGES: [&str; 2] = ["libvulkan1", "mesa-vulkan-drivers"];

/// Installs the driver where it is missing and apt can; else says what to do. The tests fail later where none is found.
pub fn run(_: &[String]) -> Result<(), String> {
    if !cfg!(target_os = "linux") || (has_loader() && has_driver()) {
        return Ok(());
    }
    let install = format!("apt-get install {}", PACKAGES.join(" "));
    if !succeeds(Command::new("apt-get").arg("--version")) {
        eprintln!(
            "no Vulkan driver found: install Mesa's (Fedora: mesa-vulkan-drivers, Arch: vulkan-swrast) and the Vulkan loader"
        );
        return Ok(());
    }
    let prefix: &[&str] = if succeeds_with(Command::new("id").arg("-u"), "0") {
        &[]
    } else if succeeds(Command::new("sudo").args(["-n", "true"])) {
        &["sudo", "-n"]
    } else {
        eprintln!("no Vulkan driver found; the GPU tests need one:\n\n    sudo {install}\n");
        return Ok(());
    };
    println!("no Vulkan driver found: {install}");
    let apt = |arguments: &[&str]| {
        let words: Vec<&str> = prefix.iter().copied().chain(["env", "DEBIAN_FRONTEND=noninteractive", "apt-get"]).collect();
        shell::run(Command::new(words[0]).args(&words[1..]).args(arguments).stdout(Stdio::null()))
    };
    let install = ["install", "--yes", "--no-install-recommends", PACKAGES[0], PACKAGES[1]];
    // The lists of packages may be old, or not there at all.
    apt(&install).or_else(|_| apt(&["update"]).and_then(|()| apt(&install)))
}

fn has_driver() -> bool {
    let named = ["VK_DRIVER_FILES", "VK_ICD_FILENAMES"].into_iter().any(|name| std::env::var_os(name).is_some());
    let data = std::env::var("XDG_DATA_DIRS").unwrap_or_else(|_| "/usr/local/share:/usr/share".into());
    let folders = data.split(':').map(PathBuf::from).chain(["/etc".into(), "/usr/share".into()]);
    named || folders.into_iter().any(|folder| has_file(&folder.join("vulkan/icd.d"), ".json"))
}

fn has_loader() -> bool {
    let folders = ["/usr/lib", "/usr/lib64", "/usr/local/lib", "/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu"];
    let listed = Command::new("ldconfig")
        .arg("-p")
        .output()
        .is_ok_and(|output| String::from_utf8_lossy(&output.stdout).contains("libvulkan.so.1"));
    listed || folders.into_iter().any(|folder| has_file(Path::new(folder), "libvulkan.so.1"))
}

fn has_file(folder: &Path, end: &str) -> bool {
    let mut entries = std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
    entries.any(|entry| entry.file_name().to_string_lossy().ends_with(end))
}

fn succeeds(command: &mut Command) -> bool {
    command.stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|status| status.success())
}

fn succeeds_with(command: &mut Command, stdout: &str) -> bool {
    command.output().is_ok_and(|output| String::from_utf8_lossy(&output.stdout).trim() == stdout)
}
