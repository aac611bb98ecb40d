//! What walkers do where roads meet: go round, turn back or cross.

use std::f64::consts::PI;

use super::Crowd;
use super::route::{Draft, Track};
use crate::path::angle_within;
use crate::place::{Node, SIDES};
use crate::random::Stream;
use crate::traffic::open::lanes::Zebra;
use crate::traffic::walking::WAIT;

impl Crowd<'_> {
    /// Through a node, from an arm's pavement to that by which one leaves.
    pub(super) fn turn(&self, draft: &mut Draft, from: Track, draws: &mut Stream) -> Option<Track> {
        let node = &self.ways.network.nodes[from.node];
        let count = node.arms.len();
        // Which arm lies on the other side of the corner.
        let next = |track: Track| match track.side {
            1 => (track.arm + 1) % count,
            _ => (track.arm + count - 1) % count,
        };
        let mut here = from;
        let may_cross = node.arms[here.arm].crossing.is_some();
        if may_cross && draws.chance(0.3) {
            here = self.cross(draft, here, draws)?;
            if draws.chance(0.25) {
                return Some(here);
            }
        }
        // Around the corner, and perhaps over the arm behind it.
        for _ in 0..2 {
            let arm = next(here);
            let there = self.track([from.node, arm, 1 - here.side], from.aside, draws)?;
            self.corner(draft, node, here, there);
            here = there;
            let on = node.arms[arm].crossing.is_some() && draws.chance(0.4);
            if !on {
                return Some(here);
            }
            here = self.cross(draft, here, draws)?;
            if draws.chance(0.5) {
                return Some(here);
            }
        }
        Some(here)
    }

    /// Over an arm's crossing to its other side.
    fn cross(&self, draft: &mut Draft, from: Track, draws: &mut Stream) -> Option<Track> {
        let network = self.ways.network;
        let node = &network.nodes[from.node];
        let middle = node.arms[from.arm].crossing?;
        let half = network.roads[node.arms[from.arm].road].section.half();
        let to = self.track([from.node, from.arm, 1 - from.side], from.aside, draws)?;
        // One keeps to the right, so that nobody walks into somebody.
        let sign = SIDES[from.side];
        let along = middle + sign * draws.between(0.25 + from.aside, 1.15);
        let crossing = |zebra: &Zebra| zebra.node == from.node && zebra.arm == from.arm;
        let number = self.ways.crossings.iter().position(crossing)?;
        for (k, across) in [
            sign * from.across,
            sign * (half + WAIT),
            -sign * (half + 0.4),
            -sign * to.across,
        ]
        .into_iter()
        .enumerate()
        {
            let pose = node.place(from.arm, along, across);
            draft.points.push([pose.x, pose.y]);
            if k == 1 {
                draft.overs.push((draft.points.len() - 1, number, from.side == 1));
            }
        }
        Some(to)
    }

    /// From one arm's pavement to that of the next arm.
    fn corner(&self, draft: &mut Draft, node: &Node, from: Track, to: Track) {
        let (a, b) = (&node.arms[from.arm], &node.arms[to.arm]);
        if let Some(ring) = node.ring_edge() {
            let out = ring + 1.0 + 0.4 * (from.across.min(to.across) - 4.0).clamp(0.5, 2.5);
            let lean = |track: Track| SIDES[track.side] * libm::asin((track.across / out).min(0.9));
            let (start, end) = (a.heading + lean(from), b.heading + lean(to));
            let turn = if from.side == 1 {
                (end - start).rem_euclid(2.0 * PI)
            } else {
                -(start - end).rem_euclid(2.0 * PI)
            };
            let steps = (turn.abs() / 0.22).ceil().max(1.0) as usize;
            for k in 0..=steps {
                let (sin, cos) = libm::sincos(start + turn * k as f64 / steps as f64);
                draft.points.push([node.at[0] + out * cos, node.at[1] + out * sin]);
            }
            return;
        }
        let between = angle_within(b.heading - a.heading).abs();
        if between > 2.6 || from.arm == to.arm {
            return;
        }
        let sin = libm::sin(between);
        let along = (to.across + from.across * libm::cos(between)) / sin;
        let pose = node.place(from.arm, along, SIDES[from.side] * from.across);
        // Kerbs are rounded: at sharp corners one keeps farther out than the pavements' lines meet.
        let half = libm::sin(0.5 * between);
        let kerb = |track: Track| {
            let road = node.arms[track.arm].road;
            track.across - self.ways.network.roads[road].section.half()
        };
        let out = (0.293 * node.corner + 0.9 * half + 0.3 + from.aside - kerb(from).min(kerb(to))).max(0.0) / half;
        let toward = a.heading + 0.5 * angle_within(b.heading - a.heading);
        let (sin, cos) = libm::sincos(toward);
        draft.points.push([pose.x + out * cos, pose.y + out * sin]);
    }
}
