//! The `planesweep` program: photographs with known cameras in, depth maps and one dense, coloured
//! point cloud out.
//!
//! This crate parses, prints and draws progress; what is computed lives in the stages' crates.

mod args;
mod commands;
mod computation;
mod console;
mod depth_maps;
mod forecast;
mod host;
mod input;
mod interrupts;
mod network;
mod out_folder;
mod prepare;
mod run_record;
mod supervisor;
mod training;
mod upload;
mod workspace;

use std::io::{Write, stdout};
use std::process::ExitCode;

use clap::Parser;

use crate::args::{Cli, Command};
use crate::console::{Outcome, UsageError};

fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => {
            // Whoever reads JSON finds the error where all others are; help is asked for by people.
            if error.use_stderr() && std::env::args_os().any(|argument| argument == "--json") {
                print_error(what_is_wrong(&error.to_string()));
            }
            error.exit();
        }
    };
    console::start_logging(cli.verbose);
    let json = cli.json;
    let done = match cli.command {
        Command::Reconstruct(args) => commands::reconstruct::run(&args, json, cli.verbose),
        Command::Inspect(args) => commands::inspect::run(&args),
        Command::Convert(args) => commands::convert::run(&args),
        Command::Depth(args) => commands::depth::run(&args),
        Command::Fuse(args) => commands::fuse::run(&args, json),
        Command::Synth(args) => commands::synth::run(&args),
        Command::Train(args) => commands::train::run(&args),
        Command::RenderDepth(args) => commands::render_depth::run(&args),
        Command::Weights(args) => commands::weights::run(&args),
        Command::Evaluate(args) => commands::evaluate::run(&args),
        Command::Bench(args) => commands::bench::run(&args),
        Command::BenchSide(args) => commands::bench::side::run(&args),
        Command::Benchmark(args) => commands::benchmark::run(&args, cli.verbose),
        Command::Coordinator(args) => commands::coordinator::run(&args),
        Command::Worker(args) => commands::worker::run(args),
        Command::Submit(args) => commands::submit::run(&args, json),
        Command::Status(args) => commands::status::run(&args),
        Command::Cancel(args) => commands::status::cancel(&args),
    };
    match done {
        Ok(Outcome { text, value, skipped_views }) => {
            // A closed pipe (`planesweep inspect ... | head`) is no failure.
            let _ = if json { writeln!(stdout(), "{value}") } else { write!(stdout(), "{text}") };
            if skipped_views { ExitCode::from(3) } else { ExitCode::SUCCESS }
        }
        Err(error) => {
            if json {
                print_error(&format!("{error:#}"));
            }
            eprintln!("planesweep: {error:#}");
            if error.is::<UsageError>() {
                return ExitCode::from(2);
            }
            commands::worker::exit_code(&error).map_or(ExitCode::FAILURE, ExitCode::from)
        }
    }
}

/// What a usage error says before it explains the usage.
fn what_is_wrong(usage_error: &str) -> &str {
    let what = usage_error.split("\n\n").next().unwrap_or(usage_error);
    what.strip_prefix("error: ").unwrap_or(what)
}

/// An error for programs (`--json`).
fn print_error(error: &str) {
    let _ = writeln!(stdout(), "{}", serde_json::json!({ "error": error }));
}
