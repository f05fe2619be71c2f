//! Docs that can rot: what they name exists.

use std::path::Path;

use crate::{files, repository, text};

/// Every Markdown file.
fn documents() -> Vec<String> {
    let top = ["README.md", "ARCHITECTURE.md", "CHANGELOG.md"].map(str::to_owned);
    let folders = ["docs", "shaders", "assets", "crates", "tests", "xtask"];
    top.into_iter().chain(folders.iter().flat_map(|folder| files(folder, ".md"))).collect()
}

/// What stands between backticks, in code blocks, and in the round brackets of links.
fn named(text: &str) -> Vec<String> {
    let mut found = Vec::new();
    let mut block = false;
    for line in text.lines() {
        if line.trim_start().starts_with("```") {
            block = !block;
        } else if block {
            found.push(line.to_owned());
        } else {
            found.extend(line.split('`').skip(1).step_by(2).map(str::to_owned));
            found.extend(line.split("](").skip(1).filter_map(|rest| Some(rest.split_once(')')?.0.to_owned())));
        }
    }
    found
}

fn words(text: &str) -> impl Iterator<Item = &str> {
    text.split(|c: char| c.is_whitespace() || "\"'(),;=".contains(c)).filter(|word| !word.is_empty())
}

#[test]
fn paths_exist() {
    let top: Vec<String> =
        std::fs::read_dir(repository("")).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    for document in documents() {
        let folder = Path::new(&document).parent().unwrap();
        for named in named(&text(&document)) {
            for word in words(&named).map(|word| word.trim_end_matches(['.', ':', '/'])) {
                // Places where things will be written, and patterns.
                let written =
                    ["target", "demo", "runs"].iter().any(|folder| word == *folder || word.starts_with(&format!("{folder}/")));
                let begins_here = word.split_once('/').is_some_and(|(first, _)| top.iter().any(|name| name == first));
                if !written && begins_here && !word.contains(['*', '<', '$', '{', '…']) {
                    assert!(repository(word).exists() || repository(folder).join(word).exists(), "{document}: no `{word}`");
                }
            }
        }
        for link in text(&document).split("](").skip(1).filter_map(|rest| Some(rest.split_once(')')?.0)) {
            let target = link.split('#').next().unwrap();
            let is_here = target.is_empty() || target.contains("://") || repository(folder).join(target).exists();
            assert!(is_here, "{document}: link to `{link}`");
        }
    }
}

#[test]
fn commands_exist() {
    let tasks = text("xtask/src/main.rs");
    let programs: Vec<String> = files("crates/cli/src/bin", ".rs")
        .iter()
        .map(|path| path.rsplit('/').next().unwrap().trim_end_matches(".rs").to_owned())
        .chain(text("tests/Cargo.toml").split("[[bin]]").skip(1).map(|bin| bin.split('"').nth(1).unwrap().to_owned()))
        .collect();
    for document in documents() {
        for named in named(&text(&document)) {
            for task in named.split("cargo xtask ").skip(1).filter_map(|rest| words(rest).next()) {
                assert!(tasks.contains(&format!("name: \"{task}\"")), "{document}: no command `cargo xtask {task}`");
            }
            for after in ["--bin ", "target/release/"] {
                for program in named.split(after).skip(1).filter_map(|rest| words(rest).next()) {
                    assert!(programs.iter().any(|known| known == program), "{document}: no program `{program}`");
                }
            }
        }
    }
}

#[test]
fn crates_exist() {
    let manifests = files("crates", "Cargo.toml")
        .iter()
        .chain(&["shaders/Cargo.toml", "tests/Cargo.toml"].map(String::from))
        .map(text)
        .collect::<String>();
    let programs = files("crates/cli/src/bin", ".rs").join(" ");
    for document in documents() {
        for named in named(&text(&document)) {
            for word in words(&named).filter(|word| !word.contains(['/', '.', ':'])) {
                let ours = ["srn-", "srn_", "sigma-", "sigma_"].iter().any(|prefix| word.starts_with(prefix));
                let name = word.replace('_', "-");
                let known = manifests.contains(&format!("name = \"{name}\"")) || programs.contains(&format!("/{name}.rs"));
                assert!(!ours || known, "{document}: no crate or program `{word}`");
            }
        }
    }
}

#[test]
fn the_table_of_kernels_is_the_printed_one() {
    let current = text("shaders/README.md");
    assert_eq!(current, srn_tests::table::update(&current).unwrap(), "shaders/README.md is out of date: cargo xtask table");
}
