use std::any::TypeId;
use std::io::Write;
use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use realo_operator::Registration;

use crate::{
    Outcome, bench, checkpoint, compare, conformance, doctor, emulate, evaluate, host, import, info, keys, latency,
    merge, new, operators, precompute, quantize, registry, render, run, simulate, train, validate,
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
    Compare(compare::Args),
    Evaluate(evaluate::Args),
    Render(render::Args),
    Precompute(precompute::Args),
    Simulate(simulate::Args),
    Train(train::Args),
    Quantize(quantize::Args),
    Checkpoint(checkpoint::Args),
    Import(import::Args),
    Info(info::Args),
    Merge(merge::Args),
    Validate(validate::Args),
    New(new::Args),
    Operators(operators::Args),
    Conformance(conformance::Args),
    Bench(bench::Args),
    Emulate(emulate::Args),
    Keys(keys::Args),
    Latency(latency::Args),
    #[command(hide = true)]
    RadioEnd(bench::radio::End),
    #[command(hide = true)]
    Tethered(run::TetheredArgs),
    Doctor(doctor::Args),
    Operator(host::OperatorArgs),
    Node(host::NodeArgs),
    Program(host::ProgramArgs),
    Host(host::ModuleArgs),
}

/// Lets options that take numbers take negative ones, so that whoever checks their range reports it.
fn with_negative_numbers(command: clap::Command) -> clap::Command {
    let numbers = [
        TypeId::of::<f64>(),
        TypeId::of::<f32>(),
        TypeId::of::<u16>(),
        TypeId::of::<u32>(),
        TypeId::of::<u64>(),
        TypeId::of::<usize>(),
    ];
    let command = command.mut_args(|arg| {
        let kind = arg.get_value_parser().type_id();
        match numbers.iter().any(|number| kind == *number) {
            true => arg.allow_negative_numbers(true),
            false => arg,
        }
    });
    command.mut_subcommands(with_negative_numbers)
}

/// This program as it was called, for commands that are printed: a name on `PATH`, or a path, quoted as a shell takes it.
/// `cargo run` calls it by a path.
pub(crate) fn called() -> String {
    let called = std::env::args_os().next();
    let called = called.map_or_else(|| "realo".into(), |program| program.to_string_lossy().into_owned());
    shlex::try_quote(&called).map_or_else(|_| called.clone(), |quoted| quoted.into_owned())
}

/// What explains an error where the current folder was removed; else nothing.
fn without_folder() -> String {
    let is_there = std::env::current_dir().is_ok();
    let named = std::env::var("PWD").map_or_else(|_| String::new(), |folder| format!(", {folder},"));
    match is_there {
        true => String::new(),
        false => format!("; the current folder{named} is not there any more: change to another one"),
    }
}

/// The whole `main` of a binary that hosts everything of realo and operators of its own:
///
/// ```no_run
/// # mod mine { pub use realo_nms::Nms as Mine; }
/// # use mine::Mine;
/// fn main() -> std::process::ExitCode {
///     realo::main_with(&[realo_operator::Registration::operator::<Mine>()])
/// }
/// ```
///
/// Graphs name the binary by their `path: bin/realo`: build it under that name, or let `dataflows/bin/realo` lead to it.
pub fn main_with(own: &[Registration]) -> ExitCode {
    registry::register(own);
    // A file that grows beyond the limit of the process is an error of whoever writes it, as on a full disk.
    let beyond = std::sync::Arc::default();
    if let Err(error) = signal_hook::flag::register(signal_hook::consts::SIGXFSZ, beyond) {
        eprintln!(
            "realo: cannot handle SIGXFSZ ({error}): a file above `ulimit -f` would end this program without a message"
        );
    }
    let usual = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        // Whoever reads what we print may stop whenever he likes (`realo info LOG | head`).
        let text = panic.payload_as_str().unwrap_or_default();
        if text.starts_with("failed printing to") {
            if !text.contains("Broken pipe") {
                // Where even this cannot be written, the code says it.
                let _ = writeln!(std::io::stderr(), "realo: {text}");
            }
            std::process::exit(Outcome::Failed.exit_code().into());
        }
        // What a plug-in sends may panic where it is read; that is caught, and reported as an error of the plug-in.
        if !realo_operator::pipe::is_reading() {
            usual(panic);
        }
    }));
    let mut matches = with_negative_numbers(Cli::command()).get_matches();
    let cli = Cli::from_arg_matches_mut(&mut matches).unwrap_or_else(|error| error.exit());
    let outcome = match cli.command {
        Command::Run(args) => run::main(&args),
        Command::Compare(args) => compare::main(&args),
        Command::Evaluate(args) => evaluate::main(&args),
        Command::Render(args) => render::main(&args),
        Command::Merge(args) => merge::main(&args),
        Command::Precompute(args) => precompute::main(&args),
        Command::Simulate(args) => simulate::main(&args),
        Command::Train(args) => train::main(&args),
        Command::Quantize(args) => quantize::main(&args),
        Command::Checkpoint(args) => checkpoint::main(&args),
        Command::Import(args) => import::main(&args),
        Command::Info(args) => info::main(&args),
        Command::Validate(args) => validate::main(&args),
        Command::New(args) => new::main(&args),
        Command::Operators(args) => operators::main(&args),
        Command::Conformance(args) => conformance::main(&args),
        Command::Bench(args) => bench::main(&args),
        Command::Emulate(args) => emulate::main(&args),
        Command::Keys(args) => keys::main(&args),
        Command::Latency(args) => latency::main(&args),
        Command::RadioEnd(args) => bench::radio::end(&args),
        Command::Tethered(args) => run::tethered(&args),
        Command::Doctor(args) => doctor::main(&args),
        Command::Operator(args) => host::operator(&args),
        Command::Node(args) => host::node(&args),
        Command::Program(args) => host::program(&args),
        Command::Host(args) => host::module(&args),
    };
    let code = outcome.map(Outcome::exit_code).unwrap_or_else(|error| {
        eprintln!("realo: {error:#}{}", without_folder());
        Outcome::Failed.exit_code()
    });
    ExitCode::from(code)
}
