//! Ways through the place: lines and arcs, and how somebody moves along one.

use std::f64::consts::TAU;

/// Seconds between the recorded steps of a motion.
pub(crate) const TICK: f64 = 0.1;

/// A point of a path or a pose in the ground plane; metres, radians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pose2 {
    pub x: f64,
    pub y: f64,
    pub heading: f64,
}

/// Lines and arcs that join smoothly.
#[derive(Clone, Debug)]
pub(crate) struct Path {
    stretches: Vec<Stretch>,
    length: f64,
}

#[derive(Clone, Copy, Debug)]
struct Stretch {
    start: f64,
    pose: Pose2,
    curvature: f64,
}

impl Stretch {
    fn at(&self, s: f64) -> Pose2 {
        let Pose2 { x, y, heading } = self.pose;
        let d = s - self.start;
        let (sin, cos) = libm::sincos(heading);
        if self.curvature == 0.0 {
            return Pose2 {
                x: x + d * cos,
                y: y + d * sin,
                heading,
            };
        }
        let turned = heading + self.curvature * d;
        let (sin1, cos1) = libm::sincos(turned);
        Pose2 {
            x: x + (sin1 - sin) / self.curvature,
            y: y - (cos1 - cos) / self.curvature,
            heading: turned,
        }
    }
}

impl Path {
    pub fn from(x: f64, y: f64, heading: f64) -> Self {
        let start = Stretch {
            start: 0.0,
            pose: Pose2 { x, y, heading },
            curvature: 0.0,
        };
        Path {
            stretches: vec![start],
            length: 0.0,
        }
    }

    pub fn length(&self) -> f64 {
        self.length
    }

    pub fn line(&mut self, length: f64) -> &mut Self {
        self.stretch(length, 0.0)
    }

    /// Turns by `angle` (left positive) on a circle of `radius`.
    pub fn arc(&mut self, radius: f64, angle: f64) -> &mut Self {
        self.stretch(
            radius * angle.abs(),
            if angle < 0.0 { -1.0 / radius } else { 1.0 / radius },
        )
    }

    fn stretch(&mut self, length: f64, curvature: f64) -> &mut Self {
        if length <= 0.0 {
            return self;
        }
        let mut pose = self.at(self.length).0;
        pose.heading -= TAU * (pose.heading / TAU).round();
        self.stretches.push(Stretch {
            start: self.length,
            pose,
            curvature,
        });
        self.length += length;
        self
    }

    /// Goes on with a path that begins where this one ends.
    pub fn append(&mut self, other: &Path) {
        let start = self.length;
        self.stretches.extend(other.stretches.iter().map(|s| Stretch {
            start: s.start + start,
            ..*s
        }));
        self.length += other.length;
    }

    /// Pose and curvature after `s` metres; the ends go on as they are.
    pub fn at(&self, s: f64) -> (Pose2, f64) {
        let next = self.stretches.partition_point(|stretch| stretch.start <= s);
        let stretch = &self.stretches[next.max(1) - 1];
        (stretch.at(s), stretch.curvature)
    }

    /// The arcs from `s` on: (start, radius).
    pub fn arcs_from(&self, s: f64) -> impl Iterator<Item = (f64, f64)> + '_ {
        let first = self.stretches.partition_point(|stretch| stretch.start <= s).max(1) - 1;
        let arcs = self.stretches[first..]
            .iter()
            .filter(|stretch| stretch.curvature != 0.0);
        arcs.map(|stretch| (stretch.start, 1.0 / stretch.curvature.abs()))
    }
}

/// Where somebody is, and how he moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct State {
    pub pose: Pose2,
    /// Along the heading, m/s.
    pub speed: f64,
    /// rad/s, left positive.
    pub turn_rate: f64,
    /// Metres gone since the motion began.
    pub gone: f64,
}

/// How somebody spends the time of the simulation.
#[derive(Clone, Debug)]
pub(crate) enum Course {
    /// Stays where he is.
    Fixed(Pose2),
    /// Moves along a path.
    Moving(Motion),
}

/// Distance and speed along a path at every tick.
#[derive(Clone, Debug)]
pub(crate) struct Motion {
    pub path: Path,
    /// Time of the first tick, s.
    pub first: f64,
    /// (distance, speed) at each tick; at least one.
    pub ticks: Vec<(f64, f64)>,
}

impl Motion {
    fn last(&self) -> f64 {
        self.first + (self.ticks.len() - 1) as f64 * TICK
    }

    fn state(&self, t: f64) -> State {
        let at = ((t - self.first) / TICK).max(0.0);
        let k = (at as usize).min(self.ticks.len().saturating_sub(2));
        let (s, v) = match self.ticks.get(k..k + 2) {
            Some([from, to]) => hermite(*from, *to, at - k as f64),
            _ => self.ticks[0],
        };
        let (pose, curvature) = self.path.at(s);
        State {
            pose,
            speed: v,
            turn_rate: v * curvature,
            gone: s,
        }
    }
}

/// Distance and speed at a share of a tick; exact where the acceleration is constant.
fn hermite((s0, v0): (f64, f64), (s1, v1): (f64, f64), u: f64) -> (f64, f64) {
    let d = s1 - s0;
    let (a, b) = (v0 * TICK, v1 * TICK);
    let (c2, c3) = (3.0 * d - 2.0 * a - b, a + b - 2.0 * d);
    (
        s0 + u * (a + u * (c2 + u * c3)),
        (a + u * (2.0 * c2 + 3.0 * u * c3)) / TICK,
    )
}

impl Course {
    /// The state at `t` seconds; `None` before he comes and after he has left.
    pub fn at(&self, t: f64) -> Option<State> {
        match self {
            Course::Fixed(pose) => Some(State {
                pose: *pose,
                speed: 0.0,
                turn_rate: 0.0,
                gone: 0.0,
            }),
            Course::Moving(motion) => {
                let there = t >= motion.first - 1e-9 && t <= motion.last() + 1e-9;
                there.then(|| motion.state(t))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::{FRAC_PI_2, PI};

    #[test]
    fn right_turn_ends_where_geometry_says() {
        let mut path = Path::from(-10.0, 0.0, 0.0);
        path.line(10.0).arc(5.0, -FRAC_PI_2).line(2.0);
        let (end, curvature) = path.at(path.length());
        assert!(
            (end.x - 5.0).abs() < 1e-12 && (end.y + 7.0).abs() < 1e-12 && curvature == 0.0,
            "{end:?}"
        );
        assert_eq!(path.arcs_from(0.0).collect::<Vec<_>>(), [(10.0, 5.0)]);
    }

    #[test]
    fn speed_is_the_derivative_of_distance() {
        let mut path = Path::from(0.0, 0.0, 1.0);
        path.line(3.0).arc(4.0, PI).line(50.0);
        let ticks: Vec<_> = (0..40).map(|k| f64::from(k) * TICK).map(|t| (t * t, 2.0 * t)).collect();
        let course = Course::Moving(Motion {
            path,
            first: 1.0,
            ticks,
        });
        assert_eq!(course.at(0.9), None);
        for t in [1.05, 2.33, 3.71, 4.2] {
            let [before, now, after] = [t - 1e-5, t, t + 1e-5].map(|t| course.at(t).unwrap());
            let moved = (
                (after.pose.x - before.pose.x) / 2e-5,
                (after.pose.y - before.pose.y) / 2e-5,
            );
            assert!((moved.0 - now.speed * libm::cos(now.pose.heading)).abs() < 1e-6);
            assert!((moved.1 - now.speed * libm::sin(now.pose.heading)).abs() < 1e-6);
            let turned = (after.pose.heading - before.pose.heading) / 2e-5;
            assert!((turned - now.turn_rate).abs() < 1e-6);
            assert!((now.speed - 2.0 * (t - 1.0)).abs() < 1e-9);
        }
    }
}
