//! The main of a plug-in.

use std::process::ExitCode;

use crate::pipe::{self, DRIVER, DRIVER_VARIABLE, MEMORY_VARIABLE, frame, hello, memory};
use crate::{Built, KnownMap, Operator, Registration};

/// The whole `main` of a plug-in: serves an operator with the settings of the command line (`key=value`, as in the
/// graph) to the host that started the program.
///
/// ```no_run
/// # use realo_operator::{Describe, Error, NoInput, NoOutput, Operator, Outputs, Settings};
/// # #[derive(Settings, serde::Serialize, serde::Deserialize)]
/// # struct Nothing {}
/// # type Settings = Nothing;
/// # type Input = NoInput;
/// # type Output = NoOutput;
/// /// Does nothing.
/// #[derive(Describe)]
/// struct Mine;
/// # impl Operator for Mine {
/// #     fn build(_: Nothing) -> Result<Self, Error> { Ok(Mine) }
/// #     fn on_input(&mut self, _: NoInput, _: &mut Outputs<NoOutput>) -> Result<(), Error> { Ok(()) }
/// # }
/// fn main() -> std::process::ExitCode {
///     realo_operator::run::<Mine>()
/// }
/// ```
///
/// An error gives the exit code 1, a panic 101. The host says why a program refuses its settings; other errors are printed on standard
/// error.
pub fn run<O: Operator + Send + 'static>() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    run_as(const { &Registration::operator::<O>() }, &args)
}

/// As [`run`], of any role that a program may have ([`Registration::source_program`], [`Registration::sink_program`]) and with these
/// settings.
pub fn run_as(registration: &'static Registration, args: &[String]) -> ExitCode {
    let served = match build(registration, args) {
        Ok((maps, built)) => serve(registration, built, &maps),
        Err(reason) if has_host() && refuse(registration, &reason).is_ok() => return ExitCode::FAILURE,
        Err(reason) => Err(reason),
    };
    match served {
        Ok(()) => ExitCode::SUCCESS,
        Err(reason) => {
            eprintln!("{}: {reason}", registration.name);
            ExitCode::FAILURE
        }
    }
}

fn has_host() -> bool {
    std::env::var(DRIVER_VARIABLE).as_deref() == Ok(DRIVER)
}

/// Maps of a stage by its ports, and the stage.
type BuiltWithMaps = (Vec<(&'static str, KnownMap)>, Built);

fn build(registration: &'static Registration, args: &[String]) -> Result<BuiltWithMaps, String> {
    if !has_host() {
        let program = std::env::args().next().unwrap_or_default();
        return Err(format!(
            "a plug-in, which a graph starts: give a node `path: bin/realo` and `args: program {program}`"
        ));
    }
    // What a stage loads for its sizes, it need not load again where it is built.
    let maps = (registration.maps)(args);
    let built = (registration.build)(args).map_err(|error| error.to_string())?;
    Ok((maps, built))
}

/// Says to the host why there is no stage.
fn refuse(registration: &Registration, reason: &str) -> Result<(), String> {
    let parts = hello::write_refusal(registration.name, reason)?;
    frame::write_first(&mut std::io::stdout().lock(), &parts).map_err(|error| error.to_string())
}

fn serve(registration: &'static Registration, built: Built, maps: &[(&str, KnownMap)]) -> Result<(), String> {
    let (calls, replies) = (std::io::stdin().lock(), std::io::stdout().lock());
    let shares = std::env::var(MEMORY_VARIABLE).is_ok_and(|probe| memory::reaches(&probe));
    let replies = std::io::BufWriter::new(replies);
    pipe::serve(registration, built, maps, calls, replies, shares)
}
