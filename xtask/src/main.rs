//! The project's own commands: `cargo xtask COMMAND`. Uses the standard library only, so that it builds in a second.

mod checks;
mod demo;
mod fuzz;
mod new_op;
mod setup;
mod shell;
mod web;

use std::process::ExitCode;

/// A command: its name, its arguments, what it does, and the function that does it.
struct Command {
    name: &'static str,
    arguments: &'static str,
    about: &'static str,
    run: fn(&[String]) -> Result<(), String>,
}

const COMMANDS: &[Command] = &[
    Command { name: "demo", arguments: "[MODEL]", about: "find poses of unseen pictures with the shipped model", run: demo::run },
    Command { name: "test", arguments: "", about: "every test, GPU tests included", run: checks::test },
    Command { name: "lint", arguments: "", about: "formatting, clippy, documentation; warnings are errors", run: checks::lint },
    Command { name: "ci", arguments: "", about: "everything that CI checks, the cheapest first", run: checks::ci },
    Command { name: "setup", arguments: "", about: "what the tests need beside Rust: a Vulkan driver", run: setup::run },
    Command {
        name: "web",
        arguments: "[MODEL | --check]",
        about: "the page with renderer and search, built for browsers and served",
        run: web::run,
    },
    Command {
        name: "golden",
        arguments: "DIR [--executor cpu64|cpu|gpu]",
        about: "every golden file of a folder on every executor",
        run: checks::golden,
    },
    Command {
        name: "fuzz",
        arguments: "[SECONDS [TARGET]]",
        about: "read spoiled files with every reader, so long each",
        run: fuzz::run,
    },
    Command {
        name: "bench",
        arguments: "[--quick] [--json] [--write]",
        about: "time and GFLOP/s of a pose step, on every executor",
        run: |arguments| shell::bin("bench", arguments),
    },
    Command {
        name: "robustness",
        arguments: "[TABLE…] [--seed N]",
        about: "search pictures whose light, masks and distances are not as in training",
        run: |arguments| {
            shell::run(shell::cargo().args(["build", "--release", "--bin", "sigma-data", "--bin", "sigma-pose"]))?;
            shell::bin("robustness", arguments)
        },
    },
    Command {
        name: "table",
        arguments: "[--check]",
        about: "print the table of kernels into shaders/README.md, or compare it",
        run: |arguments| shell::bin("table", arguments),
    },
    Command { name: "new-op", arguments: "OP DIRECTION", about: "skeletons of a kernel's five parts", run: new_op::run },
];

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let asks = |argument: &String| ["--help", "-h"].contains(&argument.as_str());
    let Some((name, rest)) = arguments.split_first().filter(|(name, _)| !asks(name)) else {
        usage(COMMANDS);
        return ExitCode::SUCCESS;
    };
    let Some(command) = COMMANDS.iter().find(|command| command.name == name) else {
        eprintln!("error: no command is called `{name}`");
        usage(COMMANDS);
        return ExitCode::from(2);
    };
    if rest.iter().any(asks) {
        usage(std::slice::from_ref(command));
        return ExitCode::SUCCESS;
    }
    match (command.run)(rest) {
        Ok(()) => ExitCode::SUCCESS,
        Err(what) => {
            eprintln!("error: {what}");
            ExitCode::FAILURE
        }
    }
}

fn usage(commands: &[Command]) {
    println!("cargo xtask COMMAND\n");
    for command in commands {
        println!("  {:<40} {}", format!("{} {}", command.name, command.arguments), command.about);
    }
}
