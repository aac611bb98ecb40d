//! Names of processes: a module that holds whole processes only groups them, so its id is no part of their names.

use std::collections::{BTreeMap, BTreeSet};

use super::{FlatGraph, FlatNode, InputSource};

/// The names of processes whose ids in dora begin with the id of a module that groups them, by that id.
///
/// Of each process: its id, and the first word of its arguments. A module groups processes if it has hosts and nodes (`host`,
/// `node`) and no single stages (`operator`, `program`). Where two would have one name, all keep what dora calls them.
pub fn short_names<'a>(processes: impl IntoIterator<Item = (&'a str, &'a str)>) -> BTreeMap<String, String> {
    let processes: Vec<(&str, &str)> = processes.into_iter().collect();
    let modules_with = |words: [&str; 2]| -> BTreeSet<&str> {
        let processes = processes.iter().filter(|(_, word)| words.contains(word));
        processes.filter_map(|(id, _)| Some(id.rsplit_once('.')?.0)).collect()
    };
    let (whole, stages) = (modules_with(["host", "node"]), modules_with(["operator", "program"]));
    let groups: BTreeSet<&str> = whole.difference(&stages).copied().collect();
    let short = |id: &'a str| id.rsplit_once('.').filter(|(group, _)| groups.contains(group));
    let short = |id: &'a str| short(id).map_or(id, |(_, name)| name);
    let clash = |(id, name): (&str, &str)| {
        let others = processes.iter().filter(|(other, _)| *other != id);
        let inside = |other: &str| other.strip_prefix(name).is_some_and(|rest| rest.starts_with('.'));
        others
            .into_iter()
            .any(|(other, _)| short(other) == name || *other == name || inside(other))
    };
    let named = processes.iter().map(|(id, _)| (*id, short(id)));
    let named = named.filter(|(id, name)| id != name && !clash((id, name)));
    named.map(|(id, name)| (id.to_string(), name.to_string())).collect()
}

impl FlatGraph {
    /// As [`short_names`], of this graph.
    fn short_names(&self) -> BTreeMap<String, String> {
        let processes = self.processes();
        let word = |process: &FlatNode| process.args.first().filter(|_| process.is_realo()).cloned();
        let words: Vec<String> = processes
            .iter()
            .map(|process| word(process).unwrap_or_default())
            .collect();
        let ids = processes.iter().map(|process| process.id.as_str());
        short_names(ids.zip(words.iter().map(String::as_str)))
    }

    /// The graph with the names of processes and of their stages in place of dora's ids.
    pub(super) fn with_short_names(mut self) -> Self {
        let short = self.short_names();
        if short.is_empty() {
            return self;
        }
        let group = |(id, name): (&String, &String)| Some((name.clone(), id.rsplit_once('.')?.0.to_string()));
        self.groups = short.iter().filter_map(group).collect();
        let mut names = short.clone();
        for stage in &mut self.nodes {
            let Some((host, name)) = stage.host.as_ref().and_then(|host| short.get_key_value(host)) else {
                continue;
            };
            let inner = stage.id.strip_prefix(host).unwrap_or_default();
            let new = format!("{name}{inner}");
            names.insert(stage.id.clone(), new);
            stage.host = Some(name.clone());
        }
        let rename = |id: &mut String| {
            if let Some(name) = names.get(id.as_str()) {
                *id = name.clone();
            }
        };
        for node in self.nodes.iter_mut().chain(&mut self.hosts) {
            rename(&mut node.id);
            for input in node.inputs.values_mut() {
                match &mut input.source {
                    InputSource::Output { node, .. } => rename(node),
                    InputSource::Builtin(source) => {
                        let logs = source
                            .strip_prefix("dora/logs/")
                            .and_then(|filter| filter.split_once('/'));
                        if let Some((level, name)) = logs.and_then(|(level, node)| Some((level, names.get(node)?))) {
                            *source = format!("dora/logs/{level}/{name}");
                        }
                    }
                }
            }
            node.outlets.values_mut().for_each(|(stage, _)| rename(stage));
        }
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The names of processes that are each written as `id word`.
    fn short(processes: &[&str]) -> Vec<String> {
        let processes: Vec<(&str, &str)> = processes.iter().map(|one| one.split_once(' ').unwrap()).collect();
        let names = short_names(processes.iter().copied());
        let name = |(id, _): &(&str, &str)| names.get(*id).cloned().unwrap_or(id.to_string());
        processes.iter().map(name).collect()
    }

    #[test]
    fn a_module_of_processes_is_no_part_of_their_names() {
        let processes = [
            "scene.player node",
            "scene.others host",
            "scene.mine mine.py",
            "method.ego host",
            "score host",
        ];
        assert_eq!(short(&processes), ["player", "others", "mine", "ego", "score"]);
        assert_eq!(short(&["a.b.ego host", "a.player node"]), ["ego", "player"]);
    }

    #[test]
    fn which_module_groups_a_process_is_known() {
        let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../dataflows/late_fusion.yml");
        let groups = FlatGraph::load(&file).unwrap().groups;
        let group = |process: &str| groups.get(process).map(String::as_str);
        assert_eq!(
            ["player", "others", "score", "ego", "fusion"].map(group),
            [
                Some("scene"),
                Some("scene"),
                Some("scene"),
                Some("perception"),
                Some("perception")
            ]
        );
        assert_eq!(group("ego.nms"), None, "a stage is no process");
    }

    #[test]
    fn a_module_of_stages_is() {
        let processes = [
            "ego.sense.sync operator",
            "ego.nms program",
            "score.evaluator operator",
            "score.results node",
            "a.b mine.py",
        ];
        assert_eq!(
            short(&processes),
            ["ego.sense.sync", "ego.nms", "score.evaluator", "score.results", "a.b"]
        );
    }

    #[test]
    fn two_of_one_name_keep_what_dora_calls_them() {
        assert_eq!(
            short(&["a.ego host", "b.ego host", "a.player node"]),
            ["a.ego", "b.ego", "player"]
        );
        assert_eq!(short(&["a.ego host", "ego.nms operator"]), ["a.ego", "ego.nms"]);
        assert_eq!(short(&["a.ego host", "ego host"]), ["a.ego", "ego"]);
    }
}
