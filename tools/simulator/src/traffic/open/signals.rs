//! Traffic lights: the phases of a node take turns in a fixed cycle.

use crate::random::Stream;

const GREEN: [f64; 2] = [17.0, 13.0];
const YELLOW: f64 = 3.0;
const ALL_RED: f64 = 3.0;
/// Walkers set out from this long after the green of another phase began, for at most `WALK`.
const WALK_FROM: f64 = 1.5;
const WALK: f64 = 5.0;

/// The plan that the lights of a node with two phases follow.
#[derive(Clone, Debug)]
pub(super) struct Signals {
    offset: f64,
}

impl Signals {
    pub fn new(seed: u64, node: usize) -> Self {
        Signals {
            offset: Stream::new(seed, "signals", node as u64).between(0.0, Self::cycle()),
        }
    }

    fn cycle() -> f64 {
        GREEN.iter().map(|green| green + YELLOW + ALL_RED).sum()
    }

    /// Time since the last green of a phase began.
    fn since_green(&self, phase: usize, t: f64) -> f64 {
        let start = if phase == 0 { 0.0 } else { GREEN[0] + YELLOW + ALL_RED };
        (t + self.offset - start).rem_euclid(Self::cycle())
    }

    /// Whether one may set out.
    pub fn green(&self, phase: usize, t: f64) -> bool {
        self.since_green(phase, t) < GREEN[phase]
    }

    /// Whether one may pass, having set out in time.
    #[cfg(test)]
    pub fn green_or_yellow(&self, phase: usize, t: f64) -> bool {
        self.since_green(phase, t) < GREEN[phase] + YELLOW
    }

    /// The earliest time from `t` on at which somebody may set out across an arm of a phase.
    pub fn next_walk(&self, phase: usize, t: f64) -> f64 {
        let since = self.since_green(1 - phase, t);
        match since {
            _ if since < WALK_FROM => t + WALK_FROM - since,
            _ if since < WALK_FROM + WALK => t,
            _ => t + Self::cycle() + WALK_FROM - since,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn phases_are_never_open_together_and_walkers_set_out_at_red() {
        let signals = Signals::new(3, 0);
        for k in 0..2000 {
            let t = f64::from(k) * 0.1;
            assert!(!signals.green_or_yellow(0, t) || !signals.green_or_yellow(1, t));
            for phase in [0, 1] {
                let walk = signals.next_walk(phase, t);
                assert!(walk >= t - 1e-9 && walk < t + 60.0);
                assert!(!signals.green_or_yellow(phase, walk) && !signals.green_or_yellow(phase, walk + 5.0));
            }
        }
    }
}
