//! What is drawn of a run: the graph that was run, with what was measured of its stages and arrows.

use std::collections::BTreeSet;
use std::path::Path;

use eyre::{Result, bail};
use realo_diagram::Diagram;
use realo_graph::{FlatGraph, FlatNode, Input, InputSource};
use realo_operator::{Durations, Role};
use realo_results::{GROUP, GraphStages, LinkBooks, Run, read_run};
use realo_schemas::{Kind, PayloadType, to_millis};

use super::stages::{self, types};
use crate::run::described::PROCESS;
use crate::{registry, roles};

/// Below this nothing is said of a time, ms.
const LEAST_MS: f64 = 0.05;

/// The picture of a run's graph.
///
/// # Errors
/// A run that cannot be read, or that does not say its graph.
pub fn of_run(folder: &Path) -> Result<Diagram> {
    of(&read_run(folder)?, folder)
}

/// The same of a run that was read.
///
/// # Errors
/// A run that does not say its graph.
pub fn of(run: &Run, folder: &Path) -> Result<Diagram> {
    if run.samples.graph.is_empty() {
        bail!(
            "{}: the run does not say which graph was run, as one that `realo run` started does: draw its graph by \
             `realo graph GRAPH`, or run it again by `realo run`",
            folder.display()
        );
    }
    let graph = graph(&run.samples.graph, folder);
    let mut diagram = stages::diagram(&graph)?;
    let name = match run.result.settings.graph.as_str() {
        "" => "graph",
        name => name,
    };
    diagram.title = stages::title(name, &diagram);
    let measured = Measured {
        run,
        seconds: run.timing.samples.duration_ns as f64 / 1e9,
    };
    diagram.about = measured.about();
    for (at, node) in graph.nodes.iter().enumerate() {
        measured.describe(&graph, node, &mut diagram.stages[at]);
    }
    Ok(diagram)
}

/// The stages of a run as a graph; where its files were is not known.
fn graph(stages: &GraphStages, folder: &Path) -> FlatGraph {
    let nodes = stages.iter().map(|(id, entries)| {
        let runs = entries.get("runs").map(String::as_str).unwrap_or_default();
        let mut words = runs.split(' ').map(String::from);
        let mut node = FlatNode::alone(id, &[], &[]);
        let is_ours = ["operator ", "node ", "program "]
            .iter()
            .any(|word| runs.starts_with(word));
        if !is_ours {
            node.path = words.next().unwrap_or_default().into();
        }
        node.args = words.collect();
        node.host = entries.get(PROCESS).cloned();
        let inputs = entries
            .iter()
            .filter_map(|(key, wire)| Some((key.strip_prefix("inputs.")?, wire)));
        node.inputs = inputs.map(|(port, wire)| (port.to_string(), input(wire))).collect();
        node
    });
    let groups = stages.iter().filter_map(|(id, entries)| {
        let process = entries.get(PROCESS).unwrap_or(id);
        Some((process.clone(), entries.get(GROUP)?.clone()))
    });
    FlatGraph {
        file: folder.into(),
        settings: Default::default(),
        nodes: nodes.collect(),
        hosts: Vec::new(),
        groups: groups.collect(),
    }
}

/// A wire as results have it: `fusion.bank/selections, queue_size 4`.
fn input(wire: &str) -> Input {
    let source = wire.split(", ").next().unwrap_or_default();
    let source = match source.split_once('/').filter(|_| !source.starts_with("dora/")) {
        Some((node, output)) => InputSource::Output {
            node: node.into(),
            output: output.into(),
        },
        None => InputSource::Builtin(source.into()),
    };
    source.into()
}

/// A run, and how long its log was.
struct Measured<'a> {
    run: &'a Run,
    seconds: f64,
}

impl Measured<'_> {
    fn about(&self) -> Vec<String> {
        let result = &self.run.result;
        let settings = &result.settings;
        let words = [
            ("", &settings.mode),
            ("ego ", &settings.ego),
            ("link ", &settings.link),
            ("compute ", &settings.compute),
            ("changed: ", &settings.set),
        ];
        let said = words.iter().filter(|(_, value)| !value.is_empty());
        let mut about: Vec<String> = said.map(|(what, value)| format!("{what}{value}")).collect();
        about.extend(result.ended_by.iter().map(|by| format!("ended early by {by}")));
        let mut lines = vec![about.join("; ")];
        let is_counted = result.nodes.values().any(|node| !node.sent.is_empty());
        lines.push(match is_counted {
            true => {
                "Hz: messages in a second of the log, of all agents together. ms: medians. KB/s: on the links.".into()
            }
            false => {
                "The run is of a program that did not count messages by output, so there are no rates: run it again."
                    .into()
            }
        });
        lines
    }

    fn describe(&self, graph: &FlatGraph, node: &FlatNode, drawn: &mut realo_diagram::Stage) {
        let (result, timing) = (&self.run.result, &self.run.timing);
        let summary = result.nodes.get(&node.id);
        let waiting = timing.waiting_ms.get(&node.id).and_then(|waiting| waiting.p50);
        let waiting = waiting
            .filter(|ms| *ms >= LEAST_MS)
            .map(|ms| format!("waits {} ms", short(ms)));
        let on_arrow = drawn.inputs.len() == 1;
        let late = timing
            .late_ms
            .get(&node.id)
            .and_then(|late| late.p50)
            .filter(|ms| *ms >= LEAST_MS);
        let facts = [
            self.takes(&node.id),
            late.map(|ms| format!("{} ms late", short(ms))),
            waiting.clone().filter(|_| !on_arrow),
            summary.and_then(|summary| some(summary.errors, "calls failed")),
            summary.and_then(|summary| some(summary.unjoined, "without partners")),
        ];
        drawn.facts = vec![joined(facts)]
            .into_iter()
            .filter(|line| !line.is_empty())
            .collect();
        for input in &mut drawn.inputs {
            let edge = result.transport.edges.get(&format!("{}.{}", node.id, input.name));
            let skipped = summary.and_then(|summary| summary.skipped_at.get(&input.name));
            let lost = [
                edge.and_then(|edge| some(edge.lost, "lost by dora")),
                skipped.and_then(|skipped| some(*skipped, "skipped")),
            ];
            input.lost = lost.iter().any(Option::is_some);
            input.facts = joined(lost.into_iter().chain([waiting.clone().filter(|_| on_arrow)]));
        }
        let mut carried = self.carried(graph, node);
        for output in &mut drawn.outputs {
            let link = carried.take_if(|_| output.payload == PayloadType::Packet.as_str());
            let (said, lost) = link.unwrap_or_default();
            output.lost = lost;
            output.facts = joined(
                [self.rate(&node.id, &output.name)]
                    .into_iter()
                    .chain(said.into_iter().map(Some)),
            );
        }
    }

    /// How long calls of a stage take.
    fn takes(&self, id: &str) -> Option<String> {
        let mut all = Durations::default();
        let triggers = self.run.timing.samples.compute.get(id)?;
        triggers.values().for_each(|durations| all.merge(durations));
        let [half, most] = [0.5, 0.95].map(|share| all.quantile(share).map(to_millis));
        let half = half.filter(|ms| *ms >= LEAST_MS)?;
        Some(format!("{} ms a call, p95 {} ms", short(half), short(most?)))
    }

    fn rate(&self, id: &str, output: &str) -> Option<String> {
        let summary = self
            .run
            .result
            .nodes
            .get(id)
            .filter(|summary| !summary.sent.is_empty())?;
        let sent = summary.sent.get(output).copied().unwrap_or(0);
        Some(match self.seconds > 0.0 {
            true => format!("{:.1} Hz", sent as f64 / self.seconds),
            false => format!("{sent} messages"),
        })
    }

    /// What a link or radio carried, kind by kind, and whether some was lost.
    fn carried(&self, graph: &FlatGraph, node: &FlatNode) -> Option<(Vec<String>, bool)> {
        let known = node.registration(&registry())?;
        let is_link = known.setting(roles::LINK).is_some() || known.role == Role::Gateway;
        if !is_link {
            return None;
        }
        let kinds = kinds_over(graph, node);
        let mut sums: Vec<(&str, LinkBooks)> = Vec::new();
        for (_, kind, books) in self.run.result.channels().filter(|(_, kind, _)| kinds.contains(*kind)) {
            match sums.iter_mut().find(|(known, _)| *known == kind) {
                Some((_, sum)) => sum.add(books),
                None => sums.push((kind, books.clone())),
            }
        }
        let lost = sums.iter().any(|(_, books)| books.lost > 0);
        let offline = self.run.result.settings.mode == "offline";
        let said = sums.iter().map(|(kind, books)| {
            let age = self
                .run
                .result
                .age_ms
                .by_kind
                .get(*kind)
                .and_then(|age| age.p50)
                .filter(|_| !offline);
            let bytes = match self.seconds > 0.0 {
                true => format!("{} KB/s", short(books.bytes as f64 / 1000.0 / self.seconds)),
                false => format!("{} KB", short(books.bytes as f64 / 1000.0)),
            };
            let words = [
                Some(format!("{kind} {bytes}")),
                age.map(|ms| format!("{ms:.0} ms old")),
                some(books.lost, "lost"),
            ];
            joined(words)
        });
        Some((said.collect(), lost))
    }
}

/// The kinds of messages that senders give to a link, by the types of what they send.
fn kinds_over(graph: &FlatGraph, link: &FlatNode) -> BTreeSet<&'static str> {
    let sources = |node: &FlatNode| -> Vec<(String, String)> {
        let taken = node.inputs.values().filter_map(Input::output);
        taken
            .map(|(node, output)| (node.to_string(), output.to_string()))
            .collect()
    };
    let packet = PayloadType::Packet.as_str();
    let mut kinds = BTreeSet::new();
    for (sender, output) in sources(link) {
        let Some(sender) = graph
            .node(&sender)
            .filter(|sender| types(graph, sender, &output) == [packet])
        else {
            continue;
        };
        for (source, output) in sources(sender) {
            let Some(source) = graph.node(&source) else { continue };
            let types = types(graph, source, &output);
            let sent = PayloadType::ALL
                .iter()
                .filter(|kind| types.iter().any(|name| name == kind.as_str()));
            kinds.extend(sent.filter_map(|payload| Kind::of(*payload)).map(|kind| kind.as_str()));
        }
    }
    kinds
}

fn some(count: u64, what: &str) -> Option<String> {
    (count > 0).then(|| format!("{count} {what}"))
}

fn joined(parts: impl IntoIterator<Item = Option<String>>) -> String {
    parts.into_iter().flatten().collect::<Vec<_>>().join(", ")
}

/// To a tenth below 100.
fn short(value: f64) -> String {
    match value < 99.95 {
        true => format!("{value:.1}"),
        false => format!("{value:.0}"),
    }
}
