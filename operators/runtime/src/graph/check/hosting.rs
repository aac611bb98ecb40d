//! Programs, arguments, and the keys that only dora reads.

use std::collections::BTreeSet;

use realo_schemas::PayloadType;
use serde_yaml::Value;

use super::ports::payload_type;
use super::{Answer, Findings, FlatGraph, FlatNode, Severity};
use crate::{Registration, Registry, Role};

/// Bytes of shared memory that a node needs that sends clouds or feature maps.
const POOL: u64 = 64 << 20;

/// The stage that a node hosts, its arguments checked; `None` for foreign nodes and unknown names.
pub(super) fn stage(
    node: &FlatNode,
    registry: &Registry,
    ask: &mut dyn FnMut(&FlatNode) -> Answer,
    findings: &mut Findings,
) -> Option<&'static Registration> {
    let args = node.args.join(" ");
    let expected = "`operator NAME` or `node NAME`";
    if !node.is_realo() {
        return foreign(node, ask(node), findings);
    }
    let Some((word, name)) = node.stage() else {
        let mend = "`realo operators` prints the names";
        findings.node(Severity::Error, node, expected, format!("args `{args}`"), mend);
        return None;
    };
    let stage = match registry.find(word, name) {
        Ok(stage) => stage,
        Err(reason) => {
            let other = if word == "node" { "operator" } else { "node" };
            let mend = match registry.find(other, name) {
                Ok(_) => format!("`{name}` is a {other}: write `{other} {name}`"),
                Err(_) => reason,
            };
            findings.node(Severity::Error, node, expected, format!("`{word} {name}`"), &mend);
            return None;
        }
    };
    if let Err(error) = (stage.check)(node.settings()) {
        let expected = format!("arguments of `{name}`");
        findings.node(
            Severity::Error,
            node,
            expected,
            error.to_string(),
            "`realo operators` prints them",
        );
    }
    if let Some(arg) = node
        .settings()
        .iter()
        .find(|arg| arg.contains("$PARAM_") || arg.contains("${"))
    {
        let mend = "dora replaces no variables in `args`, and a module's parameters only if its node sets them";
        findings.node(Severity::Warning, node, "values", format!("`{arg}`"), mend);
    }
    Some(stage)
}

/// What is known of a program that is not realo.
fn foreign(node: &FlatNode, answer: Answer, findings: &mut Findings) -> Option<&'static Registration> {
    let program = node.path.display();
    let (found, mend) = match answer {
        Some(Ok(registration)) => return Some(registration),
        Some(Err(reason)) => (
            format!("the program {program}: {reason}"),
            "dora may run it all the same",
        ),
        None => (
            format!("the program {program}"),
            "its ports are not known here; it runs on dora, and in virtual time if it hosts an operator over pipes",
        ),
    };
    findings.node(Severity::Note, node, "a stage of realo", found, mend);
    None
}

/// Keys that make dora treat a node as it must not be treated.
pub(super) fn keys(node: &FlatNode, stage: Option<&'static Registration>, findings: &mut Findings) {
    let sink = stage.map_or(node.outputs.is_empty(), |stage| stage.role == Role::Sink);
    if sink && node.other.contains_key("health_check_timeout") {
        let mend = "take it away: dora counts what a node sends, so it kills a healthy sink";
        findings.node(
            Severity::Error,
            node,
            "no `health_check_timeout` on a sink",
            "one".into(),
            mend,
        );
    }
    let restarts = node
        .other
        .get("restart_policy")
        .and_then(Value::as_str)
        .filter(|policy| *policy != "never");
    if let Some(policy) = restarts.filter(|_| stage.is_some()) {
        let mend = "take it away: a stage that starts again has forgotten what it counted";
        findings.node(
            Severity::Warning,
            node,
            "no `restart_policy`",
            format!("`{policy}`"),
            mend,
        );
    }
}

/// Nodes that send clouds or maps, whole or as packets, need a pool that holds several of them.
pub(super) fn shared_memory(graph: &FlatGraph, ranks: &[usize], findings: &mut Findings) {
    let mut order: Vec<usize> = (0..graph.nodes.len()).collect();
    order.sort_by_key(|node| ranks[*node]);
    let mut big: BTreeSet<(&str, &str)> = BTreeSet::new();
    let mut lacking = Vec::new();
    for index in order {
        let node = &graph.nodes[index];
        let takes_big = node
            .inputs
            .values()
            .filter_map(|input| input.output())
            .any(|source| big.contains(&source));
        let is_big = |output: &&String| match node.output_types.get(*output).and_then(|name| payload_type(name)) {
            Some(PayloadType::PointCloud | PayloadType::FeatureMap) => true,
            Some(PayloadType::Packet | PayloadType::Selection) => takes_big,
            _ => false,
        };
        let sent: Vec<&String> = node.outputs.iter().filter(is_big).collect();
        if !sent.is_empty() && pool(node).is_none_or(|bytes| bytes < POOL) {
            lacking.push((
                index,
                sent.iter().map(|output| output.as_str()).collect::<Vec<_>>().join(", "),
            ));
        }
        big.extend(sent.into_iter().map(|output| (node.id.as_str(), output.as_str())));
    }
    lacking.sort();
    for (index, outputs) in lacking {
        let node = &graph.nodes[index];
        let found = node
            .other
            .get("shared_memory_pool_size")
            .map_or("none".into(), |value| format!("{value:?}"));
        let expected = format!("`shared_memory_pool_size: 128MB`, for it sends clouds or maps ({outputs})");
        let mend = "write it; beyond dora's 8 MB messages take another way and overtake each other";
        findings.node(Severity::Warning, node, expected, found, mend);
    }
}

/// The node's pool in bytes, as dora reads it.
fn pool(node: &FlatNode) -> Option<u64> {
    let value = node.other.get("shared_memory_pool_size")?;
    if let Some(bytes) = value.as_u64() {
        return Some(bytes);
    }
    let text = value.as_str()?.trim();
    let digits = text
        .find(|c: char| !c.is_ascii_digit() && c != '.')
        .unwrap_or(text.len());
    let number: f64 = text[..digits].parse().ok()?;
    let unit = match text[digits..].trim().to_ascii_uppercase().as_str() {
        "" | "B" => 1.0,
        "KB" => 1024.0,
        "MB" => 1024.0 * 1024.0,
        "GB" => 1024.0 * 1024.0 * 1024.0,
        _ => return None,
    };
    Some((number * unit) as u64)
}
