//! In which order a graph's nodes stand.

use std::collections::BTreeMap;

use super::{FlatGraph, FlatNode, GraphError, OUTSIDE};
use realo_operator::config::nearest_name;
use realo_operator::{Registry, Role};

impl FlatGraph {
    /// Each node's place in a fixed topological order, by index in `nodes`.
    ///
    /// Nodes are ordered by their longest path from a source, and by declaration where that is equal, so that a rank
    /// is higher than those of all nodes upstream and depends on nothing but the file. What a gateway brings in comes from
    /// elsewhere, not from what it takes: a way that leads back to it ends there. A wire to an input of feedback counts for nothing.
    ///
    /// # Errors
    /// [`GraphError::Cycle`] names one; [`GraphError::Source`] an input from a node that does not exist.
    pub fn ranks(&self, registry: &Registry) -> Result<Vec<usize>, GraphError> {
        let upstream = self.upstream(registry)?;
        let stages = self.nodes.iter().map(|node| node.registration(registry));
        let gateways: Vec<bool> = stages
            .map(|stage| stage.is_some_and(|stage| stage.role == Role::Gateway))
            .collect();
        let mut depths: Vec<Option<usize>> = vec![None; self.nodes.len()];
        loop {
            let known = |node: &usize| depths[*node].is_some();
            let from_elsewhere = |node: &usize| known(node) || gateways[*node];
            let open = |node: &usize| depths[*node].is_none() && upstream[*node].iter().all(known);
            let reached = |node: &usize| depths[*node].is_none() && upstream[*node].iter().all(from_elsewhere);
            let mut all = 0..self.nodes.len();
            let Some(next) = all.clone().find(open).or_else(|| all.find(reached)) else {
                break;
            };
            depths[next] = Some(
                upstream[next]
                    .iter()
                    .filter_map(|node| depths[*node])
                    .max()
                    .map_or(0, |d| d + 1),
            );
        }
        if depths.iter().any(Option::is_none) {
            return Err(self.cycle(&upstream, &depths));
        }
        let mut order: Vec<usize> = (0..self.nodes.len()).collect();
        order.sort_by_key(|node| (depths[*node], *node));
        let mut ranks = vec![0; order.len()];
        for (rank, node) in order.into_iter().enumerate() {
            ranks[node] = rank;
        }
        Ok(ranks)
    }

    /// For each node the nodes that it takes from, but for feedback.
    fn upstream(&self, registry: &Registry) -> Result<Vec<Vec<usize>>, GraphError> {
        let index: BTreeMap<&str, usize> = self
            .nodes
            .iter()
            .enumerate()
            .map(|(i, node)| (node.id.as_str(), i))
            .collect();
        let sources = |node: &FlatNode| {
            let stage = node.registration(registry);
            let is_feedback = |port: &str| {
                let input = stage.and_then(|stage| stage.input(port));
                input.is_some_and(|(_, port)| port.feedback)
            };
            let wires = node
                .inputs
                .iter()
                .filter_map(|(port, input)| Some((port, input.output()?.0)))
                .filter(|(_, source)| *source != OUTSIDE);
            let found = wires.map(|(port, source)| {
                let known = index.get(source).map(|known| (port, *known));
                known.ok_or_else(|| GraphError::Source {
                    file: self.file.clone(),
                    node: node.id.clone(),
                    port: port.clone(),
                    source_id: source.into(),
                    nearest: nearest_name(source, index.keys().copied()),
                })
            });
            let found: Result<Vec<(&String, usize)>, GraphError> = found.collect();
            let found = found?.into_iter().filter(|(port, _)| !is_feedback(port));
            Ok(found.map(|(_, source)| source).collect())
        };
        self.nodes.iter().map(sources).collect()
    }

    /// One cycle among the nodes that have no depth: each of them takes from another one.
    fn cycle(&self, upstream: &[Vec<usize>], depths: &[Option<usize>]) -> GraphError {
        let mut way: Vec<usize> = (0..self.nodes.len())
            .filter(|node| depths[*node].is_none())
            .take(1)
            .collect();
        while let Some(last) = way.last() {
            let Some(next) = upstream[*last].iter().copied().find(|node| depths[*node].is_none()) else {
                break;
            };
            if let Some(start) = way.iter().position(|node| *node == next) {
                way.drain(..start);
                way.push(next);
                break;
            }
            way.push(next);
        }
        way.reverse();
        let nodes = way.into_iter().map(|node| self.nodes[node].id.clone()).collect();
        GraphError::Cycle {
            file: self.file.clone(),
            nodes,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use realo_operator::{Port, Registration};

    use super::*;
    use crate::Graph;

    fn graph(text: &str) -> FlatGraph {
        Graph::parse(text, Path::new("/data/g.yml")).unwrap().expand().unwrap()
    }

    #[test]
    fn ranks_by_longest_path_then_declaration() {
        let text = "nodes: [{id: z, path: x, inputs: {p: b/o, q: a/o}}, {id: b, path: x, inputs: {p: a/o}, outputs: [o]}, \
                    {id: a, path: x, outputs: [o]}, {id: c, path: x, inputs: {t: dora/timer/millis/5}}]";
        assert_eq!(graph(text).ranks(&Registry(&[])).unwrap(), [3, 2, 0, 1]);
    }

    #[test]
    fn what_a_gateway_brings_in_closes_no_cycle() {
        let lane = "{id: lane, path: bin/realo, args: operator transmission-encoder, inputs: {state: v2x/states}, outputs: [packets]}";
        let around = |v2x: &str| {
            let v2x = format!(
                "{{id: v2x, path: bin/realo, args: {v2x}, inputs: {{packets: lane/packets}}, outputs: [states]}}"
            );
            let graph = graph(&format!(
                "nodes: [{v2x}, {lane}, {{id: end, path: x, inputs: {{p: v2x/states}}}}]"
            ));
            graph.ranks(&crate::check::tests::REGISTRY)
        };
        assert_eq!(around("node radio").unwrap(), [1, 0, 2]);
        let error = around("operator link").unwrap_err().to_string();
        assert!(
            error.contains("lane > v2x > lane") || error.contains("v2x > lane > v2x"),
            "{error}"
        );
    }

    #[test]
    fn feedback_closes_no_cycle() {
        static STAGES: Registry = Registry(&[Registration {
            name: "loop",
            about: "",
            role: Role::Operator,
            inputs: &[Port::new("in", &[], ""), Port::new("back", &[], "").feedback()],
            outputs: &[Port::new("out", &[], "")],
            settings: &[],
            counters: &[],
            defaults: Default::default,
            check: |_| Ok(()),
            examine: |_| Ok(()),
            maps: |_| Vec::new(),
            build: |_| Err("it is never built".into()),
        }]);
        let around = |port: &str| {
            let text = format!(
                "nodes: [{{id: link, path: x, inputs: {{p: lane/out}}, outputs: [o]}}, {{id: player, path: x, outputs: [o]}}, \
                 {{id: lane, path: bin/realo, args: operator loop, inputs: {{{port}}}, outputs: [out]}}]"
            );
            graph(&text).ranks(&STAGES)
        };
        assert_eq!(around("in: player/o, back: link/o").unwrap(), [2, 0, 1]);
        assert!(
            around("in: link/o, back: player/o")
                .unwrap_err()
                .to_string()
                .contains("cycle")
        );
        assert!(
            around("in: player/o, back: nobody/o")
                .unwrap_err()
                .to_string()
                .contains("nobody")
        );
    }

    #[test]
    fn names_cycles_and_missing_nodes() {
        let text = "nodes: [{id: a, path: x, inputs: {p: c/o}}, {id: b, path: x, inputs: {p: d/o}}, \
                    {id: c, path: x, inputs: {p: b/o}}, {id: d, path: x, inputs: {p: c/o}}]";
        let error = graph(text).ranks(&Registry(&[])).unwrap_err().to_string();
        assert!(
            error.contains("d > b > c > d") || error.contains("c > d > b > c"),
            "{error}"
        );
        let error = graph("nodes: [{id: bank, path: x}, {id: b, path: x, inputs: {p: bnak/o}}]")
            .ranks(&Registry(&[]))
            .unwrap_err();
        assert!(
            error.to_string().contains("no node `bnak` (did you mean `bank`?)"),
            "{error}"
        );
        let error = Graph::parse("nodes: [{id: a, path: x}, {id: a, path: y}]", Path::new("g.yml"));
        assert!(matches!(error, Err(GraphError::Duplicate { id, .. }) if id == "a"));
    }
}
