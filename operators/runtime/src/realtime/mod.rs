//! Hosts one operator, source or sink as a dora process.
//!
//! The stage is built before it joins dora. Messages are put back in the order of their `hop`, held until they are
//! `ready` on the replay's clock, and queued as their ports say; computing takes what it takes. A stage ends when every
//! input has sent its `end`; an input that closes without one means that a node died, and this one fails too.

mod hosted;
mod inbox;
mod marks;
mod memory;
mod source;

use dora_node_api::DoraNode;
use dora_node_api::dora_core::config::DataId;
use realo_schemas::{Message, Nanos, wire};

use crate::{Built, PortId, Registration};
use inbox::Inbox;

/// Why a node failed.
#[derive(Debug, thiserror::Error)]
pub enum HostError {
    /// The stage could not be built.
    #[error("{name}: {reason}")]
    Build {
        /// Operator or node name.
        name: &'static str,
        /// What the configuration or its files lack.
        reason: String,
    },
    /// dora did not take the node, or an output.
    #[error("{id}: dora: {reason}")]
    Dora {
        /// Node id, or the operator's name before dora gave one.
        id: String,
        /// What dora said.
        reason: String,
    },
    /// The graph feeds an input that the stage does not have, or leaves a required one open.
    #[error("{id}: {reason}")]
    Wiring {
        /// Node id.
        id: String,
        /// What is wrong.
        reason: String,
    },
    /// A node above this one died.
    #[error("{id}: node `{source_id}` failed: {reason}")]
    Above {
        /// Node id.
        id: String,
        /// The node that died.
        source_id: String,
        /// What is known of it.
        reason: String,
    },
    /// The run was stopped before its end.
    #[error("{id}: stopped before the end of the stream")]
    Stopped {
        /// Node id.
        id: String,
    },
    /// The stage itself could not go on.
    #[error("{id}: {reason}")]
    Stage {
        /// Node id.
        id: String,
        /// What went wrong.
        reason: String,
    },
}

/// Builds a stage from its arguments, joins the dora dataflow that started this process, and runs to the end.
///
/// # Errors
/// [`HostError`]; the caller ends the process with a code other than 0, so that the run fails.
pub fn run(registration: &'static Registration, args: &[String]) -> Result<(), HostError> {
    memory::keep_freed_pages();
    let built = (registration.build)(args).map_err(|error| HostError::Build {
        name: registration.name,
        reason: error.to_string(),
    })?;
    let (node, events) = DoraNode::init_from_env().map_err(|error| HostError::Dora {
        id: registration.name.into(),
        reason: error.to_string(),
    })?;
    let link = DoraLink {
        id: node.id().to_string(),
        node,
        registration,
    };
    let inbox = Inbox::new(events);
    match built {
        Built::Source(source) => source::run(source, link, inbox),
        Built::Operator(operator) => hosted::run(hosted::Body::Operator(operator), link, inbox),
        Built::Sink(sink) => hosted::run(hosted::Body::Sink(sink), link, inbox),
    }
}

/// Wall time, ns since the epoch.
fn wall_now() -> Nanos {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    since.map_or(0, |since| since.as_nanos() as Nanos)
}

/// This node's outputs.
struct DoraLink {
    id: String,
    node: DoraNode,
    registration: &'static Registration,
}

impl DoraLink {
    fn send(&mut self, port: PortId, message: &Message) -> Result<(), HostError> {
        let output = DataId::from(self.registration.outputs[port.0].name.to_string());
        let row = wire::to_arrow(message);
        let sent = self.node.send_output(output, Default::default(), row);
        sent.map_err(|error| HostError::Dora {
            id: self.id.clone(),
            reason: error.to_string(),
        })
    }

    /// Which declared inputs the graph feeds, with the node behind each.
    fn wired(&self) -> Result<Vec<Option<String>>, HostError> {
        let mut wired = vec![None; self.registration.inputs.len()];
        for (id, input) in &self.node.node_config().inputs {
            let port = self.registration.input(id.as_str()).ok_or_else(|| {
                let known: Vec<_> = self.registration.inputs.iter().map(|port| port.name).collect();
                let reason = format!("no input `{id}`; {} has: {}", self.registration.name, known.join(", "));
                HostError::Wiring {
                    id: self.id.clone(),
                    reason,
                }
            })?;
            wired[port.0.0] = Some(input.mapping.to_string());
        }
        for (port, wired) in self.registration.inputs.iter().zip(&wired) {
            if port.required && wired.is_none() {
                let reason = format!("input `{}` must be wired: {}", port.name, port.about);
                return Err(HostError::Wiring {
                    id: self.id.clone(),
                    reason,
                });
            }
        }
        Ok(wired)
    }
}
