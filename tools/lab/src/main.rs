//! `realo-lab`: see `realo-lab --help`.

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// The workbench of realo: makes logs, weights and measurements
#[derive(Parser)]
#[command(name = "realo-lab", version, disable_help_subcommand = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Measure(realo_lab::measure::Args),
}

fn main() -> ExitCode {
    let Command::Measure(args) = Cli::parse().command;
    match realo_lab::measure::main(&args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("realo-lab: {error:#}");
            ExitCode::FAILURE
        }
    }
}
