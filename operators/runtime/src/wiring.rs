use std::path::Path;

use realo_schemas::Name;

use crate::graph::{self, FlatGraph, FlatNode};
use crate::pipe::Program;
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
    /// The program that hosts it, if this one does not.
    pub program: Option<Program>,
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
            program: None,
        });
        Ok(())
    }

    /// The wiring of a graph whose nodes are in the registry, or programs that host an operator ([`crate::pipe`]); those
    /// are started and asked for their ports.
    ///
    /// # Errors
    /// Names a node that only dora can run, a port that does not fit, or a wire that leads nowhere.
    pub fn of(graph: &FlatGraph, registry: &Registry) -> Result<Self, String> {
        let ranks = graph.ranks().map_err(|error| error.to_string())?;
        let mut order: Vec<usize> = (0..graph.nodes.len()).collect();
        order.sort_by_key(|index| ranks[*index]);
        let mut wiring = Wiring::default();
        for node in order.into_iter().map(|index| &graph.nodes[index]) {
            let inputs = wires(node)?;
            let (registration, program) = hosted(graph, node, registry)?;
            wiring.add(&node.id, registration, node.settings().to_vec(), &inputs)?;
            if let Some(added) = wiring.nodes.last_mut() {
                added.program = program;
            }
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

/// The wires that end at a node: (port, source node id, source port).
fn wires(node: &FlatNode) -> Result<Vec<(&str, &str, &str)>, String> {
    let wires = node.inputs.iter().map(|(port, input)| match input.output() {
        Some((source, output)) => Ok((port.as_str(), source, output)),
        None => Err(format!(
            "node `{}`: input `{port}` comes from {}, which only dora sends",
            node.id, input.source
        )),
    });
    wires.collect()
}

/// What a node is, and the program behind it if it is not this one.
fn hosted(
    graph: &FlatGraph,
    node: &FlatNode,
    registry: &Registry,
) -> Result<(&'static Registration, Option<Program>), String> {
    if let Some(registration) = node.registration(registry) {
        return Ok((registration, None));
    }
    if node.is_realo() {
        let args = node.args.join(" ");
        return Err(format!(
            "node `{}`: no operator or node of `realo operators`: `{args}`",
            node.id
        ));
    }
    let program = Program::of(node, graph.file.parent().unwrap_or(Path::new("/")));
    let registration = program.ask()?;
    let wrong: Vec<String> = graph::misdeclared(node, registration)
        .iter()
        .map(ToString::to_string)
        .collect();
    match wrong.is_empty() {
        true => Ok((registration, Some(program))),
        false => Err(wrong.join("\n  ")),
    }
}
