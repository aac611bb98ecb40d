//! `realo doctor`: whether this machine can do what is asked of it.

use std::path::PathBuf;

use eyre::Result;
use realo_graph::FlatGraph;

use crate::Outcome;
use crate::run::{Check, checks, dora_on_this_machine};

/// Looks at this machine: shared memory, file descriptors, network, dora, processor
#[derive(clap::Args)]
pub struct Args {
    /// Graph that is to run
    graph: Option<PathBuf>,
}

/// Prints what was found, a line for each thing.
pub fn main(args: &Args) -> Result<Outcome> {
    let graph = match &args.graph {
        Some(file) => Some(FlatGraph::load(file)?),
        None => None,
    };
    let mut all = checks(graph.as_ref());
    all.push(dora());
    all.push(processor());
    let mut outcome = Outcome::Complete;
    for Check { what, found } in all {
        match found {
            Ok(found) => println!("ok   {what}: {found}"),
            Err(reason) => {
                println!("FAIL {what}: {reason}");
                outcome = Outcome::Failed;
            }
        }
    }
    Ok(outcome)
}

fn dora() -> Check {
    Check {
        what: "dora",
        found: dora_on_this_machine(),
    }
}

fn processor() -> Check {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let known: Vec<String> = realo_nn::conv::Isa::ALL
        .iter()
        .filter(|isa| isa.is_available())
        .map(|isa| isa.to_string())
        .collect();
    Check {
        what: "processor",
        found: Ok(format!(
            "{cores} cores; kernels {}; a graph's detectors need about a core for each lane at 10 Hz, and a run that does not \
             keep up says which stage holds it up",
            known.join(", ")
        )),
    }
}
