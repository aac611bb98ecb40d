//! Which node is behind a wire, for checks that follow wires through stages.

use realo_operator::{Port, Registration, Side};

use super::{FlatGraph, FlatNode};

/// The nodes of a graph with the stages that they host.
pub(super) struct Wires<'a> {
    pub graph: &'a FlatGraph,
    /// In the order of the graph's nodes.
    pub stages: &'a [Option<&'static Registration>],
}

impl<'a> Wires<'a> {
    /// A node and its stage; `None` where no stage is known.
    pub fn at(&self, id: &str) -> Option<(&'a FlatNode, &'static Registration)> {
        let at = self.graph.nodes.iter().position(|node| node.id == id)?;
        Some((&self.graph.nodes[at], self.stages[at]?))
    }
}

/// Whether what comes on an input leaves by an output: a link has a way there and a way back.
pub(super) fn carries(input: &Port, stage: &Registration, output: &str) -> bool {
    match (input.side, stage.output(output).and_then(|(_, port)| port.side)) {
        (Some(from), Some(to)) => matches!(
            (from, to),
            (Side::Others, Side::OthersReceived) | (Side::Ego, Side::EgoReceived)
        ),
        _ => true,
    }
}
