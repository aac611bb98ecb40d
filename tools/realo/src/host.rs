//! `realo host`, `realo operator`, `realo node` and `realo program`: what dora starts.

use eyre::Result;
use realo_graph::FlatNode;
use realo_host::dora::{self, Hosted};

use crate::{Outcome, demo, registry};

/// Hosts the stages of a module as one process of a graph (dora starts this)
#[derive(clap::Args)]
pub struct ModuleArgs {
    /// File of the module
    module: String,
    /// node.key=value: arguments of its stages
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
    run(Hosted::Module {
        file: &args.module,
        settings: &args.settings,
    })
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
    let words: Vec<String> = [word, name]
        .map(String::from)
        .into_iter()
        .chain(args.iter().cloned())
        .collect();
    demo::make_if_missing(&FlatNode::alone(name, &words, &[]))?;
    run(Hosted::Stage(&words))
}

fn run(hosted: Hosted) -> Result<Outcome> {
    dora::run(hosted, &registry())?;
    Ok(Outcome::Complete)
}
