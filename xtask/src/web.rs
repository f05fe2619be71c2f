//! The page: views and poses in a browser, built and served; `--check` has a headless Chromium find a pose on both executors.

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::mpsc;
use std::time::Duration;

use crate::shell::{self, root};

const TARGET: &str = "wasm32-unknown-unknown";
/// Everything that is served.
const SITE: &str = "target/web";
const MODEL: &str = "assets/models/compact.safetensors";
const VIEWS: &str = "assets/dataset/test";
/// Views whose poses are looked for, the objects before white.
const SAMPLES: [&str; 9] = [
    "forklift/000006",
    "bucket/000004",
    "chicken/000000",
    "mudguard/000000",
    "seat/000000",
    "sensor/000000",
    "steering/000000",
    "turret/000000",
    "valve/000000",
];
/// Photographs whose objects are not cut out: the object, the angle of view across in degrees, and a box around the object.
pub const SCENES: [(&str, f64, [u32; 4]); 2] = [("forklift", 46.54, [35, 64, 194, 130]), ("chicken", 46.54, [75, 37, 114, 189])];
const ADDRESS: &str = "127.0.0.1:8017";
const BROWSERS: [&str; 4] = ["chromium", "chromium-browser", "google-chrome", "chrome"];
/// A software GPU takes a minute or two.
const PATIENCE: Duration = Duration::from_secs(600);
/// Most that a pose found by `--check` may be off, degrees.
const MOST_DEG: f64 = 1.0;

pub fn run(arguments: &[String]) -> Result<(), String> {
    let (is_check, model) = match arguments {
        [] => (false, MODEL),
        [flag] if flag == "--check" => (true, MODEL),
        [model] if root().join(model).is_file() => (false, model.as_str()),
        _ => return Err(format!("expected nothing, --check or a model's file, got {}", arguments.join(" "))),
    };
    build(model)?;
    let listener = TcpListener::bind(ADDRESS).map_err(|error| format!("{ADDRESS}: {error}"))?;
    let (sender, reports) = mpsc::channel();
    let server = std::thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            let sender = sender.clone();
            std::thread::spawn(move || answer(stream, &sender));
        }
    });
    if is_check {
        return check(&reports);
    }
    println!("http://{ADDRESS}/ (Ctrl-C ends it); the same files, served by anything: {SITE}");
    server.join().map_err(|_| "the server failed".into())
}

/// Whether code for browsers can be compiled here.
fn has_target() -> bool {
    let mut rustc = shell::program(std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into()));
    let output = rustc.args(["--print", "target-libdir", "--target", TARGET]).output();
    output.is_ok_and(|output| Path::new(String::from_utf8_lossy(&output.stdout).trim()).is_dir())
}

fn build(model: &str) -> Result<(), String> {
    if !has_target() {
        shell::run(shell::program("rustup").args(["target", "add", TARGET]))?;
    }
    let bindgen = bindgen()?;
    let mut cargo = shell::cargo();
    // All browsers with WebGPU have vectors.
    cargo.args(["build", "--release", "--target", TARGET, "--package", "sigma-web"]);
    shell::run(cargo.env("CARGO_TARGET_WASM32_UNKNOWN_UNKNOWN_RUSTFLAGS", "-Ctarget-feature=+simd128"))?;
    let mut glue = shell::program(bindgen);
    glue.args(["--target", "web", "--no-typescript", "--out-dir", SITE]);
    shell::run(glue.arg(format!("target/{TARGET}/release/sigma_web.wasm")))?;
    for (from, to) in
        [("crates/web/page/index.html", "index.html"), ("crates/web/page/page.js", "page.js"), (model, "model.safetensors")]
    {
        copy(from, to)?;
    }
    let mut samples = Vec::new();
    for (object, fov, bounds) in SCENES {
        let image = format!("{object}.png");
        copy(&format!("assets/scenes/{image}"), &image)?;
        let pose = numbers(&format!("assets/scenes/{object}.txt"))?;
        samples
            .push(format!(r#"{{"object": "{object}", "image": "{image}", "fov": {fov}, "pose": {pose:?}, "box": {bounds:?}}}"#));
    }
    for sample in SAMPLES {
        let (object, view) = sample.split_once('/').unwrap_or_default();
        let image = format!("{object}-{view}.png");
        copy(&format!("{VIEWS}/{object}/rgb/{view}.png"), &image)?;
        let pose = numbers(&format!("{VIEWS}/{object}/pose/{view}.txt"))?;
        let camera = numbers(&format!("{VIEWS}/{object}/intrinsics.txt"))?;
        let [focal, .., height, _] = camera[..] else { return Err(format!("{object}: broken intrinsics")) };
        let fov = 2.0 * (0.5 * height / focal).atan().to_degrees();
        samples.push(format!(r#"{{"object": "{object}", "image": "{image}", "fov": {fov}, "pose": {pose:?}}}"#));
    }
    let path = root().join(SITE).join("samples.json");
    fs::write(&path, format!("[{}]\n", samples.join(",\n"))).map_err(|error| format!("{}: {error}", path.display()))
}

/// The program that makes JavaScript for the WebAssembly, of the version that the code was written for; installed where it is missing.
fn bindgen() -> Result<PathBuf, String> {
    let lock = fs::read_to_string(root().join("Cargo.lock")).map_err(|error| format!("Cargo.lock: {error}"))?;
    let version = lock.split("name = \"wasm-bindgen\"\nversion = \"").nth(1).and_then(|rest| rest.split('"').next());
    let version = version.ok_or("Cargo.lock: no wasm-bindgen")?;
    let own = root().join("target/tools");
    for path in ["wasm-bindgen".into(), own.join("bin/wasm-bindgen")] {
        let output = Command::new(&path).arg("--version").output();
        if output.is_ok_and(|output| String::from_utf8_lossy(&output.stdout).trim().ends_with(version)) {
            return Ok(path);
        }
    }
    let mut install = shell::cargo();
    install.args(["install", "wasm-bindgen-cli", "--version", version, "--root"]);
    shell::run(install.arg(&own))?;
    Ok(own.join("bin/wasm-bindgen"))
}

fn copy(from: &str, to: &str) -> Result<(), String> {
    fs::copy(root().join(from), root().join(SITE).join(to)).map_err(|error| format!("{from}: {error}"))?;
    Ok(())
}

fn numbers(path: &str) -> Result<Vec<f64>, String> {
    let text = fs::read_to_string(root().join(path)).map_err(|error| format!("{path}: {error}"))?;
    text.split_whitespace().map(|word| word.parse().map_err(|_| format!("{path}: `{word}` is no number"))).collect()
}

/// Serves one file, or takes the page's report.
fn answer(stream: TcpStream, reports: &mpsc::Sender<String>) {
    let mut reader = BufReader::new(&stream);
    let (mut request, mut length) = (String::new(), 0);
    if reader.read_line(&mut request).is_err() {
        return;
    }
    for line in reader.by_ref().lines().map_while(Result::ok).take_while(|line| !line.is_empty()) {
        if let Some((_, value)) = line.split_once(':').filter(|(name, _)| name.eq_ignore_ascii_case("content-length")) {
            length = value.trim().parse().unwrap_or(0);
        }
    }
    let mut words = request.split_whitespace();
    let (method, path) = (words.next().unwrap_or_default(), words.next().unwrap_or_default());
    let name = path.trim_start_matches('/').split('?').next().unwrap_or_default();
    let (status, kind, body) = match method {
        "POST" => {
            let mut report = String::new();
            let read = reader.take(length).read_to_string(&mut report);
            drop(read.map(|_| reports.send(report)));
            ("200 OK", "text/plain", Vec::new())
        }
        // One folder, no others.
        _ if name.contains(['/', '\\']) || name.contains("..") => ("404 Not Found", "text/plain", Vec::new()),
        _ => {
            let name = if name.is_empty() { "index.html" } else { name };
            let kind = match name.rsplit('.').next() {
                Some("html") => "text/html",
                Some("js") => "text/javascript",
                Some("wasm") => "application/wasm",
                Some("json") => "application/json",
                Some("png") => "image/png",
                _ => "application/octet-stream",
            };
            match fs::read(root().join(SITE).join(name)) {
                Ok(body) => ("200 OK", kind, body),
                Err(_) => ("404 Not Found", "text/plain", Vec::new()),
            }
        }
    };
    let head =
        format!("HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n", body.len());
    // A browser that has gone away wants nothing more.
    let _ = (&stream).write_all(head.as_bytes()).and_then(|()| (&stream).write_all(&body));
}

/// Has a headless browser open the page, which looks for a pose on both executors and reports what it found.
fn check(reports: &mpsc::Receiver<String>) -> Result<(), String> {
    let has = |name: &&str| Command::new(name).arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok();
    let browser = BROWSERS.into_iter().find(has);
    let browser = browser.ok_or(format!("no Chromium found (looked for {}): apt-get install chromium", BROWSERS.join(", ")))?;
    let profile = root().join(SITE).join("profile");
    let mut command = Command::new(browser);
    // Without a GPU Chromium has one in software, SwiftShader, behind a flag. As root it has no sandbox.
    command.args([
        "--headless=new",
        "--no-sandbox",
        "--enable-unsafe-webgpu",
        "--no-first-run",
        "--disable-background-networking",
    ]);
    command.args(["--disable-component-update", "--disable-sync"]).arg(format!("--user-data-dir={}", profile.display()));
    command.arg(format!("http://{ADDRESS}/?check")).stdout(Stdio::null()).stderr(Stdio::null());
    let mut child = command.spawn().map_err(|error| format!("{browser}: {error}"))?;
    println!("{browser} looks for a pose on the CPU and on its GPU: a minute or two");
    let report = reports.recv_timeout(PATIENCE).map_err(|_| format!("no report within {} s", PATIENCE.as_secs()));
    let _ = child.kill().and_then(|()| child.wait());
    let _ = fs::remove_dir_all(profile);
    let report = report?;
    println!("{report}");
    let off = |line: &str| line.split_once('°').and_then(|(angle, _)| angle.parse::<f64>().ok());
    let is_right = |line: &str| off(line).is_some_and(|angle| angle <= MOST_DEG) && line.contains(", trusted");
    let is_right = report.lines().count() == 5 && report.lines().all(is_right);
    if is_right { Ok(()) } else { Err("the poses found in the browser are not as they should be".into()) }
}
