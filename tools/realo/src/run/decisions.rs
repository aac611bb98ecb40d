//! What the options and the log decide of the settings of one run.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use eyre::{Result, bail};
use realo_graph::{FlatGraph, FlatNode, Setting};
use realo_logs::{AgentKind, Log, Stream};
use realo_operator::config::{did_you_mean, nearest_name};
use realo_results::Settings;

use super::limit::PERFECT;
use super::nodes::{can_project, decide, decided_argument, deciding, given, set_model, values};
use super::prepare::{SETTINGS_FILE, stem};
use super::{Args, Mode, localization, named, replace};
use crate::roles;

/// Makes the links of a graph what they are offline, where nothing is delayed or lost.
///
/// # Errors
/// Another link, asked for beside `--offline`.
fn links_of_offline(graph: &mut FlatGraph, set: &[Setting]) -> Result<()> {
    for node in &mut graph.nodes {
        let Some(link) = decided_argument(node, roles::LINK) else {
            continue;
        };
        let is_link = |setting: &&Setting| setting.node == node.id && setting.key == link && setting.value != PERFECT;
        if let Some(Setting { node, key, value }) = set.iter().find(is_link) {
            bail!("--offline has neither delays nor loss: drop --set {node}.{key}={value}, or --offline");
        }
        node.set(link, PERFECT);
    }
    Ok(())
}

/// All that decides the settings of one run.
pub(super) struct Decisions<'a> {
    pub args: &'a Args,
    pub mode: Mode,
    /// Name of the graph.
    pub graph: &'a str,
    pub log_path: &'a Path,
    pub log: &'a Log,
    pub ego: &'a str,
    pub coop: &'a str,
    /// Absolute.
    pub out: &'a Path,
}

impl Decisions<'_> {
    /// The graph with the settings of this run; what the user set by hand stands above what the options imply.
    pub fn apply(&self, base: &FlatGraph, set: &[Setting]) -> Result<(FlatGraph, Settings)> {
        let mut graph = base.clone();
        let mut decisions = [self.of_run(), self.of_options()?, self.of_log(&graph)?].concat();
        if !values(&graph, roles::OWN, str::to_string).is_empty() {
            decisions.push((roles::OWN, self.ego.into()));
        }
        for (decided, value) in decisions {
            decide(&mut graph, decided, &value);
        }
        let choices = &self.args.choices;
        localization::choose(&mut graph, choices.localization, choices.map.as_deref())?;
        if let Some(model) = &self.args.choices.model {
            set_model(&mut graph, model)?;
        }
        if let Some(project) = self.args.choices.project {
            for node in graph.nodes.iter_mut().filter(|node| can_project(node)) {
                if let Some(argument) = decided_argument(node, roles::PROJECT) {
                    node.set(argument, project.as_str());
                }
            }
        }
        for node in &mut graph.nodes {
            if let Some(argument) = decided_argument(node, roles::RECORDING) {
                let before = base.node(&node.id).unwrap_or(node);
                let name = recording_name(before, argument, self.ego);
                node.set(argument, &self.out.join(name).to_string_lossy());
            }
        }
        for setting in set {
            graph.set(&setting.node, &setting.key, &setting.value)?;
        }
        if self.args.offline {
            links_of_offline(&mut graph, set)?;
        }
        if values(&graph, roles::OWN, str::to_string).is_empty() {
            self.refuse_unknown_roadside(&graph)?;
        }
        let settings = self.settings(&graph, set)?;
        Ok((graph, settings))
    }

    /// Refuses names of roadside units that the log does not have: nobody would be one, and the scores change. The graph of one
    /// agent may meet others than those of its log.
    fn refuse_unknown_roadside(&self, graph: &FlatGraph) -> Result<()> {
        let agents: Vec<&str> = self.log.info().agents.iter().map(|agent| &*agent.name).collect();
        for node in deciding(graph, roles::ROADSIDE) {
            let argument = decided_argument(node, roles::ROADSIDE).unwrap_or_default();
            let names = given(node, argument).unwrap_or_default().split(',').map(str::trim);
            if let Some(name) = names
                .filter(|name| !name.is_empty())
                .find(|name| !agents.contains(name))
            {
                let hint = did_you_mean(&nearest_name(name, agents.iter().copied()));
                bail!(
                    "node `{}`: setting `{argument}`: expected names of agents of {}, which are {}, found `{name}`{hint}",
                    node.id,
                    stem(self.log_path),
                    agents.join(", ")
                );
            }
        }
        Ok(())
    }

    /// The settings of this run as its results name them.
    fn settings(&self, graph: &FlatGraph, set: &[Setting]) -> Result<Settings> {
        let mut projecting = graph.clone();
        projecting.nodes.retain(can_project);
        let mut changes: BTreeMap<String, String> = set.iter().map(named::change).collect();
        changes.extend(replace::in_words(&self.args.choices.replace)?);
        let changes: Vec<String> = changes
            .into_iter()
            .map(|(key, value)| format!("{key}={value}"))
            .collect();
        let mode = if self.args.offline {
            "offline"
        } else {
            self.mode.as_str()
        };
        Ok(Settings {
            graph: self.graph.into(),
            mode: mode.into(),
            coop: self.coop.into(),
            ego: self.ego.into(),
            link: values(graph, roles::LINK, named::link),
            compute: self.args.compute.as_deref().map(named::profile).unwrap_or_default(),
            seed: values(graph, roles::SEED, str::to_string),
            project: values(&projecting, roles::PROJECT, str::to_string),
            pose_source: localization::in_words(graph),
            set: changes.join(", "),
            programs: named::programs(graph),
            rate: self
                .args
                .rate
                .filter(|rate| *rate != 1.0)
                .map(|rate| rate.to_string())
                .unwrap_or_default(),
            ..Settings::default()
        })
    }

    fn of_run(&self) -> Vec<(&'static str, String)> {
        vec![
            (roles::LOG, self.log_path.to_string_lossy().into_owned()),
            (roles::EGO, self.ego.into()),
            (roles::COOP, self.coop.into()),
            (roles::AGENTS, self.args.agents.join(",")),
            (roles::OUT, self.out.to_string_lossy().into_owned()),
            (
                roles::RUN_SETTINGS,
                self.out.join(SETTINGS_FILE).to_string_lossy().into_owned(),
            ),
        ]
    }

    fn of_options(&self) -> Result<Vec<(&'static str, String)>> {
        let args = self.args;
        let mut decisions = Vec::new();
        if args.offline {
            decisions.push((roles::OFFLINE, "true".into()));
        }
        if args.choices.recorded_detections {
            decisions.push((roles::DETECTIONS, "required".into()));
        }
        decisions.extend(args.rate.map(|rate| (roles::RATE, rate.to_string())));
        decisions.extend(args.choices.seed.map(|seed| (roles::SEED, seed.to_string())));
        decisions.extend(args.choices.stamps.iter().map(|rule| (roles::STAMPS, rule.clone())));
        decisions.extend(args.choices.isa.iter().map(|isa| (roles::ISA, isa.clone())));
        decisions.extend(
            args.choices
                .precision
                .iter()
                .map(|precision| (roles::PRECISION, precision.clone())),
        );
        let device = args.choices.device.iter();
        decisions.extend(device.map(|device| (roles::DEVICE, device.clone())));
        if let Some(profile) = &args.choices.link {
            let named = |name: &str| named::name_or_file(name).unwrap_or_else(|_| name.into());
            decisions.push((roles::LINK, realo_stages::link::with_base(profile, named)));
        }
        Ok(decisions)
    }

    fn of_log(&self, graph: &FlatGraph) -> Result<Vec<(&'static str, String)>> {
        let info = self.log.info();
        let protocol = self.args.protocol.as_deref().unwrap_or(&info.protocol);
        let mut decisions = vec![(roles::PROTOCOL, named::name_or_file(protocol)?)];
        let roadside = info.agents.iter().filter(|agent| agent.kind == AgentKind::Roadside);
        let roadside: Vec<&str> = roadside.map(|agent| &*agent.name).collect();
        decisions.push((roles::ROADSIDE, roadside.join(",")));
        let has = |agent: &str, stream| self.log.has(agent, stream);
        let names = info.agents.iter().map(|agent| agent.name.as_str());
        let bare: Vec<&str> = names
            .filter(|agent| has(agent, Stream::Sweeps) && !has(agent, Stream::Points))
            .collect();
        if !bare.is_empty() {
            let stem = stem(self.log_path);
            let agents = bare.join(", ");
            if let Some(node) = deciding(graph, roles::MODEL).next() {
                let id = &node.id;
                bail!(
                    "{stem}: a log without points of {agents}, in which node `{id}` sees nothing: take a log with points, or a graph \
                     with a module `detect.*.yml` and --recorded-detections"
                );
            }
            eprintln!("realo: {stem}: a log without points of {agents}; all sweeps are played empty");
            decisions.push((roles::POINTS, "false".into()));
        }
        Ok(decisions)
    }
}

/// The file that a node of a graph records into; one that is named after the node's agent is named after the one of the run.
fn recording_name(node: &FlatNode, argument: &str, ego: &str) -> PathBuf {
    let path = Path::new(given(node, argument).unwrap_or("recording.mcap"));
    let name = PathBuf::from(path.file_name().unwrap_or_default());
    let agent = decided_argument(node, roles::EGO).and_then(|key| given(node, key));
    match (agent, name.extension()) {
        (Some(agent), Some(kind)) if name.file_stem() == Some(agent.as_ref()) => {
            PathBuf::from(ego).with_added_extension(kind)
        }
        _ => name,
    }
}

#[cfg(test)]
mod tests {
    use realo_graph::Graph;

    use super::*;

    #[test]
    fn the_log_of_an_agents_sensors_is_named_after_the_agent_of_the_run() {
        let graphs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../dataflows");
        let graph = Graph::load(&graphs.join("late_fusion.roadside.yml"))
            .unwrap()
            .expand()
            .unwrap();
        let named = |node: &str, ego| recording_name(graph.node(node).unwrap(), "path", ego);
        assert_eq!(named("log", "cav2"), Path::new("cav2.mcap"));
        assert_eq!(named("log", "rsu1"), Path::new("rsu1.mcap"));
        assert_eq!(named("score.recorder", "cav2"), Path::new("recording.mcap"));
    }
}
