//! From the nodes of a graph to stages that can be called.

use std::collections::BTreeMap;
use std::path::Path;

use realo_engine::Wiring;
use realo_graph::{FlatGraph, FlatNode, OUTSIDE, misdeclared, unfit_maps};
use realo_operator::{Built, PortId, Registration, Registry, Role};

use crate::{Child, Program, Tap};

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

/// Outputs of stages that a tap wants, with the number by which it knows each.
pub(crate) type Tapped = BTreeMap<(usize, PortId), u32>;

impl Stages {
    /// The stages of a graph; plug-ins are started and asked for their ports.
    ///
    /// # Errors
    /// Names a node that only dora can run, a port that does not fit, or a wire that leads nowhere.
    pub fn of(graph: &FlatGraph, registry: &Registry) -> Result<Self, String> {
        let ranks = graph.ranks(registry).map_err(|error| error.to_string())?;
        let mut order: Vec<usize> = (0..graph.nodes.len()).collect();
        order.sort_by_key(|index| ranks[*index]);
        let mut stages = Stages::default();
        let mut back = Vec::new();
        let mut known: Vec<Option<&'static Registration>> = vec![None; graph.nodes.len()];
        for (at, node) in order.into_iter().map(|index| (index, &graph.nodes[index])) {
            let folder = graph.file.parent().unwrap_or(Path::new("/"));
            let (registration, program) = identify(node, folder, registry)?;
            known[at] = Some(registration);
            let (outside, inside): (Vec<_>, Vec<_>) = wires(node)?.into_iter().partition(|wire| wire.1 == OUTSIDE);
            let is_feedback = |port: &str| registration.input(port).is_some_and(|(_, port)| port.feedback);
            let (returning, inside): (Vec<_>, Vec<_>) = inside.into_iter().partition(|wire| is_feedback(wire.0));
            back.extend(returning.into_iter().map(|wire| (&node.id, wire)));
            stages.add(&node.id, registration, node.settings().to_vec(), &inside)?;
            for (port, _, entry) in outside {
                let input = stages.wiring.feed_from_outside(port)?;
                stages.entries.entry(entry.to_string()).or_default().push(input);
            }
            if let Some(recipe) = stages.recipes.last_mut() {
                recipe.program = program;
            }
        }
        for (id, (port, source, output)) in back {
            stages.wiring.feed_back(id, port, source, output)?;
        }
        match unfit_maps(graph, &known) {
            unfit if unfit.is_empty() => Ok(stages),
            unfit => Err(unfit.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n  ")),
        }
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

    /// Has the outputs that a tap wants leave their stages; gives these, each with its number.
    pub(crate) fn let_see(&mut self, tap: &Tap) -> Tapped {
        let mut seen = BTreeMap::new();
        for (index, stage) in self.wiring.stages.iter_mut().enumerate() {
            for (number, output) in stage.registration.outputs.iter().enumerate() {
                if let Some(wanted) = tap.wants(&stage.id, output.name) {
                    stage.leaves[number] = true;
                    seen.insert((index, PortId(number)), wanted);
                }
            }
        }
        seen
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
        (0..self.recipes.len()).map(|index| self.build_one(index)).collect()
    }

    fn build_one(&self, index: usize) -> Result<Built, BuildError> {
        let (stage, recipe) = (&self.wiring.stages[index], &self.recipes[index]);
        let built = match &recipe.program {
            None => (stage.registration.build)(&recipe.args).map_err(|error| error.to_string()),
            Some(program) => program.start().and_then(Child::into_built),
        };
        built.map_err(|reason| BuildError {
            node: stage.id.to_string(),
            reason,
        })
    }

    /// Whether a stage is a program that brings messages in from outside.
    pub(crate) fn is_live(&self, index: usize) -> bool {
        self.wiring.stages[index].registration.role == Role::Source && self.recipes[index].program.is_some()
    }

    /// Builds the stages that are wanted, by their indices.
    ///
    /// # Errors
    /// The first that cannot be built.
    pub(crate) fn build_where(&self, is_wanted: impl Fn(usize) -> bool) -> Result<Vec<Option<Built>>, BuildError> {
        let stages = 0..self.recipes.len();
        stages
            .map(|index| is_wanted(index).then(|| self.build_one(index)).transpose())
            .collect()
    }

    /// The arguments of a stage; `None` of a plug-in.
    pub(crate) fn arguments(&self, index: usize) -> Option<&[String]> {
        let recipe = &self.recipes[index];
        recipe.program.is_none().then_some(&recipe.args)
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
                "node `{}`: {} is not a stage of realo, and only dora runs it; a plug-in is a node with `path: bin/realo` and \
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

#[cfg(test)]
mod tests {
    use realo_graph::Graph;
    use realo_operator::{AnyOperator, Error, Outputs, Port, Role};
    use realo_schemas::{Message, Nanos, PayloadType};

    use super::*;

    struct Nothing;

    impl AnyOperator for Nothing {
        fn on_input(&mut self, _: PortId, _: Message, _: &mut Outputs) -> Result<(), Error> {
            Ok(())
        }
        fn on_wake(&mut self, _: Nanos, _: &mut Outputs) -> Result<(), Error> {
            Ok(())
        }
        fn on_end(&mut self, _: &mut Outputs) -> Result<(), Error> {
            Ok(())
        }
    }

    const BOXES: &[PayloadType] = &[PayloadType::Boxes];

    static RELAY: Registration = Registration {
        name: "relay",
        about: "",
        role: Role::Operator,
        inputs: &[
            Port::new("in", BOXES, "boxes"),
            Port::new("more", BOXES, "boxes").optional(),
        ],
        outputs: &[Port::new("out", BOXES, ""), Port::new("aside", BOXES, "")],
        settings: &[],
        counters: &[],
        defaults: Default::default,
        check: |_| Ok(()),
        examine: |_| Ok(()),
        maps: |_| Vec::new(),
        build: |args| match args {
            [] => Ok(Built::Operator(Box::new(Nothing))),
            args => Err(args.join(" ").into()),
        },
    };
    static REGISTRY: Registry = Registry(&[RELAY]);

    fn stages(nodes: &str) -> Result<Stages, String> {
        let text = format!("nodes: [{nodes}]");
        let graph = Graph::parse(&text, Path::new("/nowhere/g.yml"))
            .unwrap()
            .expand()
            .unwrap();
        Stages::of(&graph, &REGISTRY)
    }

    fn relay(id: &str, rest: &str) -> String {
        format!("{{ id: {id}, path: bin/realo, args: operator relay, outputs: [out, aside], {rest} }}")
    }

    fn problem(nodes: &str) -> String {
        match stages(nodes) {
            Ok(_) => panic!("{nodes} should be refused"),
            Err(problem) => problem,
        }
    }

    #[test]
    fn stages_stand_in_topological_order_with_their_wires() {
        let nodes = [
            relay("z", "inputs: { in: b/out, more: a/aside }"),
            relay("a", "inputs: { in: _outside/boxes, more: _outside/boxes }"),
            relay("b", "inputs: { in: a/out }"),
            relay("lonely", "inputs: { more: _outside/other }"),
        ];
        let stages = stages(&nodes.join(", ")).unwrap();
        let ids: Vec<&str> = stages.wiring.stages.iter().map(|stage| &*stage.id).collect();
        assert_eq!(ids, ["a", "lonely", "b", "z"]);
        let consumers = |from: usize, port: usize| stages.wiring.consumers(from, PortId(port));
        assert_eq!(
            (consumers(0, 0), consumers(0, 1)),
            (vec![(2, PortId(0))], vec![(3, PortId(1))])
        );
        assert_eq!(stages.entries["boxes"], [(0, PortId(0)), (0, PortId(1))]);
        assert_eq!(stages.entries["other"], [(1, PortId(1))]);
        assert_eq!(stages.open_inputs(), ["lonely: input `in` must be wired: boxes"]);
        assert!(stages.exits.is_empty());
        assert_eq!(stages.build().map(|built| built.len()), Ok(4));
    }

    #[test]
    fn outputs_leave_under_a_name() {
        let mut stages = stages(&relay("a", "inputs: { in: _outside/boxes }")).unwrap();
        stages.let_out("boxes", "a", "aside").unwrap();
        assert_eq!(stages.exits["boxes"], (0, PortId(1)));
        assert_eq!(stages.wiring.stages[0].leaves, [false, true]);
        let mut error = |stage, output| stages.let_out("boxes", stage, output).unwrap_err();
        assert_eq!(error("b", "out"), "output `boxes`: no stage `b`");
        assert_eq!(error("a", "oot"), "output `boxes`: stage `a` has no output `oot`");
    }

    #[test]
    fn what_cannot_be_hosted_is_named() {
        let cases = [
            (
                "{ id: a, path: viewer.py }".to_string(),
                "node `a`: viewer.py is not a stage of realo, and only dora runs it",
            ),
            (
                "{ id: a, path: bin/realo, args: operator rely x=1 }".into(),
                "node `a`: no operator or node of `realo operators`: `operator rely x=1`",
            ),
            (
                relay("a", "inputs: { in: dora/timer/millis/5 }"),
                "node `a`: input `in` comes from dora/timer/millis/5",
            ),
            (
                relay("a", "inputs: { into: _outside/boxes }"),
                "node `a`: relay has no input `into`",
            ),
            (relay("a", "inputs: { in: b/out }"), "no node `b`"),
            (
                format!(
                    "{}, {}",
                    relay("a", "inputs: { in: b/oot }"),
                    relay("b", "inputs: { in: _outside/x }")
                ),
                "node `b` has no output `oot`",
            ),
            (
                "{ id: a, path: bin/realo, args: program no/such/file }".into(),
                "node `a`",
            ),
        ];
        for (nodes, expected) in cases {
            let found = problem(&nodes);
            assert!(found.contains(expected), "{nodes}\n{found}");
        }
    }

    #[test]
    fn a_stage_that_cannot_be_built_is_named() {
        let mut stages = Stages::default();
        stages.add("a", &RELAY, vec![], &[]).unwrap();
        stages
            .add("b", &RELAY, vec!["no".into(), "weights".into()], &[])
            .unwrap();
        let error = stages.build().map(|_| ()).unwrap_err();
        assert_eq!(error.to_string(), "node `b`: no weights");
        assert!(stages.add("c", &RELAY, vec![], &[("in", "d", "out")]).is_err());
        assert_eq!(stages.wiring.stages.len(), 2);
    }
}
