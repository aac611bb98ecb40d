//! `realo info`: what a log or a recording holds.

use std::path::PathBuf;

use eyre::Result;

use crate::Outcome;

/// Describes a log, or a recording of a run
#[derive(clap::Args)]
pub struct Args {
    /// MCAP files
    #[arg(required = true)]
    logs: Vec<PathBuf>,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Prints a description of each file; one that is truncated or has problems is reported and ends with 3.
pub fn main(args: &Args) -> Result<Outcome> {
    let mut outcome = Outcome::Complete;
    for path in &args.logs {
        let described = realo_logs::describe_any(path)?;
        if args.json {
            println!("{}", serde_json::to_string_pretty(&described)?);
        } else {
            println!("{described}");
        }
        if described.truncated().is_some() || !described.problems().is_empty() {
            outcome = Outcome::Partial;
        }
    }
    Ok(outcome)
}
