//! Car following: the Intelligent Driver Model (Treiber, Hennecke and Helbing 2000), the same on every road.

use crate::path::TICK;

/// Seconds simulated before the log begins.
pub(super) const WARM_UP: f64 = 45.0;
/// What comfort allows in braking and in curves, m/s².
pub(super) const BRAKE: f64 = 2.0;
pub(super) const ASIDE: f64 = 2.6;
/// Hardest braking, m/s².
pub(super) const EMERGENCY: f64 = 8.0;

/// A driver's speed, m/s, and habits: seconds to whoever is ahead, and acceleration, m/s².
#[derive(Clone, Copy)]
pub(super) struct Driver {
    pub v: f64,
    pub headway: f64,
    pub accelerate: f64,
}

impl Driver {
    /// Acceleration with nobody ahead, towards the desired speed.
    pub fn free(self, desired: f64) -> f64 {
        let ratio = self.v / desired;
        self.accelerate * (1.0 - ratio * ratio * ratio * ratio)
    }

    /// Acceleration, mostly negative, behind somebody `gap` ahead; `standstill`: the gap that is kept when both stand, m.
    pub fn follow(self, desired: f64, gap: f64, leader_speed: f64, standstill: f64) -> f64 {
        let gap = gap.max(0.05);
        let closing = self.v * (self.v - leader_speed) / (2.0 * (self.accelerate * BRAKE).sqrt());
        let wanted = standstill + (self.v * self.headway * if standstill < 1.0 { 0.3 } else { 1.0 } + closing).max(0.0);
        let ratio = self.v / desired;
        self.accelerate * (1.0 - ratio * ratio * ratio * ratio - (wanted / gap) * (wanted / gap))
    }
}

/// Moves on by a tick; nobody rolls backwards.
pub(super) fn advance(s: &mut f64, v: &mut f64, acceleration: f64) {
    let next = *v + acceleration * TICK;
    if next >= 0.0 {
        *s += 0.5 * (*v + next) * TICK;
        *v = next;
    } else {
        *s += *v * *v / (-2.0 * acceleration);
        *v = 0.0;
    }
}
