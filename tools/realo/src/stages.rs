//! The reference page of all stages, docs/reference/stages.md.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

use eyre::{OptionExt, Result, WrapErr};
use realo_graph::FlatGraph;
use realo_operator::{Class, Meaning, Port, Queue, Registration, Role, SettingInfo};
use serde_json::{Map, Value};

use crate::registry;

const HEAD: &str = "\
# Stages

`realo operators --markdown` prints this page; a test compares the two.

A stage is an *operator*, or a *source*, a *sink* or a *gateway*, with its settings at its place in a graph. A node of the graph is a
process and hosts one or more stages. Settings are `key=value` words behind the stage's name in a graph. `realo run --set
STAGE.KEY=VALUE` sets one for a run.

`STAGE` is the stage's address: the node, then the stage's place in the module that the node hosts. For example,
`others.sense.localization` is the stage `localization` in the module `sense` of the node `others`. Each section lists the addresses in
shipped graphs. A wrong address makes `realo run` list those of its graph.

- `latest`: a newer message takes the place of one that waits; else all wait, in order.
- `joined`: ports that say the same word are given together, message by message of one number.
- `state`: goes before other messages of the same instant; `query`: goes after them.
- *role*: what `realo run` sets here by itself or by an option.
- A counter with a *note* is mentioned after a run; one with *exit code 3* makes the run's exit code 3.
";

/// Addresses of stages by operator.
type Addresses = BTreeMap<String, BTreeSet<String>>;

/// The whole page.
///
/// # Errors
/// Shipped graphs that are not there, or cannot be read.
pub fn page() -> Result<String> {
    let mut text = String::from(HEAD);
    let addresses = addresses()?;
    for entry in registry().0 {
        section(&mut text, entry, addresses.get(entry.name));
    }
    Ok(text)
}

/// Where stages are in shipped graphs.
fn addresses() -> Result<Addresses> {
    let folder = realo_cli::find::checkout().map(|checkout| checkout.join("dataflows"));
    let folder =
        folder.ok_or_eyre("no shipped graphs: expected the folder `dataflows` of a checkout of realo; run it there")?;
    let mut addresses = Addresses::new();
    for entry in std::fs::read_dir(&folder).wrap_err_with(|| folder.display().to_string())? {
        let path = entry?.path();
        if path.extension().is_none_or(|extension| extension != "yml") {
            continue;
        }
        for node in FlatGraph::load(&path)?.nodes {
            if let Some((_, name)) = node.stage() {
                addresses.entry(name.into()).or_default().insert(node.id.clone());
            }
        }
    }
    Ok(addresses)
}

fn section(text: &mut String, entry: &Registration, addresses: Option<&BTreeSet<String>>) {
    let kind = match entry.role {
        Role::Operator => "Operator",
        Role::Source => "Source",
        Role::Sink => "Sink",
        Role::Gateway => "Gateway",
    };
    let _ = write!(text, "\n## {}\n\n{kind}. {}.\n", entry.name, entry.about);
    if let Some(addresses) = addresses {
        let addresses: Vec<String> = addresses.iter().map(|address| format!("`{address}`")).collect();
        let _ = write!(text, "\nIn shipped graphs: {}.\n", addresses.join(", "));
    }
    if entry.inputs.len() + entry.outputs.len() > 0 {
        *text += "\n| port | types | content |\n|---|---|---|\n";
    }
    for (way, ports) in [("in", entry.inputs), ("out", entry.outputs)] {
        for port in ports {
            let properties = properties(port, way == "in");
            let types: Vec<&str> = port.types.iter().map(|of| of.as_str()).collect();
            let types = types.join(", ");
            let _ = writeln!(
                text,
                "| {way} `{}` | {types} | {}{properties} |",
                port.name,
                cell(port.about)
            );
        }
    }
    if !entry.settings.is_empty() {
        *text += "\n| setting | default | values | meaning |\n|---|---|---|---|\n";
    }
    let defaults = (entry.defaults)();
    for info in entry.settings {
        setting(text, info, &defaults);
    }
    if !entry.counters.is_empty() {
        *text += "\n| counter | counts | above 0 |\n|---|---|---|\n";
    }
    for counter in entry.counters {
        let leads_to = match counter.meaning {
            Meaning::Plain => "",
            Meaning::Loss => "a note",
            Meaning::LogFault => "a note, exit code 3",
        };
        let _ = writeln!(text, "| `{}` | {} | {leads_to} |", counter.name, cell(counter.about));
    }
}

fn setting(text: &mut String, info: &SettingInfo, defaults: &Map<String, Value>) {
    let default = match defaults.get(info.name) {
        Some(Value::String(empty)) if empty.is_empty() => "empty".into(),
        Some(Value::String(word)) => format!("`{word}`"),
        Some(value) => format!("`{}`", shortest(value)),
        None => String::new(),
    };
    let role = info.role.map(|role| format!(" (role `{role}`)")).unwrap_or_default();
    let range = info.range.unwrap_or_default();
    let about = cell(info.about);
    let _ = writeln!(text, "| `{}` | {default} | {range} | {about}{role} |", info.name);
}

/// What a port is besides its types, in parentheses.
fn properties(port: &Port, is_input: bool) -> String {
    let mut words = Vec::new();
    if is_input {
        words.extend((port.queue == Queue::Latest).then(|| "latest".to_string()));
        words.extend(port.join.map(|group| format!("joined: {group}")));
        match port.class {
            Class::State => words.push("state".into()),
            Class::Query => words.push("query".into()),
            Class::Data => {}
        }
        match port.needed {
            Some((key, value)) => words.push(format!("needed with `{key}={value}`")),
            None if !port.required => words.push("optional".into()),
            None => {}
        }
    }
    words.extend(port.side.map(|side| side.to_string()));
    match words.is_empty() {
        true => String::new(),
        false => format!(" ({})", words.join(", ")),
    }
}

/// A default as it may be written; numbers of 32 bits without the digits that 64 have.
fn shortest(value: &Value) -> String {
    match value {
        Value::Array(all) => format!("[{}]", all.iter().map(shortest).collect::<Vec<_>>().join(",")),
        Value::Number(number) if number.is_f64() => {
            let wide = number.as_f64().unwrap_or_default();
            match wide as f32 {
                short if f64::from(short) == wide => format!("{short:?}"),
                _ => number.to_string(),
            }
        }
        _ => value.to_string(),
    }
}

/// A text in a cell of a table.
fn cell(text: &str) -> String {
    text.replace('|', "\\|")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_section_has_ports_settings_and_counters() {
        let page = page().unwrap();
        for row in [
            "\n## nms\n\nOperator. Drops ",
            "| in `proposals` | Boxes | Detections in any order, one frame (latest, joined: frame) |",
            "| `threshold` | `0.15` | 0 to 1 | ",
            "| `suppressed_boxes` | ",
            "(role `model`) |",
        ] {
            assert!(page.contains(row), "{row}");
        }
        assert_eq!(cell("a|b"), "a\\|b");
        assert_eq!(
            shortest(&serde_json::json!([1.1f32, 0.1f64, 400.0, 3, null])),
            "[1.1,0.1,400.0,3,null]"
        );
    }

    #[test]
    fn what_a_stage_is_begins_with_a_capital() {
        for Registration { name, about, .. } in registry().0 {
            assert!(about.starts_with(char::is_uppercase), "{name}: {about}");
        }
    }

    #[test]
    fn the_page_has_every_counter() {
        let page = page().unwrap();
        let sections: Vec<&str> = page.split("\n## ").skip(1).collect();
        assert_eq!(sections.len(), registry().0.len());
        for (entry, section) in registry().0.iter().zip(sections) {
            assert!(section.starts_with(entry.name), "{}: {section}", entry.name);
            for counter in entry.counters {
                let row = format!("\n| `{}` | ", counter.name);
                assert!(section.contains(&row), "{}: {row}", entry.name);
            }
        }
    }
}
