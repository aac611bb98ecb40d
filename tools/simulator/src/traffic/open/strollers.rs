//! Everybody on foot on a network: along the pavements, around corners, over the crossings.

use std::f64::consts::PI;

use super::flow::Walked;
use super::lanes::Zebra;
use super::signals::Signals;
use crate::bodies::Class;
use crate::path::{Course, Motion, Path, TICK, angle_within};
use crate::place::{Network, Node, SIDES};
use crate::random::Stream;

/// Seconds walked before the log begins.
const WARM_UP: f64 = 25.0;
/// Nobody's middle comes closer to another's than this, m.
const APART: f64 = 0.95;
/// Distance from the kerb at which one waits, m.
const WAIT: f64 = 0.7;
/// Nobody walks farther in the place than this, m.
const FARTHEST: f64 = 420.0;
/// So far before the open ends of roads walkers come in, m: behind are the places where vehicles turn round.
const OPEN_END: f64 = 14.0;
/// Seconds between the looks at whether two come too close.
const LOOK: f64 = 0.2;

/// Somebody on foot.
pub(super) struct Stroller {
    pub class: Class,
    pub size: [f64; 3],
    pub course: Course,
}

/// What the walkers' ways depend on.
pub(super) struct Ways<'a> {
    pub network: &'a Network,
    pub crossings: &'a [Zebra],
    pub signals: &'a [Option<Signals>],
    pub seed: u64,
    pub count: usize,
    pub until: f64,
}

/// Walkers, and when they take up which part of which crossing.
pub(super) fn walk(ways: &Ways) -> (Vec<Stroller>, Vec<Walked>) {
    let starts = starts(ways.network);
    let mut crowd = Crowd {
        ways,
        starts,
        walkers: Vec::new(),
        walked: Vec::new(),
        places: vec![Vec::new(); ((ways.until + WARM_UP) / LOOK).ceil() as usize + 2],
    };
    if ways.count == 0 || crowd.starts.is_empty() {
        return (Vec::new(), Vec::new());
    }
    for index in 0..ways.count as u64 {
        crowd.admit(&mut Stream::new(ways.seed, "walker", index), -WARM_UP);
    }
    // Later ones come in at the ends of the roads, about as many as leave there.
    let mut arrivals = Stream::new(ways.seed, "walker-arrivals", 0);
    let pause = 160.0 / ways.count as f64;
    let mut t = -WARM_UP + arrivals.exponential(pause);
    let mut index = ways.count as u64;
    while t < ways.until {
        crowd.admit(&mut Stream::new(ways.seed, "walker", index), t);
        t += arrivals.exponential(pause);
        index += 1;
    }
    (crowd.walkers, crowd.walked)
}

/// The pavements at the open ends of roads, as (node, arm, side seen outwards).
fn starts(network: &Network) -> Vec<(usize, usize, usize)> {
    let mut starts = Vec::new();
    for (n, node) in network.nodes.iter().enumerate() {
        for (a, arm) in node.arms.iter().enumerate() {
            let road = &network.roads[arm.road];
            let far = usize::from(arm.at_start);
            for side in 0..2 {
                if road.ends[far].is_none() && road.section.pavement[side] > 0.0 {
                    // Seen outwards, sides change if the road's line comes in.
                    starts.push((n, a, if arm.at_start { side } else { 1 - side }));
                }
            }
        }
    }
    starts
}

struct Crowd<'a> {
    ways: &'a Ways<'a>,
    starts: Vec<(usize, usize, usize)>,
    walkers: Vec<Stroller>,
    walked: Vec<Walked>,
    /// Where everybody is, by look.
    places: Vec<Vec<[f64; 2]>>,
}

/// A crossing on the way.
#[derive(Clone, Copy)]
struct Over {
    crossing: usize,
    /// Distances along the way of the waiting point and the far kerb.
    wait: f64,
    far: f64,
    /// From the arm's left to its right.
    rightwards: bool,
}

/// A way on foot.
struct Route {
    path: Path,
    overs: Vec<Over>,
}

/// The points of a route in the making, and the crossings between some of them.
struct Draft {
    points: Vec<[f64; 2]>,
    overs: Vec<(usize, usize, bool)>,
}

/// A pavement along an arm: its side seen outwards, and how far from the arm's line one walks.
#[derive(Clone, Copy)]
struct Track {
    node: usize,
    arm: usize,
    side: usize,
    across: f64,
}

impl Crowd<'_> {
    /// Finds a way for one more that keeps clear of all before; gives up after some tries.
    fn admit(&mut self, draws: &mut Stream, t: f64) {
        let class = if draws.chance(0.1) {
            Class::Child
        } else {
            Class::Pedestrian
        };
        let size = class.size(draws);
        let speed = draws.normal_in(1.32, 0.18, 1.05, 1.8);
        for _ in 0..12 {
            let start = self.starts[draws.below(self.starts.len())];
            let Some(route) = self.route(start, draws) else {
                continue;
            };
            let length = route.path.length();
            let begin = if t > -WARM_UP {
                0.0
            } else {
                draws.between(0.0, (length - 45.0).max(1.0))
            };
            let inside = |over: &Over| (over.wait - 0.5..over.far + 0.5).contains(&begin);
            if begin > length - 5.0 || route.overs.iter().any(inside) {
                continue;
            }
            let delay = draws.between(0.0, 1.2);
            let motion = self.stroll(&route, t, begin, speed, delay);
            let walked: Vec<Walked> = route.overs.iter().flat_map(|over| walked(&motion, *over)).collect();
            let course = Course::Moving(motion);
            let places = self.places_of(&course);
            if self.clear(&places) {
                for (look, place) in places {
                    self.places[look].push(place);
                }
                self.walkers.push(Stroller { class, size, course });
                self.walked.extend(walked);
                return;
            }
        }
    }

    /// Where somebody is at each look.
    fn places_of(&self, course: &Course) -> Vec<(usize, [f64; 2])> {
        let at = |look: usize| {
            let state = course.at(look as f64 * LOOK - WARM_UP)?;
            Some((look, [state.pose.x, state.pose.y]))
        };
        (0..self.places.len()).filter_map(at).collect()
    }

    fn clear(&self, places: &[(usize, [f64; 2])]) -> bool {
        places.iter().all(|(look, own)| {
            self.places[*look].iter().all(|other| {
                let (dx, dy) = (other[0] - own[0], other[1] - own[1]);
                dx * dx + dy * dy > APART * APART
            })
        })
    }

    /// Walks a route tick by tick and waits at kerbs while one may not cross.
    fn stroll(&self, route: &Route, first: f64, start: f64, speed: f64, delay: f64) -> Motion {
        const BRAKE: f64 = 1.2;
        let path = &route.path;
        let (mut t, mut s, mut v) = (first, start, speed);
        let mut ticks = Vec::new();
        let mut ahead: Vec<Over> = route
            .overs
            .iter()
            .copied()
            .filter(|over| over.wait > start)
            .rev()
            .collect();
        let mut go_at = None::<f64>;
        while t <= self.ways.until + TICK && s < path.length() {
            ticks.push((s, v));
            let mut wanted = speed;
            if let Some(over) = ahead.last().copied() {
                let left = over.wait - s;
                let arrival = t + left / v.max(0.6);
                let go = self.next_walk(over, arrival);
                if left < 0.1 && go_at.is_none() && go > t + 0.2 {
                    go_at = Some(go + delay);
                }
                let free = go_at.map_or(go <= arrival + 0.01, |go| t >= go);
                if free && left < 0.2 {
                    ahead.pop();
                    go_at = None;
                } else if !free {
                    wanted = (2.0 * BRAKE * (left - 0.03).max(0.0)).sqrt().min(speed);
                }
            }
            let next = wanted.clamp(v - 2.0 * BRAKE * TICK, v + BRAKE * TICK).max(0.0);
            s += 0.5 * (v + next) * TICK;
            v = next;
            t += TICK;
        }
        Motion {
            path: path.clone(),
            first,
            ticks,
        }
    }

    fn next_walk(&self, over: Over, t: f64) -> f64 {
        let Zebra { node, arm } = self.ways.crossings[over.crossing];
        let phase = self.ways.network.nodes[node].arms[arm].phase;
        self.ways.signals[node]
            .as_ref()
            .map_or(t, |signals| signals.next_walk(phase, t))
    }

    fn track(&self, node: usize, arm: usize, side: usize, draws: &mut Stream) -> Option<Track> {
        let network = self.ways.network;
        let own = &network.nodes[node].arms[arm];
        let section = &network.roads[own.road].section;
        let on_road = if own.at_start { side } else { 1 - side };
        let width = section.pavement[on_road];
        if width <= 0.0 {
            return None;
        }
        let from = section.half() + section.bay_depth(on_road);
        let band = match section.strip(on_road) {
            Some([_, to]) => [to + 0.35, width - 0.6],
            None if width < 2.5 => [0.6, width - 0.4],
            None => [0.9, width - 0.6],
        };
        Some(Track {
            node,
            arm,
            side,
            across: from + draws.between(band[0], band[1]),
        })
    }

    /// In along a pavement, then from node to node until the place ends.
    fn route(&self, (node, arm, side): (usize, usize, usize), draws: &mut Stream) -> Option<Route> {
        let network = self.ways.network;
        let mut draft = Draft {
            points: Vec::new(),
            overs: Vec::new(),
        };
        let mut track = self.track(node, arm, side, draws)?;
        let mut inwards = true;
        let mut length = 0.0;
        loop {
            length += network.nodes[track.node].arms[track.arm].out.length();
            self.along(&mut draft, track, inwards);
            if inwards {
                track = self.turn(&mut draft, track, draws)?;
                inwards = false;
                continue;
            }
            let own = &network.nodes[track.node].arms[track.arm];
            let road = &network.roads[own.road];
            match road.ends[usize::from(own.at_start)] {
                Some((next, _)) if length < FARTHEST => {
                    // The walk has already led to the next node's arm: go on from there.
                    let arms = &network.nodes[next].arms;
                    let arm = arms
                        .iter()
                        .position(|a| a.road == own.road && a.at_start != own.at_start)?;
                    let there = Track {
                        node: next,
                        arm,
                        side: 1 - track.side,
                        across: track.across,
                    };
                    track = self.turn(&mut draft, there, draws)?;
                }
                _ => return rounded(draft),
            }
        }
    }

    /// Points along an arm's pavement, between its far end and where the node begins.
    fn along(&self, draft: &mut Draft, track: Track, inwards: bool) {
        const STEP: f64 = 5.0;
        let network = self.ways.network;
        let node = &network.nodes[track.node];
        let arm = &node.arms[track.arm];
        let road = &network.roads[arm.road];
        let far = road.ends[usize::from(arm.at_start)].map_or(OPEN_END, |(_, mouth)| mouth + 3.0);
        let [from, to] = [arm.mouth + 3.0, arm.out.length() - far];
        let count = ((to - from) / STEP).floor().max(1.0);
        let sign = SIDES[track.side];
        let mut points: Vec<[f64; 2]> = (0..=count as usize)
            .map(|k| {
                let pose = node.place(track.arm, from + (to - from) * k as f64 / count, sign * track.across);
                [pose.x, pose.y]
            })
            .collect();
        if inwards {
            points.reverse();
        }
        draft.points.extend(points);
    }

    /// Through a node, from an arm's pavement to that by which one leaves.
    fn turn(&self, draft: &mut Draft, from: Track, draws: &mut Stream) -> Option<Track> {
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
            let there = self.track(from.node, arm, 1 - here.side, draws)?;
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
        let to = self.track(from.node, from.arm, 1 - from.side, draws)?;
        // One keeps to the right, so that nobody walks into somebody.
        let sign = SIDES[from.side];
        let along = middle + sign * draws.between(0.25, 1.15);
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
        let out = (0.293 * node.corner + 0.9 * half + 0.3 - kerb(from).min(kerb(to))).max(0.0) / half;
        let toward = a.heading + 0.5 * angle_within(b.heading - a.heading);
        let (sin, cos) = libm::sincos(toward);
        draft.points.push([pose.x + out * cos, pose.y + out * sin]);
    }
}

/// A path through points with rounded corners; `None` where the points lie so that it would turn back.
fn rounded(draft: Draft) -> Option<Route> {
    const RADIUS: f64 = 0.7;
    let Draft { points, overs } = draft;
    let heading = |i: usize| libm::atan2(points[i + 1][1] - points[i][1], points[i + 1][0] - points[i][0]);
    let distance = |i: usize| {
        let (dx, dy) = (points[i + 1][0] - points[i][0], points[i + 1][1] - points[i][1]);
        (dx * dx + dy * dy).sqrt()
    };
    let last = points.len() - 1;
    if (0..last).any(|i| distance(i) < 0.05) {
        return None;
    }
    // How much each corner takes off the lines beside it.
    let mut cuts = vec![0.0; points.len()];
    for (i, cut) in cuts.iter_mut().enumerate().take(last).skip(1) {
        let turn = angle_within(heading(i) - heading(i - 1)).abs();
        if turn > 2.4 {
            return None;
        }
        let room = 0.45 * distance(i - 1).min(distance(i));
        *cut = (RADIUS * libm::tan(0.5 * turn)).min(room);
    }
    let mut path = Path::from(points[0][0], points[0][1], heading(0));
    let mut at = vec![0.0];
    for i in 0..last {
        path.line(distance(i) - cuts[i] - cuts[i + 1]);
        if i + 1 < last && cuts[i + 1] > 1e-6 {
            let turn = angle_within(heading(i + 1) - heading(i));
            path.arc(cuts[i + 1] / libm::tan(0.5 * turn.abs()), turn);
        }
        at.push(path.length());
    }
    let overs = overs
        .into_iter()
        .map(|(point, crossing, from_left)| Over {
            crossing,
            wait: at[point],
            far: at[point + 1],
            rightwards: from_left,
        })
        .collect();
    Some(Route { path, overs })
}

/// When a walker takes up which quarter of a crossing.
fn walked(motion: &Motion, over: Over) -> Vec<Walked> {
    let last = motion.ticks[motion.ticks.len() - 1].0;
    if last < over.wait || motion.ticks[0].0 > over.far {
        return Vec::new();
    }
    let time_at = |s: f64| {
        let k = motion.ticks.partition_point(|(at, _)| *at < s);
        motion.first + k as f64 * TICK
    };
    // Who still waits takes up nothing.
    let leaves = over.wait + 0.15;
    (0..4)
        .map(|quarter| {
            let cut = |q: i32| over.wait + 0.3 + f64::from(q) * 0.25 * (over.far - over.wait - 0.3);
            let share = |q: i32| {
                let along = 0.25 * f64::from(q);
                if over.rightwards { along } else { 1.0 - along }
            };
            let (a, b) = (share(quarter), share(quarter + 1));
            Walked {
                crossing: over.crossing,
                share: [a.min(b), a.max(b)],
                from: time_at((cut(quarter) - 0.9).max(leaves)),
                until: time_at(cut(quarter + 1) + 0.9),
            }
        })
        .filter(|walked| walked.from < walked.until)
        .collect()
}
