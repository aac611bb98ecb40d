//! Whose data a wire carries, and where it may go, as ports declare it.

use std::collections::BTreeMap;

use realo_operator::Side::{Ego, EgoReceived, Others, OthersReceived};
use realo_operator::{Class, Port, Registration, Side};
use realo_schemas::PayloadType;

use super::{Findings, FlatGraph, FlatNode, Severity};
use crate::flat::InputSource;

/// Checks every wire of the graph against the rules.
pub(super) fn check(
    graph: &FlatGraph,
    ranks: &[usize],
    stages: &[Option<&'static Registration>],
    findings: &mut Findings,
) {
    let mut order: Vec<usize> = (0..graph.nodes.len()).collect();
    order.sort_by_key(|node| ranks[*node]);
    let mut sides: BTreeMap<(&str, &str), Side> = BTreeMap::new();
    for index in order {
        let node = &graph.nodes[index];
        let (mut free, mut demanded) = (BTreeMap::new(), Vec::new());
        for (port, input) in &node.inputs {
            let Some(found) = input.output().and_then(|output| sides.get(&output)) else {
                continue;
            };
            match stages[index].and_then(|stage| stage.input(port)?.1.side) {
                Some(side) => {
                    wrong_side(node, port, side, *found, findings);
                    demanded.push(side);
                }
                None => {
                    free.insert(port.as_str(), *found);
                }
            }
        }
        // What a stage makes is of the side that it works for: the one that all its inputs declare, else that of the rest.
        let declares_all = stages[index].is_some_and(|stage| stage.inputs.iter().all(|port| port.side.is_some()));
        let works_for = if declares_all {
            demanded
                .first()
                .copied()
                .filter(|first| demanded.iter().all(|side| side == first))
        } else {
            single(node, &free, findings)
        };
        for output in &node.outputs {
            let made = stages[index].and_then(|stage| stage.output(output)?.1.side);
            sides.extend(
                made.or(works_for)
                    .map(|side| ((node.id.as_str(), output.as_str()), side)),
            );
        }
    }
    queries(graph, stages, findings);
    same_wires(graph, stages, findings);
}

fn wrong_side(node: &FlatNode, port: &str, demanded: Side, found: Side, findings: &mut Findings) {
    if found != demanded {
        let mend = match (demanded, found) {
            (OthersReceived, Others) => "what the others send must cross a link: wire the output `to_ego` of one",
            (OthersReceived, _) => "wire what a link's `to_ego` delivers",
            (Ego, _) => "wire the ego's lane, which begins at the player's outputs `ego_*`",
            (Others, _) => "wire the others' lane, which begins at the player's outputs without `ego_`",
            (EgoReceived, _) => "wire what a link's `to_others` delivers",
        };
        let found = format!("{found}, from `{}`", node.inputs[port].source);
        findings.port(Severity::Error, node, port, demanded.to_string(), found, mend);
    }
}

/// The one side of all inputs; a finding if there are several.
fn single(node: &FlatNode, taken: &BTreeMap<&str, Side>, findings: &mut Findings) -> Option<Side> {
    let side = *taken.values().next()?;
    if taken.values().all(|other| *other == side) {
        return Some(side);
    }
    let each: Vec<String> = taken
        .iter()
        .map(|(port, side)| format!("`{port}` takes {side}, from `{}`", node.inputs[*port].source))
        .collect();
    let mend = "wire all inputs to one lane; lanes meet in a feature-bank and cross in a link";
    findings.node(Severity::Error, node, "inputs of one lane", each.join("; "), mend);
    None
}

/// A stage that takes selections must take, beside them, the messages that asked for them.
fn queries(graph: &FlatGraph, stages: &[Option<&'static Registration>], findings: &mut Findings) {
    for (node, stage) in graph.nodes.iter().zip(stages) {
        for (selections, asked) in stage.iter().flat_map(|stage| answered(stage.inputs)) {
            let (Some(selections), Some(input)) = (node.inputs.get(selections), node.inputs.get(asked)) else {
                continue;
            };
            let source = selections.output().map(|(source, _)| source);
            let bank = graph
                .nodes
                .iter()
                .zip(stages)
                .find(|(bank, _)| Some(bank.id.as_str()) == source);
            let query = bank.and_then(|(bank, stage)| {
                let port = stage.as_ref()?.inputs.iter().find(|port| port.class == Class::Query)?;
                Some((bank, bank.inputs.get(port.name)?))
            });
            if let Some((bank, query)) = query.filter(|(_, query)| query.source != input.source) {
                let expected = format!("`{}`, which asks `{}` for the selections", query.source, bank.id);
                let mend = "wire the same output to both: a selection answers one message, and only that one finds it";
                let found = format!("`{}`", input.source);
                findings.port(Severity::Error, node, asked, expected, found, mend);
            }
        }
    }
}

/// Inputs that take selections, each with the required ones that are joined with it; what comes beside them did not ask.
fn answered(inputs: &'static [Port]) -> impl Iterator<Item = (&'static str, &'static str)> {
    let selections = inputs
        .iter()
        .filter(|port| port.types == [PayloadType::Selection] && port.join.is_some());
    selections.flat_map(move |port| {
        let partners = inputs
            .iter()
            .filter(move |other| other.join == port.join && other.name != port.name && other.required);
        partners.map(move |other| (port.name, other.name))
    })
}

/// Inputs that say so hang on one wire.
fn same_wires(graph: &FlatGraph, stages: &[Option<&'static Registration>], findings: &mut Findings) {
    let mut first: BTreeMap<&str, (&FlatNode, &InputSource)> = BTreeMap::new();
    for (node, stage) in graph.nodes.iter().zip(stages) {
        let ports = stage.iter().flat_map(|stage| stage.inputs);
        for (port, word, input) in ports.filter_map(|port| Some((port, port.wire?, node.inputs.get(port.name)?))) {
            let (other, source) = *first.entry(word).or_insert((node, &input.source));
            if *source != input.source {
                let expected = format!("`{source}`, as `{}` takes it", other.id);
                let found = format!("`{}`", input.source);
                let mend = format!("wire both inputs to one output: they are {word}");
                findings.port(Severity::Error, node, port.name, expected, found, mend);
            }
        }
    }
}
