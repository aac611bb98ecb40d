//! What walkers of all places have in common: who they are, when they come, how they go along a way.

use crate::bodies::Class;
use crate::path::{Course, Motion, Path, TICK};
use crate::random::Stream;

/// Seconds walked before the log begins.
pub(super) const WARM_UP: f64 = 25.0;
/// Nobody's middle comes closer to another's than this, m.
pub(super) const APART: f64 = 0.95;
/// Distance from the kerb at which one waits, m.
pub(super) const WAIT: f64 = 0.7;

/// Somebody on foot.
pub(super) struct Walker {
    pub class: Class,
    pub size: [f64; 3],
    pub course: Course,
}

/// Somebody who is about to walk.
pub(super) struct Gait {
    pub class: Class,
    pub size: [f64; 3],
    /// m/s, where nothing is in the way.
    pub speed: f64,
}

impl Gait {
    pub fn draw(draws: &mut Stream) -> Self {
        let class = if draws.chance(0.1) {
            Class::Child
        } else {
            Class::Pedestrian
        };
        let size = class.size(draws);
        let speed = draws.normal_in(1.32, 0.18, 1.05, 1.8);
        Gait { class, size, speed }
    }
}

/// Lets walkers in, each with its own draws and the time from which it walks: `count` at the begin, and later at the ends
/// of the roads about as many as leave there. `admit` reports how many came at once.
pub(super) fn admit_all(seed: u64, count: usize, until: f64, mut admit: impl FnMut(&mut Stream, f64) -> usize) {
    let (mut index, mut here) = (0, 0);
    while here < count {
        here += admit(&mut Stream::new(seed, "walker", index), -WARM_UP);
        index += 1;
    }
    let mut arrivals = Stream::new(seed, "walker-arrivals", 0);
    let pause = 160.0 / count as f64;
    let mut t = -WARM_UP + arrivals.exponential(pause);
    while t < until {
        let came = admit(&mut Stream::new(seed, "walker", index), t);
        for _ in 0..came {
            t += arrivals.exponential(pause);
        }
        index += 1;
    }
}

/// A crossing on the way.
#[derive(Clone, Copy)]
pub(super) struct Over {
    /// Number of the crossing, or on a grid the axis of its road.
    pub crossing: usize,
    /// Distances along the way of the waiting point and the far kerb, m.
    pub wait: f64,
    pub far: f64,
}

/// How somebody sets out.
#[derive(Clone, Copy)]
pub(super) struct Start {
    /// When, s.
    pub t: f64,
    /// Where on the way, m.
    pub at: f64,
    /// m/s.
    pub speed: f64,
    /// How long he hesitates when he may go, s.
    pub delay: f64,
}

/// Walks a way tick by tick until its end or until `until`, and waits at kerbs while one may not cross. `next_walk`: the
/// earliest time from a given one on at which one may set out over a crossing.
pub(super) fn stroll(
    path: Path,
    overs: &[Over],
    start: Start,
    until: f64,
    next_walk: impl Fn(usize, f64) -> f64,
) -> Motion {
    const BRAKE: f64 = 1.2;
    let Start { t: first, speed, .. } = start;
    let (mut t, mut s, mut v) = (first, start.at, speed);
    let mut ticks = Vec::new();
    let mut ahead: Vec<Over> = overs.iter().copied().filter(|over| over.wait > s).rev().collect();
    let mut go_at = None::<f64>;
    while t <= until + TICK && s < path.length() {
        ticks.push((s, v));
        let mut wanted = speed;
        if let Some(over) = ahead.last().copied() {
            let left = over.wait - s;
            let arrival = t + left / v.max(0.6);
            let go = next_walk(over.crossing, arrival);
            if left < 0.1 && go_at.is_none() && go > t + 0.2 {
                go_at = Some(go + start.delay);
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
    Motion { path, first, ticks }
}

/// A quarter of a crossing that a walker takes up for some time.
pub(super) struct Quarter {
    /// From where to where along his way, m.
    pub along: [f64; 2],
    pub from: f64,
    pub until: f64,
}

/// When a walker takes up which quarter of a crossing; who still waits takes up nothing.
pub(super) fn quarters(motion: &Motion, over: Over) -> [Quarter; 4] {
    let time_at = |s: f64| {
        let k = motion.ticks.partition_point(|(at, _)| *at < s);
        motion.first + k as f64 * TICK
    };
    let leaves = over.wait + 0.15;
    let cut = |q: usize| over.wait + 0.3 + q as f64 * 0.25 * (over.far - over.wait - 0.3);
    [0, 1, 2, 3].map(|quarter| {
        let along = [cut(quarter), cut(quarter + 1)];
        Quarter {
            along,
            from: time_at((along[0] - 0.9).max(leaves)),
            until: time_at(along[1] + 0.9),
        }
    })
}
