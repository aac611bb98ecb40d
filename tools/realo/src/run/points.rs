//! Runs of graphs with other settings each time, for a command that plans many of them.

use std::collections::BTreeSet;
use std::path::PathBuf;

use eyre::{Result, WrapErr};
use realo_graph::Graph;

use super::prepare::{self, RunPlan};
use super::{Args, Mode, Networks, choices, names, nodes};
use crate::roles;

/// The runs of one graph, over logs and egos.
pub struct Prepared {
    pub plans: Vec<RunPlan>,
    /// What cannot be played, in words.
    pub failed: Vec<String>,
    /// Settings that the graph has no place for.
    pub skipped: Option<String>,
}

/// The names of graphs, by which their results are told apart.
///
/// # Errors
/// Two graphs of one name.
pub fn names_of(graphs: &[PathBuf]) -> Result<Vec<String>> {
    names(graphs)
}

/// The runs of every graph in virtual time, each graph with the settings that it has a place for. `out` gives the folder of a
/// graph's results.
///
/// # Errors
/// The graph that cannot run, and why.
pub fn prepared(
    args: &Args,
    names: &[String],
    networks: &mut Networks,
    out: impl Fn(&str) -> PathBuf,
) -> Result<Vec<Prepared>> {
    let mut args = args.clone();
    choices::settle_all(&mut args.choices);
    let fitted = choices::fit(&args.choices, &args.graphs).into_iter();
    let graphs = args.graphs.iter().zip(names).zip(fitted);
    let prepare = |((graph, name), fitted): ((&PathBuf, &String), choices::Fitted)| {
        let skipped = fitted.note();
        let own = Args {
            graphs: vec![graph.clone()],
            choices: fitted.choices,
            out: Some(out(name)),
            ..args.clone()
        };
        let batch = prepare::batch_with(&own, Mode::Virtual, graph, name, networks).wrap_err_with(|| name.clone())?;
        let (plans, failed) = batch.into_parts();
        Ok(Prepared { plans, failed, skipped })
    };
    graphs.map(prepare).collect()
}

/// The profiles of the links of graphs, each once.
///
/// # Errors
/// A graph that cannot be read.
pub fn link_of(graphs: &[PathBuf]) -> Result<BTreeSet<String>> {
    let mut all = BTreeSet::new();
    for path in graphs {
        let mut flat = Graph::load(path)?.expand()?;
        nodes::anchor_paths(&mut flat)?;
        let linked = nodes::deciding(&flat, roles::LINK);
        all.extend(linked.filter_map(|node| nodes::argument(node, nodes::decided_argument(node, roles::LINK)?)));
    }
    Ok(all)
}
