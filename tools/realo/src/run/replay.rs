//! Runs in virtual time.

use eyre::{Result, WrapErr, bail, eyre};
use rayon::prelude::*;
use realo_graph::FlatGraph;
use realo_host::{ComputeProfile, Stages, virtual_time};
use realo_operator::Books;
use realo_schemas::{Nanos, to_seconds};

use super::prepare::Cell;
use super::signals;
use crate::progress::Progress;
use crate::registry;

/// Runs all cells, several at a time; they do not know of each other. Gives how each ended.
pub fn all(cells: &[&Cell]) -> Vec<Result<()>> {
    let seconds = cells.iter().map(|cell| cell.seconds).sum();
    let progress = Progress::new(format!("replaying {}", runs(cells.len())), "s of logs", Some(seconds));
    let done = cells
        .par_iter()
        .map(|cell| {
            if signals::first().is_some() {
                bail!("{}: the run had not begun", cell.name);
            }
            let mut far = Far::new(cell.seconds, &progress);
            let ended = watched(&cell.graph, &cell.compute, None, |now| far.is(now));
            far.ended();
            ended.map(drop).wrap_err_with(|| cell.name.clone())
        })
        .collect();
    progress.finish();
    done
}

fn runs(count: usize) -> String {
    match count {
        1 => "1 run".into(),
        _ => format!("{count} runs"),
    }
}

/// How far one of several runs is.
struct Far<'a> {
    progress: &'a Progress,
    /// Length of its log.
    seconds: f64,
    begin: Option<Nanos>,
    done: f64,
}

impl<'a> Far<'a> {
    /// Seconds of a log from one report to the next.
    const STEP: f64 = 0.1;

    fn new(seconds: f64, progress: &'a Progress) -> Self {
        Far {
            progress,
            seconds,
            begin: None,
            done: 0.0,
        }
    }

    fn is(&mut self, now: Nanos) {
        let begin = *self.begin.get_or_insert(now);
        let done = to_seconds(now - begin).min(self.seconds);
        if done >= self.done + Self::STEP {
            self.progress.add(done - self.done);
            self.done = done;
        }
    }

    fn ended(self) {
        self.progress.add(self.seconds - self.done);
    }
}

/// Runs a graph in virtual time; `observer` sees every message that a stage sends.
///
/// # Errors
/// A graph that virtual time cannot run; the node that failed.
pub fn replay(graph: &FlatGraph, compute: &ComputeProfile, observer: Option<virtual_time::Observer>) -> Result<Books> {
    watched(graph, compute, observer, |_| {})
}

fn watched(
    graph: &FlatGraph,
    compute: &ComputeProfile,
    observer: Option<virtual_time::Observer>,
    far: impl FnMut(Nanos),
) -> Result<Books> {
    let stages = Stages::of(graph, &registry()).map_err(|error| eyre!(error))?;
    if let Some(stranger) = compute.stranger(|id| graph.node(id).is_some()) {
        let known: Vec<&str> = graph.nodes.iter().map(|node| node.id.as_str()).collect();
        return Err(eyre!(
            "the compute profile names `{stranger}`, which is no stage of {}; there are: {}",
            graph.file.display(),
            known.join(", ")
        ));
    }
    Ok(virtual_time::run_watched(&stages, compute, observer, far)?)
}
