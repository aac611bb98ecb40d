//! What a sensor sees of one instance.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use super::Instance;
use crate::agents::{Agent, BodyState};
use crate::cast::table::Extent;
use crate::cast::{Span, TURN};
use crate::path::Pose2;
use crate::solid::Solid;
use crate::traffic::Footing;

/// A body and where it may be found in time.
pub(super) struct Candidate<'a> {
    pub solid: &'a Solid,
    pub user: Option<u32>,
    pub own: bool,
}

/// Where a candidate is at some time.
pub(super) struct Stance {
    pub pose: Pose2,
    pub footing: Footing,
    pub velocity: [f64; 2],
    pub turn_rate: f64,
    pub stride: f64,
}

/// The smallest turn that makes an angle, either way, rad.
pub(super) fn away(angle: f64) -> f64 {
    (angle - TAU * (angle / TAU).round()).abs()
}

/// How far the sensor's tilt moves azimuths, rad.
pub(super) fn tilt_margin(agent: &Agent, sensor: &BodyState) -> f64 {
    let mount = agent.mount.pitch.abs() + agent.mount.roll.abs();
    (sensor.slope[0].abs() + sensor.slope[1].abs()) * agent.sensor.steepest * 1.3 + 2e-4 + mount * agent.sensor.slant
}

/// A candidate as seen from the sensor.
pub(super) struct View {
    /// Corners of the footprint relative to the sensor, m.
    corners: [[f64; 2]; 4],
    pub near: f64,
    pub far: f64,
    /// Bottom and top relative to the sensor, m.
    heights: [f64; 2],
    pub own: bool,
}

impl View {
    pub(super) fn new(agent: &Agent, sensor: &BodyState, candidate: &Candidate, stance: &Stance) -> View {
        let Solid { low, high, .. } = candidate.solid;
        let (sin, cos) = libm::sincos(stance.pose.heading);
        let (x, y) = (stance.pose.x - sensor.position[0], stance.pose.y - sensor.position[1]);
        let corner = |u: f64, v: f64| [x + u * cos - v * sin, y + u * sin + v * cos];
        let corners = [
            corner(low[0], low[1]),
            corner(high[0], low[1]),
            corner(high[0], high[1]),
            corner(low[0], high[1]),
        ];
        // The sensor in the body's frame: the nearest point of the footprint follows by clamping.
        let (u, v) = (-(x * cos + y * sin), -(y * cos - x * sin));
        let (du, dv) = (u - u.clamp(low[0], high[0]), v - v.clamp(low[1], high[1]));
        let near = (du * du + dv * dv).sqrt();
        let far = corners
            .iter()
            .map(|c| (c[0] * c[0] + c[1] * c[1]).sqrt())
            .fold(0.0, f64::max);
        let eye = sensor.position[2] + agent.info.sensor_height;
        let lean =
            stance.footing.slope[0].abs() * high[0].max(-low[0]) + stance.footing.slope[1].abs() * high[1].max(-low[1]);
        let foot = stance.footing.z - eye;
        View {
            corners,
            near,
            far,
            heights: [foot + low[2] - lean - 0.02, foot + high[2] + lean + 0.02],
            own: candidate.own,
        }
    }

    /// Clockwise azimuths from the sensor's rear that the footprint takes up; `None` if it is far out of reach.
    pub(super) fn azimuths(&self, sensor: &BodyState, span: Span) -> Option<[f64; 2]> {
        if self.near > span.farthest {
            return None;
        }
        if self.own || self.near < 0.5 {
            return Some([-TAU, 2.0 * TAU]);
        }
        let clockwise = |c: &[f64; 2]| sensor.heading - span.first + PI - libm::atan2(c[1], c[0]);
        let first = clockwise(&self.corners[0]);
        let (mut low, mut high) = (first, first);
        for corner in &self.corners[1..] {
            // A convex footprint without the sensor in it spans less than half a turn.
            let azimuth = clockwise(corner);
            let azimuth = azimuth - TAU * ((azimuth - first) / TAU).round();
            low = low.min(azimuth);
            high = high.max(azimuth);
        }
        Some([low, high])
    }

    /// How far the azimuths may be off: motion within the sector, and the tilt of the sensor.
    pub(super) fn margin(
        &self,
        (agent, span): (&Agent, Span),
        sensor: &BodyState,
        stance: &Stance,
        half_sector: f64,
    ) -> f64 {
        let time = half_sector / span.width * TURN + 1e-4;
        let (dx, dy) = (
            sensor.velocity[0] - stance.velocity[0],
            sensor.velocity[1] - stance.velocity[1],
        );
        let radius = 0.5 * (self.far - self.near);
        let moved = (dx.abs() + dy.abs() + stance.turn_rate.abs() * radius) * time;
        (moved / self.near.max(0.5)).min(FRAC_PI_2) + sensor.turn_rate.abs() * time + tilt_margin(agent, sensor)
    }

    pub(super) fn extent(&self, bins: [i16; 2]) -> Extent {
        let [foot, top] = self.heights;
        let (near, far) = ((self.near - 0.2).max(1e-3), self.far + 0.2);
        let slope = |height: f64, toward: f64| (height / if height * toward > 0.0 { near } else { far }) as f32;
        Extent {
            bins,
            low: slope(foot, -1.0),
            high: slope(top, 1.0),
            near: (self.near - 0.2).max(0.0),
        }
    }

    pub(super) fn instance<'a>(&self, candidate: &Candidate<'a>, stance: &Stance, t: f64) -> Instance<'a> {
        let (sin, cos) = libm::sincos(stance.pose.heading);
        Instance {
            solid: candidate.solid,
            user: candidate.user,
            t,
            position: [stance.pose.x, stance.pose.y, stance.footing.z],
            velocity: stance.velocity,
            cos_sin: [cos, sin],
            turn_rate: stance.turn_rate,
            lean: stance.footing.slope,
            stride: stance.stride,
            fixed: candidate.user.is_none(),
        }
    }
}
