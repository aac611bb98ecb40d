//! Everybody on the road: who there is, and where he is at any time.

mod following;
mod grid;
mod open;
mod walking;

use crate::bodies::Class;
use crate::options::Error;
use crate::path::{Course, Motion, Pose2, State};
use crate::place::{Plan, Scenery};
use crate::random::Stream;
use crate::solid::Solid;

/// One road user.
pub(crate) struct User {
    /// Identity over the whole log.
    pub track: u64,
    pub class: Class,
    /// Length, width, height, m.
    pub size: [f64; 3],
    pub solid: Solid,
    pub course: Course,
}

/// A vehicle and its motion, from when it came until it left.
struct Driven {
    /// Number of the vehicle in its simulation.
    number: u64,
    class: Class,
    size: [f64; 3],
    motion: Motion,
    /// The arm (on a grid) or the lane (on a network) by which it came first.
    came_by: usize,
}

/// All road users of a simulation.
pub(crate) struct Traffic {
    pub users: Vec<User>,
    /// Indices of the vehicles that are cav1 and cav2.
    pub cavs: [usize; 2],
}

/// Height of the ground and its slope along and across the heading, under somebody.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Footing {
    pub z: f64,
    pub slope: [f64; 2],
}

impl User {
    /// The ground under the user at a state.
    pub fn footing(&self, place: &Scenery, state: &State) -> Footing {
        footing(place, self.class, self.size, state.pose)
    }
}

/// Walkers stand upright on pavement and road; vehicles lie on the road's slope between their wheels.
pub(crate) fn footing(place: &Scenery, class: Class, size: [f64; 3], pose: Pose2) -> Footing {
    let Pose2 { x, y, heading } = pose;
    if class.walks() {
        return Footing {
            z: place.walk_height(x, y),
            slope: [0.0; 2],
        };
    }
    let (sin, cos) = libm::sincos(heading);
    let (base, track) = (0.3 * size[0], 0.4 * size[1]);
    let at = |u: f64, v: f64| place.road_height(x + u * cos - v * sin, y + u * sin + v * cos);
    let along = (at(base, 0.0) - at(-base, 0.0)) / (2.0 * base);
    let across = (at(0.0, track) - at(0.0, -track)) / (2.0 * track);
    Footing {
        z: at(0.0, 0.0),
        slope: [along, across],
    }
}

/// What the traffic of a simulation depends on.
pub(crate) struct Demand<'a> {
    pub place: &'a Scenery,
    pub seed: u64,
    pub dense: bool,
    /// Length of the log, s.
    pub seconds: f64,
    /// Whether bodies are rounded on a grid too.
    pub rounded_bodies: bool,
}

impl Traffic {
    /// Lets everybody go about until past the log's end.
    ///
    /// # Errors
    /// [`Error::NoRoom`] where no two cars can carry cav1 and cav2.
    pub fn new(demand: &Demand) -> Result<Self, Error> {
        let until = demand.seconds + 0.5;
        let crowd = match &demand.place.plan {
            Plan::Grid(roads) => grid::crowd(demand, roads, until),
            Plan::Network(network) => open::crowd(demand, network, until)?,
        };
        Ok(Self::assemble(crowd, demand, until))
    }

    /// Gives a body to everybody who meets nobody: on networks the rounded ones, on a grid if they are asked for.
    pub(crate) fn assemble(mut crowd: Vec<Arrival>, demand: &Demand, until: f64) -> Self {
        crowd.retain(|(_, _, _, course)| !over_before(course, -0.5));
        let kept = without_overlaps(crowd, until);
        let mut cavs = [0; 2];
        let mut users = Vec::with_capacity(kept.len());
        for (index, (cav, class, size, course)) in kept.into_iter().enumerate() {
            if let Some(cav) = cav {
                cavs[cav] = index;
            }
            let draws = |name| Stream::new(demand.seed, name, index as u64);
            let solid = match demand.place.is_network() || demand.rounded_bodies {
                true => class.shape(size, &mut draws("shape")),
                false => class.body(size, &mut draws("body")),
            };
            users.push(User {
                track: index as u64 + 1,
                class,
                size,
                solid,
                course,
            });
        }
        Traffic { users, cavs }
    }
}

/// Somebody before he is admitted: which cav he is, class, size, course.
type Arrival = (Option<usize>, Class, [f64; 3], Course);

fn over_before(course: &Course, t: f64) -> bool {
    match course {
        Course::Fixed(_) => false,
        Course::Moving(motion) => motion.first + motion.ticks.len() as f64 * crate::path::TICK < t,
    }
}

/// Leaves out whoever would touch somebody else at some time: a walker before a vehicle, the later before the
/// earlier, never a cav. Rare, because everybody already minds the others.
fn without_overlaps(crowd: Vec<Arrival>, until: f64) -> Vec<Arrival> {
    let mut out = vec![false; crowd.len()];
    let rank = |i: usize| (crowd[i].0.is_some(), !crowd[i].1.walks(), std::cmp::Reverse(i));
    for (i, j) in overlaps(&crowd, until) {
        if !out[i] && !out[j] {
            let loser = if rank(i) < rank(j) { i } else { j };
            out[loser] = true;
        }
    }
    let mut keep = out.iter().map(|out| !out);
    let mut crowd = crowd;
    crowd.retain(|_| keep.next().unwrap_or(true));
    crowd
}

/// Pairs that touch at some time, each with the first time's order.
fn overlaps(crowd: &[Arrival], until: f64) -> Vec<(usize, usize)> {
    /// No two bodies reach each other from farther apart, m.
    const REACH: f64 = 17.5;
    let steps = ((until + 0.5) / 0.1).ceil() as usize;
    let mut pairs = Vec::new();
    for k in 0..=steps {
        let t = k as f64 * 0.1 - 0.5;
        let mut there: Vec<(usize, Pose2, [f64; 3])> = crowd
            .iter()
            .enumerate()
            .filter_map(|(i, (_, _, size, course))| course.at(t).map(|state| (i, state.pose, *size)))
            .collect();
        there.sort_by(|a, b| a.1.x.total_cmp(&b.1.x));
        for (n, (i, a, size_a)) in there.iter().enumerate() {
            for (j, b, size_b) in there[n + 1..].iter().take_while(|other| other.1.x - a.x < REACH) {
                if touch(*a, *size_a, *b, *size_b) && !pairs.contains(&(*i.min(j), *i.max(j))) {
                    pairs.push((*i.min(j), *i.max(j)));
                }
            }
        }
    }
    pairs
}

/// Whether two footprints overlap (separating axes).
pub(crate) fn touch(a: Pose2, size_a: [f64; 3], b: Pose2, size_b: [f64; 3]) -> bool {
    let (dx, dy) = (b.x - a.x, b.y - a.y);
    let reach = |size: [f64; 3]| 0.5 * (size[0] * size[0] + size[1] * size[1]).sqrt();
    let sum = reach(size_a) + reach(size_b);
    if dx * dx + dy * dy > sum * sum {
        return false;
    }
    let (sin, cos) = libm::sincos(b.heading - a.heading);
    let (sin, cos) = (sin.abs(), cos.abs());
    let apart = |heading: f64, own: [f64; 3], other: [f64; 3]| {
        let (s, c) = libm::sincos(heading);
        let (along, across) = ((dx * c + dy * s).abs(), (dy * c - dx * s).abs());
        along > 0.5 * (own[0] + other[0] * cos + other[1] * sin)
            || across > 0.5 * (own[1] + other[0] * sin + other[1] * cos)
    };
    !apart(a.heading, size_a, size_b) && !apart(b.heading, size_b, size_a)
}
