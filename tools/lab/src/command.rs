use std::ffi::OsString;
use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};
use eyre::Result;
use realo_cli::Outcome;
use realo_cli::program::{self, Elsewhere};

use crate::{
    bench, checkpoint, conformance, emulate, export, import, measure, paper, quantize, score, simulate, train,
};

/// What the car's program does, for who asks this one for it.
const CAR: Elsewhere = Elsewhere {
    program: "realo",
    package: "realo",
    commands: &[
        "run",
        "compare",
        "evaluate",
        "render",
        "precompute",
        "info",
        "merge",
        "validate",
        "new",
        "operators",
        "keys",
        "latency",
        "doctor",
        "operator",
        "node",
        "program",
        "host",
    ],
};

/// The workbench of realo: makes logs, weights and measurements
#[derive(Parser)]
#[command(name = "realo-lab", version, disable_help_subcommand = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Simulate(simulate::Args),
    Train(train::Args),
    Score(score::Args),
    Quantize(quantize::Args),
    Checkpoint(checkpoint::Args),
    Import(import::Args),
    Export(export::Args),
    Conformance(conformance::Args),
    Bench(bench::Args),
    Emulate(emulate::Args),
    Measure(measure::Args),
    Paper(paper::Args),
    #[command(hide = true)]
    RadioEnd(bench::radio::End),
    /// Prints all commands as Markdown
    #[command(hide = true)]
    CliReference,
}

impl Command {
    fn run(&self) -> Result<Outcome> {
        match self {
            Command::Simulate(args) => simulate::main(args),
            Command::Train(args) => train::main(args),
            Command::Score(args) => score::main(args),
            Command::Quantize(args) => quantize::main(args),
            Command::Checkpoint(args) => checkpoint::main(args),
            Command::Import(args) => import::main(args),
            Command::Export(args) => export::main(args),
            Command::Conformance(args) => conformance::main(args),
            Command::Bench(args) => bench::main(args),
            Command::Emulate(args) => emulate::main(args),
            Command::Paper(args) => paper::main(args),
            Command::Measure(args) => measure::main(args).map(|()| Outcome::Complete),
            Command::RadioEnd(args) => bench::radio::end(args),
            Command::CliReference => {
                print!("{}", realo_cli::markdown(command_line()));
                Ok(Outcome::Complete)
            }
        }
    }
}

/// All commands, with their arguments.
pub fn command_line() -> clap::Command {
    Cli::command()
}

/// Runs a command in this process, as tests need it; `words` begin with its name.
///
/// # Errors
/// Words that are no command; why the command failed.
pub fn run<S: Into<OsString>>(words: impl IntoIterator<Item = S>) -> Result<Outcome> {
    let program = std::iter::once(OsString::from("realo-lab"));
    let cli = Cli::try_parse_from(program.chain(words.into_iter().map(Into::into)))?;
    cli.command.run()
}

/// The whole `main` of the program.
pub fn main() -> ExitCode {
    program::begin("realo-lab");
    let cli: Cli = program::parse(&CAR);
    program::end(cli.command.run())
}
