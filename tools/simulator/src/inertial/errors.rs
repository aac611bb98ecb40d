//! How sensors err.

use realo_state_estimation::{Inertial, Receiver};

use super::Sky;
use crate::random::Stream;

/// Samples of an inertial unit a second.
pub(super) const IMU_HZ: f64 = 100.0;
/// Positions of a receiver a second.
const FIX_HZ: f64 = 10.0;

/// A first-order Gauss-Markov walk.
#[derive(Clone, Copy, Debug)]
struct Walk {
    value: f64,
    deviation: f64,
    keep: f64,
}

impl Walk {
    fn new(deviation: f64, correlation_s: f64, hz: f64, draws: &mut Stream) -> Self {
        Walk {
            value: deviation * draws.normal(),
            deviation,
            keep: libm::exp(-1.0 / (hz * correlation_s)),
        }
    }

    fn next(&mut self, draws: &mut Stream) -> f64 {
        let step = self.deviation * (1.0 - self.keep * self.keep).sqrt();
        self.value = self.keep * self.value + step * draws.normal();
        self.value
    }
}

/// The errors of three inertial sensors: a bias that is there from the start, one that wanders, scale, noise and range.
pub(super) struct Bias {
    of: Inertial,
    draws: Stream,
    turn_on: [f64; 3],
    scale: [f64; 3],
    walks: [Walk; 3],
    exact: bool,
}

impl Bias {
    pub fn new(of: Inertial, mut draws: Stream, exact: bool) -> Self {
        Bias {
            turn_on: [(); 3].map(|()| of.turn_on * draws.normal()),
            scale: [(); 3].map(|()| 1.0 + of.scale * draws.normal()),
            walks: [(); 3].map(|()| Walk::new(of.in_run, of.correlation_s, IMU_HZ, &mut draws)),
            of,
            draws,
            exact,
        }
    }

    /// What is read of true values.
    pub fn next(&mut self, truth: [f64; 3]) -> [f64; 3] {
        let white = self.of.white * IMU_HZ.sqrt();
        let errors: [f64; 3] = std::array::from_fn(|axis| {
            let wandering = self.walks[axis].next(&mut self.draws);
            self.turn_on[axis] + wandering + white * self.draws.normal()
        });
        let range = self.of.range;
        std::array::from_fn(|axis| match self.exact {
            true => truth[axis],
            false => (self.scale[axis] * truth[axis] + errors[axis]).clamp(-range, range),
        })
    }
}

/// The error of a position under an open sky: most of its variance wanders, the rest is white.
pub(super) struct Wandering {
    deviation: [f64; 3],
    /// Share of the variance that wanders.
    share: f64,
    draws: Stream,
    walks: [Walk; 3],
    exact: bool,
}

impl Wandering {
    pub fn new(of: &Receiver, mut draws: Stream, exact: bool) -> Self {
        let (deviation, share) = (of.deviation_m, of.wander_share);
        Wandering {
            walks: deviation.map(|axis| Walk::new(share.sqrt() * axis, of.wander_s, FIX_HZ, &mut draws)),
            deviation,
            share,
            draws,
            exact,
        }
    }

    pub fn next(&mut self) -> [f64; 3] {
        let white = (1.0 - self.share).sqrt();
        let error: [f64; 3] = std::array::from_fn(|axis| {
            let wandering = self.walks[axis].next(&mut self.draws);
            wandering + white * self.deviation[axis] * self.draws.normal()
        });
        if self.exact { [0.0; 3] } else { error }
    }
}

/// Jumps of positions between buildings, where signals come by detours; each is the same while it lasts.
pub(super) struct Multipath {
    of: Receiver,
    draws: Stream,
    jump: [f64; 3],
    /// Positions until it ends, or until the next begins.
    left: f64,
    jumps: bool,
    exact: bool,
}

impl Multipath {
    pub fn new(of: Receiver, mut draws: Stream, exact: bool) -> Self {
        Multipath {
            left: FIX_HZ * draws.exponential(of.multipath_every_s),
            of,
            draws,
            jump: [0.0; 3],
            jumps: false,
            exact,
        }
    }

    /// The jump under a sky; there is none under an open one.
    pub fn next(&mut self, sky: Sky) -> [f64; 3] {
        self.left -= 1.0;
        if self.left < 0.0 {
            self.jumps = !self.jumps;
            let mean = if self.jumps {
                self.of.multipath_lasts_s
            } else {
                self.of.multipath_every_s
            };
            self.left = FIX_HZ * self.draws.exponential(mean);
            self.jump = [(); 3].map(|()| self.of.multipath_m * self.draws.normal());
        }
        match sky {
            Sky::Narrow if self.jumps && !self.exact => self.jump,
            _ => [0.0; 3],
        }
    }
}
