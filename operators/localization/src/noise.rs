//! Errors of position and heading, drawn from normal distributions.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};
use realo_operator::Draws;

use crate::Mersenne;

/// How far poses are off.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PoseNoise {
    /// Standard deviation of x, y and z, m.
    pub position_m: f64,
    /// Standard deviation of the heading, degrees.
    pub heading_deg: f64,
}

/// An error of a pose in `map`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseError {
    /// Of x, y and z, m.
    pub shift: [f64; 3],
    /// Of the heading, degrees from x to y.
    pub turn_deg: f64,
}

impl PoseNoise {
    /// The error that V2X-Real gives to every agent and sweep: it seeds its generator anew each time, and draws roll, yaw
    /// and pitch to use yaw alone.
    pub fn reference(&self, seed: u32) -> PoseError {
        let mut generator = Mersenne::new(seed);
        let shift = [0; 3].map(|_| self.position_m * generator.normal());
        let [_, turn_deg, _] = [0; 3].map(|_| self.heading_deg * generator.normal());
        PoseError { shift, turn_deg }
    }

    /// An error of draws of its own.
    pub fn drawn(&self, draws: Draws) -> PoseError {
        PoseError {
            shift: [0, 2, 4].map(|index| self.position_m * draws.gaussian(index)),
            turn_deg: self.heading_deg * draws.gaussian(6),
        }
    }

    /// The covariance of a pose with this noise added; row-major over x, y, z, roll, pitch, yaw, m² and rad².
    pub fn widen(&self, covariance: &mut [f64; 36]) {
        let position = self.position_m * self.position_m;
        let heading = self.heading_deg.to_radians();
        for (axis, variance) in [(0, position), (1, position), (2, position), (5, heading * heading)] {
            covariance[7 * axis] += variance;
        }
    }
}

impl PoseError {
    /// The pose with the error: moved, and turned about the vertical through its own origin.
    pub fn of(&self, map_from_body: &Isometry3<f64>) -> Isometry3<f64> {
        let (sin, cos) = libm::sincos(0.5 * self.turn_deg.to_radians());
        let turn = UnitQuaternion::new_normalize(Quaternion::new(cos, 0.0, 0.0, sin));
        let moved = map_from_body.translation.vector + Vector3::from(self.shift);
        Isometry3::from_parts(Translation3::from(moved), turn * map_from_body.rotation)
    }
}
