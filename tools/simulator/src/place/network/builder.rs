//! Puts roads and nodes together.

use std::f64::consts::TAU;

use super::section::Section;
use super::{Arm, CROSSING_HALF, Control, Node, OPPOSITE, Road};
use crate::path::{Path, angle_within};

/// A network in the making.
pub(crate) struct Builder {
    pub roads: Vec<Road>,
    pub nodes: Vec<Node>,
}

impl Builder {
    pub fn new() -> Self {
        Builder {
            roads: Vec::new(),
            nodes: Vec::new(),
        }
    }

    pub fn node(&mut self, at: [f64; 2], control: Control, corner: f64, crossings: bool) -> usize {
        self.nodes.push(Node {
            at,
            control,
            corner,
            arms: Vec::new(),
            crossings,
        });
        self.nodes.len() - 1
    }

    /// A road that no other meets, or whose ends lie at nodes; `major` and `phase` hold at both.
    pub fn road(
        &mut self,
        line: Path,
        section: Section,
        nodes: [Option<usize>; 2],
        major: bool,
        phase: usize,
    ) -> usize {
        let road = self.roads.len();
        for (end, node) in nodes.into_iter().enumerate() {
            let Some(node) = node else { continue };
            let out = if end == 0 { line.clone() } else { line.reversed() };
            self.nodes[node].arms.push(Arm {
                road,
                at_start: end == 0,
                heading: out.at(0.0).0.heading,
                out,
                mouth: 0.0,
                major,
                phase,
                crossing: None,
            });
        }
        let bays = [0.0, line.length()];
        self.roads.push(Road {
            line,
            section,
            ends: nodes.map(|node| node.map(|node| (node, 0.0))),
            bays,
            caps: [0.0; 2],
        });
        road
    }

    /// Settles mouths, crossings and bays.
    pub fn settle(&mut self) {
        for node in &mut self.nodes {
            node.arms
                .sort_by(|a, b| a.heading.rem_euclid(TAU).total_cmp(&b.heading.rem_euclid(TAU)));
        }
        for n in 0..self.nodes.len() {
            for a in 0..self.nodes[n].arms.len() {
                let (mouth, crossing) = self.mouth(n, a);
                let cap = self.cap(n, a);
                let arm = &mut self.nodes[n].arms[a];
                (arm.mouth, arm.crossing) = (mouth, crossing);
                let end = usize::from(!arm.at_start);
                self.roads[arm.road].ends[end] = Some((n, mouth));
                self.roads[arm.road].caps[end] = cap;
            }
        }
        for road in &mut self.roads {
            let [from, to] = road.span();
            let free = |end: usize| if road.ends[end].is_some() { 4.0 } else { 20.0 };
            road.bays = [from + free(0), to - free(1)];
        }
    }

    /// Where the carriageway of an arm ends, seen from the node's middle.
    fn cap(&self, n: usize, a: usize) -> f64 {
        let node = &self.nodes[n];
        if let Control::Roundabout { radius, .. } = node.control {
            return radius;
        }
        let half = |arm: &Arm| self.roads[arm.road].section.half();
        let own = &node.arms[a];
        let opposite = |other: &Arm| angle_within(other.heading - own.heading).abs() > OPPOSITE;
        match node.arms.len() {
            _ if node.arms.iter().any(opposite) => 0.0,
            1 | 2 => -half(own),
            // A road that ends at another must not bulge over its far kerb.
            _ => {
                let min = node.arms.iter().map(half).fold(f64::INFINITY, f64::min);
                (node.corner - min + 0.5).clamp(0.0, min - 1.0)
            }
        }
    }

    /// Distances of an arm's mouth and of the middle of its crossing.
    pub(super) fn mouth(&self, n: usize, a: usize) -> (f64, Option<f64>) {
        let node = &self.nodes[n];
        let half = |arm: &Arm| self.roads[arm.road].section.half();
        let own = &node.arms[a];
        let mut edge = 0.0f64;
        for (_, other) in node.arms.iter().enumerate().filter(|(k, _)| *k != a) {
            let between = angle_within(other.heading - own.heading).abs();
            if between > 2.6 {
                continue;
            }
            let (sin, cos) = libm::sincos(between);
            let corner = (half(other) + half(own) * cos) / sin;
            edge = edge.max(corner + 0.6 * node.corner / libm::tan(0.5 * between));
        }
        if let Some(ring) = node.ring_edge() {
            edge = edge.max(ring + 2.0);
        }
        let walked = self.roads[own.road].section.pavement.iter().all(|width| *width > 0.0);
        if node.crossings && walked {
            let middle = edge + 0.8 + CROSSING_HALF;
            (middle + CROSSING_HALF + 1.6, Some(middle))
        } else {
            (edge + 1.0, None)
        }
    }
}
