//! The lane of the agents that send: the stages from the player to what gives their packets to the link, and runs that play
//! what it would send out of the log.

use crate::roles;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use eyre::{Result, WrapErr, bail};
use realo_graph::{FlatGraph, FlatNode, InputSource, TYPE_PREFIX};
use realo_logs::{LaneStage, Log};
use realo_operator::{Role, Side};
use realo_player::PlannedRun;
use realo_schemas::PayloadType;
use sha2::{Digest, Sha256};

use super::networks::Networks;
use super::nodes::{argument, decide, decided_argument, deciding, given, keys, registration};

/// The player's output for what is precomputed.
const PACKETS: &str = "packets";

/// The lane of a graph.
#[derive(Clone, Debug)]
pub struct SendingLane {
    /// The stage that gives packets to the link.
    pub stage: String,
    /// Its output.
    pub output: String,
    /// Ids of its stages, with that one and the player.
    stages: BTreeSet<String>,
    /// The player's outputs that it takes.
    played: BTreeSet<String>,
}

impl SendingLane {
    /// The lane of a graph; `None` where nothing that is made of sweeps crosses a link to the ego.
    ///
    /// # Errors
    /// A graph with several such channels.
    pub fn of(graph: &FlatGraph) -> Result<Option<Self>> {
        let mut sources = BTreeSet::new();
        for link in deciding(graph, roles::LINK).filter(|link| is_heard(graph, link)) {
            let known = registration(link).map(|known| known.inputs).unwrap_or_default();
            let packets = known
                .iter()
                .filter(|port| port.side == Some(Side::Others) && port.types == [PayloadType::Packet]);
            let taken = packets.filter_map(|port| link.inputs.get(port.name)?.output());
            let of_sweeps = |source: &(&str, &str)| !carries_states(graph, source.0);
            sources.extend(
                taken
                    .filter(of_sweeps)
                    .map(|(node, output)| (node.to_string(), output.to_string())),
            );
        }
        let mut sources = sources.into_iter();
        let (Some((stage, output)), more) = (sources.next(), sources.next()) else {
            return Ok(None);
        };
        if let Some((other, _)) = more {
            bail!(
                "{}: expected one channel by which agents send what they make of sweeps, found those of `{stage}` and `{other}`",
                graph.file.display()
            );
        }
        let (stages, played) = upstream(graph, &stage);
        let from_player = stages.iter().any(|id| is_player(graph, id));
        Ok(from_player.then_some(SendingLane {
            stage,
            output,
            stages,
            played,
        }))
    }

    /// The lane alone, with the player.
    pub fn cut_out(&self, graph: &FlatGraph) -> FlatGraph {
        let mut alone = graph.clone().apart();
        alone.nodes.retain(|node| self.stages.contains(&node.id));
        for node in &mut alone.nodes {
            let stages = &self.stages;
            node.inputs
                .retain(|_, input| input.output().is_some_and(|(source, _)| stages.contains(source)));
        }
        alone
    }

    /// Whether it depends on who is the ego.
    pub fn knows_ego(&self, graph: &FlatGraph) -> bool {
        let players = self
            .stages
            .iter()
            .filter_map(|id| graph.node(id))
            .filter_map(registration);
        let mut outputs = players
            .filter(|known| known.role == Role::Source)
            .flat_map(|known| known.outputs);
        outputs.any(|port| port.side == Some(Side::Ego) && self.played.contains(port.name))
    }

    /// All that decides what the lane makes of a log.
    ///
    /// # Errors
    /// A model that cannot be loaded; a program that cannot be read.
    pub fn described(&self, graph: &FlatGraph, networks: &mut Networks) -> Result<Vec<LaneStage>> {
        let nodes = self.stages.iter().filter_map(|id| graph.node(id));
        nodes
            .map(|node| match is_player(graph, &node.id) {
                true => Ok(self.described_player(graph, node)),
                false => described(graph, node, networks).wrap_err_with(|| format!("node `{}`", node.id)),
            })
            .collect()
    }

    /// Of the player what decides what it plays of sweeps and poses, and the ego if the lane knows it.
    fn described_player(&self, graph: &FlatGraph, node: &FlatNode) -> LaneStage {
        let mut keys = vec!["pose"];
        if self.knows_ego(graph) {
            keys.extend(decided_argument(node, roles::EGO));
        }
        let arguments = keys
            .into_iter()
            .filter_map(|key| Some((key.into(), argument(node, key)?)));
        LaneStage {
            stage: node.id.clone(),
            runs: node.args.iter().take(2).cloned().collect::<Vec<_>>().join(" "),
            arguments: arguments.collect(),
        }
    }

    /// The graph with what the log has precomputed in place of the lane.
    fn replaced(&self, graph: &FlatGraph) -> FlatGraph {
        let mut graph = graph.clone();
        let player = self
            .stages
            .iter()
            .find(|id| is_player(&graph, id))
            .cloned()
            .unwrap_or_default();
        let of = format!("{TYPE_PREFIX}{}", PayloadType::Packet);
        graph.rewire((&self.stage, &self.output), (&player, PACKETS), &of);
        decide(&mut graph, roles::PRECOMPUTED, "true");
        graph
    }
}

/// The graph of a run with the collaborators' messages out of the log, and what the results tell of that; `None` where the log
/// has none for this run.
///
/// # Errors
/// A log whose messages were computed by another lane, or for some of the collaborators only; offline runs.
pub fn precomputed(
    graph: &FlatGraph,
    log: &Log,
    run: &PlannedRun,
    offline: bool,
    networks: &mut Networks,
) -> Result<Option<(FlatGraph, String)>> {
    let Some(known) = &log.info().precomputed else {
        return Ok(None);
    };
    let has = |agent: &&String| known.agents.contains(agent);
    let Some(lane) = SendingLane::of(graph)?.filter(|_| run.collaborators.iter().any(|agent| has(&agent))) else {
        return Ok(None);
    };
    let (path, file) = (log.path().display(), graph.file.display());
    if offline {
        bail!(
            "{path} has messages of {} that were made with poses and at times as recorded, which --offline does not play: play \
             the log that it was made of",
            known.agents.join(", ")
        );
    }
    if let Some(difference) = known.difference(&lane.described(graph, networks)?) {
        bail!(
            "{path}: its messages of {} do not fit {file}: they were computed {difference}; take the log that it was made of, \
             or `realo precompute` that one with this graph and these options",
            known.agents.join(", ")
        );
    }
    if let Some(missing) = run.collaborators.iter().find(|agent| !has(agent)) {
        let (word, ego) = (realo_logs::shell::word(log.path()), &run.ego);
        bail!(
            "{path} has no precomputed messages of {missing}, which collaborates with {ego} too: precompute these as well \
             (`realo precompute {word} … --agent {missing}`), or choose among those that it has: --agents {ego},{}",
            known.agents.join(",")
        );
    }
    let words = format!("{} ({})", run.collaborators.join(", "), known.compute);
    Ok(Some((lane.replaced(graph), words)))
}

/// Whether somebody takes what a link brings to the ego.
fn is_heard(graph: &FlatGraph, link: &FlatNode) -> bool {
    let outputs = registration(link).map(|known| known.outputs).unwrap_or_default();
    let to_ego = outputs.iter().filter(|port| port.side == Some(Side::OthersReceived));
    let mut inputs = graph.nodes.iter().flat_map(|node| node.inputs.values());
    let to_ego: Vec<&str> = to_ego.map(|port| port.name).collect();
    inputs.any(|input| {
        let taken = input.output();
        taken.is_some_and(|(node, output)| node == link.id && to_ego.contains(&output))
    })
}

/// Whether what a sender sends are states.
fn carries_states(graph: &FlatGraph, sender: &str) -> bool {
    let states = format!("{TYPE_PREFIX}{}", PayloadType::AgentState);
    let Some(sender) = graph.node(sender) else { return false };
    let mut sources = sender.inputs.values().filter_map(|input| input.output());
    sources.any(|(node, output)| {
        let source = graph.node(node);
        source.is_some_and(|source| source.output_types.get(output) == Some(&states))
    })
}

fn is_player(graph: &FlatGraph, id: &str) -> bool {
    graph
        .node(id)
        .is_some_and(|node| decided_argument(node, roles::PRECOMPUTED).is_some())
}

/// The stages before one and itself, by the wires that their arguments make them need, and what they take of sources.
fn upstream(graph: &FlatGraph, last: &str) -> (BTreeSet<String>, BTreeSet<String>) {
    let (mut stages, mut played) = (BTreeSet::new(), BTreeSet::new());
    let mut open = vec![last.to_string()];
    while let Some(id) = open.pop() {
        let Some(node) = graph.node(&id) else { continue };
        if !stages.insert(id) {
            continue;
        }
        let needed = |port: &str| {
            let known = registration(node).and_then(|known| known.input(port));
            let when = known.and_then(|(_, port)| port.needed);
            when.is_none_or(|(key, value)| argument(node, key).as_deref() == Some(value))
        };
        for (_, input) in node.inputs.iter().filter(|(port, _)| needed(port)) {
            let InputSource::Output { node: source, output } = &input.source else {
                continue;
            };
            if is_player(graph, source) {
                played.insert(output.clone());
            }
            open.push(source.clone());
        }
    }
    (stages, played)
}

fn described(graph: &FlatGraph, node: &FlatNode, networks: &mut Networks) -> Result<LaneStage> {
    let folder = graph.file.parent().unwrap_or(Path::new("/"));
    let value = |key: &String| match registration(node) {
        Some(_) => argument(node, key),
        None => given(node, key).map(str::to_string),
    };
    let mut arguments: BTreeMap<String, String> = keys(node)
        .into_iter()
        .filter_map(|key| value(&key).map(|value| (key, value)))
        .collect();
    if let (Some(key), Some(identity)) = (decided_argument(node, roles::MODEL), networks.identity(node)?) {
        arguments.insert(key.into(), identity);
    }
    let runs = match node.program() {
        None => node.args.iter().take(2).cloned().collect::<Vec<_>>().join(" "),
        Some(program) => {
            let path = folder.join(program);
            let bytes = std::fs::read(&path).wrap_err_with(|| format!("{}", path.display()))?;
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let digest: String = Sha256::digest(bytes)[..8]
                .iter()
                .map(|byte| format!("{byte:02x}"))
                .collect();
            format!("program {name} {digest}")
        }
    };
    Ok(LaneStage {
        stage: node.id.clone(),
        runs,
        arguments,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn graph(name: &str) -> FlatGraph {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let mut graph = FlatGraph::load(&root.join(format!("dataflows/{name}.yml"))).unwrap();
        super::super::nodes::anchor_paths(&mut graph).unwrap();
        graph
    }

    /// A graph whose receivers project.
    fn received(name: &str) -> FlatGraph {
        let mut graph = graph(name);
        // Not every graph has such a stage.
        let _ = graph.set("others.projector", "project", "receiver");
        graph
    }

    fn lane(name: &str) -> Vec<String> {
        let lane = SendingLane::of(&received(name)).unwrap();
        lane.map(|lane| lane.stages.into_iter().collect()).unwrap_or_default()
    }

    #[test]
    fn a_lane_reaches_from_the_player_to_the_link() {
        let attfuse = ["encoder", "projector", "sender", "sense.localization", "sense.sync"];
        let late = ["encoder", "head", "nms", "sender", "sense.localization", "sense.sync"];
        let expected = |stages: &[&str]| {
            let mut all: Vec<String> = stages.iter().map(|stage| format!("others.{stage}")).collect();
            all.push("player".into());
            all
        };
        assert_eq!(lane("attfuse"), expected(&attfuse));
        assert_eq!(lane("late_fusion"), expected(&late));
        assert!(lane("no_fusion").is_empty());
    }

    #[test]
    fn shipped_graphs_project_as_their_weights_do_best() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        for (file, expected) in [
            ("dataflows/attfuse.yml", "sender"),
            ("dataflows/fcooper.yml", "sender"),
            ("dataflows/attfuse.roadside.yml", "sender"),
            ("examples/fusion_mean/fusion_mean.yml", "sender"),
            ("examples/python/mean_python.yml", "sender"),
            ("examples/python/torch_attfuse.yml", "sender"),
            ("examples/onnx/onnx_attfuse.yml", "sender"),
            ("dataflows/v2xvit.yml", "sender"),
            ("dataflows/early_fusion.yml", "receiver"),
        ] {
            let graph = FlatGraph::load(&root.join(file)).unwrap();
            let projector = graph.node("others.projector").unwrap();
            assert_eq!(argument(projector, "project").as_deref(), Some(expected), "{file}");
        }
    }

    #[test]
    fn senders_that_project_know_the_ego_others_do_not() {
        let knows = |graph: &FlatGraph| SendingLane::of(graph).unwrap().unwrap().knows_ego(graph);
        assert!(!knows(&received("fcooper")));
        // As shipped.
        let graph = graph("fcooper");
        assert!(knows(&graph));
        let stages = SendingLane::of(&graph).unwrap().unwrap().stages;
        assert!(
            stages.contains("v2x.state-link") && !stages.contains("v2x.link"),
            "{stages:?}"
        );
    }

    #[test]
    fn a_lane_is_described_by_its_models_and_all_arguments() {
        let mut networks = Networks::default();
        let mut described = |graph: &FlatGraph| {
            let lane = SendingLane::of(graph).unwrap().unwrap();
            lane.described(graph, &mut networks).unwrap()
        };
        let mut graph = received("attfuse");
        let known = realo_logs::Precomputed {
            graph: "attfuse".into(),
            agents: vec!["rsu1".into()],
            compute: "measured".into(),
            lane: described(&graph),
        };
        assert_eq!(known.difference(&known.lane), None);
        let model = &known.lane[0].arguments["model"];
        assert!(model.starts_with("lite-attfuse-") && !model.contains('/'), "{model}");
        // The link has no part in it.
        graph.set("v2x.link", "range_m", "3").unwrap();
        graph.set("fusion.bank", "window_ms", "3").unwrap();
        assert_eq!(known.difference(&described(&graph)), None);
        graph.set("others.sense.sync", "deskew", "false").unwrap();
        let difference = known.difference(&described(&graph)).unwrap();
        assert_eq!(difference, "with `others.sense.sync.deskew` = true, here it is false");
        let difference = known.difference(&described(&received("fcooper"))).unwrap();
        assert!(
            difference.contains("`others.encoder.model` = lite-attfuse-"),
            "{difference}"
        );
        let graph_of_boxes = self::graph("late_fusion");
        let difference = known.difference(&described(&graph_of_boxes)).unwrap();
        assert!(difference.contains("others."), "{difference}");
    }
}
