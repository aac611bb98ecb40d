//! The main of a plug-in.

use std::process::ExitCode;

use crate::pipe::{self, DRIVER, DRIVER_VARIABLE, MEMORY_VARIABLE, memory};
use crate::{Operator, Registration};

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
/// An error is printed on standard error and gives the exit code 1, a panic 101.
pub fn run<O: Operator + Send + 'static>() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    run_as(const { &Registration::operator::<O>() }, &args)
}

/// As [`run`], of any role that a program may have ([`Registration::source_program`], [`Registration::sink_program`]) and with these
/// settings.
pub fn run_as(registration: &'static Registration, args: &[String]) -> ExitCode {
    match serve(registration, args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(reason) => {
            eprintln!("{}: {reason}", registration.name);
            ExitCode::FAILURE
        }
    }
}

fn serve(registration: &'static Registration, args: &[String]) -> Result<(), String> {
    if std::env::var(DRIVER_VARIABLE).as_deref() != Ok(DRIVER) {
        let program = std::env::args().next().unwrap_or_default();
        return Err(format!(
            "a plug-in, which a graph starts: give a node `path: bin/realo` and `args: program {program}`"
        ));
    }
    // What a stage loads for its sizes, it need not load again where it is built.
    let maps = (registration.maps)(args);
    let built = (registration.build)(args).map_err(|error| error.to_string())?;
    let (calls, replies) = (std::io::stdin().lock(), std::io::stdout().lock());
    let shares = std::env::var(MEMORY_VARIABLE).is_ok_and(|probe| memory::reaches(&probe));
    let replies = std::io::BufWriter::new(replies);
    pipe::serve(registration, built, &maps, calls, replies, shares)
}
