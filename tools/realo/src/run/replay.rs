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
            clear(cell)?;
            let compute = match &cell.compute {
                Some(path) => ComputeProfile::read(path).map_err(|error| eyre!(error))?,
                None => ComputeProfile::default(),
            };
            replay(&cell.graph, &compute, &mut |_, _, _| {}).wrap_err_with(|| cell.name.clone())?;
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

/// Makes the cell's folder and takes away what would look like its result.
pub(super) fn clear(cell: &Cell) -> Result<()> {
    std::fs::create_dir_all(&cell.out).wrap_err_with(|| format!("{}", cell.out.display()))?;
    for file in ["result.json", "timing.json", "evaluation.json", "recording.mcap"] {
        match std::fs::remove_file(cell.out.join(file)) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(error).wrap_err_with(|| format!("{}", cell.out.join(file).display()));
            }
            _ => {}
        }
    }
    Ok(())
}
