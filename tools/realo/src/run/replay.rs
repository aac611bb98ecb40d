//! Runs in virtual time.

use eyre::{Result, WrapErr, eyre};
use rayon::prelude::*;
use realo_runtime::graph::FlatGraph;
use realo_runtime::{Books, ComputeProfile, Wiring, virtual_time};

use super::prepare::Cell;
use crate::REGISTRY;
use crate::simulate::progress;

/// Runs all cells, several at a time; they do not know of each other.
pub fn all(cells: &[Cell]) -> Result<()> {
    let bar = progress(cells.len() as u64, "replaying");
    let done: Vec<Result<()>> = cells
        .par_iter()
        .map(|cell| {
            replay(&cell.graph, &cell.compute, &mut |_, _, _| {}).wrap_err_with(|| cell.name.clone())?;
            bar.inc(1);
            Ok(())
        })
        .collect();
    bar.finish_and_clear();
    done.into_iter().collect()
}

/// Runs a graph in virtual time; `observer` sees every message that a node sends.
///
/// # Errors
/// A graph that virtual time cannot run; the node that failed.
pub fn replay(graph: &FlatGraph, compute: &ComputeProfile, observer: virtual_time::Observer) -> Result<Books> {
    let wiring = Wiring::of(graph, &REGISTRY).map_err(|error| eyre!(error))?;
    if let Some(node) = compute.nodes.keys().find(|id| graph.node(id).is_none()) {
        return Err(eyre!(
            "the compute profile names node `{node}`, which {} does not have",
            graph.file.display()
        ));
    }
    Ok(virtual_time::run(&wiring, compute, observer)?)
}

/// Makes the cell's folder and takes away an earlier run's results, so that none stands there unless this one succeeds.
///
/// # Errors
/// Files of those names that no run of realo wrote.
pub(super) fn claim(cell: &Cell) -> Result<()> {
    realo_results::claim(&cell.out)?;
    let recording = cell.out.join("recording.mcap");
    match std::fs::remove_file(&recording) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(error).wrap_err_with(|| format!("{}", recording.display()))
        }
        _ => Ok(()),
    }
}
