//! Where kerbs run, and what the ground on either side is.

use super::field::Field;
use super::ribbon::{BESIDE, beside};
use super::{CELL, FARTHEST, Ground, OPEN_CELL, Surface};
use crate::path::angle_within;
use crate::place::network::{Control, Node, OPPOSITE, Road};

/// Distance outside of the union of two grounds whose distances are given, with corners rounded.
fn round_union(a: f64, b: f64, radius: f64) -> f64 {
    let (u, v) = ((radius - a).max(0.0), (radius - b).max(0.0));
    radius.max(a.min(b)) - (u * u + v * v).sqrt()
}

/// What kerbs and ground are as far as roads and nodes have been added.
struct KerbPlan {
    kerb: Field<f32>,
    ground: Field<Ground>,
    /// Radius of corners, m.
    corner: f64,
}

impl KerbPlan {
    /// Roads that go on in each other, and the islands between their lanes.
    fn add_strands(&mut self, roads: &[Road], nodes: &[Node], bounds: [f64; 4]) {
        let mut nearest = vec![f64::INFINITY; self.kerb.values.len()];
        let mut islands = Vec::new();
        let mut strand_kerb = vec![f64::INFINITY; self.kerb.values.len()];
        for strand in strands(roads, nodes) {
            let mut touched = Vec::new();
            for road in strand.into_iter().map(|road| &roads[road]) {
                let section = &road.section;
                let bays = section.bay_depth(0).max(section.bay_depth(1));
                let widest = section
                    .outer(0)
                    .max(section.outer(1))
                    .max(section.half() + bays + self.corner);
                let at = beside(&road.line, bounds, CELL, widest + BESIDE);
                let length = road.line.length();
                let [from, to] = road.span();
                for (i, place) in at.found(&self.kerb) {
                    let (s, across) = (f64::from(place.along), f64::from(place.across));
                    let side = usize::from(across > 0.0);
                    let ends = (road.caps[0] - s).max(s - (length - road.caps[1]));
                    let out = (across.abs() - road.half_at(side, s)).max(ends);
                    if strand_kerb[i] == f64::INFINITY {
                        touched.push(i);
                    }
                    strand_kerb[i] = strand_kerb[i].min(out);
                    if section.median > 1.0 && (from..=to).contains(&s) {
                        islands.push((i, 0.5 * section.median - (across - section.middle()).abs()));
                    }
                    if out < nearest[i] {
                        nearest[i] = out;
                        let paved = across.abs() < section.outer(side) + 0.01 && ends <= 0.0;
                        self.ground.values[i] = if paved { Ground::Paving } else { Ground::Green };
                    }
                }
            }
            for i in touched {
                self.kerb.values[i] = round_union(f64::from(self.kerb.values[i]), strand_kerb[i], self.corner) as f32;
                strand_kerb[i] = f64::INFINITY;
            }
        }
        for (i, island) in islands {
            self.kerb.values[i] = f64::from(self.kerb.values[i]).max(island) as f32;
            if island > 0.0 {
                self.ground.values[i] = Ground::Green;
            }
        }
    }

    fn add_turning_places(&mut self, roads: &[Road]) {
        for (x, y, radius) in turning_places(roads) {
            let [c0, c1, r0, r1] = self.kerb.around(x, y, radius + self.corner);
            for (row, column) in (r0..r1).flat_map(|row| (c0..c1).map(move |column| (row, column))) {
                let i = row * self.kerb.columns + column;
                let (dx, dy) = (self.kerb.node(i).0 - x, self.kerb.node(i).1 - y);
                let outside = (dx * dx + dy * dy).sqrt() - radius;
                self.kerb.values[i] = round_union(f64::from(self.kerb.values[i]), outside, self.corner) as f32;
            }
        }
    }

    fn add_rings(&mut self, nodes: &[Node]) {
        for node in nodes {
            let Control::Roundabout { radius, width } = node.control else {
                continue;
            };
            let reach = radius + 0.5 * width + self.corner + BESIDE;
            let [c0, c1, r0, r1] = self.kerb.around(node.at[0], node.at[1], reach);
            for (row, column) in (r0..r1).flat_map(|row| (c0..c1).map(move |column| (row, column))) {
                let i = row * self.kerb.columns + column;
                let (x, y) = self.kerb.node(i);
                let (dx, dy) = (x - node.at[0], y - node.at[1]);
                let distance = (dx * dx + dy * dy).sqrt();
                let outside = distance - radius - 0.5 * width;
                let island = radius - 0.5 * width - distance;
                let out = round_union(f64::from(self.kerb.values[i]), outside, self.corner).max(island);
                self.kerb.values[i] = out as f32;
                if outside < 3.5 {
                    self.ground.values[i] = if outside < 0.0 { Ground::Green } else { Ground::Paving };
                }
            }
        }
    }
}

impl Surface {
    pub(super) fn kerbs(roads: &[Road], nodes: &[Node], bounds: [f64; 4], corner: f64) -> (Field<f32>, Field<Ground>) {
        let mut plan = KerbPlan {
            kerb: Field::new(bounds, CELL, FARTHEST as f32),
            ground: Field::new(bounds, CELL, Ground::Green),
            corner,
        };
        plan.add_strands(roads, nodes, bounds);
        plan.add_turning_places(roads);
        plan.add_rings(nodes);
        let KerbPlan { kerb, mut ground, .. } = plan;
        // Corners of the pavements at nodes belong to it, whichever road is the nearest.
        for (i, out) in kerb.values.iter().enumerate() {
            if *out <= 0.0 {
                ground.values[i] = Ground::Asphalt;
            }
        }
        (kerb, ground)
    }

    pub(super) fn open(roads: &[Road], nodes: &[Node], bounds: [f64; 4]) -> Field<f32> {
        let mut open = Field::new(bounds, OPEN_CELL, FARTHEST as f32);
        for road in roads {
            let widest = road.section.outer(0).max(road.section.outer(1));
            let at = beside(&road.line, bounds, OPEN_CELL, widest + FARTHEST);
            let length = road.line.length();
            for (i, place) in at.found(&open) {
                let across = f64::from(place.across);
                let s = f64::from(place.along);
                let beyond = (-s).max(s - length).max(0.0);
                let aside = across.abs() - road.section.outer(usize::from(across > 0.0));
                let out = if beyond > 0.0 && aside > 0.0 {
                    (aside * aside + beyond * beyond).sqrt()
                } else {
                    aside.max(if beyond > 0.0 { beyond } else { -FARTHEST })
                };
                open.values[i] = open.values[i].min(out as f32);
            }
        }
        for node in nodes {
            let Some(ring) = node.ring_edge() else { continue };
            for i in 0..open.values.len() {
                let (x, y) = open.node(i);
                let (dx, dy) = (x - node.at[0], y - node.at[1]);
                let out = (dx * dx + dy * dy).sqrt() - ring - 5.0;
                open.values[i] = open.values[i].min(out as f32);
            }
        }
        open
    }
}

/// Roads that go on in each other across nodes, as strands: between them corners are not rounded.
fn strands(roads: &[Road], nodes: &[Node]) -> Vec<Vec<usize>> {
    let mut strand: Vec<usize> = (0..roads.len()).collect();
    for node in nodes {
        for (k, a) in node.arms.iter().enumerate() {
            for b in &node.arms[..k] {
                if angle_within(a.heading - b.heading).abs() > OPPOSITE {
                    let (keep, drop) = (strand[a.road], strand[b.road]);
                    strand.iter_mut().filter(|s| **s == drop).for_each(|s| *s = keep);
                }
            }
        }
    }
    let of = |number: usize| (0..roads.len()).filter(|road| strand[*road] == number).collect();
    (0..roads.len())
        .map(of)
        .filter(|roads: &Vec<usize>| !roads.is_empty())
        .collect()
}

/// Where roads of two directions end, there is room to turn round: middles and radii.
fn turning_places(roads: &[Road]) -> Vec<(f64, f64, f64)> {
    let mut places = Vec::new();
    for road in roads.iter().filter(|road| !road.section.lanes.contains(&0)) {
        for (end, sign) in [(0, -1.0), (1, 1.0)] {
            if road.ends[end].is_none() {
                let s = if end == 0 { 0.0 } else { road.line.length() };
                let middle = road.line.at(s).0.at(sign * 8.0, 0.0);
                places.push((middle.x, middle.y, 13.0f64.max(road.section.half() + 3.0)));
            }
        }
    }
    places
}
