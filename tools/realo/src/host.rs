//! `realo operator` and `realo node`: what dora starts.

use eyre::{Result, eyre};
use realo_runtime::{Registration, realtime};

use crate::{Outcome, REGISTRY, demo};

/// Hosts an operator as a dora node (dora starts this)
#[derive(clap::Args)]
pub struct OperatorArgs {
    /// Name; `realo operators` lists them
    name: String,
    /// key=value
    args: Vec<String>,
}

/// Hosts a source or sink as a dora node (dora starts this)
#[derive(clap::Args)]
pub struct NodeArgs {
    /// Name; `realo operators` lists them
    name: String,
    /// key=value
    args: Vec<String>,
}

/// Hosts an operator until its streams end.
pub fn operator(args: &OperatorArgs) -> Result<Outcome> {
    host(
        REGISTRY.find("operator", &args.name).map_err(|error| eyre!(error))?,
        &args.args,
    )
}

/// Hosts a source or sink until its streams end.
pub fn node(args: &NodeArgs) -> Result<Outcome> {
    let registration = REGISTRY.find("node", &args.name).map_err(|error| eyre!(error))?;
    if registration.name == "player" {
        demo::make_if_missing(&args.args)?;
    }
    host(registration, &args.args)
}

fn host(registration: &'static Registration, args: &[String]) -> Result<Outcome> {
    // A panic that only unwinds this thread would look like a normal end to the nodes below.
    let print = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        print(panic);
        std::process::exit(101);
    }));
    realtime::run(registration, args)?;
    Ok(Outcome::Complete)
}
