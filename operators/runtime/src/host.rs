//! The main of a program that hosts one stage.

use std::process::ExitCode;

use crate::pipe::{self, DRIVER, DRIVER_VARIABLE};
use crate::{Operator, Registration, realtime};

/// Why a program could not host its stage to the end.
#[derive(Debug, thiserror::Error)]
pub enum HostError {
    /// `REALO_DRIVER` names no driver.
    #[error("{DRIVER_VARIABLE}: expected `{DRIVER}`, or nothing for dora, found `{0}`")]
    Driver(String),
    /// On dora.
    #[error(transparent)]
    Realtime(#[from] realtime::HostError),
    /// Over pipes.
    #[error("{name}: {reason}")]
    Pipe {
        /// The operator's name.
        name: &'static str,
        /// What went wrong.
        reason: String,
    },
}

/// The whole `main` of a plug-in: hosts an operator with the arguments of the command line (`key=value`, as in the
/// graph), on dora or, with `REALO_DRIVER=pipe`, for a run in virtual time.
///
/// ```no_run
/// # use realo_runtime::{Argument, Describe, Error, Operator, Outputs, Port, PortId};
/// # struct Mine;
/// # impl Describe for Mine {
/// #     type Config = std::collections::BTreeMap<String, String>;
/// #     const NAME: &'static str = "mine";
/// #     const ABOUT: &'static str = "";
/// #     const ARGUMENTS: &'static [Argument] = &[];
/// #     const INPUTS: &'static [Port] = &[];
/// #     const OUTPUTS: &'static [Port] = &[];
/// # }
/// # impl Operator for Mine {
/// #     fn new(_: Self::Config) -> Result<Self, Error> { Ok(Mine) }
/// #     fn on_input(&mut self, _: PortId, _: realo_schemas::Message, _: &mut Outputs) -> Result<(), Error> { Ok(()) }
/// # }
/// fn main() -> std::process::ExitCode {
///     realo_runtime::run::<Mine>()
/// }
/// ```
///
/// An error is printed on standard error and gives the exit code 1, a panic 101.
pub fn run<O: Operator + Send + 'static>() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    match host(const { &Registration::operator::<O>() }, &args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("realo: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Hosts a stage until its streams end; `REALO_DRIVER` says for which driver.
///
/// # Errors
/// [`HostError`]; the caller ends the process with a code other than 0, so that the run fails.
pub fn host(registration: &'static Registration, args: &[String]) -> Result<(), HostError> {
    // A panic that only unwinds this thread would look like a normal end to the nodes below.
    let print = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        print(panic);
        std::process::exit(101);
    }));
    match std::env::var(DRIVER_VARIABLE).as_deref() {
        Err(_) | Ok("") => Ok(realtime::run(registration, args)?),
        Ok(DRIVER) => piped(registration, args),
        Ok(other) => Err(HostError::Driver(other.into())),
    }
}

fn piped(registration: &'static Registration, args: &[String]) -> Result<(), HostError> {
    let built = (registration.build)(args).map_err(|error| error.to_string());
    let served = built.and_then(|built| {
        let (calls, replies) = (std::io::stdin().lock(), std::io::stdout().lock());
        pipe::serve(registration, built, calls, std::io::BufWriter::new(replies))
    });
    served.map_err(|reason| HostError::Pipe {
        name: registration.name,
        reason,
    })
}
