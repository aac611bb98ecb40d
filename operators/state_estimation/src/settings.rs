use nalgebra::{Isometry3, Vector3};
use realo_geodesy::{LocalFrame, earth_rate, normal_gravity};
use realo_schemas::{Nanos, from_seconds};

use crate::{STANDARD_GRAVITY, Unit, UnitNoise};

/// Where an agent's sensors are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mounting {
    /// The IMU's pose in the body frame, m.
    pub body_from_imu: Isometry3<f64>,
    /// The GNSS antenna in the body frame, m.
    pub antenna_in_body: Vector3<f64>,
    /// The point in the body frame whose velocity has the direction of the wheels: the middle of the axle that does not steer, m.
    pub axle_in_body: Vector3<f64>,
}

impl Default for Mounting {
    fn default() -> Self {
        Mounting {
            body_from_imu: Isometry3::identity(),
            antenna_in_body: Vector3::zeros(),
            axle_in_body: Vector3::zeros(),
        }
    }
}

/// The gravity and turning of the Earth in `map`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Earth {
    /// Gravity, downwards, m/s².
    pub gravity: f64,
    /// Angular rate of `map` against the stars, rad/s.
    pub rate: Vector3<f64>,
}

impl Earth {
    /// As simulators have it: standard gravity, and a map that does not turn.
    pub const SIMULATED: Earth = Earth {
        gravity: STANDARD_GRAVITY,
        rate: Vector3::new(0.0, 0.0, 0.0),
    };

    /// As it is at the origin of a map.
    pub fn at(frame: &LocalFrame) -> Self {
        Earth {
            gravity: normal_gravity(frame.origin()),
            rate: earth_rate(frame.origin()),
        }
    }
}

/// When an estimate counts as lost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Horizontal standard deviation (root of the two variances' sum), m.
    pub position_m: f64,
    /// Standard deviation of the heading, rad.
    pub heading_rad: f64,
    /// So long after the last absolute position an estimate counts as dead reckoning, ns.
    pub dead_reckoning: Nanos,
    /// GNSS that contradicts an estimate without scans for so long is right, ns. An estimate that rests on less than 10 s of fixes yields
    /// after as long a time.
    pub gnss_conflict: Nanos,
    /// GNSS that contradicts an estimate with scans for so long is right, ns.
    pub map_conflict: Nanos,
    /// Scans that contradict an estimate without GNSS for so long are right, ns.
    pub scan_conflict: Nanos,
}

impl Default for Limits {
    fn default() -> Self {
        Limits {
            position_m: 5.0,
            heading_rad: 10f64.to_radians(),
            dead_reckoning: from_seconds(1.0),
            gnss_conflict: from_seconds(30.0),
            map_conflict: from_seconds(60.0),
            scan_conflict: from_seconds(5.0),
        }
    }
}

/// What is added to the covariance that registration reports, which knows nothing of the map's errors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScanNoise {
    /// Standard deviation of each axis of the position, m.
    pub position_m: f64,
    /// Standard deviation of turns about each axis, rad.
    pub turn_rad: f64,
    /// Factor on the reported covariance.
    pub factor: f64,
    /// Whether roll and pitch of scans are used. A map of levelled scans does not show them.
    pub tilt: bool,
}

impl Default for ScanNoise {
    fn default() -> Self {
        ScanNoise {
            position_m: 0.02,
            turn_rad: 0.05f64.to_radians(),
            factor: 1.0,
            tilt: false,
        }
    }
}

/// Settings of an estimator.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Errors of the sensors.
    pub noise: UnitNoise,
    /// Where `map` is on Earth.
    pub frame: LocalFrame,
    /// Where the sensors are.
    pub mounting: Mounting,
    /// Gravity and turning of the map.
    pub earth: Earth,
    /// When an estimate is lost.
    pub limits: Limits,
    /// What is added to the covariance of scans.
    pub scan: ScanNoise,
    /// So many scans that follow each other begin an estimate without GNSS; odometry sets out with the first.
    pub scans_to_begin: u32,
    /// How long past states are kept, ns: a scan's pose may come so late.
    pub keep: Nanos,
}

impl Settings {
    /// Settings of a unit, in a map at a place, all else by default.
    pub fn new(unit: Unit, frame: LocalFrame) -> Self {
        Settings {
            noise: unit.noise(),
            frame,
            mounting: Mounting::default(),
            earth: Earth::SIMULATED,
            limits: Limits::default(),
            scan: ScanNoise::default(),
            scans_to_begin: 5,
            keep: from_seconds(1.0),
        }
    }

    /// The settings as they are, once they are some.
    ///
    /// # Errors
    /// [`SettingsError`] for a number that is not finite or out of range, with its name.
    pub(crate) fn checked(self) -> Result<Self, SettingsError> {
        let noise = &self.noise;
        let [east, north, up] = noise.gnss;
        let positive = [
            ("noise.gyro_noise", noise.gyro_noise),
            ("noise.gyro_bias_start", noise.gyro_bias_start),
            ("noise.gyro_bias_in_run", noise.gyro_bias_in_run),
            ("noise.gyro_scale", noise.gyro_scale),
            ("noise.gyro_range", noise.gyro_range),
            ("noise.accel_noise", noise.accel_noise),
            ("noise.accel_bias_start", noise.accel_bias_start),
            ("noise.accel_bias_in_run", noise.accel_bias_in_run),
            ("noise.accel_range", noise.accel_range),
            ("noise.bias_s", noise.bias_s),
            ("noise.gnss", east.min(north).min(up)),
            ("noise.gnss", east + north + up),
            ("noise.gnss_wander_s", noise.gnss_wander_s),
            ("noise.gnss_multipath_s", noise.gnss_multipath_s),
            ("noise.wheel", noise.wheel),
            ("noise.wheel_scale", noise.wheel_scale),
            ("earth.gravity", self.earth.gravity),
            ("limits.position_m", self.limits.position_m),
            ("limits.heading_rad", self.limits.heading_rad),
            ("scan.position_m", self.scan.position_m),
            ("scan.turn_rad", self.scan.turn_rad),
            ("scan.factor", self.scan.factor),
        ];
        for (name, found) in positive {
            let is_positive = found > 0.0 && found.is_finite();
            if !is_positive {
                return Err(SettingsError::NotPositive { name, found });
            }
        }
        if !(0.0..1.0).contains(&noise.gnss_wander_share) {
            let found = noise.gnss_wander_share;
            return Err(SettingsError::Share { found });
        }
        let mounting = &self.mounting;
        let vectors = [
            ("mounting.body_from_imu", mounting.body_from_imu.translation.vector),
            ("mounting.antenna_in_body", mounting.antenna_in_body),
            ("mounting.axle_in_body", mounting.axle_in_body),
            ("earth.rate", self.earth.rate),
        ];
        for (name, found) in vectors {
            if !found.iter().all(|part| part.is_finite()) {
                return Err(SettingsError::NotFinite { name });
            }
        }
        let length = mounting.body_from_imu.rotation.quaternion().norm();
        let is_rotation = (length - 1.0).abs() < 1e-6;
        if !is_rotation {
            return Err(SettingsError::NotFinite {
                name: "mounting.body_from_imu",
            });
        }
        if !(0..=MAX_KEEP).contains(&self.keep) {
            return Err(SettingsError::Keep { found: self.keep });
        }
        Ok(self)
    }
}

/// Longest time that past states are kept, ns: 10 s of them take 10 MB.
const MAX_KEEP: Nanos = 10_000_000_000;

/// Settings that are none.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SettingsError {
    /// A number that is not above 0.
    #[error("setting `{name}`: expected a finite number above 0, found {found}")]
    NotPositive {
        /// The setting.
        name: &'static str,
        /// What it is.
        found: f64,
    },
    /// A share that is not one.
    #[error("setting `noise.gnss_wander_share`: expected a share from 0 to below 1, found {found}")]
    Share {
        /// What it is.
        found: f64,
    },
    /// A vector or pose that is not finite.
    #[error("setting `{name}`: expected finite numbers, and a quaternion of length 1 in a pose")]
    NotFinite {
        /// The setting.
        name: &'static str,
    },
    /// A time that past states cannot be kept.
    #[error("setting `keep`: expected 0 to {MAX_KEEP} ns, found {found}")]
    Keep {
        /// What it is, ns.
        found: Nanos,
    },
}
