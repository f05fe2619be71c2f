//! `sigma-data inspect --meshes`: reads mesh files and says what is in them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Serialize;
use srn_data::mesh::{self, Mesh};

use crate::common::{Result, print};
use crate::progress;

#[derive(Serialize)]
struct Report {
    files: Vec<File>,
    formats: BTreeMap<String, Summary>,
}

#[derive(Serialize)]
struct File {
    path: PathBuf,
    #[serde(flatten)]
    found: Found,
}

/// What was found in a file.
#[derive(Serialize)]
#[serde(untagged)]
enum Found {
    Read { triangles: usize, parts: usize, textures: usize, low: [f32; 3], high: [f32; 3], warnings: Vec<String> },
    Refused { error: String },
}

/// What became of the files of one format, that is, with one ending.
#[derive(Serialize, Default)]
struct Summary {
    read: usize,
    read_with_warnings: usize,
    refused: usize,
    /// Why files were refused, and how many: without their names and lines.
    reasons: BTreeMap<String, usize>,
}

/// Reads these files, and all meshes in these folders; prints a line for each, and a summary for each format. False where a file
/// was refused.
pub fn inspect(paths: &[PathBuf], json: bool) -> Result<bool> {
    let mut files = vec![];
    for path in paths {
        if path.is_dir() { collect(path, &mut files)? } else { files.push(path.clone()) }
    }
    if files.is_empty() {
        return Err(format!("{}: no .{} files in it", paths[0].display(), mesh::ENDINGS.join(", .")).into());
    }
    let mut report = Report { files: vec![], formats: BTreeMap::new() };
    if !json {
        print(&format!("{:>9} {:>5} {:>8} {:>30} {:>8}  file", "triangles", "parts", "textures", "size", "warnings"))?;
    }
    let bar = progress::bar(files.len() as u64, "meshes");
    for path in files {
        bar.set_message(path.file_name().unwrap_or_default().to_string_lossy().into_owned());
        let found = match mesh::load(&path) {
            Ok((mesh, _)) => found_in(mesh),
            Err(error) => Found::Refused { error: error.to_string() },
        };
        let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        report.formats.entry(ending).or_default().add(&path, &found);
        let file = File { path, found };
        if !json {
            bar.suspend(|| print(&file.line()))?;
        }
        report.files.push(file);
        bar.inc(1);
    }
    bar.finish_and_clear();
    if json {
        print(&serde_json::to_string_pretty(&report)?)?;
    } else {
        print(&format!("\n{:<6} {:>6} {:>6} {:>13} {:>7}", "format", "files", "read", "with warnings", "refused"))?;
        for (ending, s) in &report.formats {
            let files = s.read + s.read_with_warnings + s.refused;
            print(&format!("{ending:<6} {files:>6} {:>6} {:>13} {:>7}", s.read, s.read_with_warnings, s.refused))?;
            s.reasons.iter().try_for_each(|(reason, count)| print(&format!("       refused {count}: {reason}")))?;
        }
    }
    Ok(report.formats.values().all(|summary| summary.refused == 0))
}

/// All meshes below a folder, sorted. Of an LDraw library the parts alone: its other files are pieces of them.
fn collect(folder: &Path, files: &mut Vec<PathBuf>) -> Result<()> {
    let failed = |error: std::io::Error| format!("{}: {error}", folder.display());
    let entries = std::fs::read_dir(folder).map_err(failed)?.collect::<std::io::Result<Vec<_>>>().map_err(failed)?;
    let mut entries: Vec<_> = entries.into_iter().map(|entry| (entry.path(), entry.file_type())).collect();
    entries.sort_by(|(a, _), (b, _)| a.cmp(b));
    for (path, kind) in entries {
        // Links to folders may lead in circles.
        if kind.is_ok_and(|kind| kind.is_dir()) {
            collect(&path, files)?;
            continue;
        }
        let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        let is_part = || folder.ends_with("parts") && folder.with_file_name("LDConfig.ldr").is_file();
        if mesh::ENDINGS.contains(&ending.as_str()) && path.is_file() && (ending != "dat" || is_part()) {
            files.push(path);
        }
    }
    Ok(())
}

fn found_in(mesh: Mesh) -> Found {
    let [low, high] = mesh.bounds().map(|corner| corner.to_array());
    Found::Read {
        triangles: mesh.vertices.len() / 3,
        parts: mesh.parts.iter().filter(|part| !part.vertices.is_empty()).count(),
        textures: mesh.textures.len(),
        low,
        high,
        warnings: mesh.warnings,
    }
}

impl File {
    fn line(&self) -> String {
        match &self.found {
            Found::Read { triangles, parts, textures, low, high, warnings } => {
                let size: Vec<_> = (0..3).map(|k| format!("{:.4}", high[k] - low[k])).collect();
                let (size, path, count) = (size.join(" × "), self.path.display(), warnings.len());
                let first = warnings.first().map(|warning| format!(": {warning}")).unwrap_or_default();
                format!("{triangles:>9} {parts:>5} {textures:>8} {size:>30} {count:>8}  {path}{first}")
            }
            // The error names the file.
            Found::Refused { error } => format!("{:>9} {:>54}{error}", "refused", ""),
        }
    }
}

impl Summary {
    fn add(&mut self, path: &Path, found: &Found) {
        match found {
            Found::Read { warnings, .. } if warnings.is_empty() => self.read += 1,
            Found::Read { .. } => self.read_with_warnings += 1,
            Found::Refused { error } => {
                self.refused += 1;
                let reason = error.strip_prefix(&format!("{}: ", path.display())).unwrap_or(error);
                let place = reason.strip_prefix("line ").map(|rest| rest.trim_start_matches(|c: char| c.is_ascii_digit()));
                let reason = place.and_then(|rest| rest.strip_prefix(": ")).unwrap_or(reason);
                *self.reasons.entry(reason.into()).or_default() += 1;
            }
        }
    }
}
