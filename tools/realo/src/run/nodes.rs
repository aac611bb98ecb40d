//! The nodes of a graph: which stage each runs, and its arguments.

use std::collections::BTreeSet;
use std::path::{Component, Path, PathBuf};

use eyre::{Result, bail};
use realo_graph::{FlatGraph, FlatNode};

use crate::registry;

/// The operator that can project.
pub const SENDER: &str = "transmission-encoder";
/// The first stage of a network.
pub const PILLARS: &str = "pillar-encoder";
/// The last stage of a network.
pub const HEAD: &str = "detection-head";

/// The stage that a node runs; `None` for a program of its own.
pub fn stage_of(node: &FlatNode) -> Option<&'static str> {
    node.registration(&registry()).map(|known| known.name)
}

/// The nodes of a stage.
pub fn nodes_of<'g>(graph: &'g FlatGraph, stage: &str) -> impl Iterator<Item = &'g FlatNode> {
    graph.nodes.iter().filter(move |node| stage_of(node) == Some(stage))
}

/// Sets an argument of every node of a stage.
pub fn set_all(graph: &mut FlatGraph, stage: &str, key: &str, value: &str) {
    let nodes = graph.nodes.iter_mut().filter(|node| stage_of(node) == Some(stage));
    nodes.for_each(|node| node.set(key, value));
}

/// Gives every network one model file, seen from where the user is.
///
/// # Errors
/// A graph without a network.
pub fn set_model(graph: &mut FlatGraph, path: &Path) -> Result<()> {
    if !graph.nodes.iter().any(is_network) {
        let file = graph.file.display();
        bail!("--model: {file} has no node that runs a network (recorded detections take its place): drop --model");
    }
    let path = std::path::absolute(path)?;
    let networks = graph.nodes.iter_mut().filter(|node| is_network(node));
    networks.for_each(|node| node.set("model", &path.to_string_lossy()));
    Ok(())
}

/// Whether a node can bring what it sends to the ego's frame.
pub fn takes_states(node: &FlatNode) -> bool {
    stage_of(node) == Some(SENDER) && node.inputs.contains_key("state")
}

/// An argument of a node as the graph has it.
pub fn given<'a>(node: &'a FlatNode, key: &str) -> Option<&'a str> {
    let value = |arg: &'a String| arg.split_once('=').filter(|(name, _)| *name == key);
    node.settings().iter().find_map(value).map(|(_, value)| value)
}

/// An argument of a stage: the graph's, or else its default.
pub fn argument(node: &FlatNode, key: &str) -> Option<String> {
    let default = || {
        let default = (node.registration(&registry())?.defaults)().get(key)?.clone();
        Some(default.as_str().map_or_else(|| default.to_string(), str::to_string))
    };
    given(node, key).map(str::to_string).or_else(default)
}

/// Makes the paths in a graph's arguments and in their defaults absolute: it may be started from another folder than its
/// own, from which they are seen. A value that begins with `./` or `../` is one; the model of a network and the program of a
/// plug-in always.
pub fn anchor_paths(graph: &mut FlatGraph) -> Result<()> {
    let folder = std::path::absolute(graph.file.parent().unwrap_or(Path::new(".")))?;
    for node in &mut graph.nodes {
        if let Some(program) = node.program() {
            let path = lexically_normal(&folder.join(program));
            node.set_program(&path.to_string_lossy());
        }
        let own = node.registration(&registry()).map(|known| (known.defaults)());
        let own = own.unwrap_or_default().into_iter().map(|(key, _)| key);
        let written = node.settings().iter().filter_map(|setting| setting.split_once('='));
        let keys: BTreeSet<String> = written.map(|(key, _)| key.to_string()).chain(own).collect();
        for key in keys {
            let is_path = |value: &String| is_relative_path(value) || (key == "model" && is_network(node));
            if let Some(path) = argument(node, &key).filter(is_path) {
                node.set(&key, &lexically_normal(&folder.join(path)).to_string_lossy());
            }
        }
    }
    Ok(())
}

/// The path without `..`, as it is written (no link is followed).
pub fn lexically_normal(path: &Path) -> PathBuf {
    let mut normal = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir => drop(normal.pop()),
            part => normal.push(part),
        }
    }
    normal
}

/// What nodes of one stage have for an argument, each value once.
pub fn values(nodes: &[&FlatNode], key: &str, named: impl Fn(&str) -> String) -> String {
    let values: BTreeSet<String> = nodes
        .iter()
        .filter_map(|node| argument(node, key))
        .map(|value| named(&value))
        .collect();
    values.into_iter().collect::<Vec<_>>().join(", ")
}

/// Whether a value is a path that is seen from somewhere.
pub fn is_relative_path(value: &str) -> bool {
    value.starts_with("./") || value.starts_with("../")
}

/// Whether a node runs a network.
pub fn is_network(node: &FlatNode) -> bool {
    stage_of(node).is_some_and(|stage| [PILLARS, HEAD].contains(&stage))
}
