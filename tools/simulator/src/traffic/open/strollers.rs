//! Everybody on foot on a network: along the pavements, around corners, over the crossings, alone, in groups and with
//! prams; and groups that stand.

use std::f64::consts::{PI, TAU};

use super::Footprint;
use super::flow::Walked;
use super::lanes::Zebra;
use super::signals::Signals;
use crate::bodies::Class;
use crate::path::{Course, Motion, Path, Pose2, angle_within};
use crate::place::{Network, Node, SIDES};
use crate::random::Stream;
use crate::traffic::touch;
use crate::traffic::walking::{APART, Gait, Over, Start, WAIT, WARM_UP, Walker, admit_all, quarters, stroll};

/// Nobody walks farther in the place than this, m.
const FARTHEST: f64 = 420.0;
/// So far before the open ends of roads walkers come in, m: behind are the places where vehicles turn round.
const OPEN_END: f64 = 14.0;
/// Seconds between the looks at whether two come too close.
const LOOK: f64 = 0.2;

/// Two who walk side by side keep this far from the middle between them, m.
const ABREAST: f64 = 0.37;
/// Between those who walk behind each other, m.
const BEHIND: f64 = 0.3;

/// What the walkers' ways depend on.
pub(super) struct Ways<'a> {
    pub network: &'a Network,
    pub things: &'a [Footprint],
    pub crossings: &'a [Zebra],
    pub signals: &'a [Option<Signals>],
    pub seed: u64,
    pub dense: bool,
    pub until: f64,
}

/// Walkers, and when they take up which part of which crossing.
pub(super) fn walk(ways: &Ways) -> (Vec<Walker>, Vec<Walked>) {
    let mut crowd = Crowd {
        ways,
        starts: starts(ways.network),
        walkers: Vec::new(),
        walked: Vec::new(),
        places: vec![Vec::new(); ((ways.until + WARM_UP) / LOOK).ceil() as usize + 2],
    };
    let mix = &ways.network.mix;
    let count = mix.walkers[usize::from(ways.dense)];
    if count == 0 || crowd.starts.is_empty() {
        return (Vec::new(), Vec::new());
    }
    for index in 0..mix.standing[usize::from(ways.dense)] as u64 {
        crowd.gather(&mut Stream::new(ways.seed, "standing", index));
    }
    admit_all(ways.seed, count, ways.until, |draws, t| crowd.admit(draws, t));
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
    walkers: Vec<Walker>,
    walked: Vec<Walked>,
    /// Where everybody is by look, and how far from him others keep, m.
    places: Vec<Vec<([f64; 2], f64)>>,
}

/// One of those who walk together.
struct Member {
    class: Class,
    size: [f64; 3],
    /// How far behind the first and to the left of the common way, m.
    back: f64,
    aside: f64,
}

/// Those who walk together, the first first.
struct Party {
    members: Vec<Member>,
    speed: f64,
}

impl Party {
    fn draw(draws: &mut Stream, groups: f64, prams: f64) -> Self {
        let count = if draws.chance(groups) { companions(draws) } else { 1 };
        let mut party = Party {
            members: Vec::new(),
            speed: f64::INFINITY,
        };
        for _ in 0..count {
            let Gait {
                mut class,
                mut size,
                speed,
            } = Gait::draw(draws);
            party.speed = party.speed.min(speed);
            if class == Class::Pedestrian && draws.chance(prams) {
                class = Class::Pram;
                size = class.labelled_size(draws);
                party.speed = party.speed.min(1.3);
            }
            party.members.push(Member {
                class,
                size,
                back: 0.0,
                aside: 0.0,
            });
        }
        party
    }

    /// Lines them up in one or in two files.
    fn line_up(&mut self, abreast: bool) {
        let files = if abreast { 2 } else { 1 };
        for i in 0..self.members.len() {
            let back = match i.checked_sub(files) {
                Some(before) => {
                    let before = &self.members[before];
                    before.back + 0.5 * (before.size[0] + self.members[i].size[0]) + BEHIND
                }
                None => 0.5 * (self.members[i].size[0] - self.members[0].size[0]).max(0.0),
            };
            let member = &mut self.members[i];
            member.back = back;
            member.aside = if abreast { ABREAST * SIDES[i % 2] } else { 0.0 };
        }
    }

    /// How far the last walks behind the first, m.
    fn tail(&self) -> f64 {
        self.members.iter().map(|member| member.back).fold(0.0, f64::max)
    }
}

/// How many go or stand together: two to six.
fn companions(draws: &mut Stream) -> usize {
    match draws.unit() {
        u if u < 0.5 => 2,
        u if u < 0.75 => 3,
        u if u < 0.88 => 4,
        u if u < 0.95 => 5,
        _ => 6,
    }
}

/// How far from somebody's middle others keep theirs, m.
fn margin(class: Class, size: [f64; 3]) -> f64 {
    match class {
        Class::Pram => 0.5 * (size[0] * size[0] + size[1] * size[1]).sqrt(),
        _ => 0.5 * APART,
    }
}

/// A way on foot.
struct Route {
    path: Path,
    overs: Vec<Over>,
    /// Whether each crossing is gone over from its arm's left to its right.
    rightwards: Vec<bool>,
}

/// The points of a route in the making, and the crossings between some of them.
struct Draft {
    points: Vec<[f64; 2]>,
    /// Smallest radius of its corners where there is room, m.
    radius: f64,
    overs: Vec<(usize, usize, bool)>,
}

/// A pavement along an arm: its side seen outwards, and how far from the arm's line one walks.
#[derive(Clone, Copy)]
struct Track {
    node: usize,
    arm: usize,
    side: usize,
    across: f64,
    /// How far beside it somebody walks, m.
    aside: f64,
}

impl Crowd<'_> {
    /// Finds a way for some more that keeps clear of all before, or gives up after some tries; reports how many they are.
    fn admit(&mut self, draws: &mut Stream, t: f64) -> usize {
        const TRIES: usize = 12;
        let mix = &self.ways.network.mix;
        let mut party = Party::draw(draws, mix.groups, mix.prams);
        let count = party.members.len();
        for attempt in 0..TRIES {
            let abreast = count > 1 && attempt < TRIES / 2;
            party.line_up(abreast);
            let tail = party.tail();
            let start = self.starts[draws.below(self.starts.len())];
            let Some(mut route) = self.route(start, if abreast { ABREAST } else { 0.0 }, draws) else {
                continue;
            };
            // Who pushes a pram waits so that it does not stand on the road.
            let ahead = 0.5 * (party.members[0].size[0] - 0.66).max(0.0);
            route.overs.iter_mut().for_each(|over| over.wait -= ahead);
            let length = route.path.length();
            let at = if t > -WARM_UP {
                tail
            } else {
                draws.between(tail, (length - 45.0).max(tail + 1.0))
            };
            let inside = |over: &Over| over.wait - 0.5 < at && at - tail < over.far + 0.5;
            if at > length - 5.0 || route.overs.iter().any(inside) {
                continue;
            }
            let start = Start {
                t,
                at,
                speed: party.speed,
                delay: draws.between(0.0, 1.2),
            };
            let until = self.ways.until;
            let leader = stroll(route.path.clone(), &route.overs, start, until, |over, t| {
                self.next_walk(over, t)
            });
            let courses: Option<Vec<Course>> = (party.members.iter())
                .map(|member| beside(&leader, member).map(Course::Moving))
                .collect();
            let Some(courses) = courses else { continue };
            if self.join(&party.members, courses) {
                for member in &party.members {
                    let behind = Motion {
                        ticks: leader.ticks.iter().map(|(s, v)| (s - member.back, *v)).collect(),
                        ..leader.clone()
                    };
                    let walked = (route.overs.iter().zip(&route.rightwards))
                        .flat_map(|(over, rightwards)| walked(&behind, *over, *rightwards));
                    self.walked.extend(walked);
                }
                break;
            }
        }
        count
    }

    /// Lets a group stand together on a pavement that is wide enough for others to pass.
    fn gather(&mut self, draws: &mut Stream) {
        const NARROWEST: f64 = 3.0;
        let members: Vec<Member> = Party::draw(draws, 1.0, 0.0).members;
        let network = self.ways.network;
        for _ in 0..12 {
            let node = &network.nodes[draws.below(network.nodes.len())];
            let (arm, side) = (draws.below(node.arms.len()), draws.below(2));
            let own = &node.arms[arm];
            let section = &network.roads[own.road].section;
            let on_road = if own.at_start { side } else { 1 - side };
            let width = section.pavement[on_road];
            let [from, to] = [own.mouth + 5.0, (own.out.length() - 30.0).min(75.0)];
            if width < NARROWEST || to < from {
                continue;
            }
            let kerb = section.half() + section.bay_depth(on_road);
            let free = [section.strip(on_road).map_or(0.4, |[_, to]| to + 0.45), width - 0.45];
            let along = draws.between(from, to);
            let turned = draws.between(0.0, TAU);
            // At the houses' side, as wide a ring as keeps them from touching.
            let mut radius = 0.3;
            let ring = |radius: f64| -> Vec<Pose2> {
                let across = kerb + free[1] - radius;
                let middle = node.place(arm, along, SIDES[side] * across);
                let pose = |k: usize| {
                    let heading = turned + TAU * k as f64 / members.len() as f64;
                    let on_ring = Pose2 { heading, ..middle }.at(-radius, 0.0);
                    Pose2 { heading, ..on_ring }
                };
                (0..members.len()).map(pose).collect()
            };
            while radius < 1.2 && collides(&members, &ring(radius)) {
                radius += 0.05;
            }
            // Where roads lie close to each other a pavement may end before its road does.
            let off_road = |pose: &Pose2| network.surface.off_road(pose.x, pose.y) > 0.4;
            let poses = ring(radius);
            let stands_free = |(pose, member): (&Pose2, &Member)| {
                let meets = |(thing, extent): &Footprint| touch(*pose, member.size, *thing, *extent);
                off_road(pose) && !self.ways.things.iter().any(meets)
            };
            if free[1] - 2.0 * radius < free[0]
                || collides(&members, &poses)
                || !poses.iter().zip(&members).all(stands_free)
            {
                continue;
            }
            let courses = poses.into_iter().map(Course::Fixed).collect();
            if self.join(&members, courses) {
                return;
            }
        }
    }

    /// Admits those who keep clear of all before and of each other.
    fn join(&mut self, members: &[Member], courses: Vec<Course>) -> bool {
        let places: Vec<_> = courses.iter().map(|course| self.places_of(course)).collect();
        let apart = |look: usize| {
            let there = members.iter().zip(&places).filter_map(|(member, places)| {
                let first = places.first()?.0;
                places.get(look.checked_sub(first)?).map(|(_, pose)| (member, *pose))
            });
            let there: Vec<(&Member, Pose2)> = there.collect();
            let pairs = there
                .iter()
                .enumerate()
                .flat_map(|(n, a)| there[n + 1..].iter().map(move |b| (a, b)));
            pairs.into_iter().all(|((a, p), (b, q))| !touch(*p, a.size, *q, b.size))
        };
        let clear = |(member, places): (&Member, &Vec<(usize, Pose2)>)| {
            let own = margin(member.class, member.size);
            places.iter().all(|(look, pose)| {
                self.places[*look].iter().all(|([x, y], theirs)| {
                    let (dx, dy, min) = (x - pose.x, y - pose.y, own + theirs);
                    dx * dx + dy * dy > min * min
                })
            })
        };
        if !(0..self.places.len()).all(apart) || !members.iter().zip(&places).all(clear) {
            return false;
        }
        for ((member, places), course) in members.iter().zip(places).zip(courses) {
            let margin = margin(member.class, member.size);
            for (look, pose) in places {
                self.places[look].push(([pose.x, pose.y], margin));
            }
            self.walkers.push(Walker {
                class: member.class,
                size: member.size,
                course,
            });
        }
        true
    }

    /// Where somebody is at each look.
    fn places_of(&self, course: &Course) -> Vec<(usize, Pose2)> {
        let at = |look: usize| {
            let state = course.at(look as f64 * LOOK - WARM_UP)?;
            Some((look, state.pose))
        };
        (0..self.places.len()).filter_map(at).collect()
    }

    fn next_walk(&self, crossing: usize, t: f64) -> f64 {
        let Zebra { node, arm } = self.ways.crossings[crossing];
        let phase = self.ways.network.nodes[node].arms[arm].phase;
        self.ways.signals[node]
            .as_ref()
            .map_or(t, |signals| signals.next_walk(phase, t))
    }

    fn track(&self, [node, arm, side]: [usize; 3], aside: f64, draws: &mut Stream) -> Option<Track> {
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
        let [low, high] = [band[0] + aside, band[1] - aside];
        (low < high).then(|| Track {
            node,
            arm,
            side,
            across: from + draws.between(low, high),
            aside,
        })
    }

    /// In along a pavement, then from node to node until the place ends, with room for somebody `aside` to both sides.
    fn route(&self, (node, arm, side): (usize, usize, usize), aside: f64, draws: &mut Stream) -> Option<Route> {
        let network = self.ways.network;
        let mut draft = Draft {
            points: Vec::new(),
            radius: 0.7 + 2.0 * aside,
            overs: Vec::new(),
        };
        let mut track = self.track([node, arm, side], aside, draws)?;
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
                        ..track
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

/// A path through points with rounded corners; `None` where the points lie so that it would turn back.
fn rounded(draft: Draft) -> Option<Route> {
    let Draft { points, radius, overs } = draft;
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
        *cut = (radius * libm::tan(0.5 * turn)).min(room);
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
    let rightwards = overs.iter().map(|(.., from_left)| *from_left).collect();
    let over = |(point, crossing, _): (usize, usize, bool)| Over {
        crossing,
        wait: at[point],
        far: at[point + 1],
    };
    let overs = overs.into_iter().map(over).collect();
    Some(Route {
        path,
        overs,
        rightwards,
    })
}

/// The motion of somebody beside the common way; `None` where it bends too sharply for him.
fn beside(leader: &Motion, member: &Member) -> Option<Motion> {
    /// Nobody is slowed down to less than this share in a bend.
    const LEAST: f64 = 0.3;
    let pieces: Vec<(f64, f64, f64)> = leader.path.pieces().collect();
    let scale = |curvature: f64| 1.0 - curvature * member.aside;
    if pieces
        .iter()
        .any(|(from, to, curvature)| to > from && scale(*curvature) < LEAST)
    {
        return None;
    }
    // Distances along his own way where the pieces begin.
    let mut own = vec![0.0];
    for (from, to, curvature) in &pieces {
        own.push(own[own.len() - 1] + (to - from) * scale(*curvature));
    }
    let ticks = leader.ticks.iter().map(|(s, v)| {
        let s = s - member.back;
        let k = pieces.partition_point(|(from, ..)| *from <= s).max(1) - 1;
        let (from, _, curvature) = pieces[k];
        (own[k] + (s - from) * scale(curvature), v * scale(curvature))
    });
    Some(Motion {
        path: leader.path.parallel(member.aside),
        first: leader.first,
        ticks: ticks.collect(),
    })
}

/// Whether two of some who stand touch.
fn collides(members: &[Member], poses: &[Pose2]) -> bool {
    let pairs = (0..poses.len()).flat_map(|i| (0..i).map(move |j| (i, j)));
    pairs
        .into_iter()
        .any(|(i, j)| touch(poses[i], members[i].size, poses[j], members[j].size))
}

/// When a walker takes up which quarter of a crossing.
fn walked(motion: &Motion, over: Over, rightwards: bool) -> Vec<Walked> {
    let last = motion.ticks[motion.ticks.len() - 1].0;
    if last < over.wait || motion.ticks[0].0 > over.far {
        return Vec::new();
    }
    let share = |q: usize| {
        let along = 0.25 * q as f64;
        if rightwards { along } else { 1.0 - along }
    };
    let all = quarters(motion, over).into_iter().enumerate().map(|(q, quarter)| {
        let (a, b) = (share(q), share(q + 1));
        Walked {
            crossing: over.crossing,
            share: [a.min(b), a.max(b)],
            from: quarter.from,
            until: quarter.until,
        }
    });
    all.filter(|walked| walked.from < walked.until).collect()
}
