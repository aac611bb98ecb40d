//! Hosts stages as a process on dora.
//!
//! The stages are built before the process joins dora. One thread takes events off dora at once, puts messages back in the
//! order of their `hop` and gives them to the [`realo_engine::Engine`]; as many threads as there are stages make the calls
//! that are due, each call on the thread that comes first, so that a chain of stages needs no change of threads and a
//! heavy stage holds up no light one. A process ends when all its stages have; an input that closes without an `end` means
//! that a node died, and this one fails too.

mod edges;
mod host;
mod inbox;
mod load;
mod marks;
mod memory;
mod plan;
mod queues;
mod source;
mod tether;
mod threads;

use std::path::{Path, PathBuf};

use dora_node_api::DoraNode;
use realo_graph::{FlatGraph, FlatNode};
use realo_operator::Registry;

use crate::Stages;
use inbox::Inbox;
pub use load::Slow;
pub use memory::{POOL, POOL_VARIABLE};
use plan::Plan;
pub use queues::{OVERLAY, OVERLAY_VARIABLE};
pub(crate) use tether::is_ending;
pub use tether::{TETHER_VARIABLE, tether_of};

/// Names the folder of the graph where dora is given a copy of it, and so starts its nodes elsewhere.
pub const FOLDER_VARIABLE: &str = "REALO_GRAPH_FOLDER";

/// Why a process failed.
#[derive(Debug, thiserror::Error)]
pub enum HostError {
    /// A stage could not be built, or the module not be read.
    #[error("{0}")]
    Build(String),
    /// dora did not take the process, or an output.
    #[error("{id}: dora: {reason}")]
    Dora {
        /// Id of the process, or of what it hosts before dora gave one.
        id: String,
        /// What dora said.
        reason: String,
    },
    /// The graph feeds an input that the stages do not have, or leaves a required one open.
    #[error("{id}: {reason}")]
    Wiring {
        /// Id of the process.
        id: String,
        /// What is wrong.
        reason: String,
    },
    /// A node above this one died.
    #[error("{id}: node `{source_id}` failed: {reason}")]
    Above {
        /// Id of the process.
        id: String,
        /// The node that died.
        source_id: String,
        /// What is known of it.
        reason: String,
    },
    /// The run was stopped before its end.
    #[error("{id}: dora stopped it before the end of its data")]
    Stopped {
        /// Id of the process.
        id: String,
    },
    /// A stage could not go on.
    #[error("{0}")]
    Stage(String),
}

/// What a process hosts.
#[derive(Clone, Copy, Debug)]
pub enum Hosted<'a> {
    /// One stage: the words behind `realo` in a graph.
    Stage(&'a [String]),
    /// The stages of a module, with `stage.key=value` settings.
    Module {
        /// The module's file.
        file: &'a str,
        /// Changes of its stages' settings.
        settings: &'a [String],
    },
}

impl Hosted<'_> {
    /// The stages, as the graph wires this process; and what it says of them.
    fn stages(self, plan: &Plan, registry: &Registry) -> Result<(Stages, Vec<FlatNode>), String> {
        let here = graph_folder().map_err(|error| error.to_string())?;
        let id = &plan.id;
        let inputs: Vec<String> = plan.inputs.keys().cloned().collect();
        match self {
            Hosted::Module { file, settings } => {
                let graph = realo_graph::hosted(id, file, settings, Some((&inputs, &plan.outputs)), &here);
                let graph = graph.map_err(|error| error.to_string())?;
                let mut stages = Stages::of(&graph, registry)?;
                for (name, (stage, output)) in graph.hosts.iter().flat_map(|host| &host.outlets) {
                    stages.let_out(name, stage, output)?;
                }
                Ok((stages, graph.nodes))
            }
            Hosted::Stage(words) => {
                let graph = alone(id, words, &inputs, &here);
                let mut stages = Stages::of(&graph, registry)?;
                for name in &plan.outputs {
                    stages.let_out(name, id, name)?;
                }
                Ok((stages, graph.nodes))
            }
        }
    }
}

/// The folder of the graph of which this process is a node: its paths are seen from there, and its plug-ins run there.
///
/// # Errors
/// A working directory that is gone.
pub fn graph_folder() -> std::io::Result<PathBuf> {
    std::env::var_os(FOLDER_VARIABLE).map_or_else(std::env::current_dir, |folder| Ok(folder.into()))
}

/// A graph of one stage.
fn alone(id: &str, words: &[String], inputs: &[String], folder: &Path) -> FlatGraph {
    FlatGraph {
        file: folder.join(id),
        settings: Default::default(),
        nodes: vec![FlatNode::alone(id, words, inputs)],
        hosts: Vec::new(),
        groups: Default::default(),
    }
}

/// Builds stages, joins the dora dataflow that started this process, and runs to the end; gives what ran.
///
/// # Errors
/// [`HostError`]; the caller ends the process with a code other than 0, so that the run fails.
pub fn run(hosted: Hosted, registry: &Registry) -> Result<Vec<FlatNode>, HostError> {
    // A panic that only unwinds a thread would look like a normal end to the nodes below.
    let print = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        if !realo_operator::pipe::is_reading() {
            print(panic);
            std::process::exit(101);
        }
    }));
    memory::keep_freed_pages();
    queues::widen();
    tether::follow();
    let plan = Plan::of_this_process().map_err(|reason| HostError::Dora {
        id: "realo".into(),
        reason,
    })?;
    let Plan { id, inputs, .. } = &plan;
    let wrong = |reason| HostError::Wiring { id: id.clone(), reason };
    let (mut stages, nodes) = hosted.stages(&plan, registry).map_err(wrong)?;
    stages.run_in_realtime();
    let open = stages.open_inputs();
    if !open.is_empty() {
        return Err(wrong(open.join("; ")));
    }
    let built = stages.build().map_err(|error| HostError::Build(error.to_string()))?;
    memory::size_pool(&stages);
    threads::let_connections_close(&stages);
    let (node, events) = DoraNode::init_from_env().map_err(|error| HostError::Dora {
        id: id.clone(),
        reason: error.to_string(),
    })?;
    host::run(host::Joined {
        id: id.clone(),
        node,
        stages,
        built,
        froms: inputs.clone(),
        returning: plan.returning.clone(),
        inbox: Inbox::new(events),
    })?;
    Ok(nodes)
}
