//! How a program begins, reads its command line and ends; and the program beside it.

use std::any::TypeId;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::OnceLock;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{CommandFactory, FromArgMatches};
use eyre::{Result, bail};
use realo_operator::config::nearest_name;

use crate::Outcome;

/// The commands of a program that another one has.
#[derive(Clone, Copy)]
pub struct Elsewhere {
    /// The name of the other program, and of its package.
    pub program: &'static str,
    /// How the package is called.
    pub package: &'static str,
    /// The commands.
    pub commands: &'static [&'static str],
}

/// The name of this program.
static NAME: OnceLock<&str> = OnceLock::new();

/// The program's name, with which its messages begin.
pub fn name() -> &'static str {
    NAME.get().copied().unwrap_or("realo")
}

/// Prepares the process of the program `own`: whoever reads what it prints may stop, and a full disk is an error as others
/// are.
pub fn begin(own: &'static str) {
    // Nobody begins twice.
    let _ = NAME.set(own);
    // A file that grows beyond the limit of the process is an error of whoever writes it, as on a full disk.
    let beyond = std::sync::Arc::default();
    if let Err(error) = signal_hook::flag::register(signal_hook::consts::SIGXFSZ, beyond) {
        eprintln!(
            "{}: cannot handle SIGXFSZ ({error}): a file above `ulimit -f` would end this program without a message",
            name()
        );
    }
    let usual = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        // Whoever reads what we print may stop whenever he likes (`realo info LOG | head`).
        let text = panic.payload_as_str().unwrap_or_default();
        if text.starts_with("failed printing to") {
            if !text.contains("Broken pipe") {
                // Where even this cannot be written, the code says it.
                let _ = writeln!(std::io::stderr(), "{}: {text}", name());
            }
            std::process::exit(Outcome::Failed.exit_code().into());
        }
        // What a plug-in sends may panic where it is read; that is caught, and reported as an error of the plug-in.
        if !realo_operator::pipe::is_reading() {
            usual(panic);
        }
    }));
}

/// Reads the command line, or ends the program with what is wrong with it.
pub fn parse<P: CommandFactory + FromArgMatches>(elsewhere: &Elsewhere) -> P {
    let command = with_negative_numbers(P::command());
    let words: Vec<String> = std::env::args_os()
        .skip(1)
        .map(|word| word.to_string_lossy().into_owned())
        .collect();
    let known = command.clone();
    let matches = command.try_get_matches().unwrap_or_else(|error| {
        let other = called_beside(elsewhere.program);
        let other = beside(elsewhere.program).is_ok().then_some(other);
        let said = said_of(&error, &known, elsewhere, &words, other.as_deref());
        if let Some(said) = said.or_else(|| said_of_kinds(&error, &known, &words)) {
            eprintln!("{said}");
            // As clap ends.
            std::process::exit(2);
        }
        error.exit()
    });
    P::from_arg_matches(&matches).unwrap_or_else(|error| error.exit())
}

/// Where a command is that this program does not have: of the other program, or one of its that has a similar name. `words` are
/// those of the command line, `other` is the other program as it is called, where it is built.
fn said_of(
    error: &clap::Error,
    own: &clap::Command,
    elsewhere: &Elsewhere,
    words: &[String],
    other: Option<&str>,
) -> Option<String> {
    let ContextValue::String(command) = error.get(ContextKind::InvalidSubcommand)? else {
        return None;
    };
    if error.kind() != ErrorKind::InvalidSubcommand {
        return None;
    }
    let Elsewhere {
        program,
        package,
        commands,
    } = elsewhere;
    let own_name = own.get_name();
    let shown = own.get_subcommands().filter(|known| !known.is_hide_set());
    let known = shown.map(clap::Command::get_name).chain(commands.iter().copied());
    let nearest = nearest_name(command, known)?;
    if !commands.contains(&&*nearest) {
        return None;
    }
    let words: Vec<String> = words
        .iter()
        .map(|word| quoted(if word == command { &nearest } else { word }))
        .collect();
    let line = format!("{} {}", other.unwrap_or(program), words.join(" "));
    let what = match nearest == *command {
        true => format!("{own_name}: `{command}` is a command of `{program}`"),
        false => format!("{own_name}: there is no command `{command}`; `{program}` has `{nearest}`"),
    };
    Some(match other {
        Some(_) => format!("{what}: run it: {line}"),
        None => format!("{what}: build it by `cargo build --release -p {package}`, then run it: {line}"),
    })
}

/// What there is instead of a command that a command of this program does not have, as a kind of data set.
fn said_of_kinds(error: &clap::Error, own: &clap::Command, words: &[String]) -> Option<String> {
    let ContextValue::String(wrong) = error.get(ContextKind::InvalidSubcommand)? else {
        return None;
    };
    let (mut at, mut path) = (own, Vec::new());
    for word in words.iter().take_while(|word| *word != wrong) {
        if let Some(next) = at.find_subcommand(word) {
            at = next;
            path.push(word.as_str());
        }
    }
    let shown = at.get_subcommands().filter(|known| !known.is_hide_set());
    let names: Vec<&str> = shown
        .map(clap::Command::get_name)
        .filter(|name| *name != "help")
        .collect();
    // Of the program's own commands, clap's words say where they are listed.
    if path.is_empty() || names.is_empty() {
        return None;
    }
    let (own, path) = (own.get_name(), path.join(" "));
    // Any short name is like any other by its length alone.
    let begins_alike = |near: &String| near.chars().next() == wrong.chars().next();
    let nearest = nearest_name(wrong, names.iter().copied()).filter(begins_alike);
    let nearest = nearest.map_or(String::new(), |nearest| format!("; did you mean `{nearest}`?"));
    Some(format!(
        "{own}: {path}: expected one of {}, found `{}`{nearest}\n`{} {path} --help` says what each is",
        names.join(", "),
        wrong.escape_debug(),
        called(),
    ))
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

/// Says what went wrong, and gives the exit code of a command.
pub fn end(outcome: Result<Outcome>) -> ExitCode {
    let code = outcome.map(Outcome::exit_code).unwrap_or_else(|error| {
        eprintln!("{}: {error:#}{}", name(), without_folder());
        Outcome::Failed.exit_code()
    });
    ExitCode::from(code)
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

/// This program as it was called, for commands that are printed: a name on `PATH`, or a path, quoted as a shell takes it.
/// `cargo run` calls it by a path.
pub fn called() -> String {
    let called = std::env::args_os().next();
    quoted(&called.map_or_else(|| "realo".into(), |program| program.to_string_lossy().into_owned()))
}

/// Another program of realo, for commands that are printed: where this one was called by a path, the one beside it.
pub fn called_beside(name: &str) -> String {
    let called = std::env::args_os().next();
    quoted(
        &Path::new(&called.unwrap_or_default())
            .with_file_name(name)
            .to_string_lossy(),
    )
}

/// The text as a shell takes it.
pub fn quoted(text: &str) -> String {
    realo_logs::shell::quoted(text)
}

/// The file of another program of realo, which lies beside this one.
///
/// # Errors
/// It is not there; with the command that builds it.
pub fn beside(name: &str) -> Result<PathBuf> {
    let path = std::env::current_exe()?.with_file_name(name);
    if !path.is_file() {
        bail!(
            "{}: expected the program `{name}` beside this one, found none: build it by `cargo build --release -p {name}`",
            path.display()
        );
    }
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAB: Elsewhere = Elsewhere {
        program: "realo-lab",
        package: "realo-lab",
        commands: &["train"],
    };

    #[test]
    fn a_command_of_the_other_program_is_named_with_what_runs_or_builds_it() {
        let own = clap::Command::new("realo").subcommands(["run", "render"].map(clap::Command::new));
        let said = |words: &str, other| {
            let words: Vec<String> = shlex::split(words).unwrap();
            let error = own.clone().try_get_matches_from(&words).unwrap_err();
            said_of(&error, &own, &LAB, &words[1..], other)
        };
        assert_eq!(
            said("realo train --steps 3 -o 'a b'", Some("target/release/realo-lab")).unwrap(),
            "realo: `train` is a command of `realo-lab`: run it: target/release/realo-lab train --steps 3 -o 'a b'"
        );
        assert_eq!(
            said("realo train --help", None).unwrap(),
            "realo: `train` is a command of `realo-lab`: build it by `cargo build --release -p realo-lab`, then run it: realo-lab train \
             --help"
        );
        assert_eq!(
            said("realo trane --steps 3", Some("realo-lab")).unwrap(),
            "realo: there is no command `trane`; `realo-lab` has `train`: run it: realo-lab train --steps 3"
        );
        for ours in ["realo rnder", "realo nothing-like-it", "realo run --train"] {
            assert_eq!(said(ours, None), None, "{ours}");
        }
    }

    #[test]
    fn a_kind_that_is_not_there_is_answered_with_those_that_are() {
        let kinds = ["opv2v", "kitti"].map(clap::Command::new);
        let own = clap::Command::new("realo").subcommand(clap::Command::new("export").subcommands(kinds));
        let said = |words: &[&str]| {
            let error = own.clone().try_get_matches_from(words).unwrap_err();
            let words: Vec<String> = words[1..].iter().map(ToString::to_string).collect();
            said_of_kinds(&error, &own, &words)
        };
        let near = said(&["realo", "export", "kiti", "a.mcap", "-o", "b"]).unwrap();
        let expected = "realo: export: expected one of opv2v, kitti, found `kiti`; did you mean `kitti`?\n";
        assert!(
            near.starts_with(expected) && near.ends_with(" export --help` says what each is"),
            "{near}"
        );
        for far in ["nuscenes", "vitti"] {
            let said = said(&["realo", "export", far, "a.mcap"]).unwrap();
            assert!(said.contains(&format!("found `{far}`\n")), "{said}");
        }
        assert_eq!(said(&["realo", "nothing"]), None);
        assert_eq!(said(&["realo", "export", "kitti", "--nothing"]), None);
    }

    #[test]
    fn a_message_says_how_to_build_a_program_that_is_not_beside_this_one() {
        let said = beside("realo-nowhere").unwrap_err().to_string();
        assert!(said.contains("cargo build --release -p realo-nowhere"), "{said}");
    }

    #[test]
    fn negative_numbers_are_numbers() {
        let value = clap::Arg::new("value").value_parser(clap::value_parser!(f64));
        let command = with_negative_numbers(clap::Command::new("realo").arg(value));
        let found = command.try_get_matches_from(["realo", "-3"]).unwrap();
        assert_eq!(found.get_one::<f64>("value"), Some(&-3.0));
    }
}
