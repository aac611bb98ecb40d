//! Turns from lane to lane at a node.

use std::f64::consts::PI;

use super::bends::{Bend, kerb_radius, turn_path, yields};
use super::meeting::{meeting, passes, sampled};
use super::{Conflict, Kind, Lanes, Mouth, Over, Zebra, lane};
use crate::path::{Path, Pose2, angle_within};
use crate::place::{Control, Network, Node};

#[derive(Clone, Copy, PartialEq, Eq)]
enum Direction {
    Left,
    Straight,
    Right,
}

/// The lane on which one goes on in a direction, if one may; `leads`: riders go that way; `driving`: lanes that come in.
fn exit(from: &Mouth, outgoing: &[Mouth], direction: Direction, leads: bool, driving: usize) -> Option<Mouth> {
    let exits = || outgoing.iter().copied().filter(|mouth| mouth.strip.index.is_some());
    let numbered = |index: usize| exits().find(|mouth| mouth.strip.index == Some(index));
    let outermost = || exits().max_by_key(|mouth| mouth.strip.index);
    match (from.strip.index, direction) {
        // Where no cycle lane goes on, riders go on in the outermost lane.
        (None, _) if leads => {
            let cycle = outgoing.iter().copied().find(|mouth| mouth.strip.index.is_none());
            cycle.or(outermost())
        }
        (None, _) => None,
        (Some(index), Direction::Straight) => numbered(index).or(outermost().filter(|_| driving == 1)),
        (Some(0), Direction::Left) => numbered(0),
        (Some(index), Direction::Right) if index + 1 == driving => outermost(),
        (Some(_), _) => None,
    }
}

impl Lanes {
    pub(super) fn join(&mut self, network: &Network, number: usize, node: &Node, mouths: &[[Vec<Mouth>; 2]]) {
        let first = self.lanes.len();
        // How each turn bends, by its place behind `first`: for right of way.
        let mut bends = Vec::new();
        match node.control {
            Control::Roundabout { radius, .. } => self.ring(number, node, mouths, radius, &mut bends),
            _ => {
                for a in 0..node.arms.len() {
                    self.turns(network, number, node, mouths, a, &mut bends);
                }
            }
        }
        let crossings: Vec<(usize, usize)> = (0..node.arms.len())
            .filter(|arm| node.arms[*arm].crossing.is_some())
            .map(|arm| {
                self.crossings.push(Zebra { node: number, arm });
                (self.crossings.len() - 1, arm)
            })
            .collect();
        let samples: Vec<Vec<Pose2>> = self.lanes[first..].iter().map(|lane| sampled(&lane.path)).collect();
        for i in first..self.lanes.len() {
            for j in first..self.lanes.len() {
                let turn = |lane: usize| matches!(self.lanes[lane].kind, Kind::Turn { .. });
                if i == j || !turn(i) || !turn(j) {
                    continue;
                }
                let (a, b) = (&samples[i - first], &samples[j - first]);
                let reach = self.reach(i) + self.reach(j);
                if let Some(theirs) = meeting(a, b, reach) {
                    let yields = yields(node, &bends[i - first], &bends[j - first]);
                    self.lanes[i].conflicts.push(Conflict {
                        other: j,
                        theirs,
                        yields,
                    });
                }
            }
            for (crossing, arm) in &crossings {
                let section = &network.roads[node.arms[*arm].road].section;
                if let Some(share) = passes(node, *arm, section.half(), &samples[i - first], self.reach(i)) {
                    self.lanes[i].over.push(Over {
                        crossing: *crossing,
                        share,
                    });
                }
            }
        }
    }

    /// Half the width that a vehicle on a turn needs, m.
    pub(super) fn reach(&self, lane: usize) -> f64 {
        let lane = &self.lanes[lane];
        match lane.next.first() {
            Some((next, _)) if self.lanes[*next].kind == Kind::Cycle => 0.55,
            // Slow lanes are narrow and lie closer together; few trucks are on them.
            _ if lane.limit < 8.5 => 1.25,
            _ => 1.45,
        }
    }

    /// The turns from an arm of a node to all others.
    fn turns(
        &mut self,
        network: &Network,
        number: usize,
        node: &Node,
        mouths: &[[Vec<Mouth>; 2]],
        a: usize,
        bends: &mut Vec<Bend>,
    ) {
        let own = &node.arms[a];
        let bend_to = |b: usize| angle_within(node.arms[b].heading - own.heading - PI);
        let others: Vec<usize> = (0..node.arms.len()).filter(|b| *b != a).collect();
        let ahead = others
            .iter()
            .copied()
            .min_by(|b, c| bend_to(*b).abs().total_cmp(&bend_to(*c).abs()))
            .filter(|b| bend_to(*b).abs() < 0.8 || others.len() == 1);
        let incoming = &mouths[a][0];
        let driving = incoming.iter().filter(|mouth| mouth.strip.index.is_some()).count();
        for b in others.iter().copied() {
            let outgoing = &mouths[b][1];
            let straight = ahead == Some(b);
            let left = bend_to(b) > 0.0;
            for from in incoming {
                let direction = match () {
                    () if straight => Direction::Straight,
                    () if left => Direction::Left,
                    () => Direction::Right,
                };
                let leads = direction == Direction::Straight || ahead.is_none() && direction == Direction::Right;
                let Some(to) = exit(from, outgoing, direction, leads, driving) else {
                    continue;
                };
                let [start, end] = [&self.lanes[from.lane].path, &self.lanes[to.lane].path];
                // Who turns right goes around the kerb's corner; who turns left has all the room of the node.
                let half = |arm: usize| network.roads[node.arms[arm].road].section.half();
                let edge = (half(a) - from.strip.offset.abs()).min(half(b) - to.strip.offset.abs());
                let radius = if left {
                    18.0
                } else {
                    kerb_radius(node.corner, bend_to(b)) + edge
                };
                let path = turn_path(start.at(start.length()).0, end.at(0.0).0, radius);
                let slower = |lane: usize| self.lanes[lane].limit;
                let limit = slower(from.lane).min(slower(to.lane));
                let weight = match () {
                    () if straight => 0.5,
                    () => 0.5 / (others.len() as f64 - 1.0).max(1.0),
                };
                self.turn(number, a, path, limit, from.lane, to.lane, weight);
                bends.push(Bend {
                    arm: a,
                    to: b,
                    angle: if straight { 0.0 } else { bend_to(b) },
                    cycle: from.strip.index.is_none(),
                    ring: false,
                });
            }
        }
    }

    #[allow(clippy::too_many_arguments)] // a turn in its parts
    pub(super) fn turn(
        &mut self,
        node: usize,
        arm: usize,
        path: Path,
        limit: f64,
        from: usize,
        to: usize,
        weight: f64,
    ) -> usize {
        let number = self.lanes.len();
        let mut turn = lane(path, Kind::Turn { node, arm }, limit);
        turn.next.push((to, 1.0));
        self.lanes.push(turn);
        self.lanes[from].next.push((number, weight));
        number
    }
}
