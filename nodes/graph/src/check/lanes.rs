//! Whose data a wire carries, and where it may go.

use std::collections::BTreeMap;
use std::fmt;

use super::{Findings, FlatGraph, FlatNode, Severity};
use realo_operator::{Registration, Registry};

/// Whose data a wire carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Lane {
    /// The ego's own.
    Ego,
    /// The other agents', where they are made.
    Others,
    /// The other agents', after a link brought it to the ego.
    OthersReceived,
    /// The ego's, after a link brought it to the others.
    EgoReceived,
}
use Lane::{Ego, EgoReceived, Others, OthersReceived};

impl fmt::Display for Lane {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Ego => "the ego's data",
            Others => "the others' data",
            OthersReceived => "the others' data, through a link",
            EgoReceived => "the ego's data, through a link",
        })
    }
}

/// Stands for every output.
const ALL: &str = "*";

/// What a stage demands of its inputs and makes of its outputs; ports that are not named are free and carry no lane.
struct Rule {
    /// Name of the operator or node; `x-*` stands for all that begin with `x-`.
    stage: &'static str,
    inputs: &'static [(&'static str, Lane)],
    outputs: &'static [(&'static str, Lane)],
}

/// Stages where lanes begin, meet or cross. Any other stage takes one lane and passes it on.
const RULES: &[Rule] = &[
    Rule {
        stage: "player",
        inputs: &[],
        outputs: &[
            ("ego_clouds", Ego),
            ("ego_poses", Ego),
            ("ego_recorded", Ego),
            ("truth", Ego),
            ("clouds", Others),
            ("poses", Others),
            ("recorded", Others),
        ],
    },
    Rule {
        stage: "link",
        inputs: &[("ego", Ego), ("others", Others), ("ego_state", Ego), ("states", Others)],
        outputs: &[("to_ego", OthersReceived), ("to_others", EgoReceived)],
    },
    Rule {
        stage: "feature-bank",
        inputs: &[("ego", Ego), ("others", OthersReceived)],
        outputs: &[("selections", Ego)],
    },
    Rule {
        stage: "fusion-*",
        inputs: &[("ego", Ego), ("selections", Ego)],
        outputs: &[(ALL, Ego)],
    },
    Rule {
        stage: "evaluator",
        inputs: &[("truth", Ego), ("boxes", Ego)],
        outputs: &[],
    },
    Rule {
        stage: "results",
        inputs: &[("boxes", Ego), ("truth", Ego)],
        outputs: &[],
    },
    Rule {
        stage: "recorder",
        inputs: &[
            ("boxes", Ego),
            ("ego_boxes", Ego),
            ("other_boxes", Others),
            ("ego_state", Ego),
            ("states", Others),
            ("truth", Ego),
            ("ego_clouds", Ego),
            ("clouds", Others),
        ],
        outputs: &[],
    },
];

/// Inputs that tell a stage of another lane than the one it works for: stage, port, lane.
const ASIDE: &[(&str, &str, Lane)] = &[("transmission-encoder", "state", EgoReceived)];

/// Pairs of inputs that must hang on the same wire: (stage, input) and (stage, input), and why.
const SAME_WIRE: &[(&str, &str, &str, &str, &str)] = &[
    (
        "evaluator",
        "boxes",
        "results",
        "boxes",
        "the boxes that are scored are those that are kept",
    ),
    (
        "evaluator",
        "truth",
        "results",
        "truth",
        "both speak of the same frames",
    ),
];

/// Checks every wire of the graph against the rules.
pub(super) fn check(
    graph: &FlatGraph,
    ranks: &[usize],
    stages: &[Option<&'static Registration>],
    findings: &mut Findings,
) {
    let mut order: Vec<usize> = (0..graph.nodes.len()).collect();
    order.sort_by_key(|node| ranks[*node]);
    let mut lanes: BTreeMap<(&str, &str), Lane> = BTreeMap::new();
    for index in order {
        let node = &graph.nodes[index];
        let taken = node
            .inputs
            .iter()
            .filter_map(|(port, input)| Some((port.as_str(), *lanes.get(&input.output()?)?)));
        let mut taken: BTreeMap<&str, Lane> = taken.collect();
        aside(node, stages[index], &mut taken, findings);
        match rule_of(stages[index]) {
            Some(rule) => {
                demanded(node, rule, &taken, findings);
                let given = |output: &str| rule.outputs.iter().find(|(port, _)| *port == ALL || *port == output);
                let made = node
                    .outputs
                    .iter()
                    .filter_map(|output| Some((output.as_str(), given(output)?.1)));
                lanes.extend(made.map(|(output, lane)| ((node.id.as_str(), output), lane)));
            }
            None => {
                let Some(lane) = single(node, &taken, findings) else {
                    continue;
                };
                lanes.extend(
                    node.outputs
                        .iter()
                        .map(|output| ((node.id.as_str(), output.as_str()), lane)),
                );
            }
        }
    }
    queries(graph, stages, findings);
    same_wires(graph, stages, findings);
}

fn rule_of(stage: Option<&'static Registration>) -> Option<&'static Rule> {
    let name = stage?.name;
    RULES.iter().find(|rule| match rule.stage.strip_suffix('*') {
        Some(head) => name.starts_with(head),
        None => name == rule.stage,
    })
}

fn demanded(node: &FlatNode, rule: &Rule, taken: &BTreeMap<&str, Lane>, findings: &mut Findings) {
    for (port, demanded) in rule.inputs {
        if let Some(found) = taken.get(port) {
            wrong_lane(node, port, *demanded, *found, findings);
        }
    }
}

/// Takes the ports beside a stage's lane out of `taken`, checked.
fn aside(
    node: &FlatNode,
    stage: Option<&'static Registration>,
    taken: &mut BTreeMap<&str, Lane>,
    findings: &mut Findings,
) {
    let of_stage = ASIDE
        .iter()
        .filter(|(name, ..)| stage.is_some_and(|stage| stage.name == *name));
    for (_, port, demanded) in of_stage {
        if let Some(found) = taken.remove(port) {
            wrong_lane(node, port, *demanded, found, findings);
        }
    }
}

fn wrong_lane(node: &FlatNode, port: &str, demanded: Lane, found: Lane, findings: &mut Findings) {
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

/// The one lane of all inputs; a finding if there are several.
fn single(node: &FlatNode, taken: &BTreeMap<&str, Lane>, findings: &mut Findings) -> Option<Lane> {
    let lane = *taken.values().next()?;
    if taken.values().all(|other| *other == lane) {
        return Some(lane);
    }
    let each: Vec<String> = taken
        .iter()
        .map(|(port, lane)| format!("`{port}` takes {lane}, from `{}`", node.inputs[*port].source))
        .collect();
    let mend = "wire all inputs to one lane; lanes meet in a feature-bank and cross in a link";
    findings.node(Severity::Error, node, "inputs of one lane", each.join("; "), mend);
    None
}

/// A stage that takes a bank's selections must take as `ego` the messages that asked for them.
fn queries(graph: &FlatGraph, stages: &[Option<&'static Registration>], findings: &mut Findings) {
    for node in &graph.nodes {
        let (Some(ego), Some(selections)) = (node.inputs.get("ego"), node.inputs.get("selections")) else {
            continue;
        };
        let source = selections.output().map(|(source, _)| source);
        let bank = graph.nodes.iter().zip(stages).find(|(bank, stage)| {
            Some(bank.id.as_str()) == source && stage.is_some_and(|stage| stage.name == "feature-bank")
        });
        let Some((bank, query)) = bank.and_then(|(bank, _)| Some((bank, bank.inputs.get("ego")?))) else {
            continue;
        };
        if query.source != ego.source {
            let expected = format!("`{}`, which asks `{}` for the selections", query.source, bank.id);
            let mend = "wire the same output to both: a selection answers one message, and only that one finds it";
            findings.port(
                Severity::Error,
                node,
                "ego",
                expected,
                format!("`{}`", ego.source),
                mend,
            );
        }
    }
}

fn same_wires(graph: &FlatGraph, stages: &[Option<&'static Registration>], findings: &mut Findings) {
    let wires = |name: &'static str, port: &'static str| {
        let named = graph
            .nodes
            .iter()
            .zip(stages)
            .filter(move |(_, stage)| stage.is_some_and(|stage| stage.name == name));
        named.filter_map(move |(node, _)| Some((node, node.inputs.get(port)?)))
    };
    for (stage, port, other, other_port, why) in SAME_WIRE {
        for (node, input) in wires(other, other_port) {
            let Some((first, expected)) = wires(stage, port).next() else {
                continue;
            };
            if expected.source != input.source {
                let expected = format!("`{}`, as `{}` takes it", expected.source, first.id);
                findings.port(
                    Severity::Error,
                    node,
                    other_port,
                    expected,
                    format!("`{}`", input.source),
                    *why,
                );
            }
        }
    }
}

/// Ports that the tables name and the registry does not have; a table that speaks of nothing would check nothing.
pub(crate) fn check_tables(registry: &Registry) -> Vec<String> {
    let mut missing = Vec::new();
    for (name, port, _) in ASIDE {
        if !registry
            .0
            .iter()
            .any(|stage| stage.name == *name && stage.input(port).is_some())
        {
            missing.push(format!("lanes: no stage `{name}` with an input `{port}`"));
        }
    }
    for rule in RULES {
        let stages: Vec<&Registration> = registry
            .0
            .iter()
            .filter(|stage| rule_of(Some(stage)).is_some_and(|found| found.stage == rule.stage))
            .collect();
        if stages.is_empty() {
            missing.push(format!("lanes: no stage `{}`", rule.stage));
        }
        for stage in stages {
            let inputs = rule.inputs.iter().filter(|(port, _)| stage.input(port).is_none());
            missing.extend(inputs.map(|(port, _)| format!("lanes: `{}` has no input `{port}`", stage.name)));
            let outputs = rule
                .outputs
                .iter()
                .filter(|(port, _)| *port != ALL && stage.output(port).is_none());
            missing.extend(outputs.map(|(port, _)| format!("lanes: `{}` has no output `{port}`", stage.name)));
        }
    }
    missing
}
