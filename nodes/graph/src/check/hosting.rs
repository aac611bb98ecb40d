//! Programs, settings, and the keys that only dora reads.

use serde_yaml::Value;

use super::{Answer, Findings, FlatNode, Severity};
use crate::variables;
use realo_operator::{Registration, Registry};

/// The stage that a node hosts, its settings checked; `None` for foreign nodes and unknown names.
pub(super) fn stage(
    node: &FlatNode,
    registry: &Registry,
    ask: &mut dyn FnMut(&FlatNode) -> Answer,
    findings: &mut Findings,
) -> Option<&'static Registration> {
    let args = node.args.join(" ");
    let expected = "`operator NAME`, `node NAME`, `program PATH` or `host MODULE`";
    if !node.is_realo() {
        foreign(node, findings);
        return None;
    }
    if node.program().is_some() {
        return plug_in(node, ask(node), findings);
    }
    let Some((word, name)) = node.stage() else {
        let mend = "`realo operators` prints the names";
        findings.node(Severity::Error, node, expected, format!("args `{args}`"), mend);
        return None;
    };
    let stage = match registry.find(word, name) {
        Ok(stage) => stage,
        Err(reason) => {
            let other = if word == "node" { "operator" } else { "node" };
            let mend = match registry.find(other, name) {
                Ok(_) => format!("`{name}` is a {other}: write `{other} {name}`"),
                Err(_) => reason,
            };
            findings.node(Severity::Error, node, expected, format!("`{word} {name}`"), &mend);
            return None;
        }
    };
    if let Err(error) = (stage.check)(node.settings()) {
        let expected = format!("settings of `{name}`");
        findings.node(
            Severity::Error,
            node,
            expected,
            error.to_string(),
            "`realo operators` prints them",
        );
    }
    if !parameter(node, findings)
        && let Some(arg) = node.settings().iter().find(|arg| variables::named(arg).is_some())
    {
        let mend = "`$NAME` stands for what the `env` at the graph's head says, in the settings of the graph's own stages; a \
                    module's parameter only for what its node sets";
        findings.node(Severity::Warning, node, "values", format!("`{arg}`"), mend);
    }
    Some(stage)
}

/// Names a parameter that has no value; whether there is one.
pub(super) fn parameter(node: &FlatNode, findings: &mut Findings) -> bool {
    let Some((arg, parameter)) = node.parameter() else {
        return false;
    };
    let fix = format!("write `{parameter}` under the `params` of its module's node");
    let found = format!("`{arg}`");
    findings.node(Severity::Error, node, "a value for each parameter", found, &fix);
    true
}

/// A program that only dora runs.
fn foreign(node: &FlatNode, findings: &mut Findings) {
    let found = format!("the program {}", node.path.display());
    let (severity, mend) = match node.host {
        None => (
            Severity::Note,
            "dora runs it, virtual time does not; a plug-in is a node with `path: bin/realo` and `args: program PATH`",
        ),
        Some(_) => (
            Severity::Error,
            "a host runs stages of realo and plug-ins, which have `path: bin/realo` and `args: program PATH`",
        ),
    };
    findings.node(severity, node, "a stage of realo", found, mend);
}

/// What a plug-in says of its ports.
fn plug_in(node: &FlatNode, answer: Answer, findings: &mut Findings) -> Option<&'static Registration> {
    let program = node.program().unwrap_or_default();
    match answer {
        Some(Ok(registration)) => return Some(registration),
        Some(Err(reason)) => {
            let mend = "correct it, or name another program";
            // The finding names the node.
            let own = reason.strip_prefix(&format!("node `{}`: ", node.id)).unwrap_or(&reason);
            findings.node(
                Severity::Error,
                node,
                "a program that hosts an operator",
                own.into(),
                mend,
            );
        }
        None => {
            let mend = "its ports are not known without starting it";
            findings.node(
                Severity::Note,
                node,
                "a stage of realo",
                format!("the program {program}"),
                mend,
            );
        }
    }
    None
}

/// Keys that make dora treat a process as it must not be treated; `ours`: whether stages of realo run in it.
pub(super) fn keys(process: &FlatNode, ours: bool, is_sink: bool, findings: &mut Findings) {
    if is_sink && process.other.contains_key("health_check_timeout") {
        let mend = "take it away: dora counts what a node sends, so it kills a healthy sink";
        let expected = "no `health_check_timeout` on a sink";
        findings.node(Severity::Error, process, expected, "one".into(), mend);
    }
    let restarts = process
        .other
        .get("restart_policy")
        .and_then(Value::as_str)
        .filter(|policy| *policy != "never");
    if let Some(policy) = restarts.filter(|_| ours) {
        let mend = "take it away: a stage that starts again has forgotten what it counted";
        let found = format!("`{policy}`");
        findings.node(Severity::Warning, process, "no `restart_policy`", found, mend);
    }
}
