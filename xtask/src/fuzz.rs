//! Long searches for files that a reader cannot bear.

use std::io::{BufRead, BufReader};
use std::process::Stdio;

use crate::shell::cargo;

/// Every target for so many seconds, or those whose name begins like TARGET; a line for each. What a finding is, its test says on
/// stderr. The files are `crates/*/tests/*.rs`: each of their tests `fuzz_TARGET` starts from good files.
pub fn run(arguments: &[String]) -> Result<(), String> {
    let seconds = arguments.first().map_or("60", String::as_str);
    seconds.parse::<u32>().map_err(|_| format!("expected seconds, found `{seconds}`"))?;
    let test = format!("fuzz_{}", arguments.get(1).map_or("", String::as_str));
    let mut command = cargo();
    command.args([
        "test",
        "--release",
        "--workspace",
        "--no-fail-fast",
        "--test",
        "formats",
        "--test",
        "meshes",
        "--test",
        "files",
        "--test",
        "torch",
    ]);
    command.args([&test, "--", "--nocapture"]).env("SRN_FUZZ_SECONDS", seconds);
    let mut child = command.stdout(Stdio::piped()).spawn().map_err(|error| error.to_string())?;
    println!("{:<16} {:>10} {:>9} {:>8}", "target", "inputs", "findings", "seconds");
    let mut targets = 0;
    for line in BufReader::new(child.stdout.take().expect("stdout is piped")).lines() {
        let line = line.map_err(|error| error.to_string())?;
        // "fuzzed TARGET: N inputs, N findings, N s", perhaps behind what the test harness prints.
        let Some((target, rest)) = line.split_once("fuzzed ").and_then(|(_, said)| said.split_once(": ")) else { continue };
        let numbers: Vec<_> = rest.split(", ").filter_map(|number| number.split(' ').next()).collect();
        if let [inputs, findings, seconds] = numbers[..] {
            println!("{target:<16} {inputs:>10} {findings:>9} {seconds:>8}");
            targets += 1;
        }
    }
    let status = child.wait().map_err(|error| error.to_string())?;
    match (status.success(), targets) {
        (true, 0) => Err(format!("no target begins with `{}`", arguments.get(1).map_or("", String::as_str))),
        (true, _) => Ok(()),
        (false, _) => Err("something was found".into()),
    }
}
