//! `realo info`: what a log holds.

use std::path::PathBuf;

use eyre::Result;

use crate::Outcome;

/// Describes a log
#[derive(clap::Args)]
pub struct Args {
    /// MCAP files
    #[arg(required = true)]
    logs: Vec<PathBuf>,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Prints a description of each log; a truncated one is reported and ends with 3.
pub fn main(args: &Args) -> Result<Outcome> {
    let mut outcome = Outcome::Complete;
    for path in &args.logs {
        let description = realo_logs::describe(path)?;
        if args.json {
            println!("{}", serde_json::to_string_pretty(&description)?);
        } else {
            println!("{description}");
        }
        if description.truncated.is_some() {
            outcome = Outcome::Partial;
        }
    }
    Ok(outcome)
}
