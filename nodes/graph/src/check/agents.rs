//! Whose graph it is, where one agent has a graph of its own.

use super::{Findings, FlatGraph, FlatNode, Severity};
use realo_documents::shown;
use realo_operator::{Registration, Role};

/// Player, radio and log recorder of a graph are of one agent.
pub(super) fn check(graph: &FlatGraph, stages: &[Option<&'static Registration>], findings: &mut Findings) {
    let mut first: Option<(&FlatNode, &str)> = None;
    for (node, stage) in graph.nodes.iter().zip(stages) {
        let Some(argument) = stage.and_then(agent_argument) else {
            continue;
        };
        let given = node.settings().iter().filter_map(|setting| setting.split_once('='));
        let mut given = given.filter(|(key, value)| *key == argument && !value.is_empty());
        let Some((_, agent)) = given.next() else { continue };
        let (other, known) = *first.get_or_insert((node, agent));
        if agent != known {
            let expected = format!("`{argument}={}`, as node `{}` has it", shown(known), other.id);
            let mend = "a graph with a radio or a log recorder is one agent's: give all three the same `agent`";
            findings.node(Severity::Error, node, expected, format!("`{}`", shown(agent)), mend);
        }
    }
}

/// The setting that says whose sensors, packets or log it has.
fn agent_argument(stage: &Registration) -> Option<&'static str> {
    match stage.role {
        Role::Source => stage.setting("own"),
        Role::Gateway | Role::Sink => stage.setting("ego"),
        Role::Operator => None,
    }
}
