//! `realo validate`: what dora does not check.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use eyre::Result;
use realo_cli::Outcome;
use realo_graph::{Finding, FlatGraph, FlatNode, Severity};
use realo_host::Program;

use crate::registry;

/// Checks graphs beyond what `dora validate` does, and says how to mend them
#[derive(clap::Args)]
pub struct Args {
    /// Dataflow files, or names of shipped ones
    #[arg(required = true)]
    graphs: Vec<PathBuf>,
    /// Start no program to ask for its ports, and load no network: only look whether models and weights are there
    #[arg(long)]
    no_start: bool,
    /// Model file of every detector [default: each node's own]
    #[arg(long)]
    model: Option<PathBuf>,
    /// STAGE="program PATH key=value …" or STAGE="operator NAME …": puts another stage in the place of one first, or a new
    /// one before an input of one: STAGE.INPUT="…"
    #[arg(long)]
    replace: Vec<String>,
}

/// Prints the findings of each graph, and what is wrong with the networks and operators that it runs; errors fail.
pub fn main(args: &Args) -> Result<Outcome> {
    let mut outcome = Outcome::Complete;
    for path in &args.graphs {
        let mut graph = FlatGraph::load(&realo_cli::find::graph(path)?)?;
        crate::run::replace_stages(&mut graph, &args.replace, false)?;
        let missing = crate::run::missing_programs(&graph);
        for program in &missing {
            println!("{}: error: {program}", path.display());
        }
        let findings = check(&graph, args, args.no_start || !missing.is_empty());
        for finding in &findings {
            println!("{}: {finding}", path.display());
        }
        if !missing.is_empty() || findings.iter().any(|finding| finding.severity == Severity::Error) {
            outcome = Outcome::Failed;
        } else if let Err(error) = networks(graph, args) {
            println!("{}: error: {error:#}", path.display());
            outcome = Outcome::Failed;
        } else if findings.is_empty() {
            println!("{}: fine", path.display());
        } else {
            println!("{}: can run, see above", path.display());
        }
    }
    Ok(outcome)
}

/// What is wrong with the networks and operators of a graph; with `--no-start` no network is loaded.
fn networks(graph: FlatGraph, args: &Args) -> Result<()> {
    let model = args.model.as_deref();
    match args.no_start {
        true => crate::run::check_files(graph, model),
        false => crate::run::check_networks(graph, model),
    }
}

/// The findings; programs of plug-ins are started over pipes and asked for their ports.
fn check(graph: &FlatGraph, args: &Args, no_start: bool) -> Vec<Finding> {
    let folder = graph.file.parent().unwrap_or(Path::new("/"));
    let mut programs = BTreeMap::new();
    let mut findings = realo_graph::validate_asking(graph, &registry(), &mut |node| {
        let answer = Program::of(node, folder).filter(|_| !no_start)?.ask();
        programs.extend(answer.as_ref().ok().map(|program| (node.id.clone(), *program)));
        Some(answer)
    });
    // Files of networks are relative to the graph; what cannot be found is said where they are loaded.
    if let Ok(graph) = crate::run::anchored(graph.clone(), args.model.as_deref()) {
        let stage = |node: &FlatNode| {
            programs
                .get(&node.id)
                .copied()
                .or_else(|| node.registration(&registry()))
        };
        let stages: Vec<_> = graph.nodes.iter().map(stage).collect();
        findings.extend(realo_graph::unfit_maps(&graph, &stages));
    }
    findings
}
