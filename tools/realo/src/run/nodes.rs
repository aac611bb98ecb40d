//! The stages of a graph: which have an argument that something of a run decides, and their arguments.

use std::collections::BTreeSet;
use std::path::Path;

use eyre::{Result, bail};
use realo_graph::{FlatGraph, FlatNode, normalized};
use realo_operator::Registration;

use crate::{registry, roles};

pub(super) fn registration(node: &FlatNode) -> Option<&'static Registration> {
    node.registration(&registry())
}

/// The argument of a node that something of a run decides. A stage that may have a network and names no model runs none.
pub fn decided_argument(node: &FlatNode, role: &'static str) -> Option<&'static str> {
    let known = registration(node)?;
    let is_of_networks = [roles::MODEL, roles::ISA, roles::PRECISION, roles::DEVICE].contains(&role);
    let model = known.setting(roles::MODEL).and_then(|model| argument(node, model));
    let runs_none = is_of_networks && model.is_some_and(|model| model.is_empty());
    known.setting(role).filter(|_| !runs_none)
}

/// The nodes with an argument that something of a run decides.
pub fn deciding<'a>(graph: &'a FlatGraph, role: &'static str) -> impl Iterator<Item = &'a FlatNode> {
    graph
        .nodes
        .iter()
        .filter(move |node| decided_argument(node, role).is_some())
}

/// Names of the registered operators and nodes that would take it.
pub fn takers(role: &'static str) -> String {
    let takes = |known: &&Registration| known.setting(role).is_some();
    let names: Vec<&str> = registry().0.iter().filter(takes).map(|known| known.name).collect();
    names.join(" or ")
}

/// Sets what something of a run decides, wherever it does.
pub fn decide(graph: &mut FlatGraph, role: &'static str, value: &str) {
    for node in &mut graph.nodes {
        if let Some(argument) = decided_argument(node, role) {
            node.set(argument, value);
        }
    }
}

/// What the nodes have for something that a run decides, each value once.
pub fn values(graph: &FlatGraph, role: &'static str, named: impl Fn(&str) -> String) -> String {
    let nodes = deciding(graph, role);
    let value = |node: &FlatNode| argument(node, decided_argument(node, role)?);
    let values: BTreeSet<String> = nodes.filter_map(value).map(|value| named(&value)).collect();
    values.into_iter().collect::<Vec<_>>().join(", ")
}

/// Gives every network one model file, seen from where the user is.
///
/// # Errors
/// A graph without a network.
pub fn set_model(graph: &mut FlatGraph, path: &Path) -> Result<()> {
    if deciding(graph, roles::MODEL).next().is_none() {
        let file = graph.file.display();
        bail!("--model: {file} has no node that runs a network (recorded detections take its place): drop --model");
    }
    decide(
        graph,
        roles::MODEL,
        &std::path::absolute(realo_cli::find::model(path)?)?.to_string_lossy(),
    );
    Ok(())
}

/// Whether a node can bring what it sends to the ego's frame: what it needs for that is wired.
pub fn can_project(node: &FlatNode) -> bool {
    let Some(argument) = decided_argument(node, roles::PROJECT) else {
        return false;
    };
    let ports = registration(node).map(|known| known.inputs).unwrap_or_default();
    let needed = |port: &&realo_operator::Port| port.needed.is_some_and(|(known, _)| known == argument);
    ports
        .iter()
        .filter(needed)
        .all(|port| node.inputs.contains_key(port.name))
}

/// An argument of a node as the graph has it.
pub fn given<'a>(node: &'a FlatNode, key: &str) -> Option<&'a str> {
    let value = |arg: &'a String| arg.split_once('=').filter(|(name, _)| *name == key);
    node.settings().iter().find_map(value).map(|(_, value)| value)
}

/// An argument of a stage: the graph's, or else its default.
pub fn argument(node: &FlatNode, key: &str) -> Option<String> {
    let default = || {
        let default = (registration(node)?.defaults)().get(key)?.clone();
        Some(default.as_str().map_or_else(|| default.to_string(), str::to_string))
    };
    given(node, key).map(str::to_string).or_else(default)
}

/// The keys of all arguments of a node: those that the graph has, and those with a default.
pub fn keys(node: &FlatNode) -> BTreeSet<String> {
    let own = registration(node).map(|known| (known.defaults)());
    let own = own.unwrap_or_default().into_iter().map(|(key, _)| key);
    let written = node.settings().iter().filter_map(|setting| setting.split_once('='));
    written.map(|(key, _)| key.to_string()).chain(own).collect()
}

/// Makes the paths in a graph's arguments and in their defaults absolute: it may be started from another folder than its
/// own, to which they are relative.
pub fn anchor_paths(graph: &mut FlatGraph) -> Result<()> {
    let folder = std::path::absolute(graph.file.parent().unwrap_or(Path::new(".")))?;
    for node in &mut graph.nodes {
        if let Some(program) = node.program() {
            let path = normalized(&folder.join(program));
            node.set_program(&path.to_string_lossy());
        }
        let known = registration(node);
        for key in keys(node) {
            let is_path = |value: &String| is_path(known, &key, value, &folder);
            if let Some(path) = argument(node, &key).filter(is_path) {
                node.set(&key, &normalized(&folder.join(path)).to_string_lossy());
            }
        }
    }
    Ok(())
}

/// Whether the value of a setting is a path relative to `folder`. One that begins with `./` or `../` is, and one with a
/// `/` or an ending where something has that name; the model of a network always, if there is one. A stage says which of its settings are
/// paths. A program (`known` is `None`) does not; there all may be but numbers.
pub fn is_path(known: Option<&Registration>, key: &str, value: &str, folder: &Path) -> bool {
    let may_be = match known {
        Some(known) => known
            .settings
            .iter()
            .any(|setting| setting.name == key && setting.is_path),
        None => value.parse::<f64>().is_err(),
    };
    let is_relative = value.starts_with("./") || value.starts_with("../");
    let path = Path::new(value);
    let is_there = || (path.components().count() > 1 || path.extension().is_some()) && folder.join(path).exists();
    let is_model = || known.and_then(|known| known.setting(roles::MODEL)) == Some(key);
    may_be && !value.is_empty() && (is_relative || is_model() || is_there())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_is_not_a_path_even_if_a_file_has_its_name() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["0.2", "a.toml"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let find = |word, name| registry().find(word, name).ok();
        let cases = [
            (find("operator", "nms"), "threshold", "0.2", false),
            (find("operator", "nms"), "threshold", "a.toml", false),
            (find("operator", "link"), "profile", "a.toml", true),
            (find("operator", "link"), "profile", "b.toml", false),
            (find("operator", "link"), "profile", "./b.toml", true),
            (find("operator", "pillar-encoder"), "model", "lite", true),
            (find("operator", "fusion-guard"), "model", "", false),
            (find("node", "player"), "ego", "./cav1", false),
            (None, "overlap", "0.2", false),
            (None, "weights", "a.toml", true),
        ];
        for (known, key, value, expected) in cases {
            assert_eq!(is_path(known, key, value, folder.path()), expected, "{key}={value}");
        }
    }
}
