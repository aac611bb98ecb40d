//! Named sets of motion sensors. All their numbers are here.
//!
//! | origin | numbers |
//! |---|---|
//! | data sheet of NovAtel SPAN-CPT | `tactical`: noise, turn-on and in-run bias, and range of the gyroscopes; single-point position |
//! | table of SPAN-IGM in a journal paper | `tactical`: noise and in-run bias of the accelerometers |
//! | comparison of MEMS chips on a web log (BMI055) | `consumer`: noise of gyroscopes and accelerometers |
//! | a choice for usual cars, in the range of these chips | `consumer`: biases |
//! | RTK receivers: 0.01 m + 1 ppm | `rtk`: positions |
//!
//! What no source says is a modelling choice, marked *chosen* below: turn-on biases of accelerometers, times of
//! correlation, scale factors, ranges of accelerometers, multipath, latencies, and everything about wheels. Cross-axis
//! errors, vibration rectification, temperature and the Earth's rotation are not simulated.

use std::f64::consts::PI;

use crate::options::Error;

/// Standard gravity, m/s².
pub(crate) const GRAVITY: f64 = 9.806_65;

const DEG: f64 = PI / 180.0;
const DEG_PER_HOUR: f64 = DEG / 3600.0;
/// Degrees per square root of an hour, as rad/s/√Hz.
const DEG_PER_ROOT_HOUR: f64 = DEG / 60.0;
const MILLI_G: f64 = 1e-3 * GRAVITY;

/// The motion sensors of an agent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum MotionUnit {
    /// MEMS chips of usual cars, and a receiver without corrections.
    Consumer,
    /// Fibre-optic gyroscopes, and a receiver without corrections.
    Tactical,
    /// The same gyroscopes, and a receiver with corrections by a reference station.
    Rtk,
}

impl MotionUnit {
    /// All, with their names and what they mean.
    pub const ALL: &[(MotionUnit, &str, &str)] = &[
        (MotionUnit::Consumer, "consumer", "MEMS chips, GNSS without corrections"),
        (
            MotionUnit::Tactical,
            "tactical",
            "fibre-optic gyroscopes, GNSS without corrections",
        ),
        (MotionUnit::Rtk, "rtk", "the same gyroscopes, GNSS with RTK"),
    ];

    /// Its name.
    pub fn name(self) -> &'static str {
        let of = MotionUnit::ALL.iter().find(|(unit, ..)| *unit == self);
        of.map_or("", |(_, name, _)| name)
    }

    /// The unit of a name.
    ///
    /// # Errors
    /// [`Error::UnknownUnit`] lists the names.
    pub fn named(name: &str) -> Result<Self, Error> {
        let found = MotionUnit::ALL.iter().find(|(_, known, _)| *known == name);
        found
            .map(|(unit, ..)| *unit)
            .ok_or_else(|| Error::UnknownUnit { found: name.into() })
    }

    pub(crate) fn gyroscopes(self) -> Inertial {
        match self {
            MotionUnit::Consumer => Inertial {
                white: 0.014 * DEG,
                turn_on: 0.3 * DEG,
                in_run: 6.0 * DEG_PER_HOUR,
                // Chosen.
                correlation_s: 300.0,
                scale: 5e-3,
                range: 2000.0 * DEG,
            },
            MotionUnit::Tactical | MotionUnit::Rtk => Inertial {
                white: 0.0667 * DEG_PER_ROOT_HOUR,
                turn_on: 3.0 * DEG_PER_HOUR,
                in_run: 1.0 * DEG_PER_HOUR,
                correlation_s: 300.0,
                scale: 1500e-6,
                range: 375.0 * DEG,
            },
        }
    }

    pub(crate) fn accelerometers(self) -> Inertial {
        match self {
            MotionUnit::Consumer => Inertial {
                white: 150e-6 * GRAVITY,
                turn_on: 20.0 * MILLI_G,
                // Chosen, from here on.
                in_run: 0.5 * MILLI_G,
                correlation_s: 300.0,
                scale: 3e-3,
                range: 8.0 * GRAVITY,
            },
            MotionUnit::Tactical | MotionUnit::Rtk => Inertial {
                white: 0.03 / 60.0,
                in_run: 0.1 * MILLI_G,
                // Chosen, from here on.
                turn_on: 1.0 * MILLI_G,
                correlation_s: 300.0,
                scale: 3e-4,
                range: 10.0 * GRAVITY,
            },
        }
    }

    pub(crate) fn receiver(self) -> Receiver {
        let single = Receiver {
            deviation_m: [1.2, 1.2, 2.5],
            quality: realo_schemas::FixQuality::Single,
            // Chosen, from here on.
            multipath_m: 5.0,
            multipath_every_s: 8.0,
            multipath_lasts_s: 4.0,
            between_buildings: 2.0,
            latency_ms: [40.0, 90.0],
        };
        match self {
            MotionUnit::Consumer | MotionUnit::Tactical => single,
            MotionUnit::Rtk => Receiver {
                deviation_m: [0.015, 0.015, 0.03],
                quality: realo_schemas::FixQuality::Differential,
                // Chosen: a wrong ambiguity.
                multipath_m: 0.8,
                ..single
            },
        }
    }
}

/// Three equal inertial sensors.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Inertial {
    /// White noise, rad/s/√Hz or m/s²/√Hz.
    pub white: f64,
    /// Standard deviation of the bias when it is switched on, rad/s or m/s².
    pub turn_on: f64,
    /// Standard deviation of the bias's wandering, and the time in which it loses 63 % of itself, s.
    pub in_run: f64,
    pub correlation_s: f64,
    /// Standard deviation of the scale factor's error.
    pub scale: f64,
    /// Readings end here.
    pub range: f64,
}

/// A satellite receiver.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Receiver {
    /// Standard deviation of a position east, north and up, m.
    pub deviation_m: [f64; 3],
    pub quality: realo_schemas::FixQuality,
    /// Standard deviation of a jump between buildings, of each axis, m; mean times between jumps and of one, s.
    pub multipath_m: f64,
    pub multipath_every_s: f64,
    pub multipath_lasts_s: f64,
    /// What it says of its standard deviations is so much more between buildings.
    pub between_buildings: f64,
    /// From a measurement to its arrival, min and max, ms.
    pub latency_ms: [f64; 2],
}

/// Share of the variance of a position that wanders, and the time in which that loses 63 % of itself, s.
pub(crate) const WANDERING: [f64; 2] = [0.7, 100.0];

/// Wheels, all chosen: standard deviations of the scale factor's error and of the speed, m/s.
pub(crate) const WHEEL_SCALE: f64 = 0.005;
pub(crate) const WHEEL_NOISE: f64 = 0.03;
/// Slower wheels give no pulses and read 0, m/s.
pub(crate) const WHEEL_STOPS: f64 = 0.02;
/// From a measurement to its arrival, ms: of the inertial unit, and of the wheels. Chosen.
pub(crate) const IMU_LATENCY_MS: [f64; 2] = [1.0, 3.0];
pub(crate) const WHEEL_LATENCY_MS: [f64; 2] = [4.0, 14.0];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_have_names_and_are_in_si() {
        for (unit, name, _) in MotionUnit::ALL {
            assert_eq!((MotionUnit::named(name), unit.name()), (Ok(*unit), *name));
        }
        assert!(
            MotionUnit::named("atomic")
                .unwrap_err()
                .to_string()
                .contains("consumer, tactical")
        );
        // 0.0667 °/√h at 100 Hz are 0.011 °/s a sample.
        let gyroscopes = MotionUnit::Tactical.gyroscopes();
        assert!((gyroscopes.white * 10.0 / DEG - 0.011_1).abs() < 1e-4);
        assert!((MotionUnit::Tactical.accelerometers().white * 10.0 - 0.005).abs() < 1e-12);
        assert!((gyroscopes.turn_on / DEG * 3600.0 - 3.0).abs() < 1e-9);
    }
}
