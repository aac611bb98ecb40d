//! Everybody on foot: along the pavements, around corners and over the crossings when they may.

use super::lights::Lights;
use super::vehicles::Crossing;
use super::zones::Zone;
use crate::bodies::Class;
use crate::path::{Course, Motion, Path, TICK};
use crate::place::{Grid, REACH, Roads};
use crate::random::Stream;

/// Seconds walked before the log begins.
const WARM_UP: f64 = 25.0;
/// Nobody's middle comes closer to another's than this, m.
const APART: f64 = 0.95;
/// Distance from the kerb at which one waits, m.
const WAIT: f64 = 0.7;
/// Between this and that from the kerb people walk along a road, m.
const BAND: [f64; 2] = [3.6, 6.0];

/// Somebody on foot.
pub(crate) struct Walker {
    pub class: Class,
    pub size: [f64; 3],
    pub course: Course,
}

/// Walkers, and when they take up which part of the junction.
pub(crate) fn walk(roads: &Roads, lights: &Lights, seed: u64, dense: bool, until: f64) -> (Vec<Walker>, Vec<Crossing>) {
    let mut crowd = Crowd {
        roads,
        lights,
        until,
        walkers: Vec::new(),
        crossings: Vec::new(),
    };
    let count = if dense { 54 } else { 18 };
    for index in 0..count {
        crowd.admit(&mut Stream::new(seed, "walker", index), -WARM_UP);
    }
    // Later ones come in at the ends of the roads, as many as leave there.
    let mut arrivals = Stream::new(seed, "walker-arrivals", 0);
    let pause = 160.0 / count as f64;
    let mut t = -WARM_UP + arrivals.exponential(pause);
    let mut index = count;
    while t < until {
        crowd.admit(&mut Stream::new(seed, "walker", index), t);
        t += arrivals.exponential(pause);
        index += 1;
    }
    (crowd.walkers, crowd.crossings)
}

struct Crowd<'a> {
    roads: &'a Roads,
    lights: &'a Lights,
    until: f64,
    walkers: Vec<Walker>,
    crossings: Vec<Crossing>,
}

/// A way on foot: its path, and where along it a road is crossed.
struct Route {
    path: Path,
    /// Distance at which it is nearest to the centre.
    middle: f64,
    crossing: Option<Over>,
}

/// A crossing on the way: the road's axis, and the distances of waiting point and far kerb.
#[derive(Clone, Copy)]
struct Over {
    axis: usize,
    wait: f64,
    far: f64,
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
            let route = self.route(draws);
            let start = if t > -WARM_UP {
                0.0
            } else {
                route.middle + draws.between(-100.0, 45.0)
            };
            let inside = route
                .crossing
                .is_some_and(|over| (over.wait - 0.5..over.far + 0.5).contains(&start));
            if start < 0.0 || start > route.path.length() - 5.0 || inside {
                continue;
            }
            let delay = draws.between(0.0, 1.2);
            let motion = self.stroll(route.path, route.crossing, t, start, speed, delay);
            let crossings = route.crossing.map(|over| crossings(&motion, over)).unwrap_or_default();
            let course = Course::Moving(motion);
            if self.clear(&course, t) {
                self.walkers.push(Walker { class, size, course });
                self.crossings.extend(crossings);
                return;
            }
        }
    }

    fn clear(&self, course: &Course, from: f64) -> bool {
        let steps = ((self.until - from) / 0.2).ceil() as usize;
        (0..=steps).map(|k| from + k as f64 * 0.2).all(|t| {
            let Some(own) = course.at(t) else { return true };
            self.walkers
                .iter()
                .filter_map(|walker| walker.course.at(t))
                .all(|other| {
                    let (dx, dy) = (other.pose.x - own.pose.x, other.pose.y - own.pose.y);
                    dx * dx + dy * dy > APART * APART
                })
        })
    }

    /// Walks a route tick by tick and waits at the kerb while one may not cross.
    fn stroll(&self, path: Path, over: Option<Over>, first: f64, start: f64, speed: f64, delay: f64) -> Motion {
        const BRAKE: f64 = 1.2;
        let (mut t, mut s, mut v) = (first, start, speed);
        let mut ticks = Vec::new();
        let mut waits = over.filter(|over| over.wait > start);
        let mut go_at = None::<f64>;
        while t <= self.until + TICK && s < path.length() {
            ticks.push((s, v));
            let mut wanted = speed;
            if let Some(over) = waits {
                let left = over.wait - s;
                let arrival = t + left / v.max(0.6);
                let go = self.lights.next_walk(over.axis, arrival);
                if left < 0.1 && go_at.is_none() && go > t + 0.2 {
                    go_at = Some(go + delay);
                }
                let free = go_at.map_or(go <= arrival + 0.01, |go| t >= go);
                if free && left < 0.2 {
                    waits = None;
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

    fn route(&self, draws: &mut Stream) -> Route {
        match self.roads.grid {
            Grid::Intersection => self.route_at_junction(draws),
            Grid::Corridor => self.route_along(draws),
        }
    }

    /// In from the end of one road, then around the corner or over one of the two crossings, then out.
    fn route_at_junction(&self, draws: &mut Stream) -> Route {
        let axis = draws.below(2);
        let mut sign = || if draws.chance(0.5) { 1.0 } else { -1.0 };
        let (ahead, aside) = (sign(), sign());
        let action = draws.unit();
        let half = self.roads.half;
        // (u, v): along and across the road of `axis`, both positive in the quadrant where the way begins.
        let place = |u: f64, v: f64| {
            if axis == 0 {
                [ahead * u, aside * v]
            } else {
                [aside * v, ahead * u]
            }
        };
        let track = half[axis] + draws.between(BAND[0], BAND[1]);
        let other = half[1 - axis] + draws.between(BAND[0], BAND[1]);
        let end = REACH - 4.0;
        if action < 0.35 {
            return rounded(&[place(end, track), place(other, track), place(other, end)], 1, None);
        }
        let shift = draws.between(-0.75, 1.05);
        if action < 0.7 {
            // Over the road that one walks along, on the right-hand half of the crossing, then straight on or out.
            let u = self.roads.crossing(axis).0 + shift;
            let kerb = half[axis];
            let mut points = vec![
                place(end, track),
                place(u, track),
                place(u, kerb + WAIT),
                place(u, -kerb - 0.4),
            ];
            if draws.chance(0.5) {
                points.push(place(u, -end));
            } else {
                let back = half[axis] + draws.between(BAND[0], BAND[1]);
                points.extend([place(u, -back), place(end, -back)]);
            }
            return rounded(&points, 2, Some(axis));
        }
        // Straight on, over the other road.
        let v = self.roads.crossing(1 - axis).0 + shift.max(-0.3);
        let kerb = half[1 - axis];
        let points = [
            place(end, v),
            place(kerb + WAIT, v),
            place(-kerb - 0.4, v),
            place(-end, v),
        ];
        rounded(&points, 1, Some(1 - axis))
    }

    fn route_along(&self, draws: &mut Stream) -> Route {
        let mut sign = || if draws.chance(0.5) { 1.0 } else { -1.0 };
        let (ahead, aside) = (sign(), sign());
        let crosses = draws.chance(0.45);
        let kerb = self.roads.half[0];
        let track = kerb + draws.between(BAND[0], BAND[1]);
        let end = REACH - 4.0;
        let place = |u: f64, v: f64| [ahead * u, aside * v];
        if !crosses {
            return rounded(&[place(end, track), place(0.0, track), place(-end, track)], 1, None);
        }
        let u = draws.between(-1.25, 1.25);
        let back = kerb + draws.between(BAND[0], BAND[1]);
        let out = if draws.chance(0.5) { end } else { -end };
        let over = [place(u, kerb + WAIT), place(u, -kerb - 0.4)];
        let points = [
            place(end, track),
            place(u, track),
            over[0],
            over[1],
            place(u, -back),
            place(out, -back),
        ];
        rounded(&points, 2, Some(0))
    }
}

/// A path through points with rounded corners. `middle`: the point nearest the centre; if a road of `axis` is
/// crossed, that is where one waits, and the point after it is the far kerb.
fn rounded(points: &[[f64; 2]], middle: usize, axis: Option<usize>) -> Route {
    const RADIUS: f64 = 0.7;
    let heading = |i: usize| libm::atan2(points[i + 1][1] - points[i][1], points[i + 1][0] - points[i][0]);
    let distance = |i: usize| {
        let (dx, dy) = (points[i + 1][0] - points[i][0], points[i + 1][1] - points[i][1]);
        (dx * dx + dy * dy).sqrt()
    };
    let mut path = Path::from(points[0][0], points[0][1], heading(0));
    let mut at = vec![0.0];
    let mut cut = 0.0;
    for i in 0..points.len() - 1 {
        let turn = if i + 2 < points.len() {
            heading(i + 1) - heading(i)
        } else {
            0.0
        };
        let turn = turn - std::f64::consts::TAU * (turn / std::f64::consts::TAU).round();
        let next_cut = if turn.abs() < 1e-9 {
            0.0
        } else {
            RADIUS * libm::tan(turn.abs() / 2.0)
        };
        path.line(distance(i) - cut - next_cut);
        if next_cut > 0.0 {
            path.arc(RADIUS, turn);
        }
        at.push(path.length());
        cut = next_cut;
    }
    let crossing = axis.map(|axis| Over {
        axis,
        wait: at[middle],
        far: at[middle + 1],
    });
    Route {
        path,
        middle: at[middle],
        crossing,
    }
}

/// When a walker takes up which quarter of his crossing.
fn crossings(motion: &Motion, over: Over) -> Vec<Crossing> {
    let time_at = |s: f64| {
        let k = motion.ticks.partition_point(|(at, _)| *at < s);
        motion.first + k as f64 * TICK
    };
    // Who still waits takes up nothing.
    let leaves = over.wait + 0.15;
    (0..4)
        .map(|quarter| {
            let cut = |q: i32| over.wait + 0.3 + f64::from(q) * 0.25 * (over.far - over.wait - 0.3);
            let (from, to) = (cut(quarter), cut(quarter + 1));
            let zone = Zone::along(&motion.path, from, to, 0.9);
            Crossing {
                zone,
                from: time_at((from - 0.9).max(leaves)),
                until: time_at(to + 0.9),
            }
        })
        .filter(|crossing| crossing.from < crossing.until)
        .collect()
}
