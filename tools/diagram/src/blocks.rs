//! In which order stages stand in their process, and processes in layers.

use std::collections::BTreeSet;

use crate::Diagram;

/// What stands in a process from top to bottom.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Block {
    /// A stage by its index.
    Stage(usize),
    /// A module: its name and what is in it.
    Module(String, Vec<Block>),
}

impl Block {
    /// How many modules are within each other.
    pub fn depth(&self) -> usize {
        match self {
            Block::Stage(_) => 0,
            Block::Module(_, inner) => 1 + depth(inner),
        }
    }
}

/// How many modules are within each other.
pub fn depth(blocks: &[Block]) -> usize {
    blocks.iter().map(Block::depth).max().unwrap_or(0)
}

/// The stages of a process: each below those that it takes from, and those of a module together.
pub fn of_process(diagram: &Diagram, process: usize) -> Vec<Block> {
    let all = 0..diagram.stages.len();
    grouped(
        diagram,
        all.filter(|stage| diagram.stages[*stage].process == process).collect(),
        0,
    )
}

fn grouped(diagram: &Diagram, stages: Vec<usize>, depth: usize) -> Vec<Block> {
    let mut groups: Vec<(Option<&String>, Vec<usize>)> = Vec::new();
    for stage in stages {
        let module = diagram.stages[stage].modules.get(depth);
        match groups
            .iter_mut()
            .find(|(known, _)| module.is_some() && *known == module)
        {
            Some((_, members)) => members.push(stage),
            None => groups.push((module, vec![stage])),
        }
    }
    let group_of = |stage: usize| groups.iter().position(|(_, members)| members.contains(&stage));
    let wires = diagram.wires.iter().filter(|wire| !wire.feedback);
    let edges = wires.filter_map(|wire| Some((group_of(wire.from.stage)?, group_of(wire.to.stage)?)));
    let order = sorted(groups.len(), &edges.filter(|(from, to)| from != to).collect());
    let block = |at: usize| match &groups[at] {
        (Some(module), members) => Block::Module(module.to_string(), grouped(diagram, members.clone(), depth + 1)),
        (None, members) => Block::Stage(members[0]),
    };
    order.into_iter().map(block).collect()
}

/// Indices, each after those that edges lead from; the first of those that may come next comes next. A circle is entered at
/// its first index.
pub fn sorted(count: usize, edges: &BTreeSet<(usize, usize)>) -> Vec<usize> {
    let mut order = Vec::with_capacity(count);
    let mut left: BTreeSet<usize> = (0..count).collect();
    while let Some(first) = left.first().copied() {
        let is_open = |index: &usize| !edges.iter().any(|(from, to)| to == index && left.contains(from));
        let next = left.iter().copied().find(is_open).unwrap_or(first);
        left.remove(&next);
        order.push(next);
    }
    order
}

/// The layer of each process, from left to right: beyond all that it takes from, but for wires that lead back.
///
/// Processes take from each other, though their stages form no circle: what comes last of a process decides.
pub fn layers(diagram: &Diagram) -> Vec<usize> {
    let depths = depths(diagram);
    let count = diagram.processes.len();
    let last = |process: usize| {
        let stages = (0..depths.len()).filter(|stage| diagram.stages[*stage].process == process);
        stages.map(|stage| depths[stage]).max()
    };
    let mut order: Vec<usize> = (0..count).collect();
    order.sort_by_key(|process| (last(*process), *process));
    let mut place = vec![0; count];
    for (at, process) in order.iter().enumerate() {
        place[*process] = at;
    }
    let edges: BTreeSet<(usize, usize)> = diagram
        .wires
        .iter()
        .map(|wire| (diagram.process_of(wire.from), diagram.process_of(wire.to)))
        .filter(|(from, to)| place[*from] < place[*to])
        .collect();
    let mut layers = vec![0; count];
    for process in order {
        let before = edges.iter().filter(|(_, to)| *to == process);
        layers[process] = before.map(|(from, _)| layers[*from] + 1).max().unwrap_or(0);
    }
    layers
}

/// The longest way to each stage, but for feedback and wires that close a circle.
fn depths(diagram: &Diagram) -> Vec<usize> {
    let count = diagram.stages.len();
    let wires = diagram.wires.iter().filter(|wire| !wire.feedback);
    let edges: BTreeSet<(usize, usize)> = wires.map(|wire| (wire.from.stage, wire.to.stage)).collect();
    let order = sorted(count, &edges);
    let mut depths: Vec<Option<usize>> = vec![None; count];
    for stage in order {
        let before = edges.iter().filter(|(_, to)| *to == stage);
        let longest = before.filter_map(|(from, _)| depths[*from]).max();
        depths[stage] = Some(longest.map_or(0, |depth| depth + 1));
    }
    depths.into_iter().map(Option::unwrap_or_default).collect()
}
