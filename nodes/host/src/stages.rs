//! From the nodes of a graph to stages that can be called.

use std::collections::BTreeMap;
use std::path::Path;

use realo_engine::Wiring;
use realo_graph::{FlatGraph, FlatNode, OUTSIDE, misdeclared};
use realo_operator::{Built, PortId, Registration, Registry};

use crate::Program;

/// A stage that cannot be built.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("node `{node}`: {reason}")]
pub struct BuildError {
    /// Its id.
    pub node: String,
    /// What its configuration or its files lack.
    pub reason: String,
}

/// Stages that are known and wired, in topological order.
#[derive(Clone, Default)]
pub struct Stages {
    /// The wires between them.
    pub wiring: Wiring,
    /// By name of what comes from outside: the inputs that take it.
    pub entries: BTreeMap<String, Vec<(usize, PortId)>>,
    /// By name of what goes outside: the output behind it.
    pub exits: BTreeMap<String, (usize, PortId)>,
    recipes: Vec<Recipe>,
}

/// How a stage is built.
#[derive(Clone)]
struct Recipe {
    args: Vec<String>,
    /// The program that serves it, if it is no part of this one.
    program: Option<Program>,
}

impl Stages {
    /// The stages of a graph; plug-ins are started and asked for their ports.
    ///
    /// # Errors
    /// Names a node that only dora can run, a port that does not fit, or a wire that leads nowhere.
    pub fn of(graph: &FlatGraph, registry: &Registry) -> Result<Self, String> {
        let ranks = graph.ranks().map_err(|error| error.to_string())?;
        let mut order: Vec<usize> = (0..graph.nodes.len()).collect();
        order.sort_by_key(|index| ranks[*index]);
        let mut stages = Stages::default();
        for node in order.into_iter().map(|index| &graph.nodes[index]) {
            let folder = graph.file.parent().unwrap_or(Path::new("/"));
            let (registration, program) = identify(node, folder, registry)?;
            let (outside, inside): (Vec<_>, Vec<_>) = wires(node)?.into_iter().partition(|wire| wire.1 == OUTSIDE);
            stages.add(&node.id, registration, node.settings().to_vec(), &inside)?;
            for (port, _, entry) in outside {
                let input = stages.wiring.feed_from_outside(port)?;
                stages.entries.entry(entry.to_string()).or_default().push(input);
            }
            if let Some(recipe) = stages.recipes.last_mut() {
                recipe.program = program;
            }
        }
        Ok(stages)
    }

    /// Adds a stage; `inputs` are (port, source stage id, source port).
    ///
    /// # Errors
    /// As [`Wiring::add`].
    pub fn add(
        &mut self,
        id: &str,
        registration: &'static Registration,
        args: Vec<String>,
        inputs: &[(&str, &str, &str)],
    ) -> Result<(), String> {
        self.wiring.add(id, registration, inputs)?;
        self.recipes.push(Recipe { args, program: None });
        Ok(())
    }

    /// Lets an output of a stage leave under a name.
    ///
    /// # Errors
    /// Names a stage or output that does not exist.
    pub fn let_out(&mut self, name: &str, stage: &str, output: &str) -> Result<(), String> {
        let stages = &mut self.wiring.stages;
        let found = stages.iter().position(|known| &*known.id == stage);
        let index = found.ok_or_else(|| format!("output `{name}`: no stage `{stage}`"))?;
        let port = stages[index].registration.output(output);
        let (port, _) = port.ok_or_else(|| format!("output `{name}`: stage `{stage}` has no output `{output}`"))?;
        stages[index].leaves[port.0] = true;
        self.exits.insert(name.into(), (index, port));
        Ok(())
    }

    /// Has nobody wait long for plug-ins that do not answer.
    pub(crate) fn run_in_realtime(&mut self) {
        let programs = self.recipes.iter_mut().filter_map(|recipe| recipe.program.as_mut());
        programs.for_each(Program::run_in_realtime);
    }

    /// Builds every stage, files and weights included.
    ///
    /// # Errors
    /// The first that cannot be built.
    pub fn build(&self) -> Result<Vec<Built>, BuildError> {
        let stages = self.wiring.stages.iter().zip(&self.recipes);
        let built = stages.map(|(stage, recipe)| {
            let built = match &recipe.program {
                None => (stage.registration.build)(&recipe.args).map_err(|error| error.to_string()),
                Some(program) => program.start().map(|child| Built::Operator(Box::new(child))),
            };
            built.map_err(|reason| BuildError {
                node: stage.id.to_string(),
                reason,
            })
        });
        built.collect()
    }

    /// Required inputs that nothing feeds.
    pub fn open_inputs(&self) -> Vec<String> {
        let stages = self.wiring.stages.iter();
        let open = stages.flat_map(|stage| {
            let ports = stage.registration.inputs.iter().zip(&stage.inputs);
            ports
                .filter(|(port, feed)| port.required && feed.is_none())
                .map(|(port, _)| format!("{}: input `{}` must be wired: {}", stage.id, port.name, port.about))
        });
        open.collect()
    }
}

/// The wires that end at a node: (port, source node id, source port).
fn wires(node: &FlatNode) -> Result<Vec<(&str, &str, &str)>, String> {
    let wires = node.inputs.iter().map(|(port, input)| match input.output() {
        Some((source, output)) => Ok((port.as_str(), source, output)),
        None => Err(format!(
            "node `{}`: input `{port}` comes from {}, which only dora sends",
            node.id, input.source
        )),
    });
    wires.collect()
}

/// What a node is, and the program behind it if it is not this one.
fn identify(
    node: &FlatNode,
    folder: &Path,
    registry: &Registry,
) -> Result<(&'static Registration, Option<Program>), String> {
    if let Some(registration) = node.registration(registry) {
        return Ok((registration, None));
    }
    let Some(program) = Program::of(node, folder) else {
        let args = node.args.join(" ");
        return Err(match node.is_realo() {
            true => format!("node `{}`: no operator or node of `realo operators`: `{args}`", node.id),
            false => format!(
                "node `{}`: {} is no stage of realo, and only dora runs it; a plug-in is a node with `path: bin/realo` and \
                 `args: program PATH`",
                node.id,
                node.path.display()
            ),
        });
    };
    let registration = program.ask()?;
    let wrong: Vec<String> = misdeclared(node, registration)
        .iter()
        .map(ToString::to_string)
        .collect();
    match wrong.is_empty() {
        true => Ok((registration, Some(program))),
        false => Err(wrong.join("\n  ")),
    }
}
