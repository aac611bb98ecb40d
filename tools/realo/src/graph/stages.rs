//! What is drawn of an expanded graph.

use std::path::Path;

use eyre::{Result, bail};
use realo_diagram::{Diagram, End, Group, Port, Process, Stage, Wire};
use realo_graph::{FlatGraph, FlatNode, InputSource, TYPE_PREFIX};
use realo_operator::Registration;
use realo_schemas::PayloadType;

use crate::registry;
use crate::run::count;

/// What a graph has, in a line.
pub fn title(name: &str, diagram: &Diagram) -> String {
    format!(
        "{name}: {}, {}, {}",
        count(diagram.processes.len(), "process", "processes"),
        count(diagram.stages.len(), "stage", "stages"),
        count(diagram.wires.len(), "wire", "wires")
    )
}

/// The picture of a graph without a title.
///
/// # Errors
/// A wire from a stage that is not there.
pub fn diagram(graph: &FlatGraph) -> Result<Diagram> {
    let mut diagram = Diagram::default();
    for node in &graph.nodes {
        let process = process_of(&mut diagram, graph, node);
        let inner = match &node.host {
            Some(host) => node.id.strip_prefix(&format!("{host}.")).unwrap_or(&node.id),
            None => &node.id,
        };
        let mut modules: Vec<String> = match node.host {
            Some(_) => inner.split('.').map(String::from).collect(),
            None => vec![inner.to_string()],
        };
        let name = modules.pop().unwrap_or_default();
        diagram.stages.push(Stage {
            process,
            modules,
            what: what(node).filter(|what| *what != name).unwrap_or_default(),
            name,
            ..Stage::default()
        });
    }
    group(&mut diagram, graph);
    for (at, node) in graph.nodes.iter().enumerate() {
        wire(&mut diagram, graph, at, node)?;
    }
    Ok(diagram)
}

/// The index of a stage's process, which is added where it is new.
fn process_of(diagram: &mut Diagram, graph: &FlatGraph, node: &FlatNode) -> usize {
    let name = node.host.as_ref().unwrap_or(&node.id);
    if let Some(known) = diagram.processes.iter().position(|process| process.name == *name) {
        return known;
    }
    let host = graph.hosts.iter().find(|host| host.id == *name);
    let module = host.and_then(|host| host.args.get(1));
    let module = module.map(|module| without_folder(module, &graph.file));
    let group = graph.groups.get(name).map(|group| format!("in {group}"));
    let machine = host.unwrap_or(node).machine().map(|machine| format!("on {machine}"));
    let what: Vec<String> = module.into_iter().chain(group).chain(machine).collect();
    diagram.processes.push(Process {
        name: name.clone(),
        what: what.join(", "),
        is_stage: node.host.is_none(),
        group: None,
    });
    diagram.processes.len() - 1
}

/// Groups processes by the machines that they are for, where the graph says so, else by the modules that they were wired in with.
fn group(diagram: &mut Diagram, graph: &FlatGraph) {
    let nodes = || graph.hosts.iter().chain(&graph.nodes);
    let machine = |name: &str| {
        nodes()
            .find(|node| node.id == name)?
            .machine()
            .map(|machine| machine.to_string())
    };
    let has_machines = diagram.processes.iter().any(|process| machine(&process.name).is_some());
    for at in 0..diagram.processes.len() {
        let name = diagram.processes[at].name.clone();
        let (found, what) = match has_machines {
            true => (machine(&name), "machine"),
            false => (graph.groups.get(&name).cloned(), "module"),
        };
        let Some(name) = found else { continue };
        let known = diagram.groups.iter().position(|group| group.name == name);
        diagram.processes[at].group = known.or(Some(diagram.groups.len()));
        if known.is_none() {
            diagram.groups.push(Group {
                name,
                what: what.into(),
            });
        }
    }
}

/// A module's file as the graph's folder has it, else by its name: where a graph lies says nothing of it.
fn without_folder(module: &str, graph: &Path) -> String {
    let module = Path::new(module);
    let folder = graph.parent().unwrap_or(Path::new("/"));
    let short = match module.strip_prefix(folder) {
        Ok(inside) => Some(inside.as_os_str()),
        Err(_) if module.is_absolute() => module.file_name(),
        Err(_) => Some(module.as_os_str()),
    };
    short.unwrap_or_default().to_string_lossy().into_owned()
}

/// What a stage runs.
fn what(node: &FlatNode) -> Option<String> {
    if !node.is_realo() {
        return Some(node.path.file_name()?.to_string_lossy().into_owned());
    }
    match node.args.as_slice() {
        [word, name, ..] if word == "operator" => Some(name.clone()),
        [word, name, ..] => Some(format!("{word} {name}")),
        _ => None,
    }
}

/// Adds the inputs of a stage, and the outputs that they take.
fn wire(diagram: &mut Diagram, graph: &FlatGraph, at: usize, node: &FlatNode) -> Result<()> {
    let known = node.registration(&registry());
    for (port, input) in &node.inputs {
        let to = End {
            stage: at,
            port: diagram.stages[at].inputs.len(),
        };
        let mut drawn = Port {
            name: port.clone(),
            ..Port::default()
        };
        match &input.source {
            InputSource::Builtin(source) => drawn.from.clone_from(source),
            InputSource::Output { node: source, output } => {
                let Some(stage) = graph.nodes.iter().position(|node| node.id == *source) else {
                    bail!(
                        "{}: input `{port}` of `{}` takes from `{source}`, which is not a stage of the graph; `realo validate` says more",
                        graph.file.display(),
                        node.id
                    );
                };
                let feedback = known
                    .and_then(|known| known.input(port))
                    .is_some_and(|(_, port)| port.feedback);
                let from = End {
                    stage,
                    port: output_of(diagram, graph, stage, output),
                };
                diagram.wires.push(Wire { from, to, feedback });
            }
        }
        diagram.stages[at].inputs.push(drawn);
    }
    Ok(())
}

/// The index of an output, which is added where it is new.
fn output_of(diagram: &mut Diagram, graph: &FlatGraph, stage: usize, output: &str) -> usize {
    let known = diagram.stages[stage]
        .outputs
        .iter()
        .position(|port| port.name == output);
    known.unwrap_or_else(|| {
        let payload = types(graph, &graph.nodes[stage], output).join(" or ");
        let port = Port {
            name: output.into(),
            payload,
            ..Port::default()
        };
        let outputs = &mut diagram.stages[stage].outputs;
        outputs.push(port);
        outputs.len() - 1
    })
}

/// The payload types of an output: what the graph says, else what its stage may send and all that take it do.
pub fn types(graph: &FlatGraph, node: &FlatNode, output: &str) -> Vec<String> {
    if let Some(declared) = node.output_types.get(output) {
        return vec![declared.strip_prefix(TYPE_PREFIX).unwrap_or(declared).to_string()];
    }
    let of = |known: &'static Registration| known.outputs.iter().find(|port| port.name == output);
    let Some(port) = node.registration(&registry()).and_then(of) else {
        return Vec::new();
    };
    let taken = |kind: &&PayloadType| {
        let takers = graph
            .nodes
            .iter()
            .flat_map(|taker| taker.inputs.iter().map(move |input| (taker, input)));
        let mut takers = takers.filter(|(_, (_, input))| input.output() == Some((node.id.as_str(), output)));
        takers.all(|(taker, (input, _))| {
            let known = taker.registration(&registry()).and_then(|known| known.input(input));
            known.is_none_or(|(_, port)| port.types.contains(kind))
        })
    };
    let types = port.types.iter().filter(taken);
    types.map(|kind| kind.as_str().to_string()).collect()
}
