//! One check of everything that a folder of graphs, the stages and the types say about each other.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use realo_schemas::PayloadType;
use serde_yaml::Value;

use super::expand::{is_detection, module_of};
use super::{FlatGraph, Graph, GraphError, TYPE_PREFIX, read, validate};
use realo_operator::Registry;

/// Everything in which the graphs of a folder, its `types/realo/v1.yml` and the registered stages disagree.
///
/// Empty if every graph expands and [`validate`] finds neither error nor warning nor foreign node, with each
/// `modules/detect.*.yml` where it detects; if the types are the payload types; and if every module is used.
pub fn audit(registry: &Registry, dataflows: &Path) -> Vec<String> {
    let mut wrong = Vec::new();
    match graphs(dataflows) {
        Ok(files) if files.is_empty() => wrong.push(format!("{}: no graphs", dataflows.display())),
        Ok(files) => {
            let detections = detections(dataflows).unwrap_or_default();
            wrong.extend(files.iter().flat_map(|file| audit_graph(registry, file, &detections)));
        }
        Err(error) => wrong.push(error.to_string()),
    }
    wrong.extend(unused_modules(dataflows).unwrap_or_else(|error| vec![error.to_string()]));
    wrong.extend(types(dataflows).unwrap_or_else(|error| vec![error.to_string()]));
    wrong
}

/// The graphs of a folder, by name.
fn graphs(folder: &Path) -> Result<Vec<PathBuf>, GraphError> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(GraphError::read(folder))? {
        let path = entry.map_err(GraphError::read(folder))?.path();
        if path.is_file() && path.extension().is_some_and(|extension| extension == "yml") {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

/// Names of the detections that a folder has modules of.
fn detections(dataflows: &Path) -> Result<Vec<String>, GraphError> {
    let names = graphs(&dataflows.join("modules"))?;
    // What follows a second dot is what a lane does with its boxes.
    let name = |file: &PathBuf| {
        let words = file.file_name()?.to_str()?.strip_prefix("detect.")?;
        Some(words.split_once('.')?.0.to_string())
    };
    let names: BTreeSet<String> = names.iter().filter_map(name).collect();
    Ok(names.into_iter().collect())
}

fn audit_graph(registry: &Registry, file: &Path, detections: &[String]) -> Vec<String> {
    let graph = match Graph::load(file) {
        Ok(graph) => graph,
        Err(error) => return vec![error.to_string()],
    };
    let other = detections.iter().map(|name| graph.clone().with_detection(name));
    let mut seen: Vec<FlatGraph> = Vec::new();
    let mut wrong = Vec::new();
    for graph in std::iter::once(graph.clone()).chain(other) {
        match graph.expand() {
            Ok(flat) if seen.contains(&flat) => {}
            Ok(flat) => {
                let findings = validate(&flat, registry).into_iter();
                wrong.extend(findings.map(|finding| format!("{}: {finding}", file.display())));
                seen.push(flat);
            }
            // It detects in a way of its own, so no detection can take the place.
            Err(GraphError::NoDetectModule { .. }) => {}
            Err(error) => wrong.push(error.to_string()),
        }
    }
    wrong.sort();
    wrong.dedup();
    wrong
}

fn unused_modules(dataflows: &Path) -> Result<Vec<String>, GraphError> {
    let modules = graphs(&dataflows.join("modules"))?;
    let mut used = BTreeSet::new();
    for file in graphs(dataflows)? {
        let (_, nodes) = read::dataflow(&read::text_of(&file)?, &file)?;
        used.extend(nodes.iter().filter_map(|node| module_of(node, dataflows, dataflows)));
        let params = nodes.iter().flat_map(|node| node.params.values());
        let words = params.flat_map(|value| value.split_whitespace());
        used.extend(
            words
                .filter(|word| word.ends_with(".yml"))
                .map(|word| dataflows.join(word)),
        );
    }
    for file in &modules {
        let folder = file.parent().unwrap_or(dataflows);
        let inner = read::module(file)?.nodes;
        used.extend(inner.iter().filter_map(|node| module_of(node, folder, dataflows)));
    }
    // Where one module of detection is used, any other can take its place.
    let detects = |file: &Path| {
        let name = file.file_name().and_then(|name| name.to_str());
        name.is_some_and(is_detection)
    };
    let swapped = used.iter().any(|file| detects(file));
    let unused = modules
        .iter()
        .filter(|file| !(used.contains(*file) || swapped && detects(file)));
    Ok(unused
        .map(|file| format!("{}: no graph uses this module", file.display()))
        .collect())
}

fn types(dataflows: &Path) -> Result<Vec<String>, GraphError> {
    let file = dataflows
        .join("types")
        .join(TYPE_PREFIX.trim_end_matches('/'))
        .with_extension("yml");
    let text = read::text_of(&file)?;
    let document = read::document(&text, &file)?;
    let written = document.get("types").and_then(Value::as_mapping);
    let written: BTreeSet<&str> = written
        .into_iter()
        .flatten()
        .filter_map(|(name, _)| name.as_str())
        .collect();
    let known: BTreeSet<&str> = PayloadType::ALL.iter().map(|name| name.as_str()).collect();
    let missing = known
        .difference(&written)
        .map(|name| format!("{}: type `{name}` is missing", file.display()));
    let extra = written
        .difference(&known)
        .map(|name| format!("{}: no payload has the type `{name}`", file.display()));
    Ok(missing.chain(extra).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::check::tests::{GRAPH, REGISTRY};

    fn write(file: PathBuf, text: &str) {
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(file, text).unwrap();
    }

    #[test]
    fn finds_what_graphs_modules_and_types_do_not_agree_on() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let all: String = PayloadType::ALL
            .iter()
            .map(|name| format!("  {name}: {{ arrow: Struct }}\n"))
            .collect();
        write(root.join("types/realo/v1.yml"), &format!("types:\n{all}"));
        write(root.join("modules/used.yml"), "module: { name: used }\nnodes: []");
        write(
            root.join("late.yml"),
            &format!("{GRAPH}\n  - id: empty\n    module: modules/used.yml\n"),
        );
        assert_eq!(audit(&REGISTRY, root), Vec::<String>::new());

        write(
            root.join("types/realo/v1.yml"),
            &format!("types:\n{}  Boxs: {{}}\n", all.replace("Boxes", "Box")),
        );
        write(root.join("modules/unused.yml"), "module: { name: unused }\nnodes: []");
        write(
            root.join("late.yml"),
            &GRAPH.replacen(
                "proposals: ego-detect/proposals",
                "proposals: { source: ego-detect/proposals, input_timeout: 1 }",
                1,
            ),
        );
        write(root.join("worse.yml"), "nodes: [{ id: a, module: modules/none.yml }]");
        let found = audit(&REGISTRY, root);
        let expected = [
            "late.yml: warning: node `ego-nms`, port `proposals`: expected no `input_timeout`, found one",
            "worse.yml: module node `a`: its file",
            "unused.yml: no graph uses this module",
            "used.yml: no graph uses this module",
            "type `Boxes` is missing",
            "no payload has the type `Box`",
            "no payload has the type `Boxs`",
        ];
        for part in expected {
            assert!(
                found.iter().any(|line| line.contains(part)),
                "no `{part}` in\n{}",
                found.join("\n")
            );
        }
        assert_eq!(found.len(), expected.len(), "{}", found.join("\n"));
    }

    #[test]
    fn tries_every_detection_in_every_graph_that_detects() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        write(root.join("modules/detect.a.yml"), "module: { name: a }\nnodes: []");
        write(
            root.join("modules/detect.b.yml"),
            "module: { name: b, inputs: [radar] }\nnodes: []",
        );
        let says = |part: &str| audit(&REGISTRY, root).iter().filter(|line| line.contains(part)).count();
        write(root.join("g.yml"), "nodes: []");
        assert_eq!(says("no graph uses this module"), 2);
        write(root.join("g.yml"), "nodes: [{ id: d, module: modules/detect.a.yml }]");
        assert_eq!(says("no graph uses this module"), 0);
        assert_eq!(says("module `b` needs the input `radar`"), 1);
    }
}
