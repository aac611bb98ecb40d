//! In which order a graph's nodes stand.

use std::collections::BTreeMap;

use super::{FlatGraph, FlatNode, GraphError, OUTSIDE};
use realo_operator::config::nearest_name;

impl FlatGraph {
    /// Each node's place in a fixed topological order, by index in `nodes`.
    ///
    /// Nodes are ordered by their longest path from a source, and by declaration where that is equal, so that a rank
    /// is higher than those of all nodes upstream and depends on nothing but the file.
    ///
    /// # Errors
    /// [`GraphError::Cycle`] names one; [`GraphError::Source`] an input from a node that does not exist.
    pub fn ranks(&self) -> Result<Vec<usize>, GraphError> {
        let upstream = self.upstream()?;
        let mut depths: Vec<Option<usize>> = vec![None; self.nodes.len()];
        loop {
            let known = |node: &usize| depths[*node].is_some();
            let open = |node: &usize| depths[*node].is_none() && upstream[*node].iter().all(known);
            let Some(next) = (0..self.nodes.len()).find(open) else {
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

    /// For each node the nodes that it takes from.
    fn upstream(&self) -> Result<Vec<Vec<usize>>, GraphError> {
        let index: BTreeMap<&str, usize> = self
            .nodes
            .iter()
            .enumerate()
            .map(|(i, node)| (node.id.as_str(), i))
            .collect();
        let sources = |node: &FlatNode| {
            let wires = node
                .inputs
                .iter()
                .filter_map(|(port, input)| Some((port, input.output()?.0)))
                .filter(|(_, source)| *source != OUTSIDE);
            let found = wires.map(|(port, source)| {
                index.get(source).copied().ok_or_else(|| GraphError::Source {
                    file: self.file.clone(),
                    node: node.id.clone(),
                    port: port.clone(),
                    source_id: source.into(),
                    nearest: nearest_name(source, index.keys().copied()),
                })
            });
            found.collect()
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

    use super::*;
    use crate::Graph;

    fn graph(text: &str) -> FlatGraph {
        Graph::parse(text, Path::new("/data/g.yml")).unwrap().expand().unwrap()
    }

    #[test]
    fn ranks_by_longest_path_then_declaration() {
        let text = "nodes: [{id: z, path: x, inputs: {p: b/o, q: a/o}}, {id: b, path: x, inputs: {p: a/o}, outputs: [o]}, \
                    {id: a, path: x, outputs: [o]}, {id: c, path: x, inputs: {t: dora/timer/millis/5}}]";
        assert_eq!(graph(text).ranks().unwrap(), [3, 2, 0, 1]);
    }

    #[test]
    fn names_cycles_and_missing_nodes() {
        let text = "nodes: [{id: a, path: x, inputs: {p: c/o}}, {id: b, path: x, inputs: {p: d/o}}, \
                    {id: c, path: x, inputs: {p: b/o}}, {id: d, path: x, inputs: {p: c/o}}]";
        let error = graph(text).ranks().unwrap_err().to_string();
        assert!(
            error.contains("d > b > c > d") || error.contains("c > d > b > c"),
            "{error}"
        );
        let error = graph("nodes: [{id: bank, path: x}, {id: b, path: x, inputs: {p: bnak/o}}]")
            .ranks()
            .unwrap_err();
        assert!(
            error.to_string().contains("no node `bnak` (did you mean `bank`?)"),
            "{error}"
        );
        let error = Graph::parse("nodes: [{id: a, path: x}, {id: a, path: y}]", Path::new("g.yml"))
            .unwrap()
            .expand();
        assert!(matches!(error, Err(GraphError::Duplicate { id, .. }) if id == "a"));
    }
}
