//! Another stage in the place of one of a graph, wherever the stage is written.

use std::collections::BTreeSet;
use std::str::FromStr;

use realo_documents::shown;

use super::flat::{STAGE, TAKES, set_argument};
use super::{FlatGraph, FlatNode, GraphError, Input};

/// `STAGE=program PATH key=value …` or `STAGE=operator NAME key=value …`.
///
/// Several stages in a row, joined by `+`, give way to one: it takes the inputs of the first and has the outputs of the
/// last. Several places, joined by `,`, get the same stage: `ego.encoder+head,others.encoder+head=program detector.py`.
/// Behind a `+` the module's name may be left out.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Replacement {
    /// Ids of the stages, as written, by place.
    pub places: Vec<Vec<String>>,
    /// `program` or `operator`, the path or name, and the arguments.
    pub words: Vec<String>,
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
                    None => Ok(Replacement { places, words }),
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
    /// [`GraphError::UnknownNode`], with all stages; [`GraphError::Node`] for a stage that cannot be replaced.
    pub fn replace(&mut self, replacement: &Replacement) -> Result<Vec<String>, GraphError> {
        let mut replaced = Vec::new();
        for place in &replacement.places {
            let chain = self.chain(place)?;
            replaced.extend(self.put(&chain, &replacement.words));
        }
        Ok(replaced)
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
            let node = self.node(&id).ok_or_else(|| self.unknown(&id))?;
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
    let prefix = format!("{}.", process.id);
    let inner = |id: &str| id.strip_prefix(&prefix).unwrap_or(id).to_string();
    let name = inner(last);
    let is_of_stage = |word: &String| {
        let key = word
            .strip_prefix(&format!("{name}."))
            .and_then(|rest| rest.split_once('='));
        key.is_some_and(|(key, _)| !key.contains('.'))
    };
    process.args.retain(|word| !is_of_stage(word));
    // Words that came through a shell's splitting can be joined again; a NUL, which could not, no argument can hold.
    let Ok(words) = shlex::try_join(words.iter().map(String::as_str)) else {
        return;
    };
    set_argument(&mut process.args, &format!("{name}.{STAGE}"), &words);
    if first != last {
        set_argument(&mut process.args, &format!("{name}.{TAKES}"), &inner(first));
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

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
