//! A process as a column of stages: how large it is, and where everything in it is.

use std::collections::BTreeMap;

use realo_render::{Fonts, Weight};

use crate::blocks::{Block, depth, of_process};
use crate::picture::{BoxAt, FrameAt, PortAt, Rect};
use crate::{Diagram, End, Port};

/// Size of the letters of names, px.
pub const NAME: f64 = 13.0;
/// Size of all other letters, px.
pub const SMALL: f64 = 11.0;
/// From one port to the next.
const ROW: f64 = 18.0;
/// A line of text within a box.
const LINE: f64 = 15.0;
/// Between what is drawn and its border.
const PAD: f64 = 8.0;
/// Between two boxes.
const GAP: f64 = 9.0;
/// From the border of a module to that of one within it.
const NEST: f64 = 7.0;
/// Height of a module's name.
const MODULE: f64 = 20.0;
/// From one wire that runs down beside the boxes to the next.
const TRACK: f64 = 8.0;
/// Between the texts of both sides of a box.
const APART: f64 = 16.0;

/// A process; px from its upper left corner.
pub struct Column {
    pub size: [f64; 2],
    /// Its own frame first.
    pub frames: Vec<FrameAt>,
    pub boxes: Vec<BoxAt>,
    /// Wires between its stages, by index: the x at which they run down.
    pub tracks: BTreeMap<usize, f64>,
}

/// What is needed to lay a process out.
struct Layout<'a> {
    diagram: &'a Diagram,
    fonts: &'a Fonts,
    /// The boxes' left and right sides.
    sides: [f64; 2],
    y: f64,
    frames: Vec<FrameAt>,
    boxes: Vec<BoxAt>,
}

/// The width of a text.
pub fn width(fonts: &Fonts, text: &str, size: f64, weight: Weight) -> f64 {
    fonts.width(text, size, weight)
}

impl Column {
    pub fn of(diagram: &Diagram, process: usize, fonts: &Fonts) -> Self {
        let blocks = of_process(diagram, process);
        let nest = NEST * depth(&blocks) as f64;
        let what = &diagram.processes[process];
        let stages: Vec<usize> = (0..diagram.stages.len())
            .filter(|stage| diagram.stages[*stage].process == process)
            .collect();
        let measured = stages.iter().map(|stage| box_width(diagram, *stage, fonts));
        let title = width(fonts, &what.name, NAME, Weight::Bold).max(width(fonts, &what.what, SMALL, Weight::Regular));
        let names = modules(&blocks).into_iter();
        let names = names.map(|name| width(fonts, name, SMALL, Weight::Bold) + PAD);
        let inner = measured.chain(names).fold(0.0, f64::max).max(title - nest).ceil();
        let left = PAD + 2.0 + nest;
        let mut layout = Layout {
            diagram,
            fonts,
            sides: [left, left + inner],
            y: PAD + NAME + 6.0 + if what.what.is_empty() { 0.0 } else { LINE },
            frames: Vec::new(),
            boxes: Vec::new(),
        };
        blocks.iter().for_each(|block| layout.put(block));
        let beside = layout.sides[1] + nest + PAD;
        let labels = labels(diagram, process, fonts);
        let (tracks, end) = tracks(diagram, &layout.boxes, beside + labels);
        let size = [end + PAD - TRACK / 2.0, layout.y - GAP + PAD + 2.0];
        let own = FrameAt {
            rect: Rect::new([0.0, 0.0], size),
            name: what.name.clone(),
            what: what.what.clone(),
            is_process: true,
        };
        let mut frames = vec![own];
        frames.extend(layout.frames);
        Column {
            size,
            frames,
            boxes: layout.boxes,
            tracks,
        }
    }
}

/// Names of all modules.
fn modules(blocks: &[Block]) -> Vec<&str> {
    let mut names = Vec::new();
    for block in blocks {
        if let Block::Module(name, inner) = block {
            names.push(name.as_str());
            names.extend(modules(inner));
        }
    }
    names
}

/// Room for what arrows say beside the boxes of a process.
fn labels(diagram: &Diagram, process: usize, fonts: &Fonts) -> f64 {
    let stages = diagram.stages.iter().filter(|stage| stage.process == process);
    let facts = stages.flat_map(|stage| &stage.outputs).map(|port| &port.facts);
    let longest = facts
        .map(|facts| width(fonts, facts, SMALL, Weight::Regular))
        .fold(0.0, f64::max);
    if longest > 0.0 { longest.ceil() + 2.0 * PAD } else { 0.0 }
}

/// The ports of a stage by where they are: fed from other processes on the left; fed from its own, and outputs, on the right.
fn sides(diagram: &Diagram, stage: usize) -> [Vec<(usize, bool)>; 2] {
    let ports = &diagram.stages[stage];
    let fed_inside = |port: &usize| {
        let end = End { stage, port: *port };
        let mut wires = diagram.wires.iter().filter(|wire| wire.to == end);
        wires.any(|wire| diagram.is_inside(wire))
    };
    let (inside, outside): (Vec<usize>, Vec<usize>) = (0..ports.inputs.len()).partition(fed_inside);
    let right = inside.into_iter().map(|port| (port, false));
    let right = right.chain((0..ports.outputs.len()).map(|port| (port, true)));
    [outside.into_iter().map(|port| (port, false)).collect(), right.collect()]
}

/// What is written at a port.
fn port_width(port: &Port, is_output: bool, fonts: &Fonts) -> f64 {
    let small = |text: &str| width(fonts, text, SMALL, Weight::Regular);
    let more = if is_output { &port.payload } else { &port.from };
    let own = small(&port.name) + if more.is_empty() { 0.0 } else { 6.0 + small(more) };
    // What an input's arrow says stands in the box, as arrows end there.
    match is_output || port.facts.is_empty() {
        true => own,
        false => own + 6.0 + small(&port.facts),
    }
}

fn box_width(diagram: &Diagram, stage: usize, fonts: &Fonts) -> f64 {
    let drawn = &diagram.stages[stage];
    let column = |ports: &[(usize, bool)]| {
        let port = |(port, is_output): &(usize, bool)| {
            let ports = if *is_output { &drawn.outputs } else { &drawn.inputs };
            port_width(&ports[*port], *is_output, fonts)
        };
        ports.iter().map(port).fold(0.0, f64::max)
    };
    let [left, right] = sides(diagram, stage);
    let rows = match (left.is_empty(), right.is_empty()) {
        (false, false) => column(&left) + APART + column(&right),
        _ => column(&left) + column(&right),
    };
    let mut lines = vec![rows, width(fonts, &drawn.name, NAME, Weight::Bold)];
    let small = drawn.facts.iter().chain([&drawn.what]);
    lines.extend(small.map(|text| width(fonts, text, SMALL, Weight::Regular)));
    lines.into_iter().fold(0.0, f64::max) + 2.0 * (PAD + 2.0)
}

impl Layout<'_> {
    fn put(&mut self, block: &Block) {
        match block {
            Block::Stage(stage) => self.stage(*stage),
            Block::Module(name, inner) => {
                let top = self.y;
                self.y += MODULE;
                inner.iter().for_each(|block| self.put(block));
                let out = NEST * block.depth() as f64;
                let [left, right] = self.sides;
                let bottom = self.y - GAP + NEST;
                let frame = FrameAt {
                    rect: Rect::new([left - out, top], [right - left + 2.0 * out, bottom - top]),
                    name: name.clone(),
                    what: String::new(),
                    is_process: false,
                };
                self.frames.push(frame);
                self.y = bottom + GAP;
            }
        }
    }

    fn stage(&mut self, stage: usize) {
        let drawn = &self.diagram.stages[stage];
        let [left, right] = self.sides;
        let lines = 1.0 + if drawn.what.is_empty() { 0.0 } else { 1.0 } + drawn.facts.len() as f64;
        let head = 6.0 + LINE * lines;
        let ports = sides(self.diagram, stage);
        let rows = ports.iter().map(Vec::len).max().unwrap_or(0) as f64;
        let height = head + ROW * rows + if rows > 0.0 { 5.0 } else { 3.0 };
        let mut placed = Vec::new();
        for (x, ports) in [left, right].into_iter().zip(&ports) {
            for (row, (port, is_output)) in ports.iter().enumerate() {
                placed.push(PortAt {
                    end: End { stage, port: *port },
                    is_output: *is_output,
                    is_right: x == right,
                    at: [x, self.y + head + ROW * (row as f64 + 0.5) + 1.0],
                });
            }
        }
        debug_assert!(self.fonts.width(&drawn.name, NAME, Weight::Bold) <= right - left);
        self.boxes.push(BoxAt {
            stage,
            rect: Rect::new([left, self.y], [right - left, height]),
            ports: placed,
        });
        self.y += height + GAP;
    }
}

/// Where wires between stages of a process run down, right of `from`: those of one output together, short ones near the
/// boxes, and none on another; and where they end.
fn tracks(diagram: &Diagram, boxes: &[BoxAt], from: f64) -> (BTreeMap<usize, f64>, f64) {
    let ports = || boxes.iter().flat_map(|drawn| &drawn.ports);
    let y_of = |end: End, is_output: bool| {
        let port = ports().find(|port| port.end == end && port.is_output == is_output);
        port.map(|port| port.at[1])
    };
    let mut nets: BTreeMap<End, (f64, f64, Vec<usize>)> = BTreeMap::new();
    for (at, wire) in diagram.wires.iter().enumerate() {
        let (Some(y), Some(to)) = (y_of(wire.from, true), y_of(wire.to, false)) else {
            continue;
        };
        let (low, high, wires) = nets.entry(wire.from).or_insert((y, y, Vec::new()));
        (*low, *high) = (low.min(to), high.max(to));
        wires.push(at);
    }
    let mut nets: Vec<(f64, f64, Vec<usize>)> = nets.into_values().collect();
    nets.sort_by(|a, b| (a.1 - a.0).total_cmp(&(b.1 - b.0)).then(a.0.total_cmp(&b.0)));
    let mut taken: Vec<Vec<[f64; 2]>> = Vec::new();
    let mut found = BTreeMap::new();
    for (low, high, wires) in nets {
        let is_free = |track: &Vec<[f64; 2]>| track.iter().all(|[a, b]| high + ROW / 2.0 < *a || *b + ROW / 2.0 < low);
        let at = taken.iter().position(is_free).unwrap_or(taken.len());
        if at == taken.len() {
            taken.push(Vec::new());
        }
        taken[at].push([low, high]);
        let x = from + TRACK * (at as f64 + 0.5);
        found.extend(wires.into_iter().map(|wire| (wire, x)));
    }
    (found, from + TRACK * taken.len() as f64)
}
