//! `realo operators`: every operator and node with its ports and arguments.

use eyre::Result;
use realo_operator::{Port, Queue, Registration};
use serde_json::{Value, json};

use crate::{Outcome, registry};

/// Lists every operator and node with ports, types and arguments
#[derive(clap::Args)]
pub struct Args {
    /// Only this one
    name: Option<String>,
    /// As JSON
    #[arg(long)]
    json: bool,
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
    if args.json {
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
    for argument in entry.arguments {
        let default = defaults.get(argument.name).map(Value::to_string).unwrap_or_default();
        println!(
            "  arg  {:<30} {}",
            format!("{}={default}", argument.name),
            argument.about
        );
    }
    println!();
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
    let argument =
        |a: &realo_operator::Argument| json!({"name": a.name, "default": defaults.get(a.name), "about": a.about});
    json!({
        "kind": entry.word(),
        "name": entry.name,
        "about": entry.about,
        "inputs": entry.inputs.iter().map(port).collect::<Vec<_>>(),
        "outputs": entry.outputs.iter().map(port).collect::<Vec<_>>(),
        "arguments": entry.arguments.iter().map(argument).collect::<Vec<_>>(),
    })
}
