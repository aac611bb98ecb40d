//! The errors of named units of IMU, GNSS receiver and wheel encoder.

use std::f64::consts::PI;

/// Standard gravity, m/s², by which data sheets count accelerometers' errors.
const STANDARD_GRAVITY: f64 = 9.806_65;
/// Radians of a degree.
const DEGREE: f64 = PI / 180.0;
/// Share of the variance of a receiver's position that wanders, and over how long, s. No sheet gives them; the simulator has
/// the same ones.
const WANDER: (f64, f64) = (0.7, 100.0);

/// A class of sensors, by the name that is used for it in graphs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Unit {
    /// A MEMS IMU of a car and a single-point receiver.
    Consumer,
    /// A tactical IMU and a single-point receiver.
    #[default]
    Tactical,
    /// A tactical IMU and a receiver with corrections of phase (RTK).
    Rtk,
}

/// Standard deviations and densities of a unit's errors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UnitNoise {
    /// Angle random walk, rad/√s.
    pub gyro_noise: f64,
    /// Bias of the gyro when it is switched on, rad/s.
    pub gyro_bias_start: f64,
    /// How far the gyro's bias moves in a run, rad/s.
    pub gyro_bias_in_run: f64,
    /// Largest rate that the gyro measures, rad/s.
    pub gyro_range: f64,
    /// Velocity random walk, m/s/√s.
    pub accel_noise: f64,
    /// Bias of the accelerometer when it is switched on, m/s².
    pub accel_bias_start: f64,
    /// How far the accelerometer's bias moves in a run, m/s².
    pub accel_bias_in_run: f64,
    /// Largest specific force that the accelerometer measures, m/s².
    pub accel_range: f64,
    /// Position of the GNSS receiver east, north and up, m.
    pub gnss: [f64; 3],
    /// Share of the receiver's variance that wanders.
    pub gnss_wander_share: f64,
    /// Time over which it wanders, s.
    pub gnss_wander_s: f64,
    /// Noise of wheel speed, m/s.
    pub wheel: f64,
    /// Error of the wheels' circumference, as a share of the speed.
    pub wheel_scale: f64,
}

impl Unit {
    /// The unit of a name.
    pub fn named(name: &str) -> Option<Self> {
        [Unit::Consumer, Unit::Tactical, Unit::Rtk]
            .into_iter()
            .find(|unit| unit.name() == name)
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Unit::Consumer => "consumer",
            Unit::Tactical => "tactical",
            Unit::Rtk => "rtk",
        }
    }

    /// Its errors.
    ///
    /// | | consumer | tactical, rtk |
    /// |---|---|---|
    /// | gyro noise | 0.014 °/s/√Hz (BMI055) | 0.0667 °/√h (SPAN-CPT) |
    /// | gyro bias, start and in run | 0.3 °/s, 6 °/h | 3 °/h, 1 °/h |
    /// | accelerometer noise | 150 µg/√Hz | 0.03 m/s/√h |
    /// | accelerometer bias | 20 mg | 0.1 mg |
    /// | GNSS | 1.2, 1.2, 2.5 m | as consumer; rtk 0.015, 0.015, 0.03 m |
    ///
    /// Sheets are silent on the following, so these are choices: the in-run part of an accelerometer's bias (a tenth of the
    /// bias), ranges (the gyro of SPAN-CPT has 375 °/s; 1,000 °/s for consumer, 16 g and 10 g for accelerometers), the
    /// wandering share of GNSS, and all of wheel speed (0.05 m/s and 0.5 %).
    pub fn noise(self) -> UnitNoise {
        let (gnss_wander_share, gnss_wander_s) = WANDER;
        let consumer = UnitNoise {
            gyro_noise: 0.014 * DEGREE,
            gyro_bias_start: 0.3 * DEGREE,
            gyro_bias_in_run: 6.0 * DEGREE / 3600.0,
            gyro_range: 1_000.0 * DEGREE,
            accel_noise: 150e-6 * STANDARD_GRAVITY,
            accel_bias_start: 20e-3 * STANDARD_GRAVITY,
            accel_bias_in_run: 2e-3 * STANDARD_GRAVITY,
            accel_range: 16.0 * STANDARD_GRAVITY,
            gnss: [1.2, 1.2, 2.5],
            gnss_wander_share,
            gnss_wander_s,
            wheel: 0.05,
            wheel_scale: 0.005,
        };
        let tactical = UnitNoise {
            gyro_noise: 0.0667 * DEGREE / 60.0,
            gyro_bias_start: 3.0 * DEGREE / 3600.0,
            gyro_bias_in_run: DEGREE / 3600.0,
            gyro_range: 375.0 * DEGREE,
            accel_noise: 0.03 / 60.0,
            accel_bias_start: 0.1e-3 * STANDARD_GRAVITY,
            accel_bias_in_run: 0.01e-3 * STANDARD_GRAVITY,
            accel_range: 10.0 * STANDARD_GRAVITY,
            ..consumer
        };
        match self {
            Unit::Consumer => consumer,
            Unit::Tactical => tactical,
            Unit::Rtk => UnitNoise {
                gnss: [0.015, 0.015, 0.03],
                ..tactical
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_found_by_their_names_and_sheets_are_read_in_their_units() {
        for unit in [Unit::Consumer, Unit::Tactical, Unit::Rtk] {
            assert_eq!(Unit::named(unit.name()), Some(unit));
        }
        assert_eq!(Unit::named("Tactical"), None);
        let tactical = Unit::Tactical.noise();
        // After an hour a walk of 0.0667 °/√h has come 0.0667°, one of 0.03 m/s/√h 0.03 m/s.
        assert!((tactical.gyro_noise * 3600f64.sqrt() - 0.0667f64.to_radians()).abs() < 1e-12);
        assert!((tactical.accel_noise * 3600f64.sqrt() - 0.03).abs() < 1e-12);
        assert!((tactical.gyro_bias_start.to_degrees() * 3600.0 - 3.0).abs() < 1e-9);
        assert_eq!(Unit::Rtk.noise().gyro_noise, tactical.gyro_noise);
    }
}
