//! The machines that a graph names: what dora says only when it starts it, or never.

use serde_yaml::Value;

use super::{Findings, FlatGraph, FlatNode, Severity};
use crate::flat::DEPLOY;
use realo_documents::shown;
use realo_operator::config::nearest_name;

/// What dora reads of `deploy`.
const KEYS: &[&str] = &["machine", "working_dir", "labels", "distribute"];

pub(super) fn check(graph: &FlatGraph, findings: &mut Findings) {
    let processes = graph.processes();
    check_deploy_keys(graph, findings);
    let is_placed = |process: &&FlatNode| ["machine", "labels"].iter().any(|key| process.deployed(key).is_some());
    if !processes.iter().any(is_placed) {
        return;
    }
    for process in processes {
        if !is_placed(&process) {
            let expected = "`deploy: { machine: NAME }`, as other nodes have";
            let mend = "dora starts a node without it on a daemon that was given no --machine-id, and refuses the graph if there is none";
            findings.node(Severity::Warning, process, expected, "none".into(), mend);
        } else if process.is_realo() && process.deployed("working_dir").is_none() {
            let expected = "`working_dir` in its `deploy`";
            let mend = "dora starts it in _work/SESSION of the daemon's folder, from where neither `bin/realo` nor a module is seen: \
                        write `working_dir: ../../dataflows`, with daemons that are started in the folder that holds `dataflows`";
            findings.node(Severity::Warning, process, expected, "none".into(), mend);
        }
    }
}

/// What `deploy` says, of the graph and of each process.
pub(super) fn check_deploy_keys(graph: &FlatGraph, findings: &mut Findings) {
    if let Some((expected, found, mend)) = graph.settings.get(DEPLOY).and_then(unknown_key) {
        findings.whole(Severity::Error, &expected, found, &mend);
    }
    graph
        .processes()
        .iter()
        .for_each(|process| check_deploy_keys_of(process, findings));
}

/// A key of `deploy` that dora does not read: what is expected, what is there, what to do.
fn unknown_key(deploy: &Value) -> Option<(String, String, String)> {
    let written = deploy.as_mapping().into_iter().flatten();
    let mut written = written.map(|(key, _)| key.as_str().unwrap_or_default());
    let key = written.find(|key| !KEYS.contains(key))?;
    let hint = nearest_name(key, KEYS.iter().copied()).map_or_else(
        || "remove it: dora does not read it".to_string(),
        |name| format!("did you mean `{name}`?"),
    );
    Some((
        format!("a `deploy` with {}", KEYS.join(", ")),
        format!("`{}`", shown(key)),
        hint,
    ))
}

fn check_deploy_keys_of(process: &FlatNode, findings: &mut Findings) {
    let Some(deploy) = process.other.get(DEPLOY) else {
        return;
    };
    if let Some((expected, found, mend)) = unknown_key(deploy) {
        findings.node(Severity::Error, process, expected, found, &mend);
    }
    let is_text = |key| process.deployed(key).is_none_or(Value::is_string);
    if !deploy.is_mapping() || !is_text("machine") || !is_text("working_dir") {
        let expected = "`deploy: { machine: NAME, working_dir: PATH }`";
        let mend = "names and paths are texts: quote numbers";
        findings.node(Severity::Error, process, expected, "something else".into(), mend);
    }
}
