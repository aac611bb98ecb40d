//! What results say of the graph that was run, by which two graphs of one name are told apart.

use std::collections::BTreeMap;
use std::path::Path;

use realo_graph::{FlatGraph, FlatNode, Input};
use realo_results::{GROUP, GraphStages};
use sha2::{Digest, Sha256};

use super::named;
use super::nodes::{argument, given, keys, registration};
use crate::roles;

/// What each run decides anew, or what results say elsewhere.
const ELSEWHERE: &[&str] = &[
    roles::LOG,
    roles::EGO,
    roles::OWN,
    roles::COOP,
    roles::AGENTS,
    roles::ROADSIDE,
    roles::LINK,
    roles::SEED,
    roles::PROTOCOL,
    roles::MODEL,
    roles::ISA,
    roles::PRECISION,
    roles::DEVICE,
    roles::PROJECT,
    roles::OUT,
    roles::RUN_SETTINGS,
    roles::RECORDING,
];
/// What of a stage is a setting begins so; wires and variables have beginnings of their own.
const SETTINGS: &str = "settings.";

/// The process that hosts a stage.
pub const PROCESS: &str = "process";

/// The stages of an expanded graph: of each what it `runs`, its `process`, that one's `group`, `settings.KEY`, `inputs.PORT` and
/// `env.NAME`.
pub fn stages(graph: &FlatGraph) -> GraphStages {
    let described = |node: &FlatNode| {
        let mut found = described(node);
        let process = node.host.as_ref().unwrap_or(&node.id);
        let group = graph.groups.get(process);
        found.extend(group.map(|group| (GROUP.to_string(), group.clone())));
        (node.id.clone(), found)
    };
    graph.nodes.iter().map(described).collect()
}

/// A hash of them, but for how processes are grouped, which changes nothing of a run.
pub fn hash(stages: &GraphStages) -> String {
    let mut hash = Sha256::new();
    let mut add = |text: &str| {
        hash.update((text.len() as u64).to_le_bytes());
        hash.update(text);
    };
    for (stage, entries) in stages {
        add(stage);
        let entries = entries.iter().filter(|(name, _)| *name != GROUP);
        add(&entries.clone().count().to_string());
        for (name, value) in entries {
            add(name);
            add(value);
        }
    }
    named::digits(hash)
}

fn described(node: &FlatNode) -> BTreeMap<String, String> {
    let known = registration(node);
    let elsewhere: Vec<&str> = known.map_or_else(Vec::new, |known| {
        ELSEWHERE.iter().filter_map(|role| known.setting(role)).collect()
    });
    let value = |key: &str| match known {
        Some(_) => argument(node, key),
        None => given(node, key).map(str::to_string),
    };
    let keys = keys(node).into_iter().filter(|key| !elsewhere.contains(&key.as_str()));
    let mut found: BTreeMap<String, String> = keys
        .filter_map(|key| value(&key).map(|value| (format!("{SETTINGS}{key}"), without_folder(&value))))
        .collect();
    found.insert("runs".into(), runs(node));
    found.extend(node.host.iter().map(|host| (PROCESS.to_string(), host.clone())));
    let inputs = node.inputs.iter();
    found.extend(inputs.map(|(port, input)| (format!("inputs.{port}"), wire(input))));
    for (name, value) in &node.env {
        let text = value.as_str().map(without_folder);
        let text = text.unwrap_or_else(|| serde_json::to_string(value).unwrap_or_default());
        found.insert(format!("env.{name}"), text);
    }
    found
}

/// `operator nms`; a program by its name, as results have a hash of each plug-in.
fn runs(node: &FlatNode) -> String {
    let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    if let Some(program) = node.program() {
        return format!("program {}", name(Path::new(program)));
    }
    match node.is_realo() {
        true => node.args.iter().take(2).cloned().collect::<Vec<_>>().join(" "),
        false => {
            let words = node.args.iter().map(|word| without_folder(word));
            std::iter::once(name(&node.path))
                .chain(words)
                .collect::<Vec<_>>()
                .join(" ")
        }
    }
}

fn wire(input: &Input) -> String {
    let mut text = input.source.to_string();
    text.extend(input.queue_size.map(|size| format!(", queue_size {size}")));
    text.extend(input.queue_policy.iter().map(|policy| format!(", {policy}")));
    text.extend(input.input_timeout.map(|seconds| format!(", input_timeout {seconds}")));
    text
}

/// A value without the folder of a file, which is another one on each machine; a file with a hash of what it holds.
fn without_folder(value: &str) -> String {
    let path = Path::new(value);
    match path.file_name().filter(|_| path.is_absolute()) {
        Some(_) if path.is_file() => named::file(path),
        Some(name) => name.to_string_lossy().into_owned(),
        None => value.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::nodes::{anchor_paths, decide};
    use super::*;

    fn graph() -> FlatGraph {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let mut graph = FlatGraph::load(&root.join("dataflows/late_fusion.yml")).unwrap();
        anchor_paths(&mut graph).unwrap();
        graph
    }

    fn hash_of(graph: &FlatGraph) -> String {
        hash(&stages(graph))
    }

    #[test]
    fn a_graph_is_known_by_stages_wires_and_settings() {
        let first = hash_of(&graph());
        assert_eq!(first.len(), named::DIGITS);
        let changes: [fn(&mut FlatGraph); 4] = [
            |graph| graph.set("fusion.bank", "window_ms", "7").unwrap(),
            |graph| _ = graph.nodes.pop(),
            |graph| _ = graph.nodes.iter_mut().find_map(|node| node.inputs.pop_first()),
            |graph| {
                let variable = ("TZ".to_string(), "UTC".into());
                graph.nodes[0].env.extend([variable]);
            },
        ];
        for (at, change) in changes.into_iter().enumerate() {
            let mut changed = graph();
            change(&mut changed);
            assert_ne!(hash_of(&changed), first, "{at}");
        }
        // A default that is written down is no change.
        let mut written = graph();
        let bank = written.node("fusion.bank").unwrap();
        let (key, value) = ("window_ms", argument(bank, "window_ms").unwrap());
        written.set("fusion.bank", key, &value).unwrap();
        assert_eq!(hash_of(&written), first);
    }

    #[test]
    fn a_graph_is_not_known_by_what_each_run_decides_or_by_folders() {
        let first = hash_of(&graph());
        let mut apart = graph();
        assert_eq!(stages(&apart)["fusion.bank"][GROUP], "perception");
        apart.groups.clear();
        assert_eq!(
            hash_of(&apart),
            first,
            "modules that group processes change nothing of a run"
        );
        let mut decided = graph();
        for role in ELSEWHERE {
            decide(&mut decided, role, "/another/one");
        }
        assert_eq!(hash_of(&decided), first);
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str, text: &str| {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(&path, text).unwrap();
            let mut graph = graph();
            graph.set("fusion.bank", "window_ms", &path.to_string_lossy()).unwrap();
            hash_of(&graph)
        };
        assert_eq!(file("a/times.toml", "1"), file("b/times.toml", "1"));
        assert_ne!(file("a/times.toml", "1"), file("b/times.toml", "2"));
        let text = serde_json::to_string(&stages(&graph())).unwrap();
        assert!(
            !text.contains(env!("CARGO_MANIFEST_DIR")) && !text.contains("\"/"),
            "{text}"
        );
    }
}
