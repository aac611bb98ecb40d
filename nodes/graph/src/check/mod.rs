//! What dora does not check about a graph.

mod agents;
mod hosting;
mod lanes;
mod machines;
mod maps;
mod packets;
mod ports;
mod processes;
mod wires;

use std::fmt;

use serde_yaml::Value;

use super::{FlatGraph, FlatNode};
use realo_operator::{Registration, Registry, Role};

/// How much a finding matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// Worth knowing; nothing is wrong.
    Note,
    /// The graph runs, but may lose messages or hide mistakes.
    Warning,
    /// The graph does not run, or its result means something else than it says.
    Error,
}

/// One thing that a check found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// How much it matters.
    pub severity: Severity,
    /// The node's id; empty for the graph as a whole.
    pub node: String,
    /// The port, where it is about one.
    pub port: Option<String>,
    /// What should be there.
    pub expected: String,
    /// What is there.
    pub found: String,
    /// How to correct it.
    pub fix: String,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let severity = match self.severity {
            Severity::Note => "note",
            Severity::Warning => "warning",
            Severity::Error => "error",
        };
        write!(f, "{severity}: ")?;
        match (self.node.as_str(), &self.port) {
            ("", _) => write!(f, "graph: ")?,
            (node, None) => write!(f, "node `{node}`: ")?,
            (node, Some(port)) => write!(f, "node `{node}`, port `{port}`: ")?,
        }
        write!(f, "expected {}, found {}", self.expected, self.found)?;
        if self.fix.is_empty() {
            Ok(())
        } else {
            write!(f, "; {}", self.fix)
        }
    }
}

/// Everything that is wrong with a graph and dora does not see, in the order of its nodes.
///
/// Checked are: stages and their settings, ports and their types, wires (their ends, policies, cycles), lanes (what
/// belongs to the ego, what to the others, what crossed a link), outputs of processes, health checks, and whose graph it is. The
/// graph that has no [`Severity::Error`] can be run by either driver, unless a [`Severity::Note`] names a foreign node.
pub fn validate(graph: &FlatGraph, registry: &Registry) -> Vec<Finding> {
    validate_asking(graph, registry, &mut |_| None)
}

/// What a program that is not realo says of its ports, or why it says nothing.
pub type Answer = Option<Result<&'static Registration, String>>;

/// [`validate`], with the ports that `ask` learns from programs that are not realo; `None`: it does not ask this one.
pub fn validate_asking(
    graph: &FlatGraph,
    registry: &Registry,
    ask: &mut dyn FnMut(&FlatNode) -> Answer,
) -> Vec<Finding> {
    let mut findings = Findings::default();
    whole(graph, registry, &mut findings);
    let stages: Vec<Option<&'static Registration>> = graph
        .nodes
        .iter()
        .map(|node| hosting::stage(node, registry, ask, &mut findings))
        .collect();
    for (node, stage) in graph.nodes.iter().zip(&stages) {
        ports::declared(node, *stage, &mut findings);
        ports::wires(graph, node, *stage, &mut findings);
        let is_sink = stage.map_or(node.outputs.is_empty(), |stage| stage.role == Role::Sink);
        // Of a hosted stage dora knows nothing.
        if node.host.is_none() {
            hosting::keys(node, stage.is_some(), is_sink, &mut findings);
        }
    }
    processes::check(graph, &mut findings);
    machines::check(graph, &mut findings);
    agents::check(graph, &stages, &mut findings);
    packets::check(graph, &stages, &mut findings);
    match graph.ranks(registry) {
        Ok(ranks) => {
            lanes::check(graph, &ranks, &stages, &mut findings);
        }
        // A wire from nowhere is found above, with its port.
        Err(super::GraphError::Source { .. }) => {}
        Err(error) => findings.whole(Severity::Error, "no cycle", error.to_string(), ""),
    }
    findings.0
}

/// Where the ports that a graph gives to a node differ from those that its program declares.
pub fn misdeclared(node: &FlatNode, program: &'static Registration) -> Vec<Finding> {
    let mut findings = Findings::default();
    ports::declared(node, Some(program), &mut findings);
    findings.0
}

/// Where a BEV map comes to an input that takes maps of another size, as far as both sizes are known: `stages` says what each node is.
pub fn unfit_maps(graph: &FlatGraph, stages: &[Option<&'static Registration>]) -> Vec<Finding> {
    let mut findings = Findings::default();
    maps::check(graph, stages, &mut findings);
    findings.0
}

/// What is wrong with a graph although a run by options does not need it: where its processes are to run, and parameters without a
/// value. The same graph is started without options too.
pub fn written_findings(graph: &FlatGraph) -> Vec<Finding> {
    let mut findings = Findings::default();
    machines::check_deploy_keys(graph, &mut findings);
    for node in &graph.nodes {
        hosting::parameter(node, &mut findings);
    }
    findings.0
}

fn whole(graph: &FlatGraph, registry: &Registry, findings: &mut Findings) {
    if graph.settings.get("strict_types") != Some(&Value::Bool(true)) {
        let mend = "write `strict_types: true` at the head of the file, so that dora checks the types of all wires";
        findings.whole(Severity::Warning, "`strict_types: true`", "none".into(), mend);
    }
    let closes = |node: &&FlatNode| node.registration(registry).is_some_and(|stage| stage.name == "results");
    match graph.nodes.iter().filter(closes).count() {
        1 => {}
        0 => {
            let mend = "add a node with `args: node results`; without it no result is written and no run is complete";
            findings.whole(Severity::Warning, "a `results` node", "none".into(), mend);
        }
        n => findings.whole(
            Severity::Error,
            "one `results` node",
            format!("{n}"),
            "they would write the same files",
        ),
    }
}

#[derive(Default)]
struct Findings(Vec<Finding>);

impl Findings {
    fn whole(&mut self, severity: Severity, expected: &str, found: String, mend: &str) {
        let (expected, mend) = (expected.to_string(), mend.to_string());
        self.0.push(Finding {
            severity,
            node: String::new(),
            port: None,
            expected,
            found,
            fix: mend,
        });
    }

    fn node(&mut self, severity: Severity, node: &FlatNode, expected: impl Into<String>, found: String, mend: &str) {
        let (node, expected, mend) = (node.id.clone(), expected.into(), mend.to_string());
        self.0.push(Finding {
            severity,
            node,
            port: None,
            expected,
            found,
            fix: mend,
        });
    }

    fn port(
        &mut self,
        severity: Severity,
        node: &FlatNode,
        port: &str,
        expected: impl Into<String>,
        found: String,
        mend: impl Into<String>,
    ) {
        let (node, port) = (node.id.clone(), Some(port.to_string()));
        self.0.push(Finding {
            severity,
            node,
            port,
            expected: expected.into(),
            found,
            fix: mend.into(),
        });
    }
}

#[cfg(test)]
pub(super) mod tests;
