//! A graph in which something else is sent in the place of an output.

use std::collections::BTreeSet;

use super::{FlatGraph, FlatNode, Input, InputSource};

impl FlatGraph {
    /// Gives whoever takes the output `from` (node, output) another one, `to`, of the type `of`, and leaves out the stages
    /// whose outputs then nobody takes, directly or through others. A stage that nobody heard before stays.
    pub fn rewire(&mut self, from: (&str, &str), to: (&str, &str), of: &str) {
        let before = self.heard();
        let of_node = |(node, output): (&str, &str)| InputSource::Output {
            node: node.into(),
            output: output.into(),
        };
        let (from, source) = (of_node(from), of_node(to));
        // Processes take it from the process of the stage.
        let names = [from.clone(), self.as_dora_has_it(&from)];
        let inputs = self.nodes.iter_mut().chain(&mut self.hosts);
        for input in inputs.flat_map(|node| node.inputs.values_mut()) {
            if names.contains(&input.source) {
                input.source = source.clone();
            }
        }
        if let Some(node) = self.nodes.iter_mut().find(|node| node.id == to.0) {
            node.outputs.insert(to.1.into());
            node.output_types.insert(to.1.into(), of.into());
        }
        let after = self.heard();
        self.leave_out(&before.difference(&after).cloned().collect());
    }

    /// The stages that end in one that sends nothing, and these.
    pub(super) fn heard(&self) -> BTreeSet<String> {
        let sinks = self.nodes.iter().filter(|node| node.outputs.is_empty());
        let mut open: Vec<&FlatNode> = sinks.collect();
        let mut heard = BTreeSet::new();
        while let Some(node) = open.pop() {
            if heard.insert(node.id.clone()) {
                let sources = node.inputs.values().filter_map(Input::output);
                open.extend(sources.filter_map(|(id, _)| self.node(id)));
            }
        }
        heard
    }

    /// Takes stages away, and out of the processes that host them; nobody takes anything of them.
    pub(super) fn leave_out(&mut self, gone: &BTreeSet<String>) {
        let mut left_out: Vec<FlatNode> = Vec::new();
        self.nodes.retain(|node| match gone.contains(&node.id) {
            true => {
                left_out.push(node.clone());
                false
            }
            false => true,
        });
        let outlets = self.hosts.iter().flat_map(|process| {
            let gone = process.outlets.iter().filter(|(_, (stage, _))| gone.contains(stage));
            gone.map(|(output, _)| (process.id.clone(), output.clone()))
        });
        let outlets: BTreeSet<(String, String)> = outlets.collect();
        let of_gone = |input: &Input| {
            let source = input
                .output()
                .map(|(node, output)| (node.to_string(), output.to_string()));
            source.is_some_and(|source| gone.contains(&source.0) || outlets.contains(&source))
        };
        for node in self.nodes.iter_mut().chain(&mut self.hosts) {
            node.inputs.retain(|_, input| !of_gone(input));
        }
        for process in &mut self.hosts {
            process.outlets.retain(|_, (stage, _)| !gone.contains(stage));
            let outlets = &process.outlets;
            process.outputs.retain(|output| outlets.contains_key(output));
            process.output_types.retain(|output, _| outlets.contains_key(output));
            let inner: Vec<String> = left_out
                .iter()
                .filter(|stage| stage.host.as_ref() == Some(&process.id))
                .filter_map(|stage| Some(format!("{}.", stage.id.strip_prefix(&process.id)?.strip_prefix('.')?)))
                .collect();
            let is_of = |word: &String, stage: &String| {
                let key = word.strip_prefix(stage.as_str()).and_then(|rest| rest.split_once('='));
                key.is_some_and(|(key, _)| !key.contains('.'))
            };
            process
                .args
                .retain(|word| !inner.iter().any(|stage| is_of(word, stage)));
        }
        let alive: BTreeSet<&String> = self.nodes.iter().filter_map(|node| node.host.as_ref()).collect();
        let alive: BTreeSet<String> = alive.into_iter().cloned().collect();
        self.hosts.retain(|process| alive.contains(&process.id));
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

    fn ids(graph: &FlatGraph, of: &str) -> Vec<String> {
        let ids = graph.nodes.iter().map(|node| node.id.clone());
        ids.filter(|id| id.starts_with(of)).collect()
    }

    #[test]
    fn a_lane_whose_packets_come_from_elsewhere_only_says_where_its_agents_are() {
        let before = shipped("attfuse");
        let mut graph = before.clone();
        graph.rewire(("others.sender", "packets"), ("player", "packets"), "realo/v1/Packet");
        assert_eq!(
            ids(&graph, "others"),
            ["others.sense.sync", "others.sense.localization"]
        );
        assert_eq!(ids(&graph, "ego"), ids(&before, "ego"), "the ego's lane is as before");
        assert_eq!(ids(&graph, "v2x"), ["v2x.link"], "nobody listens to the ego's states");
        let link = graph.node("v2x.link").unwrap();
        assert_eq!(link.inputs["others"].output(), Some(("player", "packets")));
        // What dora starts is the same graph.
        let written = graph.to_yaml().unwrap();
        let again = Graph::parse(&written, &graph.file).unwrap().expand().unwrap();
        assert_eq!(ids(&again, ""), ids(&graph, ""), "{written}");
        let link = again.node("v2x.link").unwrap();
        assert_eq!(link.inputs["others"].output(), Some(("player", "packets")), "{written}");
        let others = again.hosts.iter().find(|process| process.id == "others").unwrap();
        assert!(
            !others.args.iter().any(|word| word.contains("encoder")),
            "{:?}",
            others.args
        );
        assert!(others.outputs.contains("state") && !others.outputs.contains("packets"));
        assert!(!others.inputs.contains_key("from_ego"), "{:?}", others.inputs);
    }

    #[test]
    fn an_output_that_nobody_takes_changes_nothing() {
        let mut graph = shipped("no_fusion");
        let before = ids(&graph, "");
        graph.rewire(("ego.sense.sync", "nothing"), ("player", "packets"), "realo/v1/Packet");
        assert_eq!(ids(&graph, ""), before);
    }
}
