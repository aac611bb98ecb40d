//! Names of processes: a module that holds whole processes only groups them, so its id is no part of their names.

use std::collections::{BTreeMap, BTreeSet};

use super::{FlatGraph, InputSource};

/// The names of processes whose ids in dora begin with the id of a module that groups them, by that id.
///
/// Of each process: its id, and whether it hosts a module. A module groups processes if one of them is a host. Where two would
/// have one name, all keep what dora calls them.
pub fn short_names<'a>(processes: impl IntoIterator<Item = (&'a str, bool)>) -> BTreeMap<String, String> {
    let processes: Vec<(&str, bool)> = processes.into_iter().collect();
    let hosts = processes.iter().filter(|(_, is_host)| *is_host);
    let groups: BTreeSet<&str> = hosts.filter_map(|(id, _)| Some(id.rsplit_once('.')?.0)).collect();
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
    /// The graph with the names of processes and of their stages in place of dora's ids.
    pub(super) fn with_short_names(mut self) -> Self {
        let processes = self.processes();
        let is_host = |id: &str| self.hosts.iter().any(|host| host.id == id);
        let short = short_names(
            processes
                .iter()
                .map(|process| (process.id.as_str(), is_host(&process.id))),
        );
        if short.is_empty() {
            return self;
        }
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

    fn short(ids: &[&str]) -> Vec<String> {
        let host = |id: &&str| id.ends_with(['!']);
        let names = short_names(ids.iter().map(|id| (id.trim_end_matches('!'), host(id))));
        let name = |id: &&str| {
            let id = id.trim_end_matches('!');
            names.get(id).cloned().unwrap_or(id.into())
        };
        ids.iter().map(name).collect()
    }

    #[test]
    fn a_module_of_processes_is_no_part_of_their_names() {
        let ids = ["scene.player", "scene.others!", "method.ego!", "score"];
        assert_eq!(short(&ids), ["player", "others", "ego", "score"]);
        let nested = ["a.b.ego!", "a.player"];
        assert_eq!(short(&nested), ["ego", "a.player"], "`a` holds no host");
    }

    #[test]
    fn a_module_of_stages_is() {
        let ids = ["ego.sense.sync", "ego.nms", "others.nms", "score.results"];
        assert_eq!(short(&ids), ids);
    }

    #[test]
    fn two_of_one_name_keep_what_dora_calls_them() {
        assert_eq!(short(&["a.ego!", "b.ego!", "a.player"]), ["a.ego", "b.ego", "player"]);
        assert_eq!(short(&["a.ego!", "ego.nms"]), ["a.ego", "ego.nms"]);
        assert_eq!(short(&["a.ego!", "ego"]), ["a.ego", "ego"]);
    }
}
