//! Where everything of a diagram is, in pixels.

use std::collections::BTreeMap;

use realo_render::{Fonts, Weight};

use crate::column::{Column, NAME, SMALL, width};
use crate::layers::{Arranged, Gaps, Item, Link, arrange};
use crate::{Diagram, End, Group, blocks};

/// Around the picture.
const MARGIN: f64 = 16.0;
/// Size of the title's letters, px.
pub const TITLE: f64 = 17.0;
/// From one line above the picture to the next.
pub const LEADING: f64 = 18.0;
/// Between two processes, and between a process and a wire that passes it.
const GAP: f64 = 24.0;
/// Between wires that pass processes.
const LANE: f64 = 9.0;
/// Between two layers: the least, and how much more where wires climb, up to a limit.
const CHANNEL: [f64; 3] = [54.0, 0.18, 120.0];

/// From the frame of a group to the processes in it.
const PAD: f64 = 12.0;
/// Height of a group's name.
const GROUP: f64 = 24.0;

/// A rectangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rect {
    /// Its left side.
    pub x: f64,
    /// Its upper side.
    pub y: f64,
    /// Its width.
    pub width: f64,
    /// Its height.
    pub height: f64,
}

impl Rect {
    /// By its upper left corner and its size.
    pub fn new([x, y]: [f64; 2], [width, height]: [f64; 2]) -> Self {
        Rect { x, y, width, height }
    }

    fn moved(self, [x, y]: [f64; 2]) -> Self {
        Rect {
            x: self.x + x,
            y: self.y + y,
            ..self
        }
    }

    /// Whether both have some area in common.
    pub fn overlaps(&self, other: &Rect) -> bool {
        let apart = |a: f64, width: f64, b: f64, other: f64| a + width <= b || b + other <= a;
        !apart(self.x, self.width, other.x, other.width) && !apart(self.y, self.height, other.y, other.height)
    }

    /// The smallest that holds both.
    fn around(&self, other: &Rect) -> Rect {
        let (x, y) = (self.x.min(other.x), self.y.min(other.y));
        let right = (self.x + self.width).max(other.x + other.width);
        let bottom = (self.y + self.height).max(other.y + other.height);
        Rect::new([x, y], [right - x, bottom - y])
    }

    /// Whether the other lies within.
    pub fn holds(&self, other: &Rect) -> bool {
        other.x >= self.x
            && other.y >= self.y
            && other.x + other.width <= self.x + self.width
            && other.y + other.height <= self.y + self.height
    }
}

/// A group, a process or a module.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameAt {
    /// Where it is.
    pub rect: Rect,
    /// Its name.
    pub name: String,
    /// What it is or runs.
    pub what: String,
    /// Whether it is a process.
    pub is_process: bool,
}

/// A stage.
#[derive(Clone, Debug, PartialEq)]
pub struct BoxAt {
    /// Its index.
    pub stage: usize,
    /// Where it is.
    pub rect: Rect,
    /// Its ports.
    pub ports: Vec<PortAt>,
}

/// A port on a side of its box.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PortAt {
    /// Whose it is.
    pub end: End,
    /// Whether it is an output.
    pub is_output: bool,
    /// On which side.
    pub is_right: bool,
    /// Where wires begin or end.
    pub at: [f64; 2],
}

/// A wire.
#[derive(Clone, Debug, PartialEq)]
pub struct WireAt {
    /// Its index.
    pub wire: usize,
    /// Its path as in SVG.
    pub path: String,
}

/// A diagram with places.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Width and height.
    pub size: [f64; 2],
    /// From where the diagram is drawn; what it is stands above.
    pub top: f64,
    /// Groups of processes.
    pub groups: Vec<FrameAt>,
    /// Processes and modules, outer ones first.
    pub frames: Vec<FrameAt>,
    /// Stages.
    pub boxes: Vec<BoxAt>,
    /// Wires, all that the diagram has.
    pub wires: Vec<WireAt>,
}

/// Lays a diagram out.
pub fn picture(diagram: &Diagram) -> Picture {
    let fonts = Fonts::new();
    let columns: Vec<Column> = (0..diagram.processes.len())
        .map(|process| Column::of(diagram, process, &fonts))
        .collect();
    let layers = blocks::layers(diagram);
    let links = links(diagram, &columns);
    let items: Vec<Item> = columns
        .iter()
        .zip(&layers)
        .zip(diagram.bands())
        .map(|((column, layer), band)| Item {
            layer: *layer,
            height: column.size[1].ceil(),
            band,
        })
        .collect();
    let outer: Vec<Link> = links.iter().map(|(_, link)| *link).collect();
    let gaps = Gaps {
        item: GAP,
        lane: LANE,
        lane_height: 2.0,
        band: 2.0 * PAD + GROUP + GAP,
    };
    let arranged = arrange(&items, &outer, &gaps);
    // Room for the frames of groups.
    let [side, head] = if diagram.groups.is_empty() {
        [0.0; 2]
    } else {
        [PAD, PAD + GROUP]
    };
    let top = MARGIN + TITLE + LEADING * diagram.about.len() as f64 + 14.0 + head;
    let across = Across::of(&layers, &columns, &arranged, MARGIN + side);
    let places: Vec<[f64; 2]> = layers
        .iter()
        .zip(&arranged.tops)
        .map(|(layer, y)| [across.layers[*layer][0], top + y])
        .collect();
    let mut drawn = Picture {
        size: [
            (across.right + side).max(above(diagram, &fonts)) + MARGIN,
            top + arranged.height + side + MARGIN,
        ],
        top,
        groups: Vec::new(),
        frames: Vec::new(),
        boxes: Vec::new(),
        wires: Vec::new(),
    };
    for (column, place) in columns.iter().zip(&places) {
        drawn.take(column, *place);
    }
    drawn.wires = wires(diagram, &drawn, &columns, &places, &links, &arranged, &across);
    drawn.groups = groups(diagram, &columns, &places);
    drawn
}

/// The frames around the processes of each group.
fn groups(diagram: &Diagram, columns: &[Column], places: &[[f64; 2]]) -> Vec<FrameAt> {
    let frame = |(at, group): (usize, &Group)| {
        let members = (0..columns.len()).filter(|process| diagram.processes[*process].group == Some(at));
        let rects = members.map(|process| Rect::new(places[process], columns[process].size));
        let around = rects.reduce(|all, rect| all.around(&rect))?;
        let rect = Rect::new(
            [around.x - PAD, around.y - PAD - GROUP],
            [around.width + 2.0 * PAD, around.height + 2.0 * PAD + GROUP],
        );
        Some(FrameAt {
            rect,
            name: group.name.clone(),
            what: group.what.clone(),
            is_process: false,
        })
    };
    diagram.groups.iter().enumerate().filter_map(frame).collect()
}

/// How wide the lines above the picture are.
fn above(diagram: &Diagram, fonts: &Fonts) -> f64 {
    let about = diagram.about.iter();
    let about = about.map(|line| width(fonts, line, SMALL + 1.0, Weight::Regular));
    let title = width(fonts, &diagram.title, TITLE, Weight::Bold);
    MARGIN + about.fold(title, f64::max)
}

/// The wires between processes, by index, as links between columns.
fn links(diagram: &Diagram, columns: &[Column]) -> Vec<(usize, Link)> {
    let heights: BTreeMap<(End, bool), f64> = columns
        .iter()
        .flat_map(|column| &column.boxes)
        .flat_map(|drawn| &drawn.ports)
        .map(|port| ((port.end, port.is_output), port.at[1]))
        .collect();
    let nets: BTreeMap<End, usize> = diagram.wires.iter().map(|wire| wire.from).zip(0..).collect();
    let outer = diagram
        .wires
        .iter()
        .enumerate()
        .filter(|(_, wire)| !diagram.is_inside(wire));
    let link = |(at, wire): (usize, &crate::Wire)| {
        let link = Link {
            from: diagram.process_of(wire.from),
            from_y: *heights.get(&(wire.from, true))?,
            to: diagram.process_of(wire.to),
            to_y: *heights.get(&(wire.to, false))?,
            net: nets[&wire.from],
        };
        Some((at, link))
    };
    outer.filter_map(link).collect()
}

/// Where layers and the channels between them are.
struct Across {
    left: f64,
    /// Left and right of each layer.
    layers: Vec<[f64; 2]>,
    right: f64,
}

impl Across {
    fn of(layers: &[usize], columns: &[Column], arranged: &Arranged, left: f64) -> Self {
        let count = layers.iter().map(|layer| layer + 1).max().unwrap_or(0);
        let hops = || arranged.routes.iter().flatten();
        let channel = |at: usize| {
            let climbs = hops()
                .filter(|hop| hop.channel == at)
                .map(|hop| (hop.from.y - hop.to.y).abs());
            let climb = climbs.fold(f64::NEG_INFINITY, f64::max);
            let [least, more, most] = CHANNEL;
            match climb.is_finite() {
                true => (least + more * climb).min(most),
                // Nothing passes outside of the first and last layers.
                false if at == 0 || at == count => 0.0,
                false => least,
            }
        };
        let mut x = left + channel(0);
        let mut found = Vec::new();
        for layer in 0..count {
            let members = layers.iter().zip(columns).filter(|(of, _)| **of == layer);
            let width = members.map(|(_, column)| column.size[0]).fold(0.0, f64::max).ceil();
            found.push([x, x + width]);
            x += width + channel(layer + 1);
        }
        Across {
            left,
            layers: found,
            right: x,
        }
    }

    /// Left and right of a channel; channel `n` is left of layer `n`.
    fn channel(&self, at: usize) -> [f64; 2] {
        let left = at.checked_sub(1).map_or(self.left, |layer| self.layers[layer][1]);
        let right = self.layers.get(at).map_or(self.right, |layer| layer[0]);
        [left, right]
    }
}

impl Picture {
    fn take(&mut self, column: &Column, place: [f64; 2]) {
        self.frames.extend(column.frames.iter().map(|frame| FrameAt {
            rect: frame.rect.moved(place),
            ..frame.clone()
        }));
        self.boxes.extend(column.boxes.iter().map(|drawn| {
            BoxAt {
                stage: drawn.stage,
                rect: drawn.rect.moved(place),
                ports: drawn
                    .ports
                    .iter()
                    .map(|port| PortAt {
                        at: [port.at[0] + place[0], port.at[1] + place[1]],
                        ..*port
                    })
                    .collect(),
            }
        }));
    }

    /// Where a port is.
    pub fn port(&self, end: End, is_output: bool) -> Option<&PortAt> {
        let mut ports = self.boxes.iter().flat_map(|drawn| &drawn.ports);
        ports.find(|port| port.end == end && port.is_output == is_output)
    }
}

/// The paths of all wires.
fn wires(
    diagram: &Diagram,
    drawn: &Picture,
    columns: &[Column],
    places: &[[f64; 2]],
    links: &[(usize, Link)],
    arranged: &Arranged,
    across: &Across,
) -> Vec<WireAt> {
    let routes: BTreeMap<usize, usize> = links.iter().map(|(wire, _)| *wire).zip(0..).collect();
    let path = |(at, wire): (usize, &crate::Wire)| {
        let (from, to) = (drawn.port(wire.from, true)?.at, drawn.port(wire.to, false)?.at);
        let process = diagram.process_of(wire.from);
        let path = match routes.get(&at) {
            None => down(from, to, columns[process].tracks.get(&at)? + places[process][0]),
            Some(route) => {
                let mut path = format!("M{} {}", short(from[0]), short(from[1]));
                for hop in &arranged.routes[*route] {
                    let sides = across.channel(hop.channel);
                    let place = |at: &crate::layers::At| [sides[usize::from(at.is_right)], drawn.top + at.y];
                    path.push_str(&curve(place(&hop.from), place(&hop.to), sides));
                }
                path.push_str(&format!("H{}", short(to[0])));
                path
            }
        };
        Some(WireAt { wire: at, path })
    };
    diagram.wires.iter().enumerate().filter_map(path).collect()
}

/// To a channel, and through it.
fn curve([x, y]: [f64; 2], [end, low]: [f64; 2], [left, right]: [f64; 2]) -> String {
    let reach = match x == end {
        // It turns round.
        true => 0.7 * (right - left),
        false => 0.5 * (right - left),
    };
    let bend = |at: f64| if at == left { at + reach } else { at - reach };
    format!(
        "H{}C{} {} {} {} {} {}",
        short(x),
        short(bend(x)),
        short(y),
        short(bend(end)),
        short(low),
        short(end),
        short(low)
    )
}

/// From a side of a box down to the same side of another one.
fn down([x, y]: [f64; 2], [end, low]: [f64; 2], track: f64) -> String {
    let turn = 5.0_f64.min((low - y).abs() / 2.0) * (low - y).signum();
    let round = turn.abs();
    format!(
        "M{} {}H{}Q{t} {} {t} {}V{}Q{t} {} {} {}H{}",
        short(x),
        short(y),
        short(track - round),
        short(y),
        short(y + turn),
        short(low - turn),
        short(low),
        short(track - round),
        short(low),
        short(end),
        t = short(track),
    )
}

/// A number of pixels, to a tenth.
pub fn short(value: f64) -> String {
    format!("{}", (value * 10.0).round() / 10.0 + 0.0)
}

/// Size of the letters of a name; of all else it is smaller.
pub const LETTERS: [f64; 2] = [NAME, SMALL];
