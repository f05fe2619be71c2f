//! What must hold before a change is in: the same here and in CI.

use std::time::Instant;

use crate::shell::{self, Count, cargo};
use crate::{demo, setup};

/// Formatting, clippy and documentation.
pub fn lint(_: &[String]) -> Result<(), String> {
    shell::run(cargo().args(["fmt", "--all", "--check"]))?;
    shell::run(cargo().args(["clippy", "--release", "--workspace", "--all-targets", "--", "-D", "warnings"]))?;
    let mut doc = cargo();
    doc.args(["doc", "--quiet", "--release", "--workspace", "--no-deps"]);
    shell::run(doc.env("RUSTDOCFLAGS", "-D warnings"))
}

/// All tests; a missing adapter is a failure. The last line counts them.
pub fn test(arguments: &[String]) -> Result<(), String> {
    setup::run(&[])?;
    let mut count = Count::default();
    let result = all_tests(arguments, &mut count);
    println!("{count}");
    result
}

/// The golden files of a folder.
pub fn golden(arguments: &[String]) -> Result<(), String> {
    shell::bin("golden", arguments)
}

/// Everything, the cheapest first; the last line counts the tests.
pub fn ci(_: &[String]) -> Result<(), String> {
    let begin = Instant::now();
    let mut count = Count::default();
    let result = stages(&mut count);
    println!("── {:.0} s in all", begin.elapsed().as_secs_f64());
    println!("{count}");
    result
}

fn stages(count: &mut Count) -> Result<(), String> {
    stage("set-up", || setup::run(&[]))?;
    stage("lint", || lint(&[]))?;
    stage("house tests", || {
        // Counted with all others, below.
        let house = ["test", "--quiet", "--release", "--workspace", "--test", "house"];
        shell::count_tests(cargo().args(house), &mut Count::default())
    })?;
    stage("tests", || all_tests(&[], count))?;
    stage("golden values", || golden(&["tests/golden".into()]))?;
    stage("demo", || demo::run(&[]))
}

fn all_tests(arguments: &[String], count: &mut Count) -> Result<(), String> {
    shell::bin("adapters", &[] as &[&str])?;
    shell::count_tests(cargo().args(["test", "--release", "--workspace", "--no-fail-fast"]).args(arguments), count)
}

fn stage(name: &str, work: impl FnOnce() -> Result<(), String>) -> Result<(), String> {
    println!("── {name}");
    let begin = Instant::now();
    let result = work();
    println!("── {name}: {:.0} s", begin.elapsed().as_secs_f64());
    result
}
