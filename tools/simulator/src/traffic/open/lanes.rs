//! Lanes, the turns that join them at nodes, and who goes first where turns meet.

use std::f64::consts::{FRAC_PI_2, PI};

use crate::path::{Path, Pose2, angle_within};
use crate::place::{Arm, CROSSING_HALF, Control, Network, Node, Strip};

/// Step along lanes where they are compared, m.
const STEP: f64 = 0.5;

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
pub(super) struct Lane {
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
    pub lanes: Vec<Lane>,
    pub crossings: Vec<Zebra>,
}

fn lane(path: Path, kind: Kind, limit: f64) -> Lane {
    let tightest = path
        .pieces()
        .filter(|(from, to, _)| to - from > 0.05)
        .map(|(_, _, curvature)| 1.0 / curvature.abs().max(1e-6))
        .fold(f64::INFINITY, f64::min);
    Lane {
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

    fn join(&mut self, network: &Network, number: usize, node: &Node, mouths: &[[Vec<Mouth>; 2]]) {
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
    fn reach(&self, lane: usize) -> f64 {
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
            let exits: Vec<Mouth> = outgoing.iter().copied().filter(|m| m.strip.index.is_some()).collect();
            let straight = ahead == Some(b);
            let left = bend_to(b) > 0.0;
            for from in incoming {
                let to = match from.strip.index {
                    None if straight || ahead.is_none() && !left => {
                        // Where no cycle lane goes on, riders go on in the outermost lane.
                        let cycle = outgoing.iter().copied().find(|m| m.strip.index.is_none());
                        cycle.or(exits.iter().copied().max_by_key(|m| m.strip.index))
                    }
                    None => None,
                    Some(index) if straight => {
                        let same = exits.iter().copied().find(|m| m.strip.index == Some(index));
                        same.or(exits
                            .iter()
                            .copied()
                            .max_by_key(|m| m.strip.index)
                            .filter(|_| driving == 1))
                    }
                    Some(index) if left && index == 0 => exits.iter().copied().find(|m| m.strip.index == Some(0)),
                    Some(index) if !left && index + 1 == driving => exits.iter().copied().max_by_key(|m| m.strip.index),
                    Some(_) => None,
                };
                let Some(to) = to else { continue };
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
    fn turn(&mut self, node: usize, arm: usize, path: Path, limit: f64, from: usize, to: usize, weight: f64) -> usize {
        let number = self.lanes.len();
        let mut turn = lane(path, Kind::Turn { node, arm }, limit);
        turn.next.push((to, 1.0));
        self.lanes.push(turn);
        self.lanes[from].next.push((number, weight));
        number
    }

    /// The ring of a roundabout, its entries and exits.
    fn ring(&mut self, number: usize, node: &Node, mouths: &[[Vec<Mouth>; 2]], radius: f64, bends: &mut Vec<Bend>) {
        const LIMIT: f64 = 7.5;
        let on_ring = |angle: f64| {
            let (sin, cos) = libm::sincos(angle);
            Pose2 {
                x: node.at[0] + radius * cos,
                y: node.at[1] + radius * sin,
                heading: angle + FRAC_PI_2,
            }
        };
        let count = node.arms.len();
        let arc = |from: f64, to: f64| {
            let mut path = Path::from_pose(on_ring(from));
            path.arc(radius, (to - from).rem_euclid(2.0 * PI));
            path
        };
        // How far before and behind an arm one leaves and joins the ring, rad.
        let gaps = (0..count).map(|k| {
            let next = node.arms[(k + 1) % count].heading;
            (next - node.arms[k].heading).rem_euclid(2.0 * PI)
        });
        let beside = (0.5 * gaps.fold(PI, f64::min) - 0.12).min(0.5);
        // Stretches between arms are plain lanes; those past an arm are turns, because entries join behind them.
        let between: Vec<usize> = (0..count)
            .map(|k| {
                let from = node.arms[k].heading + beside;
                let to = node.arms[(k + 1) % count].heading - beside;
                let mut piece = lane(arc(from, to), Kind::Drive, LIMIT);
                piece.outer = false;
                self.lanes.push(piece);
                bends.push(Bend {
                    arm: k,
                    to: k,
                    angle: 0.0,
                    cycle: false,
                    ring: true,
                });
                self.lanes.len() - 1
            })
            .collect();
        for k in 0..count {
            let heading = node.arms[k].heading;
            let before = between[(k + count - 1) % count];
            let past = arc(heading - beside, heading + beside);
            self.turn(number, k, past, LIMIT, before, between[k], 0.55);
            let ring = |ring: bool| Bend {
                arm: k,
                to: k,
                angle: 0.0,
                cycle: false,
                ring,
            };
            bends.push(ring(true));
            for from in &mouths[k][0] {
                let start = &self.lanes[from.lane].path;
                let path = turn_path(start.at(start.length()).0, on_ring(heading + beside), f64::INFINITY);
                self.turn(number, k, path, LIMIT, from.lane, between[k], 1.0);
                bends.push(ring(false));
            }
            for to in &mouths[k][1] {
                let path = turn_path(
                    on_ring(heading - beside),
                    self.lanes[to.lane].path.at(0.0).0,
                    f64::INFINITY,
                );
                self.turn(number, k, path, LIMIT, before, to.lane, 0.45);
                bends.push(ring(true));
            }
        }
    }
}

/// How a turn goes.
struct Bend {
    arm: usize,
    to: usize,
    /// Left positive, 0 for straight on.
    angle: f64,
    cycle: bool,
    /// On the ring of a roundabout.
    ring: bool,
}

/// Number of the arm by which a road's begin or end lies at a node.
fn arm_of(node: &Node, road: usize, at_start: bool) -> usize {
    let is = |arm: &Arm| arm.road == road && arm.at_start == at_start;
    node.arms
        .iter()
        .position(is)
        .expect("a road is an arm of the nodes at its ends")
}

/// Radius of the circle that comes as near to a corner as a kerb does that is rounded by [`crate::place::Network`]'s
/// surface: greater where roads meet at a wide angle.
fn kerb_radius(corner: f64, bend: f64) -> f64 {
    let flat = 1.0 - libm::cos(0.5 * bend);
    (0.292 * corner / flat.max(1e-3)).min(25.0)
}

/// A way from one pose to another: straight as far as the bend allows, then a curve of equal tangents that is about as
/// wide as `radius`.
fn turn_path(from: Pose2, to: Pose2, radius: f64) -> Path {
    let bend = angle_within(to.heading - from.heading);
    let (dx, dy) = (to.x - from.x, to.y - from.y);
    let (s0, c0) = libm::sincos(from.heading);
    let (s1, c1) = libm::sincos(to.heading);
    let sin = c0 * s1 - s0 * c1;
    if bend.abs() < 0.25 || bend.abs() > 2.8 || sin.abs() < 1e-3 {
        return Path::between(from, to);
    }
    // Where the two straight lines meet: so far ahead of the begin, so far before the end.
    let ahead = (dx * s1 - dy * c1) / sin;
    let before = (dy * c0 - dx * s0) / sin;
    let tangent = ahead.min(before).min(radius * libm::tan(0.5 * bend.abs()));
    if tangent < 2.0 {
        return Path::between(from, to);
    }
    let mut path = Path::from_pose(from);
    path.line(ahead - tangent);
    path.append(&Path::between(
        from.at(ahead - tangent, 0.0),
        to.at(tangent - before, 0.0),
    ));
    path.line(before - tangent);
    path
}

fn sampled(path: &Path) -> Vec<Pose2> {
    let count = (path.length() / STEP).ceil() as usize;
    (0..=count)
        .map(|k| path.at((k as f64 * STEP).min(path.length())).0)
        .collect()
}

/// From where to where the second of two ways is within `reach` of the first.
fn meeting(a: &[Pose2], b: &[Pose2], reach: f64) -> Option<[f64; 2]> {
    let near = |q: &Pose2| {
        a.iter().any(|p| {
            let (dx, dy) = (p.x - q.x, p.y - q.y);
            dx * dx + dy * dy < reach * reach
        })
    };
    let first = b.iter().position(near)?;
    let last = b.iter().rposition(near)?;
    Some([first as f64 * STEP, last as f64 * STEP])
}

/// The share of a crossing that a way takes up, from the arm's left to its right.
fn passes(node: &Node, arm: usize, half: f64, way: &[Pose2], reach: f64) -> Option<[f64; 2]> {
    let middle = node.arms[arm].crossing?;
    let frame = node.place(arm, middle, 0.0);
    let (sin, cos) = libm::sincos(frame.heading);
    let mut share = [f64::INFINITY, f64::NEG_INFINITY];
    for pose in way {
        let (dx, dy) = (pose.x - frame.x, pose.y - frame.y);
        let (along, across) = (dx * cos + dy * sin, dy * cos - dx * sin);
        if along.abs() < CROSSING_HALF + 0.6 && across.abs() < half {
            let at = |v: f64| ((half - v) / (2.0 * half)).clamp(0.0, 1.0);
            share = [share[0].min(at(across + reach)), share[1].max(at(across - reach))];
        }
    }
    (share[0] < share[1]).then_some(share)
}

/// Whether one turn waits for another.
fn yields(node: &Node, own: &Bend, other: &Bend) -> bool {
    if let Control::Roundabout { .. } = node.control {
        return !own.ring && other.ring;
    }
    if own.arm == other.arm {
        // Who turns right lets riders beside him go first.
        return other.cycle && !own.cycle && own.angle != 0.0;
    }
    let (a, b) = (&node.arms[own.arm], &node.arms[other.arm]);
    let between = angle_within(b.heading - a.heading);
    let opposite = between.abs() > 2.2;
    match node.control {
        Control::Priority if a.major != b.major => b.major,
        _ if opposite => own.angle > 0.3 && other.angle <= 0.3,
        Control::Signals => false,
        // Seen from an arm, the next one clockwise is to the left of who comes in by it: headings point outwards.
        Control::Uncontrolled => between > 0.0,
        _ => own.angle > 0.3 && other.angle <= 0.3 || (own.to == other.to && own.angle.abs() > other.angle.abs()),
    }
}
