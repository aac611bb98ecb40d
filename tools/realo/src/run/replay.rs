//! Runs in virtual time.

use eyre::{Result, WrapErr, eyre};
use rayon::prelude::*;
use realo_graph::FlatGraph;
use realo_host::{ComputeProfile, Stages, virtual_time};
use realo_operator::Books;

use super::prepare::Cell;
use crate::registry;
use crate::simulate::progress;

/// Runs all cells, several at a time; they do not know of each other. Gives how each ended.
pub fn all(cells: &[&Cell]) -> Vec<Result<()>> {
    let bar = progress(cells.len() as u64, "replaying");
    let done = cells
        .par_iter()
        .map(|cell| {
            let ended = replay(&cell.graph, &cell.compute, None).wrap_err_with(|| cell.name.clone());
            bar.inc(1);
            ended.map(drop)
        })
        .collect();
    bar.finish_and_clear();
    done
}

/// Runs a graph in virtual time; `observer` sees every message that a stage sends.
///
/// # Errors
/// A graph that virtual time cannot run; the node that failed.
pub fn replay(graph: &FlatGraph, compute: &ComputeProfile, observer: Option<virtual_time::Observer>) -> Result<Books> {
    let stages = Stages::of(graph, &registry()).map_err(|error| eyre!(error))?;
    if let Some(stranger) = compute.stranger(|id| graph.node(id).is_some()) {
        let known: Vec<&str> = graph.nodes.iter().map(|node| node.id.as_str()).collect();
        return Err(eyre!(
            "the compute profile names `{stranger}`, which is no stage of {}; there are: {}",
            graph.file.display(),
            known.join(", ")
        ));
    }
    Ok(virtual_time::run(&stages, compute, observer)?)
}
