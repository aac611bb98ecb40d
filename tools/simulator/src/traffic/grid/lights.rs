//! The traffic lights: a fixed cycle in which the axes take turns. At the junction, each axis' green is followed by an
//! arrow for those who turn left.

use crate::place::Grid;
use crate::random::Stream;

const YELLOW: f64 = 3.0;
const ALL_RED: f64 = 3.0;
/// How long nobody sets out any more before the arrow's end counts as red.
const ARROW_YELLOW: f64 = 2.0;
/// Walkers set out from this long after the green of the parallel axis, for at most `WALK`.
const WALK_FROM: f64 = 2.0;
const WALK: f64 = 4.5;

/// What an axis' lights show.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Light {
    Green,
    Yellow,
    Red,
}

/// The plan that all lights of the place follow.
#[derive(Clone, Debug)]
pub(crate) struct Lights {
    green: [f64; 2],
    /// Length of the arrows for those who turn left, 0 for none.
    arrow: f64,
    offset: f64,
}

impl Lights {
    pub fn new(grid: Grid, seed: u64) -> Self {
        let (green, arrow) = match grid {
            Grid::Intersection => ([18.0, 16.0], 6.0),
            Grid::Corridor => ([24.0, 18.0], 0.0),
        };
        let mut lights = Lights {
            green,
            arrow,
            offset: 0.0,
        };
        lights.offset = Stream::new(seed, "lights", 0).between(0.0, lights.cycle());
        lights
    }

    fn cycle(&self) -> f64 {
        self.share(0) + self.share(1)
    }

    /// What an axis takes of the cycle, until the other's green.
    fn share(&self, axis: usize) -> f64 {
        let arrow = if self.arrow > 0.0 {
            self.arrow + ARROW_YELLOW
        } else {
            0.0
        };
        self.green[axis] + YELLOW + arrow + ALL_RED
    }

    /// Time since the last green of an axis began.
    fn since_green(&self, axis: usize, t: f64) -> f64 {
        let start = if axis == 0 { 0.0 } else { self.share(0) };
        (t + self.offset - start).rem_euclid(self.cycle())
    }

    pub fn show(&self, axis: usize, t: f64) -> Light {
        match self.since_green(axis, t) {
            since if since < self.green[axis] => Light::Green,
            since if since < self.green[axis] + YELLOW => Light::Yellow,
            _ => Light::Red,
        }
    }

    /// Whether an axis' arrow lets those go who turn left.
    pub fn arrow(&self, axis: usize, t: f64) -> bool {
        let since = self.since_green(axis, t) - self.green[axis] - YELLOW;
        (0.0..self.arrow).contains(&since)
    }

    /// Whether those who pass a red light at `t` can have set out by the arrow.
    #[cfg(test)]
    pub fn arrow_or_its_yellow(&self, axis: usize, t: f64) -> bool {
        self.arrow(axis, t) || self.arrow(axis, t - ARROW_YELLOW)
    }

    /// The earliest time from `t` on at which somebody may set out across a road of `axis`.
    pub fn next_walk(&self, axis: usize, t: f64) -> f64 {
        let since = self.since_green(1 - axis, t);
        match since {
            _ if since < WALK_FROM => t + WALK_FROM - since,
            _ if since < WALK_FROM + WALK => t,
            _ => t + self.cycle() + WALK_FROM - since,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_are_never_open_together_and_walkers_cross_at_red() {
        let lights = Lights::new(Grid::Intersection, 3);
        for k in 0..2000 {
            let t = f64::from(k) * 0.1;
            assert!(lights.show(0, t) == Light::Red || lights.show(1, t) == Light::Red);
            for axis in [0, 1] {
                let walk = lights.next_walk(axis, t);
                assert!(walk >= t && walk < t + 60.0);
                for later in [0.0, 5.0, 12.0] {
                    assert_eq!(lights.show(axis, walk + later), Light::Red);
                }
            }
        }
    }
}
