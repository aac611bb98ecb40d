//! Processes and what flows between them, as text.

use std::collections::{BTreeMap, BTreeSet};

use crate::canvas::Canvas;
use crate::layers::{Arranged, Gaps, Hop, Item, Link, arrange};
use crate::listing::printable;
use crate::{Diagram, blocks};

/// Height of a process.
const HEIGHT: f64 = 3.0;
const GAPS: Gaps = Gaps {
    item: 0.0,
    lane: 0.0,
    lane_height: 1.0,
    band: 1.0,
};
/// Between layers, beside the wires that climb: a line at its begin, and an arrow.
const BESIDE: usize = 3;

/// All processes in layers from left to right; nothing where they are wider than `width`, or where there is only one.
pub fn overview(diagram: &Diagram, width: usize) -> String {
    if diagram.processes.len() < 2 {
        return String::new();
    }
    let layers = blocks::layers(diagram);
    let items: Vec<Item> = layers
        .iter()
        .zip(diagram.bands())
        .map(|(layer, band)| Item {
            layer: *layer,
            height: HEIGHT,
            band,
        })
        .collect();
    let pairs: BTreeSet<(usize, usize)> = diagram
        .wires
        .iter()
        .filter(|wire| !diagram.is_inside(wire))
        .map(|wire| (diagram.process_of(wire.from), diagram.process_of(wire.to)))
        .collect();
    let link = |(from, to): &(usize, usize)| Link {
        from: *from,
        from_y: HEIGHT / 2.0,
        to: *to,
        to_y: HEIGHT / 2.0,
        net: *from,
    };
    let links: Vec<Link> = pairs.iter().map(link).collect();
    let arranged = arrange(&items, &links, &GAPS);
    let drawn = Drawn::of(diagram, &layers, &links, &arranged);
    match drawn.width <= width {
        true => drawn.text(diagram, &links),
        false => String::new(),
    }
}

/// Wires of one process in a channel: the rows where they come in and go out on each side.
#[derive(Default)]
struct Net {
    left: BTreeSet<usize>,
    right: BTreeSet<usize>,
}

impl Net {
    /// Its first and its last row.
    fn span(&self) -> [usize; 2] {
        let rows = || self.left.iter().chain(&self.right).copied();
        [rows().min().unwrap_or(0), rows().max().unwrap_or(0)]
    }

    fn climbs(&self) -> bool {
        let [first, last] = self.span();
        first != last || self.left.is_empty() || self.right.is_empty()
    }
}

struct Drawn<'a> {
    arranged: &'a Arranged,
    layers: &'a [usize],
    names: Vec<String>,
    /// By channel, the columns in which wires climb, by net.
    tracks: Vec<BTreeMap<usize, usize>>,
    /// Left of each layer, and how wide it is.
    places: Vec<[usize; 2]>,
    width: usize,
}

fn row(y: f64) -> usize {
    y.max(0.0) as usize
}

impl<'a> Drawn<'a> {
    fn of(diagram: &Diagram, layers: &'a [usize], links: &[Link], arranged: &'a Arranged) -> Self {
        let count = layers.iter().map(|layer| layer + 1).max().unwrap_or(0);
        let names: Vec<String> = diagram
            .processes
            .iter()
            .map(|process| printable(&process.name))
            .collect();
        let mut nets: Vec<BTreeMap<usize, Net>> = (0..=count).map(|_| BTreeMap::new()).collect();
        for (link, route) in links.iter().zip(&arranged.routes) {
            for Hop { channel, from, to } in route {
                let net = nets[*channel].entry(link.net).or_default();
                for at in [from, to] {
                    let rows = if at.is_right { &mut net.right } else { &mut net.left };
                    rows.insert(row(at.y));
                }
            }
        }
        let (mut tracks, mut places, mut x) = (Vec::new(), Vec::new(), 0);
        for (channel, nets) in nets.iter().enumerate() {
            let order = in_order(nets);
            if channel > 0 || !order.is_empty() {
                x += 1;
            }
            tracks.push(order.iter().copied().zip(x..).collect::<BTreeMap<usize, usize>>());
            x += order.len();
            if channel == count {
                break;
            }
            x += if channel > 0 || !order.is_empty() {
                BESIDE - 1
            } else {
                0
            };
            let members = layers.iter().zip(&names).filter(|(layer, _)| **layer == channel);
            let wide = members.map(|(_, name)| name.chars().count() + 4).max().unwrap_or(0);
            places.push([x, wide]);
            x += wide;
        }
        Drawn {
            arranged,
            layers,
            names,
            tracks,
            places,
            width: x,
        }
    }

    fn text(&self, diagram: &Diagram, links: &[Link]) -> String {
        // The name of a group is in the row above it.
        let head = usize::from(!diagram.groups.is_empty());
        let row = |y| row(y) + head;
        let mut canvas = Canvas::new(self.width + 1, row(self.arranged.height) + 1);
        for (link, route) in links.iter().zip(&self.arranged.routes) {
            let [left, _] = self.places[self.layers[link.from]];
            let mut x = left + self.names[link.from].chars().count() + 3;
            for Hop { channel, from, to } in route {
                let end = match self.tracks[*channel].get(&link.net) {
                    Some(track) => *track,
                    None => x,
                };
                canvas.across(x, end, row(from.y));
                canvas.down(end, row(from.y), row(to.y));
                x = end;
                // What runs through a layer is joined to its lane by the next channel.
                if *channel == self.layers[link.to] && to.is_right {
                    canvas.across(x, self.places[self.layers[link.to]][0] - 1, row(to.y));
                }
            }
        }
        for (process, name) in self.names.iter().enumerate() {
            let [x, _] = self.places[self.layers[process]];
            let y = row(self.arranged.tops[process]);
            let bar = "─".repeat(name.chars().count() + 2);
            canvas.write(&format!("╭{bar}╮"), [x, y]);
            canvas.write(&format!("│ {name} │"), [x, y + 1]);
            canvas.write(&format!("╰{bar}╯"), [x, y + 2]);
            if links.iter().any(|link| link.to == process) {
                canvas.write("▸", [x - 1, y + 1]);
            }
        }
        for (group, band) in diagram.groups.iter().zip(&self.arranged.bands) {
            let Some([top, _]) = band else { continue };
            canvas.rule(
                &printable(&format!("┄ {} ({}) ", group.name, group.what)),
                row(*top) - 1,
            );
        }
        canvas.text()
    }
}

/// The nets of a channel that climb, from left to right: what comes from the left in a row turns before what leaves to the right
/// in it begins.
fn in_order(nets: &BTreeMap<usize, Net>) -> Vec<usize> {
    let climbing: Vec<usize> = nets.iter().filter(|(_, net)| net.climbs()).map(|(at, _)| *at).collect();
    let mut edges = BTreeSet::new();
    for (a, one) in climbing.iter().enumerate() {
        for (b, other) in climbing.iter().enumerate().filter(|(b, _)| *b != a) {
            if !nets[one].left.is_disjoint(&nets[other].right) {
                edges.insert((a, b));
            }
        }
    }
    let order = blocks::sorted(climbing.len(), &edges);
    order.into_iter().map(|at| climbing[at]).collect()
}
