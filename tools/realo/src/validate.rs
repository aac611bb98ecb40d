//! `realo validate`: what dora does not check.

use std::path::PathBuf;

use eyre::Result;
use realo_runtime::graph::{self, FlatGraph, Severity};

use crate::{Outcome, REGISTRY};

/// Checks graphs beyond what `dora validate` does, and says how to mend them
#[derive(clap::Args)]
pub struct Args {
    /// Dataflow files
    #[arg(required = true)]
    graphs: Vec<PathBuf>,
}

/// Prints the findings of each graph; errors fail.
pub fn main(args: &Args) -> Result<Outcome> {
    let mut outcome = Outcome::Complete;
    for path in &args.graphs {
        let findings = graph::validate(&FlatGraph::load(path)?, &REGISTRY);
        for finding in &findings {
            println!("{}: {finding}", path.display());
        }
        if findings.iter().any(|finding| finding.severity == Severity::Error) {
            outcome = Outcome::Failed;
        } else if findings.is_empty() {
            println!("{}: fine", path.display());
        } else {
            println!("{}: can run, see above", path.display());
        }
    }
    Ok(outcome)
}
