//! Everybody on foot: along the pavements, around corners and over the crossings when they may.

use super::lights::Lights;
use super::vehicles::Crossing;
use super::zones::Zone;
use crate::path::{Course, Motion, Path};
use crate::place::{Grid, REACH, Roads};
use crate::random::Stream;
use crate::traffic::walking::{APART, Gait, Over, Start, WAIT, WARM_UP, Walker, admit_all, quarters, stroll};

/// Between this and that from the kerb people walk along a road, m.
const BAND: [f64; 2] = [3.6, 6.0];

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
    admit_all(seed, count, until, |draws, t| {
        crowd.admit(draws, t);
        1
    });
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

impl Crowd<'_> {
    /// Finds a way for one more that keeps clear of all before; gives up after some tries.
    fn admit(&mut self, draws: &mut Stream, t: f64) {
        let Gait { class, size, speed } = Gait::draw(draws);
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
            let start = Start {
                t,
                at: start,
                speed,
                delay,
            };
            let lights = self.lights;
            let motion = stroll(route.path, route.crossing.as_slice(), start, self.until, |axis, t| {
                lights.next_walk(axis, t)
            });
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
        crossing: axis,
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
    let crossing = |quarter: crate::traffic::walking::Quarter| {
        let [from, to] = quarter.along;
        Crossing {
            zone: Zone::along(&motion.path, from, to, 0.9),
            from: quarter.from,
            until: quarter.until,
        }
    };
    let all = quarters(motion, over).map(crossing).into_iter();
    all.filter(|crossing| crossing.from < crossing.until).collect()
}
