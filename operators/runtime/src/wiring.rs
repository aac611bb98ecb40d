use realo_schemas::Name;

use crate::graph::FlatGraph;
use crate::{PortId, Registration, Registry};

/// A graph whose nodes are all known: what a driver needs, in topological order.
#[derive(Clone, Default)]
pub struct Wiring {
    /// Every node comes after those that feed it.
    pub nodes: Vec<Node>,
}

/// One node of a [`Wiring`].
#[derive(Clone)]
pub struct Node {
    /// Id in the graph.
    pub id: Name,
    /// What it is.
    pub registration: &'static Registration,
    /// Its `key=value` arguments.
    pub args: Vec<String>,
    /// For each declared input the node (index in [`Wiring::nodes`]) and output that feed it.
    pub inputs: Vec<Option<(usize, PortId)>>,
}

impl Wiring {
    /// Adds a node; `inputs` are (port, source node id, source port).
    ///
    /// # Errors
    /// Names a port or source that does not exist (sources must be added first).
    pub fn add(
        &mut self,
        id: &str,
        registration: &'static Registration,
        args: Vec<String>,
        inputs: &[(&str, &str, &str)],
    ) -> Result<(), String> {
        let mut wired = vec![None; registration.inputs.len()];
        for (port, source, output) in inputs {
            let (PortId(index), _) = registration
                .input(port)
                .ok_or_else(|| format!("node `{id}`: {} has no input `{port}`", registration.name))?;
            let from = self.nodes.iter().position(|node| *node.id == **source);
            let from = from.ok_or_else(|| format!("node `{id}`: input `{port}` comes from unknown node `{source}`"))?;
            let output_port = self.nodes[from].registration.output(output);
            let (output, _) = output_port.ok_or_else(|| format!("node `{source}` has no output `{output}`"))?;
            wired[index] = Some((from, output));
        }
        self.nodes.push(Node {
            id: id.into(),
            registration,
            args,
            inputs: wired,
        });
        Ok(())
    }

    /// The wiring of a graph whose nodes are all in the registry.
    ///
    /// # Errors
    /// Names a node that only dora can run, or a wire that leads nowhere.
    pub fn of(graph: &FlatGraph, registry: &Registry) -> Result<Self, String> {
        let ranks = graph.ranks().map_err(|error| error.to_string())?;
        let mut order: Vec<usize> = (0..graph.nodes.len()).collect();
        order.sort_by_key(|index| ranks[*index]);
        let mut wiring = Wiring::default();
        for index in order {
            let node = &graph.nodes[index];
            let registration = node.registration(registry).ok_or_else(|| {
                let program = node.path.display();
                format!(
                    "node `{}` ({program}): virtual time runs the operators and nodes of `realo operators` only; \
                     run this graph in realtime",
                    node.id
                )
            })?;
            let mut inputs = Vec::new();
            for (port, input) in &node.inputs {
                let (source, output) = input.output().ok_or_else(|| {
                    format!(
                        "node `{}`: input `{port}` comes from {}, which only dora sends",
                        node.id, input.source
                    )
                })?;
                inputs.push((port.as_str(), source, output));
            }
            wiring.add(&node.id, registration, node.settings().to_vec(), &inputs)?;
        }
        Ok(wiring)
    }

    /// The inputs (node, port) that an output feeds, in order of nodes and ports.
    pub fn consumers(&self, from: usize, output: PortId) -> Vec<(usize, PortId)> {
        let edges = self.nodes.iter().enumerate().flat_map(|(node, n)| {
            let fed = move |(port, source): (usize, &Option<(usize, PortId)>)| {
                (*source == Some((from, output))).then_some((node, PortId(port)))
            };
            n.inputs.iter().enumerate().filter_map(fed)
        });
        edges.collect()
    }
}
