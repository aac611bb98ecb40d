//! What a sensor makes of a hit.

use super::{NOTHING, SOMETHING};
use crate::cast::round;
use crate::random::{mix, normal_of, unit_of};
use crate::sensor::Optics;
use crate::solid::Hit;

/// What came back of a ray.
#[derive(Clone, Copy)]
pub(crate) struct Return {
    /// m; negative for nothing.
    pub range: f64,
    pub intensity: u8,
    pub(super) met: u32,
}

impl Return {
    pub const NONE: Return = Return {
        range: -1.0,
        intensity: 0,
        met: NOTHING,
    };

    /// Index of the road user that was met.
    pub fn user(&self) -> Option<u32> {
        self.met.checked_sub(SOMETHING + 1)
    }
}

/// Range and intensity of what comes back; `None` if nothing is seen.
#[inline]
pub(super) fn receive(optics: &Optics, hit: &Hit, hash: u64) -> Option<(f64, u8)> {
    let ratio = optics.reference_range / hit.t;
    let mut q = optics.strength * hit.rho * hit.cos * ratio * ratio;
    if optics.extinction > 0.0 {
        q *= libm::exp(-2.0 * optics.extinction * hit.t);
    }
    let q4 = q * q * q * q;
    if unit_of(hash) * (q4 + 1.0) >= q4 * (1.0 - optics.unanswered) {
        return None;
    }
    let scatter = (optics.noise_floor + optics.noise_slope / q.sqrt()).min(optics.noise_ceiling);
    let range = hit.t + scatter * normal_of(mix(hash));
    let range = round(range * optics.steps_per_metre) * optics.step;
    if range < optics.nearest || range > optics.farthest {
        return None;
    }
    // Calibrated for range: 100 stands for a white wall met squarely, more for retro-reflectors.
    let shimmer = (hash & 0x3ff) as f64 * (0.06 / 1024.0);
    Some((range, (100.0 * hit.rho * hit.cos * (0.97 + shimmer)).min(255.0) as u8))
}
