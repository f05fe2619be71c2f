//! Who knows whom, and what libraries do not do.

use crate::{files, text};

/// Folder, name and the crates of this project that it may depend on.
const CRATES: &[(&str, &str, &[&str])] = &[
    ("shaders", "srn-shaders", &[]),
    ("crates/plan", "srn-plan", &["srn-shaders"]),
    ("crates/cpu", "srn-cpu", &["srn-plan", "srn-shaders"]),
    ("crates/gpu", "srn-gpu", &["srn-plan", "srn-shaders"]),
    ("crates/photo", "srn-photo", &[]),
    ("crates/data", "srn-data", &["srn-photo"]),
    ("crates/sigma-srn", "sigma-srn", &["srn-photo", "srn-plan", "srn-cpu", "srn-gpu", "srn-shaders"]),
    // From the GPU crate only the rasteriser.
    ("crates/cli", "sigma-cli", &["sigma-srn", "srn-data", "srn-gpu"]),
    ("crates/web", "sigma-web", &["sigma-srn"]),
    ("tests", "srn-tests", &["sigma-srn", "srn-data", "srn-plan", "srn-cpu", "srn-gpu", "srn-shaders"]),
    ("xtask", "xtask", &[]),
];

/// Who may depend on wgpu and naga: the GPU crate, and the tests that look over its shoulder.
const GRAPHICS: &[&str] = &["crates/gpu", "tests"];

/// Names in the sections of a manifest that list dependencies.
fn dependencies(folder: &str) -> Vec<String> {
    let mut found = Vec::new();
    let mut listed = false;
    for line in text(format!("{folder}/Cargo.toml")).lines() {
        if line.starts_with('[') {
            listed = line.ends_with("dependencies]");
        } else if let Some((name, _)) = line.split_once('=').filter(|_| listed) {
            found.push(name.trim().trim_end_matches(".workspace").to_owned());
        }
    }
    found
}

#[test]
fn every_member_of_the_workspace_is_known() {
    let manifest = text("Cargo.toml");
    let members = manifest.lines().find(|line| line.starts_with("members = ")).unwrap();
    for &(folder, name, _) in CRATES {
        assert!(members.contains(&format!("\"{folder}\"")), "{folder} is no member of the workspace");
        assert!(text(format!("{folder}/Cargo.toml")).contains(&format!("name = \"{name}\"")), "{folder} is not called {name}");
    }
    assert_eq!(members.matches('"').count(), 2 * CRATES.len(), "a member without a rule here: {members}");
}

#[test]
fn dependencies_run_one_way() {
    for &(folder, name, allowed) in CRATES {
        let found = dependencies(folder);
        for ours in found.iter().filter(|found| CRATES.iter().any(|(_, known, _)| known == found)) {
            assert!(allowed.contains(&ours.as_str()), "{name} must not know {ours}");
        }
        for graphics in found.iter().filter(|found| ["wgpu", "naga"].contains(&found.as_str())) {
            assert!(GRAPHICS.contains(&folder), "{name} depends on {graphics}; only srn-gpu does, and re-exports it");
        }
    }
    assert_eq!(dependencies("xtask"), [""; 0], "xtask uses the standard library only");
}

#[test]
fn crate_docs_say_what_a_crate_owns_and_does_not_know() {
    for &(folder, ..) in CRATES.iter().filter(|(folder, ..)| *folder != "xtask") {
        let path = if folder == "tests" { "tests/harness/lib.rs".into() } else { format!("{folder}/src/lib.rs") };
        let text = text(&path);
        let docs: Vec<&str> = text.lines().map_while(|line| line.strip_prefix("//!")).map(str::trim).collect();
        let opening = docs.split(|line| line.is_empty()).next().unwrap().join(" ");
        assert!(opening.starts_with("This crate owns "), "{path} opens with: {opening}");
        assert!(opening.contains(" does not know "), "{path} does not say what the crate does not know: {opening}");
    }
}

/// Lines of code before the file's unit tests, with their numbers.
fn code(path: &str) -> Vec<(usize, String)> {
    let text = text(path);
    let tests = text.find("#[cfg(test)]").unwrap_or(text.len());
    let lines = text[..tests].lines().enumerate().map(|(number, line)| (number + 1, line.trim().to_owned()));
    lines.filter(|(_, line)| !line.starts_with("//")).collect()
}

#[test]
fn libraries_never_print_and_never_panic_on_what_they_are_given() {
    const NEVER: [&str; 9] =
        ["println!", "eprintln!", "print!", "eprint!", "dbg!", "panic!", "todo!", "unimplemented!", ".unwrap()"];
    for &(folder, ..) in CRATES.iter().filter(|(folder, ..)| !["crates/cli", "tests", "xtask"].contains(folder)) {
        for path in files(&format!("{folder}/src"), ".rs") {
            for (number, line) in code(&path) {
                // `expect` says why it cannot happen; `unwrap` does not.
                let found = NEVER.iter().find(|word| line.contains(**word));
                assert!(found.is_none(), "{path}:{number}: {line}");
            }
        }
    }
}

/// What a device is known to compute holds for one translation of the kernels.
#[test]
fn the_translator_of_kernels_is_the_one_in_use() {
    let lock = text("Cargo.lock").replace("\r\n", "\n");
    let version =
        lock.split_once("name = \"naga\"\nversion = \"").and_then(|(_, rest)| rest.split_once('"')).expect("naga is locked").0;
    let named = format!("const TRANSLATOR: &str = \"naga {version}\";");
    assert!(text("crates/gpu/src/gpu.rs").contains(&named), "crates/gpu/src/gpu.rs: no `{named}`");
}

#[test]
fn exceptions_from_lints_give_a_reason() {
    for folder in ["shaders", "crates", "tests", "xtask"] {
        for path in files(folder, ".rs") {
            let attribute = ["#[", "#!["].map(|open| format!("{open}allow("));
            for (number, line) in text(&path).lines().enumerate() {
                let allows = attribute.iter().any(|attribute| line.trim().starts_with(attribute));
                assert!(!allows, "{path}:{}: use #[expect(…, reason = …)]: {line}", number + 1);
            }
        }
    }
}
