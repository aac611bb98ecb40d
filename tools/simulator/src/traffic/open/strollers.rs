//! Everybody on foot on a network: along the pavements, around corners, over the crossings, alone, in groups and with
//! prams; and groups that stand.

mod corners;
mod party;
mod route;

use std::f64::consts::TAU;

use super::Footprint;
use super::flow::Walked;
use super::lanes::Zebra;
use super::signals::Signals;
use crate::path::{Course, Motion, Pose2};
use crate::place::{Network, SIDES};
use crate::random::Stream;
use crate::traffic::touch;
use crate::traffic::walking::{Over, Start, WARM_UP, Walker, admit_all, quarters, stroll};
use party::{ABREAST, Member, Party, beside, collides, margin};

/// Seconds between the looks at whether two come too close.
const LOOK: f64 = 0.2;

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
