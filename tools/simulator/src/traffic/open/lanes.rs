//! Lanes, the turns that join them at nodes, and who goes first where turns meet.

mod bends;
mod meeting;
mod ring;
mod turns;

use std::f64::consts::PI;

use crate::path::Path;
use crate::place::{Network, Strip};
use bends::arm_of;

/// What a lane is for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Kind {
    /// A driving lane of a road.
    Drive,
    /// A cycle lane.
    Cycle,
    /// Joins lanes at a node: nobody drives on to it without a grant.
    Turn {
        node: usize,
        /// Arm by which one comes.
        arm: usize,
    },
    /// Turns round at an open end; only for those who stay.
    Loop,
}

/// A stretch of another lane on which nobody can be while one passes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Conflict {
    pub other: usize,
    /// From where to where on the other lane, m.
    pub theirs: [f64; 2],
    /// Whether the other goes first.
    pub yields: bool,
}

/// Where a lane goes over a pedestrian crossing.
#[derive(Clone, Copy, Debug)]
pub(super) struct Over {
    pub crossing: usize,
    /// Share of the crossing, from the arm's left to its right, that the lane takes up.
    pub share: [f64; 2],
}

/// A lane.
#[derive(Clone, Debug)]
pub(super) struct RoadLane {
    pub path: Path,
    pub kind: Kind,
    pub limit: f64,
    /// Lanes that go on from its end, with their weights.
    pub next: Vec<(usize, f64)>,
    /// Lanes to the left and right that one may change over to, and between which distances.
    pub beside: [Option<(usize, [f64; 2])>; 2],
    pub conflicts: Vec<Conflict>,
    pub over: Vec<Over>,
    /// Whether vehicles come in at its begin.
    pub source: bool,
    /// Whether vehicles leave the place at its end, and the loop back for those who stay.
    pub exit: Option<Option<usize>>,
    /// Smallest radius, m.
    pub tightest: f64,
    /// Outermost of its direction, where trucks and buses keep.
    pub outer: bool,
    /// Road that it belongs to.
    pub road: Option<usize>,
}

/// A pedestrian crossing over an arm.
#[derive(Clone, Copy, Debug)]
pub(super) struct Zebra {
    pub node: usize,
    pub arm: usize,
}

/// All lanes of a place.
pub(super) struct Lanes {
    pub lanes: Vec<RoadLane>,
    pub crossings: Vec<Zebra>,
}

fn lane(path: Path, kind: Kind, limit: f64) -> RoadLane {
    let tightest = path
        .pieces()
        .filter(|(from, to, _)| to - from > 0.05)
        .map(|(_, _, curvature)| 1.0 / curvature.abs().max(1e-6))
        .fold(f64::INFINITY, f64::min);
    RoadLane {
        path,
        kind,
        limit,
        next: Vec::new(),
        beside: [None; 2],
        conflicts: Vec::new(),
        over: Vec::new(),
        source: false,
        exit: None,
        tightest,
        outer: true,
        road: None,
    }
}

/// A lane's end at an arm.
#[derive(Clone, Copy)]
struct Mouth {
    lane: usize,
    strip: Strip,
}

impl Lanes {
    pub fn new(network: &Network) -> Self {
        let mut all = Lanes {
            lanes: Vec::new(),
            crossings: Vec::new(),
        };
        // By node and arm: lanes that come in and lanes that go out.
        let mut mouths: Vec<Vec<[Vec<Mouth>; 2]>> = (network.nodes.iter())
            .map(|node| node.arms.iter().map(|_| [Vec::new(), Vec::new()]).collect())
            .collect();
        for (index, road) in network.roads.iter().enumerate() {
            let first = all.lanes.len();
            let [from, to] = road.span();
            let strips = road.section.strips();
            for strip in &strips {
                let piece = road.line.part(from, to).parallel(strip.offset);
                let path = if strip.forward { piece } else { piece.reversed() };
                let kind = if strip.index.is_some() {
                    Kind::Drive
                } else {
                    Kind::Cycle
                };
                let mut lane = lane(path, kind, road.section.limit);
                lane.road = Some(index);
                let lanes = road.section.lanes[usize::from(!strip.forward)];
                lane.outer = strip.index.is_none_or(|i| i + 1 == lanes);
                let ends = if strip.forward { [0, 1] } else { [1, 0] };
                lane.source = road.ends[ends[0]].is_none();
                let merges = network.merges.iter().any(|merge| merge.road == index);
                lane.exit = (road.ends[ends[1]].is_none() && !merges).then_some(None);
                let number = all.lanes.len();
                for (role, end) in ends.into_iter().enumerate() {
                    let Some((node, _)) = road.ends[end] else { continue };
                    let arm = arm_of(&network.nodes[node], index, end == 0);
                    // A lane begins where its vehicles go out of the node, and ends where they come in.
                    mouths[node][arm][1 - role].push(Mouth {
                        lane: number,
                        strip: *strip,
                    });
                }
                all.lanes.push(lane);
            }
            all.neighbours(first, &strips);
            all.loops(first, &strips);
        }
        for merge in &network.merges {
            all.merge(network, merge.road, merge.onto, merge.stretch);
        }
        for (number, node) in network.nodes.iter().enumerate() {
            all.join(network, number, node, &mouths[number]);
        }
        all
    }

    /// Tells lanes side by side of each other.
    fn neighbours(&mut self, first: usize, strips: &[Strip]) {
        for (i, own) in strips.iter().enumerate() {
            for (j, other) in strips.iter().enumerate() {
                let (Some(a), Some(b)) = (own.index, other.index) else {
                    continue;
                };
                if own.forward != other.forward || a.abs_diff(b) != 1 {
                    continue;
                }
                // Lanes are numbered from the middle, which lies to the left.
                let side = usize::from(b > a);
                let length = self.lanes[first + i].path.length();
                self.lanes[first + i].beside[side] = Some((first + j, [0.0, length]));
            }
        }
    }

    /// Ways back at open ends, from each lane that leaves to the outermost that comes in.
    fn loops(&mut self, first: usize, strips: &[Strip]) {
        for i in 0..strips.len() {
            if self.lanes[first + i].exit.is_none() || strips[i].index.is_none() {
                continue;
            }
            let back = (0..strips.len())
                .filter(|j| strips[*j].index.is_some() && strips[*j].forward != strips[i].forward)
                .max_by_key(|j| strips[*j].index);
            let Some(back) = back.map(|j| first + j).filter(|back| self.lanes[*back].source) else {
                continue;
            };
            let out = &self.lanes[first + i].path;
            let end = out.at(out.length()).0;
            let begin = self.lanes[back].path.at(0.0).0;
            let (dx, dy) = (begin.x - end.x, begin.y - end.y);
            let aside = (dx * dx + dy * dy).sqrt();
            let mut path = Path::from_pose(end);
            let radius = (0.5 * aside).max(6.5);
            let angle = libm::acos(((aside / radius + 2.0) / 4.0).min(1.0));
            path.arc(radius, -angle)
                .arc(radius, PI + 2.0 * angle)
                .arc(radius, -angle);
            // What rounding leaves.
            path.reach(begin);
            let mut lane = lane(path, Kind::Loop, 5.0);
            lane.next.push((back, 1.0));
            let number = self.lanes.len();
            self.lanes.push(lane);
            self.lanes[first + i].exit = Some(Some(number));
        }
    }

    fn merge(&mut self, network: &Network, road: usize, onto: usize, stretch: [f64; 2]) {
        let own = self.lanes.iter().position(|lane| lane.road == Some(road));
        let outermost = network.roads[onto].section.lanes[0] - 1;
        let left = self
            .lanes
            .iter()
            .position(|lane| lane.road == Some(onto))
            .map(|first| first + outermost);
        if let (Some(own), Some(left)) = (own, left) {
            self.lanes[own].beside[0] = Some((left, stretch));
        }
    }
}
