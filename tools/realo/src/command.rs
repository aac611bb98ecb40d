use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};
use realo_cli::Outcome;
use realo_cli::program::{self, Elsewhere};
use realo_operator::Registration;

use crate::{
    compare, doctor, evaluate, graph, host, info, keys, latency, map, merge, new, operators, precompute, registry,
    render, report, run, sweep, validate,
};

/// What the workbench does, for who asks this program for it.
const LAB: Elsewhere = Elsewhere {
    program: "realo-lab",
    package: "realo-lab",
    commands: &[
        "simulate",
        "train",
        "quantize",
        "checkpoint",
        "import",
        "conformance",
        "bench",
        "emulate",
        "measure",
    ],
};

/// Online cooperative perception for vehicles and roadside units, on dora
#[derive(Parser)]
#[command(name = "realo", version, disable_help_subcommand = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Run(run::Args),
    Sweep(sweep::Args),
    Compare(compare::Args),
    Evaluate(evaluate::Args),
    Report(report::Args),
    Render(render::Args),
    Graph(graph::Args),
    Precompute(precompute::Args),
    Info(info::Args),
    Merge(merge::Args),
    Map(map::Args),
    Validate(validate::Args),
    New(new::Args),
    Operators(operators::Args),
    Keys(keys::Args),
    Latency(latency::Args),
    #[command(hide = true)]
    Tethered(run::TetheredArgs),
    Doctor(doctor::Args),
    Operator(host::OperatorArgs),
    Node(host::NodeArgs),
    Program(host::ProgramArgs),
    Host(host::ModuleArgs),
    /// Prints all commands as Markdown
    #[command(hide = true)]
    CliReference,
}

/// All commands, with their arguments.
pub fn command_line() -> clap::Command {
    Cli::command()
}

/// The whole `main` of a binary that hosts everything of realo and operators of its own:
///
/// ```no_run
/// # mod mine { pub use realo_stages::Nms as Mine; }
/// # use mine::Mine;
/// fn main() -> std::process::ExitCode {
///     realo::main_with(&[realo_operator::Registration::operator::<Mine>()])
/// }
/// ```
///
/// Graphs name the binary by their `path: bin/realo`: build it under that name, or let `dataflows/bin/realo` lead to it.
/// With `default-features = false` it compiles no simulator, and makes no demo log.
pub fn main_with(own: &[Registration]) -> ExitCode {
    registry::register(own);
    program::begin("realo");
    let cli: Cli = program::parse(&LAB);
    program::end(match cli.command {
        Command::Run(args) => run::main(&args),
        Command::Sweep(args) => sweep::main(&args),
        Command::Compare(args) => compare::main(&args),
        Command::Evaluate(args) => evaluate::main(&args),
        Command::Report(args) => report::main(&args),
        Command::Render(args) => render::main(&args),
        Command::Graph(args) => graph::main(&args),
        Command::Merge(args) => merge::main(&args),
        Command::Map(args) => map::main(&args),
        Command::Precompute(args) => precompute::main(&args),
        Command::Info(args) => info::main(&args),
        Command::Validate(args) => validate::main(&args),
        Command::New(args) => new::main(&args),
        Command::Operators(args) => operators::main(&args),
        Command::Keys(args) => keys::main(&args),
        Command::Latency(args) => latency::main(&args),
        Command::Tethered(args) => run::tethered(&args),
        Command::Doctor(args) => doctor::main(&args),
        Command::Operator(args) => host::operator(&args),
        Command::Node(args) => host::node(&args),
        Command::Program(args) => host::program(&args),
        Command::Host(args) => host::module(&args),
        Command::CliReference => {
            print!("{}{}", realo_cli::HEAD, realo_cli::markdown(command_line()));
            Ok(Outcome::Complete)
        }
    })
}
