//! Motion along a path in time.

use super::{Path, Pose2, TICK};

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

    /// The state at `t` seconds; `None` before the first tick and after the last.
    pub fn at(&self, t: f64) -> Option<State> {
        let there = t >= self.first - 1e-9 && t <= self.last() + 1e-9;
        there.then(|| self.state(t))
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
            Course::Moving(motion) => motion.at(t),
        }
    }
}
