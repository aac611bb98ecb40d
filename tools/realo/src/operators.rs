//! `realo operators`: every operator and node with its ports, settings and counters.

use eyre::Result;
use realo_cli::Outcome;
use realo_operator::{Counter, Meaning, Port, Queue, Registration};
use realo_schemas::{PayloadType, layout};
use serde_json::{Value, json};

use crate::{registry, stages};

/// Lists every operator, source, sink and gateway with ports, types, settings and counters
#[derive(clap::Args)]
pub struct Args {
    /// Only this one
    name: Option<String>,
    /// As JSON
    #[arg(long)]
    json: bool,
    /// What they count, as a table
    #[arg(long, conflicts_with = "json")]
    counters: bool,
    /// As the page docs/reference/stages.md
    #[arg(long, conflicts_with_all = ["json", "counters", "name"])]
    markdown: bool,
    /// The columns of all messages as JSON, which the Python package reads
    #[arg(long, conflicts_with_all = ["json", "counters", "markdown", "name"])]
    schema: bool,
}

/// Prints the registry.
pub fn main(args: &Args) -> Result<Outcome> {
    let wanted = |entry: &&Registration| args.name.as_deref().is_none_or(|name| entry.name == name);
    let entries: Vec<&Registration> = registry().0.iter().filter(wanted).collect();
    if let (Some(name), true) = (&args.name, entries.is_empty()) {
        let known: Vec<_> = registry().0.iter().map(|entry| entry.name).collect();
        return Err(eyre::eyre!(
            "no operator or node `{name}`; there are: {}",
            known.join(", ")
        ));
    }
    if args.markdown {
        print!("{}", stages::page()?);
    } else if args.schema {
        println!("{}", schema()?);
    } else if args.counters {
        print!("{}", counters(&entries));
    } else if args.json {
        println!(
            "{}",
            serde_json::to_string_pretty(&entries.iter().map(|e| document(e)).collect::<Vec<_>>())?
        );
    } else {
        entries.iter().for_each(|entry| print(entry));
    }
    Ok(Outcome::Complete)
}

fn print(entry: &Registration) {
    println!("{} {}\n  {}", entry.word(), entry.name, entry.about);
    for port in entry.inputs {
        println!(
            "  in   {:<14} {:<30} {}{}",
            port.name,
            types(port),
            port.about,
            traits(port)
        );
    }
    for port in entry.outputs {
        println!("  out  {:<14} {:<30} {}", port.name, types(port), port.about);
    }
    let defaults = (entry.defaults)();
    for setting in entry.settings {
        let default = defaults.get(setting.name).map(Value::to_string).unwrap_or_default();
        let range = setting.range.map(|range| format!(" ({range})")).unwrap_or_default();
        println!(
            "  arg  {:<30} {}{range}",
            format!("{}={default}", setting.name),
            setting.about
        );
    }
    for counter in entry.counters {
        println!("  cnt  {:<30} {}{}", counter.name, counter.about, said(counter));
    }
    println!();
}

/// What a count above 0 leads to.
fn said(counter: &Counter) -> &'static str {
    match counter.meaning {
        Meaning::Plain => "",
        Meaning::Loss => " (a note)",
        Meaning::LogFault => " (a note, exit code 3)",
    }
}

/// The table of what operators and nodes count.
fn counters(entries: &[&Registration]) -> String {
    let mut table = String::from("| node | counter | counts | above 0 |\n|---|---|---|---|\n");
    for entry in entries {
        for (place, counter) in entry.counters.iter().enumerate() {
            let node = if place == 0 { entry.name } else { "" };
            let said = said(counter).trim_matches([' ', '(', ')']);
            let row = ["", node, &format!("`{}`", counter.name), counter.about, said, ""];
            table += &row
                .map(|cell| {
                    if cell.is_empty() {
                        String::new()
                    } else {
                        format!(" {cell} ")
                    }
                })
                .join("|")
                .replace("||", "| |");
            table += "\n";
        }
    }
    table
}

fn types(port: &Port) -> String {
    port.types.iter().map(|t| t.as_str()).collect::<Vec<_>>().join("|")
}

fn traits(port: &Port) -> String {
    let mut traits = Vec::new();
    if port.queue == Queue::Latest {
        traits.push("latest".to_string());
    }
    if let Some(group) = port.join {
        traits.push(format!("joined: {group}"));
    }
    if !port.required {
        traits.push("optional".into());
    }
    if traits.is_empty() {
        String::new()
    } else {
        format!(" ({})", traits.join(", "))
    }
}

/// The columns of all messages, as `python/realo_operator/schema.json` has them.
fn schema() -> Result<String> {
    let object = |columns: Vec<layout::Column>| -> Value {
        columns
            .into_iter()
            .map(|(name, kind)| (name, Value::String(kind)))
            .collect()
    };
    let payloads = PayloadType::ALL
        .iter()
        .map(|of| (of.to_string(), object(layout::payload(*of))));
    let all = json!({"header": object(layout::header()), "payloads": payloads.collect::<Value>()});
    Ok(serde_json::to_string_pretty(&all)?)
}

fn document(entry: &Registration) -> Value {
    let port = |port: &Port| {
        json!({
            "name": port.name,
            "types": port.types.iter().map(|t| t.as_str()).collect::<Vec<_>>(),
            "queue": if port.queue == Queue::Latest { "latest" } else { "all" },
            "required": port.required,
            "join": port.join,
            "about": port.about,
        })
    };
    let defaults = (entry.defaults)();
    let setting = |a: &realo_operator::SettingInfo| json!({"name": a.name, "default": defaults.get(a.name), "about": a.about, "range": a.range, "role": a.role});
    json!({
        "kind": entry.word(),
        "name": entry.name,
        "about": entry.about,
        "inputs": entry.inputs.iter().map(port).collect::<Vec<_>>(),
        "outputs": entry.outputs.iter().map(port).collect::<Vec<_>>(),
        "settings": entry.settings.iter().map(setting).collect::<Vec<_>>(),
        "counters": entry.counters.iter().map(counter).collect::<Vec<_>>(),
    })
}

fn counter(counter: &Counter) -> Value {
    let Counter {
        name,
        about,
        meaning,
        quiet_percent,
        note,
        remedy,
    } = counter;
    json!({
        "name": name,
        "about": about,
        "meaning": meaning,
        "quiet_percent": quiet_percent,
        "note": note,
        "remedy": remedy,
    })
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;

    use super::*;

    /// What differs first, and how to write the file again.
    fn assert_same(file: &str, option: &str, written: &str, expected: &str) {
        let differs = expected.lines().zip(written.lines()).find(|(a, b)| a != b);
        assert!(
            written.trim_end() == expected.trim_end(),
            "{file}: expected what `realo operators {option}` prints, found {differs:#?}"
        );
    }

    #[test]
    fn the_page_of_stages_is_what_the_stages_say() {
        let page = include_str!("../../../docs/reference/stages.md");
        assert_same("docs/reference/stages.md", "--markdown", page, &stages::page().unwrap());
    }

    #[test]
    fn python_reads_the_columns_of_the_schemas() {
        let file = include_str!("../../../python/realo_operator/schema.json");
        assert_same(
            "python/realo_operator/schema.json",
            "--schema",
            file,
            &schema().unwrap(),
        );
    }

    /// What stands between two texts, each time.
    fn between<'a>(text: &'a str, from: &str, to: &str) -> Vec<&'a str> {
        let parts = text.split(from).skip(1);
        parts.filter_map(|part| part.split(to).next()).collect()
    }

    /// The sources of a folder, tests at the ends of files left out.
    fn sources(folder: &Path) -> String {
        let mut text = String::new();
        for entry in fs::read_dir(folder).expect("the folder can be read") {
            let path = entry.expect("the entry can be read").path();
            if path.is_dir() {
                text += &sources(&path);
            } else if path.extension().is_some_and(|kind| kind == "rs") {
                let whole = fs::read_to_string(&path).expect("the file can be read");
                text += whole.split("#[cfg(test)]").next().unwrap_or_default();
            }
        }
        text
    }

    /// The words of all lists of counters in a text.
    fn words_of_lists(text: &str) -> Vec<String> {
        let lists = [between(text, "[Counter] = &[", "]"), between(text, "counters(", ")")];
        let words = lists.concat().join(" ");
        words
            .split(|c: char| !c.is_alphanumeric() && c != '_')
            .map(String::from)
            .collect()
    }

    #[test]
    fn every_counter_of_the_sources_is_in_the_list_of_its_operator() {
        let root = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."));
        let mut known = 0;
        // What stages of several crates count is in the lists of both.
        let in_lists = |crates: &[&str]| -> Vec<String> {
            let texts = crates.iter().map(|name| sources(&root.join(name)));
            texts.flat_map(|text| words_of_lists(&text)).collect()
        };
        let shared = in_lists(&["operators/pillar_encoder/src", "operators/detection_head/src"]);
        for folder in ["operators", "nodes"] {
            for entry in fs::read_dir(root.join(folder)).expect("the folder can be read") {
                let path = entry.expect("the entry can be read").path().join("src");
                let text = if path.is_dir() { sources(&path) } else { continue };
                let listed = match path.ends_with("bev/src") {
                    true => shared.clone(),
                    false => words_of_lists(&text),
                };
                for counter in between(&text, "const ", ": Counter =") {
                    // What comes before is of another constant.
                    let name = counter.rsplit("const ").next().unwrap_or(counter);
                    // The host's own counter, of what any plug-in sends, is in no list of a stage.
                    let is_of_host = path.ends_with("host/src");
                    if !is_of_host && name.chars().all(|c| c.is_ascii_uppercase() || c == '_') {
                        known += 1;
                        assert!(
                            listed.iter().any(|listed| listed == name),
                            "{}: {name} is in no list of counters",
                            path.display()
                        );
                    }
                }
            }
        }
        let registered: usize = registry().0.iter().map(|entry| entry.counters.len()).sum();
        assert!(known > 50 && registered >= known, "{known} of {registered}");
    }

    #[test]
    fn counters_that_notes_know_by_their_names_are_counted() {
        let counters: Vec<&Counter> = registry().0.iter().flat_map(|entry| entry.counters).collect();
        let named = realo_results::named_counters();
        assert!(named.len() > 10, "{named:?}");
        for name in named {
            let is_counted = counters.iter().any(|counter| counter.name == name);
            assert!(is_counted, "no operator or node counts `{name}`");
        }
    }

    #[test]
    fn counters_have_names_of_their_own_and_losses_have_words() {
        for entry in registry().0 {
            for (place, counter) in entry.counters.iter().enumerate() {
                let place = &entry.counters[..place];
                assert!(
                    place.iter().all(|other| other.name != counter.name),
                    "{} {}",
                    entry.name,
                    counter.name
                );
                let has_words = !counter.note.is_empty() && !counter.remedy.is_empty();
                assert_eq!(
                    has_words,
                    counter.meaning != Meaning::Plain,
                    "{} {}",
                    entry.name,
                    counter.name
                );
            }
        }
    }
}
