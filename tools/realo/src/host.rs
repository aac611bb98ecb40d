//! `realo host`, `realo operator`, `realo node` and `realo program`: what dora starts.

use std::path::Path;

use eyre::Result;
use realo_cli::Outcome;
use realo_graph::{FlatNode, normalized, with_variables};
use realo_host::dora::{self, Hosted};

use crate::run::{argument, decided_argument};
use crate::{demo, registry, roles};

/// Hosts the stages of a module as one process of a graph (dora starts this)
#[derive(clap::Args)]
pub struct ModuleArgs {
    /// File of the module
    module: String,
    /// stage.key=value: settings of its stages
    settings: Vec<String>,
}

/// Hosts an operator as a process of a graph (dora starts this)
#[derive(clap::Args)]
pub struct OperatorArgs {
    /// Name; `realo operators` lists them
    name: String,
    /// key=value
    args: Vec<String>,
}

/// Hosts a source or sink as a process of a graph (dora starts this)
#[derive(clap::Args)]
pub struct NodeArgs {
    /// Name; `realo operators` lists them
    name: String,
    /// key=value
    args: Vec<String>,
}

/// Hosts a plug-in as a process of a graph (dora starts this)
#[derive(clap::Args)]
pub struct ProgramArgs {
    /// The program
    path: String,
    /// key=value
    args: Vec<String>,
}

/// Hosts the stages of a module until their streams end.
pub fn module(args: &ModuleArgs) -> Result<Outcome> {
    let here = dora::graph_folder()?;
    let settings = filled_in(&args.settings);
    let hosted = Hosted::Module {
        file: &args.module,
        settings: &settings,
    };
    report(&dora::run(hosted, &registry())?, &here)
}

/// Hosts an operator until its streams end.
pub fn operator(args: &OperatorArgs) -> Result<Outcome> {
    stage("operator", &args.name, &args.args)
}

/// Hosts a source or sink until its streams end.
pub fn node(args: &NodeArgs) -> Result<Outcome> {
    stage("node", &args.name, &args.args)
}

/// Hosts a plug-in until its streams end.
pub fn program(args: &ProgramArgs) -> Result<Outcome> {
    stage("program", &args.path, &args.args)
}

fn stage(word: &str, name: &str, args: &[String]) -> Result<Outcome> {
    let here = dora::graph_folder()?;
    let words: Vec<String> = [word, name]
        .map(String::from)
        .into_iter()
        .chain(filled_in(args))
        .collect();
    let stage = FlatNode::alone(name, &words, &[]);
    demo::make_if_missing(&stage)?;
    report(&dora::run(Hosted::Stage(&words), &registry())?, &here)
}

/// Arguments with what the graph's `env` says in place of its names: dora gives it to the process, and leaves arguments alone.
fn filled_in(args: &[String]) -> Vec<String> {
    let value = |name: &str| std::env::var(name).ok();
    args.iter().map(|arg| with_variables(arg, value)).collect()
}

/// Prints the table of a run that nobody else reports on: dora started its graph.
fn report(stages: &[FlatNode], folder: &Path) -> Result<Outcome> {
    for stage in stages {
        let value = |decided| argument(stage, decided_argument(stage, decided)?);
        let (Some(out), Some("")) = (value(roles::OUT), value(roles::RUN_SETTINGS).as_deref()) else {
            continue;
        };
        let out = normalized(&folder.join(out));
        let run = realo_results::read_run(&out)?;
        let name = run.result.settings.graph.clone();
        println!("{}results in {}", crate::tables::table(&[(&name, &run)]), out.display());
    }
    Ok(Outcome::Complete)
}
