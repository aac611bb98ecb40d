//! `realo-lab conformance`: test vectors through the code that the graphs run.

use std::path::PathBuf;

use eyre::Result;
use realo_cli::Outcome;

/// Runs every conformance vector of a folder through the code that the graphs run
#[derive(clap::Args)]
pub struct Args {
    /// Folder with `manifest.json`
    dir: PathBuf,
}

/// Prints a line for each vector; 0 all passed, 1 a failure or nothing ran, 3 some not supported.
pub fn main(args: &Args) -> Result<Outcome> {
    let results = realo_conformance::run(&args.dir);
    for result in &results {
        println!("{result}");
    }
    Ok(match realo_conformance::exit_code(&results) {
        0 => Outcome::Complete,
        3 => Outcome::Partial,
        _ => Outcome::Failed,
    })
}
