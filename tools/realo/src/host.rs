//! `realo operator` and `realo node`: what dora starts.

use eyre::{Result, eyre};
use realo_runtime::Registration;

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
    realo_runtime::host(registration, args)?;
    Ok(Outcome::Complete)
}
