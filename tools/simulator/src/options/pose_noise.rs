//! How wrong agents are about where they are.

use super::error::{Error, require};

/// The error model `gnss-ins-rtk-like` of the poses that agents believe.
///
/// A vehicle's error is a first-order Gauss-Markov walk (bias) plus white noise at each pose. A roadside unit was
/// surveyed once: one draw of the bias, no white noise. Covariances are the sums of both variances.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseNoise {
    /// Standard deviation of the bias (east, north, up), m. RTK receivers: 0.015, 0.015, 0.03.
    pub position_bias_m: [f64; 3],
    /// Time in which the bias of the position loses 63 % of itself, s (a modelling choice: 60).
    pub position_correlation_s: f64,
    /// White noise of the position on each axis, m (a modelling choice: 0.005).
    pub position_white_m: f64,
    /// Standard deviation of the heading's bias, degrees. Two antennas 2 m apart: 0.08.
    pub heading_bias_deg: f64,
    /// Standard deviation of the bias of roll and pitch, degrees (a modelling choice: 0.02).
    pub tilt_bias_deg: f64,
    /// Time in which the biases of the angles lose 63 % of themselves, s (a modelling choice: 30).
    pub angle_correlation_s: f64,
    /// White noise of each angle, degrees (a modelling choice: 0.01).
    pub angle_white_deg: f64,
    /// White noise of the velocity on each axis, m/s. CPT7: 0.03.
    pub velocity_white_m_s: f64,
    /// White noise of the angular rate on each axis, degrees/s (a modelling choice: 0.05).
    pub rate_white_deg_s: f64,
}

impl PoseNoise {
    /// The model's name, for a log's metadata.
    pub const NAME: &'static str = "gnss-ins-rtk-like";

    /// Poses without error.
    pub fn none() -> Self {
        PoseNoise {
            position_bias_m: [0.0; 3],
            position_correlation_s: 60.0,
            position_white_m: 0.0,
            heading_bias_deg: 0.0,
            tilt_bias_deg: 0.0,
            angle_correlation_s: 30.0,
            angle_white_deg: 0.0,
            velocity_white_m_s: 0.0,
            rate_white_deg_s: 0.0,
        }
    }

    pub(super) fn check(&self) -> Result<(), Error> {
        let [x, y, z] = self.position_bias_m;
        let deviations = [
            ("position_bias_m", x),
            ("position_bias_m", y),
            ("position_bias_m", z),
            ("position_white_m", self.position_white_m),
            ("heading_bias_deg", self.heading_bias_deg),
            ("tilt_bias_deg", self.tilt_bias_deg),
            ("angle_white_deg", self.angle_white_deg),
            ("velocity_white_m_s", self.velocity_white_m_s),
            ("rate_white_deg_s", self.rate_white_deg_s),
        ];
        for (field, value) in deviations {
            require(
                value >= 0.0 && value.is_finite(),
                field,
                value,
                "a finite number, 0 or more",
            )?;
        }
        for (field, value) in [
            ("position_correlation_s", self.position_correlation_s),
            ("angle_correlation_s", self.angle_correlation_s),
        ] {
            require(
                value > 0.0 && value.is_finite(),
                field,
                value,
                "a finite number greater than 0",
            )?;
        }
        Ok(())
    }
}

impl Default for PoseNoise {
    fn default() -> Self {
        PoseNoise {
            position_bias_m: [0.015, 0.015, 0.03],
            position_correlation_s: 60.0,
            position_white_m: 0.005,
            heading_bias_deg: 0.08,
            tilt_bias_deg: 0.02,
            angle_correlation_s: 30.0,
            angle_white_deg: 0.01,
            velocity_white_m_s: 0.03,
            rate_white_deg_s: 0.05,
        }
    }
}
