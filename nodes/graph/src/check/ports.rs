//! Ports, their types, and the wires between them.

use realo_schemas::PayloadType;

use super::{Findings, FlatGraph, FlatNode, Severity};
use crate::{Input, OUTSIDE, TYPE_PREFIX};
use realo_operator::config::{did_you_mean, nearest_name};
use realo_operator::{Port, Registration};

/// The payload of a type of ours.
pub(super) fn payload_type(name: &str) -> Option<PayloadType> {
    name.strip_prefix(TYPE_PREFIX)?.parse().ok()
}

/// The ports that a node declares: known, outputs typed, and the required inputs wired. dora infers the type of an input.
pub(super) fn declared(node: &FlatNode, stage: Option<&'static Registration>, findings: &mut Findings) {
    // What dora itself sends has no type of ours.
    for (port, _) in node
        .inputs
        .iter()
        .filter(|(_, input)| stage.is_some() || input.output().is_some())
    {
        typed(
            node,
            port,
            stage.map(|stage| (stage, stage.inputs)),
            node.input_types.get(port),
            "input",
            findings,
        );
    }
    for port in &node.outputs {
        typed(
            node,
            port,
            stage.map(|stage| (stage, stage.outputs)),
            node.output_types.get(port),
            "output",
            findings,
        );
    }
    for (kind, types, ports) in [
        ("input_types", &node.input_types, node.inputs.keys().collect::<Vec<_>>()),
        ("output_types", &node.output_types, node.outputs.iter().collect()),
    ] {
        for port in types.keys().filter(|port| !ports.contains(port)) {
            let mend = "declare the port, or take its type away";
            findings.port(
                Severity::Error,
                node,
                port,
                "a port of the node",
                format!("only its entry in `{kind}`"),
                mend,
            );
        }
    }
    let inputs = stage.map(|stage| stage.inputs).unwrap_or_default();
    for port in inputs
        .iter()
        .filter(|port| is_needed(node, port) && !node.inputs.contains_key(port.name))
    {
        let mend = format!("wire it under `inputs`: {} ({})", port.about, names(port));
        findings.port(
            Severity::Error,
            node,
            port.name,
            match port.needed {
                Some((argument, value)) => format!("a wire to this input, which {argument}={value} needs"),
                None => "a wire to this required input".into(),
            },
            "none".into(),
            mend,
        );
    }
}

/// Whether a graph must wire an input: always, or with one of the node's settings.
fn is_needed(node: &FlatNode, port: &Port) -> bool {
    let given = |(argument, value): (&str, &str)| {
        let setting = format!("{argument}={value}");
        node.settings().contains(&setting)
    };
    port.required || port.needed.is_some_and(given)
}

fn typed(
    node: &FlatNode,
    port: &str,
    known: Option<(&'static Registration, &'static [Port])>,
    written: Option<&String>,
    kind: &str,
    findings: &mut Findings,
) {
    let mut allowed = None;
    if let Some((stage, ports)) = known {
        match ports.iter().find(|known| known.name == port) {
            Some(known) => allowed = Some(known),
            None => {
                let all: Vec<&str> = ports.iter().map(|port| port.name).collect();
                let hint = did_you_mean(&nearest_name(port, all.iter().copied()));
                let expected = format!(
                    "an {kind} of `{}`: {}",
                    stage.name,
                    if all.is_empty() {
                        "it has none".into()
                    } else {
                        all.join(", ")
                    }
                );
                findings.port(
                    Severity::Error,
                    node,
                    port,
                    expected,
                    format!("`{port}`{hint}"),
                    "rename or remove it",
                );
                return;
            }
        }
    }
    let expected = allowed.map_or_else(|| format!("a type in `{kind}_types`"), names);
    let Some(written) = written else {
        if kind == "input" {
            return;
        }
        let mend = format!("add it to `{kind}_types`; dora does not check a wire whose ends have no types");
        return findings.port(Severity::Error, node, port, expected, "no type".into(), mend);
    };
    let base = written.split('[').next().unwrap_or_default();
    match (payload_type(base), allowed) {
        (Some(found), Some(port)) if port.types.contains(&found) => {}
        (Some(_), None) => {}
        (None, None) if !base.starts_with(TYPE_PREFIX) => {}
        _ => {
            let all = PayloadType::ALL.map(|name| format!("{TYPE_PREFIX}{name}"));
            let hint = did_you_mean(&nearest_name(base, all.iter().map(String::as_str)).filter(|near| near != base));
            findings.port(
                Severity::Error,
                node,
                port,
                expected,
                format!("`{written}`{hint}"),
                "correct the type",
            );
        }
    }
}

fn names(port: &Port) -> String {
    let names: Vec<String> = port.types.iter().map(|name| format!("`{TYPE_PREFIX}{name}`")).collect();
    names.join(" or ")
}

/// The wires that end at a node: their other end, its type, and how dora queues them.
pub(super) fn wires(graph: &FlatGraph, node: &FlatNode, stage: Option<&'static Registration>, findings: &mut Findings) {
    for (port, input) in &node.inputs {
        match input.output() {
            Some((OUTSIDE, _)) => {}
            Some((source, output)) => sending_end(graph, (node, stage), port, (source, output), findings),
            None if stage.is_some() => {
                let mend = "our stages take messages of the graph only";
                findings.port(
                    Severity::Error,
                    node,
                    port,
                    "an output of a node",
                    format!("`{}`", input.source),
                    mend,
                );
            }
            None => {}
        }
        queue(node, port, input, stage.is_some(), findings);
    }
}

fn sending_end(
    graph: &FlatGraph,
    (node, stage): (&FlatNode, Option<&'static Registration>),
    port: &str,
    (source, output): (&str, &str),
    findings: &mut Findings,
) {
    let Some(sender) = graph.node(source) else {
        let nearest = nearest_name(source, graph.nodes.iter().map(|node| node.id.as_str()));
        let found = format!("`{source}/{output}`: no node `{source}`{}", did_you_mean(&nearest));
        return findings.port(
            Severity::Error,
            node,
            port,
            "an output of a node",
            found,
            "correct the source",
        );
    };
    if !sender.outputs.contains(output) {
        let nearest = nearest_name(output, sender.outputs.iter().map(String::as_str));
        let known = sender.outputs.iter().cloned().collect::<Vec<_>>().join(", ");
        let expected = format!("an output of `{source}`: {known}");
        let found = format!("`{source}/{output}`{}", did_you_mean(&nearest));
        return findings.port(
            Severity::Error,
            node,
            port,
            expected,
            found,
            "correct the source, or declare the output",
        );
    }
    let base = |name: &String| name.split('[').next().unwrap_or_default().to_string();
    let Some(sent) = sender.output_types.get(output).map(base) else {
        return;
    };
    let taken = match (
        node.input_types.get(port).map(base),
        stage.and_then(|stage| stage.input(port)),
    ) {
        (Some(taken), _) => vec![taken],
        (None, Some((_, port))) => port.types.iter().map(|name| format!("{TYPE_PREFIX}{name}")).collect(),
        (None, None) => return,
    };
    let ours = sent.starts_with(TYPE_PREFIX) || taken.iter().any(|taken| taken.starts_with(TYPE_PREFIX));
    if ours && !taken.contains(&sent) && taken != ["std/core/v1/Bytes"] {
        let found = format!("`{sent}` from `{source}/{output}`");
        findings.port(
            Severity::Error,
            node,
            port,
            format!("`{}`", taken.join("` or `")),
            found,
            "wire another output, or correct a type",
        );
    }
}

fn queue(node: &FlatNode, port: &str, input: &Input, ours: bool, findings: &mut Findings) {
    if input.queue_policy.as_deref() == Some("backpressure") {
        let mend = "take it away: it moves the wire to a slower way and still loses messages between machines";
        findings.port(
            Severity::Warning,
            node,
            port,
            "no `queue_policy`",
            "`backpressure`".into(),
            mend,
        );
    }
    if ours && input.input_timeout.is_some() {
        let mend = "take it away: a pause of the log would end the wire";
        findings.port(Severity::Warning, node, port, "no `input_timeout`", "one".into(), mend);
    }
}
