//! Another stage in the place of one of a graph, or a new one before an input, wherever the stage is written.

use std::collections::BTreeSet;
use std::path::Path;
use std::str::FromStr;

use realo_documents::shown;
use realo_operator::config::nearest_name;

use super::flat::{BEFORE, STAGE, TAKES, set_argument};
use super::{FlatGraph, FlatNode, GraphError, Input, InputSource};

/// `STAGE=program PATH key=value …` or `STAGE=operator NAME key=value …`.
///
/// Several stages in a row, joined by `+`, give way to one: it takes the inputs of the first and has the outputs of the
/// last. Several places, joined by `,`, get the same stage: `ego.encoder+head,others.encoder+head=program detector.py`.
/// Behind a `+` the module's name may be left out. `STAGE.INPUT=…` puts a new stage before an input of one: it takes what
/// the input took, and is named as its operator or program in the module of that stage.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Replacement {
    /// Ids of the stages, as written, by place.
    pub places: Vec<Vec<String>>,
    /// `program` or `operator`, the path or name, and the arguments.
    pub words: Vec<String>,
    /// Names of the input and the output of a stage that is put before an input; `None`: both are that input's.
    pub ports: Option<[String; 2]>,
}

impl FromStr for Replacement {
    type Err = GraphError;

    fn from_str(text: &str) -> Result<Self, GraphError> {
        let wrong = |reason: &str| GraphError::Replacement(shown(text), reason.into());
        let (left, right) = text.split_once('=').ok_or_else(|| wrong("no `=` behind the stage"))?;
        let places: Vec<Vec<String>> = left
            .split(',')
            .map(|place| place.split('+').map(|id| id.trim().to_string()).collect())
            .collect();
        if places.iter().flatten().any(String::is_empty) {
            return Err(wrong("a stage without a name"));
        }
        let words = shlex::split(right).ok_or_else(|| wrong("a quote is not closed"))?;
        match words.as_slice() {
            [word, _, arguments @ ..] if word == "program" || word == "operator" => {
                match arguments.iter().find(|argument| !argument.contains('=')) {
                    Some(argument) => Err(wrong(&format!("`{}` is not of the form key=value", shown(argument)))),
                    None => Ok(Replacement {
                        places,
                        words,
                        ports: None,
                    }),
                }
            }
            [] => Err(wrong("nothing behind `=`")),
            [first, ..] if first.contains(['/', '.']) => Err(wrong(&format!(
                "`{}` without the word `program` before it",
                shown(first)
            ))),
            [first, ..] => Err(wrong(&format!(
                "`{}` is neither, or has no name behind it",
                shown(first)
            ))),
        }
    }
}

impl FlatGraph {
    /// Puts the stage of a replacement into its places; gives the ids of the stages that it became. Stages whose outputs
    /// then nobody takes are left out. Whether its ports fit [`super::validate`] says.
    ///
    /// # Errors
    /// [`GraphError::UnknownNode`], with all stages; [`GraphError::UnknownInput`]; [`GraphError::Node`] for a stage that cannot be
    /// replaced.
    pub fn replace(&mut self, replacement: &Replacement) -> Result<Vec<String>, GraphError> {
        let mut replaced = Vec::new();
        for place in &replacement.places {
            if let Some((taker, port)) = self.input_of(place) {
                replaced.push(self.put_before(&taker, &port, replacement)?);
                continue;
            }
            let chain = self.chain(place)?;
            replaced.extend(self.put(&chain, &replacement.words));
        }
        Ok(replaced)
    }

    /// The stage and its input that a place names, if it names one and no stage.
    pub fn input_of(&self, place: &[String]) -> Option<(String, String)> {
        let [place] = place else { return None };
        let (taker, port) = place.rsplit_once('.').filter(|_| self.node(place).is_none())?;
        let is_wired = self.node(taker)?.inputs.contains_key(port);
        is_wired.then(|| (taker.into(), port.into()))
    }

    /// The error for a place that names neither a stage nor an input.
    fn unknown_place(&self, place: &str) -> GraphError {
        let parts = place.rsplit_once('.');
        let Some((taker, input)) = parts.and_then(|(taker, input)| Some((self.node(taker)?, input))) else {
            return self.unknown(place);
        };
        let known: Vec<&str> = taker.inputs.keys().map(String::as_str).collect();
        GraphError::UnknownInput {
            file: self.file.clone(),
            node: taker.id.clone(),
            input: input.into(),
            nearest: nearest_name(input, known.iter().copied()),
            known: known.join(", "),
        }
    }

    /// Puts a new stage before an input. Returns its id.
    fn put_before(&mut self, taker: &str, port: &str, replacement: &Replacement) -> Result<String, GraphError> {
        let wrong = |reason: String| GraphError::Node {
            file: self.file.clone(),
            node: taker.into(),
            reason,
        };
        let (Some(at), words) = (self.nodes.iter().position(|node| node.id == taker), &replacement.words) else {
            return Err(self.unknown(taker));
        };
        let stem = Path::new(&words[1]).file_stem().unwrap_or_default().to_string_lossy();
        let id = match taker.rsplit_once('.') {
            Some((module, _)) => format!("{module}.{stem}"),
            None => stem.into_owned(),
        };
        if self.node(&id).is_some() {
            return Err(wrong(format!(
                "expected one stage `{id}`, found that the graph has one already"
            )));
        }
        let node = &self.nodes[at];
        if !node.is_realo() {
            let path = node.path.display();
            return Err(wrong(format!(
                "expected a stage of ours behind what is put before its input, found {path}"
            )));
        }
        let [input, output] = replacement
            .ports
            .clone()
            .unwrap_or_else(|| [port, port].map(String::from));
        let wire = node.inputs[port].clone();
        let of = wire
            .output()
            .and_then(|(id, output)| self.node(id)?.output_types.get(output));
        let stage = FlatNode {
            inputs: [(input.clone(), wire.clone())].into(),
            outputs: [output.clone()].into(),
            output_types: of.map(|of| (output.clone(), of.clone())).into_iter().collect(),
            other: node.other.clone(),
            env: node.env.clone(),
            path: node.path.clone(),
            host: node.host.clone(),
            ..FlatNode::alone(&id, words, &[])
        };
        let host = stage.host.clone();
        let own = InputSource::Output {
            node: id.clone(),
            output: output.clone(),
        };
        self.nodes[at].inputs.insert(port.into(), own.into());
        self.nodes.insert(at, stage);
        if let Some(process) = self.hosts.iter_mut().find(|process| host.as_ref() == Some(&process.id)) {
            let [taker, name] = [taker, &id].map(|id| within(process, id));
            tell(process, &name, words);
            set_argument(
                &mut process.args,
                &format!("{name}.{BEFORE}"),
                &format!("{taker}.{port} {input} {output}"),
            );
        }
        Ok(id)
    }

    /// The stages of a place by their full ids; each takes what the one before it makes.
    fn chain(&self, place: &[String]) -> Result<Vec<String>, GraphError> {
        let mut chain: Vec<String> = Vec::new();
        for id in place {
            let module = chain.first().and_then(|first| first.rsplit_once('.'));
            let inside = module.map(|(module, _)| format!("{module}.{id}"));
            let id = match inside.filter(|inside| self.node(inside).is_some() && self.node(id).is_none()) {
                Some(inside) => inside,
                None => id.clone(),
            };
            let node = self.node(&id).ok_or_else(|| self.unknown_place(&id))?;
            let wrong = |reason: String| GraphError::Node {
                file: self.file.clone(),
                node: id.clone(),
                reason,
            };
            let is_operator = node.program().is_some() || node.stage().is_some_and(|(word, _)| word == "operator");
            if !is_operator || !node.is_realo() {
                let found = node.args.join(" ");
                return Err(wrong(format!(
                    "expected an operator or a program to replace, found `{}`; sources and sinks are changed in the graph's file",
                    shown(&found)
                )));
            }
            if let Some(before) = chain.last() {
                let takes = |input: &Input| input.output().is_some_and(|(source, _)| source == before);
                let same_host = self.node(before).is_some_and(|before| before.host == node.host);
                if !node.inputs.values().any(takes) || !same_host {
                    return Err(wrong(format!(
                        "expected it to take what `{before}` makes, in the same process; join by `+` only stages that follow each other"
                    )));
                }
            }
            chain.push(id);
        }
        Ok(chain)
    }

    fn put(&mut self, chain: &[String], words: &[String]) -> Option<String> {
        let (first, last) = (chain.first()?, chain.last()?.clone());
        let inputs = self.node(first)?.inputs.clone();
        let before = self.heard();
        let node = self.nodes.iter_mut().find(|node| node.id == last)?;
        node.args = words.to_vec();
        node.inputs = inputs;
        let host = node.host.clone();
        let after = self.heard();
        if let Some(process) = self.hosts.iter_mut().find(|process| host.as_ref() == Some(&process.id)) {
            retell(process, first, &last, words);
        }
        self.leave_out(&before.difference(&after).cloned().collect::<BTreeSet<String>>());
        Some(last)
    }
}

/// Says it to the process that hosts the stage; what its file said of the stage before is forgotten.
fn retell(process: &mut FlatNode, first: &str, last: &str, words: &[String]) {
    let name = within(process, last);
    let is_of_stage = |word: &String| {
        let key = word
            .strip_prefix(&format!("{name}."))
            .and_then(|rest| rest.split_once('='));
        key.is_some_and(|(key, _)| !key.contains('.') && ![BEFORE, TAKES].contains(&key))
    };
    process.args.retain(|word| !is_of_stage(word));
    tell(process, &name, words);
    if first != last {
        let first = within(process, first);
        set_argument(&mut process.args, &format!("{name}.{TAKES}"), &first);
    }
}

/// The name of a stage in the process that hosts it.
fn within(process: &FlatNode, id: &str) -> String {
    let inner = id.strip_prefix(&process.id).and_then(|rest| rest.strip_prefix('.'));
    inner.unwrap_or(id).to_string()
}

/// Says to a process what one of its stages is.
fn tell(process: &mut FlatNode, name: &str, words: &[String]) {
    // Words that came through a shell's splitting can be joined again; a NUL, which could not, no argument can hold.
    if let Ok(words) = shlex::try_join(words.iter().map(String::as_str)) {
        set_argument(&mut process.args, &format!("{name}.{STAGE}"), &words);
    }
}

#[cfg(test)]
mod tests {
    use super::super::Graph;
    use super::*;

    fn shipped(name: &str) -> FlatGraph {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        FlatGraph::load(&root.join(format!("dataflows/{name}.yml"))).unwrap()
    }

    fn replaced(name: &str, text: &str) -> Result<FlatGraph, GraphError> {
        let mut graph = shipped(name);
        graph.replace(&text.parse()?)?;
        Ok(graph)
    }

    fn again(graph: &FlatGraph) -> FlatGraph {
        let written = graph.to_yaml().unwrap();
        Graph::parse(&written, &graph.file).unwrap().expand().unwrap()
    }

    #[test]
    fn a_stage_of_a_host_gives_way_to_a_program_and_dora_starts_the_same() {
        let before = shipped("late_fusion");
        let mut graph = replaced("late_fusion", "fusion.fusion=program '/my plug/fill.py' overlap=0.2").unwrap();
        graph.set("fusion.fusion", "overlap", "0.3").unwrap();
        let ids = |graph: &FlatGraph| graph.nodes.iter().map(|node| node.id.clone()).collect::<Vec<_>>();
        assert_eq!(ids(&graph), ids(&before), "all other stages stay");
        for graph in [&graph, &again(&graph)] {
            let node = graph.node("fusion.fusion").unwrap();
            assert_eq!(node.args, ["program", "/my plug/fill.py", "overlap=0.3"]);
            assert_eq!(node.inputs, before.node("fusion.fusion").unwrap().inputs);
        }
    }

    #[test]
    fn settings_of_a_file_for_the_old_stage_are_not_given_to_the_new_one() {
        let graph = replaced("attfuse", "fusion.fusion=program /x/mean").unwrap();
        let again = again(&graph);
        assert_eq!(again.node("fusion.fusion").unwrap().args, ["program", "/x/mean"]);
        let head = |graph: &FlatGraph| graph.node("fusion.head").unwrap().args.clone();
        assert_eq!(head(&again), head(&graph));
    }

    #[test]
    fn a_stage_takes_the_place_of_several_in_several_lanes() {
        let text = "ego.encoder+head,others.encoder+others.head=program /x/detector.py";
        let graph = replaced("late_fusion", text).unwrap();
        let before = shipped("late_fusion");
        for graph in [&graph, &again(&graph)] {
            for side in ["ego", "others"] {
                assert!(graph.node(&format!("{side}.encoder")).is_none());
                let head = graph.node(&format!("{side}.head")).unwrap();
                assert_eq!(head.args, ["program", "/x/detector.py"]);
                assert_eq!(head.inputs, before.node(&format!("{side}.encoder")).unwrap().inputs);
            }
        }
    }

    #[test]
    fn a_new_stage_comes_before_an_input_and_dora_starts_the_same() {
        let before = shipped("attfuse");
        let mut replacement: Replacement = "others.sender.messages=operator liar agents=cav2".parse().unwrap();
        replacement.ports = Some(["messages", "said"].map(String::from));
        let mut graph = before.clone();
        assert_eq!(graph.replace(&replacement).unwrap(), ["others.liar"]);
        graph.set("others.liar", "ghosts", "3").unwrap();
        for graph in [&graph, &again(&graph)] {
            assert_eq!(graph.nodes.len(), before.nodes.len() + 1);
            let liar = graph.node("others.liar").unwrap();
            assert_eq!(liar.args, ["operator", "liar", "agents=cav2", "ghosts=3"]);
            assert_eq!(
                liar.inputs["messages"],
                before.node("others.sender").unwrap().inputs["messages"]
            );
            let sender = &graph.node("others.sender").unwrap().inputs["messages"];
            assert_eq!(sender.output(), Some(("others.liar", "said")));
        }
        graph
            .replace(&"others.liar=operator liar agents=rsu1".parse().unwrap())
            .unwrap();
        for graph in [&graph, &again(&graph)] {
            assert_eq!(
                graph.node("others.liar").unwrap().args,
                ["operator", "liar", "agents=rsu1"],
                "it gave way"
            );
        }
        let of_own = shipped("late_fusion").apart();
        let mut graph = of_own.clone();
        graph
            .replace(&"fusion.nms.proposals=program /x/filter.py".parse().unwrap())
            .unwrap();
        let filter = graph.node("fusion.filter").unwrap();
        assert_eq!(
            (filter.host.as_ref(), filter.outputs.contains("proposals")),
            (None, true)
        );
        assert!(graph.to_yaml().unwrap().contains("program /x/filter.py"));
    }

    #[test]
    fn what_cannot_be_replaced_is_refused_by_name() {
        for (text, expected) in [
            (
                "fusion.fuse=program x",
                "no node `fusion.fuse` (did you mean `fusion.fusion`?)",
            ),
            ("fusion.fuse=program x", "fusion.nms"),
            ("player=program x", "node `player`: expected an operator or a program"),
            (
                "ego.encoder+nms=program x",
                "expected it to take what `ego.encoder` makes",
            ),
            (
                "fusion.fusion.egos=program x",
                "nothing feeds an input `egos` of `fusion.fusion` (did you mean `ego`?); its inputs are: ego, selections",
            ),
            (
                "fusion.nms.proposals=operator fusion",
                "expected one stage `fusion.fusion`, found that the graph has one already",
            ),
            ("fusion.fusion=fusion.py", "without the word `program`"),
            ("fusion.fusion=program", "`program` is neither, or has no name"),
            ("fusion.fusion=", "nothing behind `=`"),
            ("fusion.fusion", "no `=`"),
            ("=program x", "a stage without a name"),
            ("fusion.fusion=program x 0.2", "`0.2` is not of the form key=value"),
            ("fusion.fusion=program 'x", "a quote"),
        ] {
            let error = replaced("late_fusion", text).unwrap_err().to_string();
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
