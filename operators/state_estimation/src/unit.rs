//! The errors of named units of IMU, GNSS receiver and wheel encoder. All their numbers are here: simulators make these errors, and
//! estimators expect them.
//!
//! | origin | numbers |
//! |---|---|
//! | data sheet of NovAtel SPAN-CPT | `tactical`: noise, turn-on and in-run bias, scale factor and range of the gyroscopes; single-point position |
//! | table of SPAN-IGM in a journal paper | `tactical`: noise and in-run bias of the accelerometers |
//! | comparison of MEMS chips on a web log (BMI055) | `consumer`: noise of gyroscopes and accelerometers |
//! | a choice for usual cars, in the range of these chips | `consumer`: biases |
//! | RTK receivers: 0.01 m + 1 ppm | `rtk`: positions |
//!
//! These sources have nothing about the rest. It is chosen, and marked *chosen* below: turn-on biases of accelerometers, times of correlation,
//! scale factors (but for that of SPAN-CPT), ranges of accelerometers and of `consumer`, the wandering share of GNSS, multipath, latencies,
//! and everything about wheels.

use std::f64::consts::PI;

use realo_schemas::FixQuality;

/// Standard gravity, m/s²: by which data sheets count the errors of accelerometers, and which simulations have.
pub const STANDARD_GRAVITY: f64 = 9.806_65;

const DEG: f64 = PI / 180.0;
const DEG_PER_HOUR: f64 = DEG / 3600.0;
/// Degrees per square root of an hour, as rad/s/√Hz.
const DEG_PER_ROOT_HOUR: f64 = DEG / 60.0;
const MILLI_G: f64 = 1e-3 * STANDARD_GRAVITY;

/// A class of sensors, by the name that is used for it in graphs and commands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Unit {
    /// MEMS chips of usual cars, and a receiver without corrections.
    Consumer,
    /// Fibre-optic gyroscopes, and a receiver without corrections.
    #[default]
    Tactical,
    /// The same gyroscopes, and a receiver with corrections by a reference station.
    Rtk,
}

/// Three equal inertial sensors: rates in rad/s, specific forces in m/s².
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Inertial {
    /// White noise, a unit per √Hz.
    pub white: f64,
    /// Standard deviation of the bias when it is switched on.
    pub turn_on: f64,
    /// Standard deviation of the bias's wandering.
    pub in_run: f64,
    /// Time in which that loses 63 % of itself, s.
    pub correlation_s: f64,
    /// Standard deviation of the scale factor's error.
    pub scale: f64,
    /// Readings end here.
    pub range: f64,
}

/// A satellite receiver.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Receiver {
    /// Standard deviation of a position east, north and up, m.
    pub deviation_m: [f64; 3],
    /// How positions are found.
    pub quality: FixQuality,
    /// Share of the variance that wanders.
    pub wander_share: f64,
    /// Time in which that loses 63 % of itself, s.
    pub wander_s: f64,
    /// Standard deviation of a jump between buildings, of each axis, m.
    pub multipath_m: f64,
    /// Mean time from one jump to the next, s.
    pub multipath_every_s: f64,
    /// Mean time of a jump, s.
    pub multipath_lasts_s: f64,
    /// What it says of its standard deviations is so many times as much between buildings.
    pub between_buildings: f64,
    /// From a measurement to its arrival, min and max, ms.
    pub latency_ms: [f64; 2],
}

/// Encoders of the wheels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wheels {
    /// Standard deviation of the scale factor's error, as of a wrong circumference.
    pub scale: f64,
    /// Standard deviation of a speed, m/s.
    pub noise: f64,
    /// Slower wheels give no pulses and read 0, m/s.
    pub stops: f64,
    /// From a measurement to its arrival, min and max, ms.
    pub latency_ms: [f64; 2],
}

/// Standard deviations and densities as a filter models them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UnitNoise {
    /// Angle random walk, rad/√s.
    pub gyro_noise: f64,
    /// Bias of the gyro at the start, rad/s.
    pub gyro_bias_start: f64,
    /// How far the gyro's bias moves in a run, rad/s.
    pub gyro_bias_in_run: f64,
    /// Error of the gyro's scale factor.
    pub gyro_scale: f64,
    /// Largest rate that the gyro measures, rad/s.
    pub gyro_range: f64,
    /// Velocity random walk, m/s/√s.
    pub accel_noise: f64,
    /// Bias of the accelerometer at the start, m/s²; what a wrong scale makes of gravity is part of it.
    pub accel_bias_start: f64,
    /// How far the accelerometer's bias moves in a run, m/s².
    pub accel_bias_in_run: f64,
    /// Largest specific force that the accelerometer measures, m/s².
    pub accel_range: f64,
    /// Time in which biases move by their in-run part, s.
    pub bias_s: f64,
    /// Position of the GNSS receiver east, north and up, m.
    pub gnss: [f64; 3],
    /// Share of the receiver's variance that wanders.
    pub gnss_wander_share: f64,
    /// Time over which it wanders, s.
    pub gnss_wander_s: f64,
    /// Mean time of a jump between buildings, s.
    pub gnss_multipath_s: f64,
    /// Noise of wheel speed, m/s.
    pub wheel: f64,
    /// Error of the wheels' circumference, as a share of the speed.
    pub wheel_scale: f64,
}

impl Unit {
    /// All, with their names and what they mean.
    pub const ALL: &[(Unit, &str, &str)] = &[
        (Unit::Consumer, "consumer", "MEMS chips, GNSS without corrections"),
        (
            Unit::Tactical,
            "tactical",
            "fibre-optic gyroscopes, GNSS without corrections",
        ),
        (Unit::Rtk, "rtk", "the same gyroscopes, GNSS with RTK"),
    ];
    /// From a measurement of an inertial unit to its arrival, min and max, ms. Chosen.
    pub const IMU_LATENCY_MS: [f64; 2] = [1.0, 3.0];

    /// The unit of a name.
    pub fn named(name: &str) -> Option<Self> {
        let found = Unit::ALL.iter().find(|(_, known, _)| *known == name);
        found.map(|(unit, ..)| *unit)
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        let of = Unit::ALL.iter().find(|(unit, ..)| *unit == self);
        of.map_or("", |(_, name, _)| name)
    }

    /// Its gyroscopes.
    pub fn gyroscopes(self) -> Inertial {
        match self {
            Unit::Consumer => Inertial {
                white: 0.014 * DEG,
                turn_on: 0.3 * DEG,
                in_run: 6.0 * DEG_PER_HOUR,
                // Chosen.
                correlation_s: 300.0,
                scale: 5e-3,
                range: 2000.0 * DEG,
            },
            Unit::Tactical | Unit::Rtk => Inertial {
                white: 0.0667 * DEG_PER_ROOT_HOUR,
                turn_on: 3.0 * DEG_PER_HOUR,
                in_run: 1.0 * DEG_PER_HOUR,
                // Chosen.
                correlation_s: 300.0,
                scale: 1500e-6,
                range: 375.0 * DEG,
            },
        }
    }

    /// Its accelerometers.
    pub fn accelerometers(self) -> Inertial {
        match self {
            Unit::Consumer => Inertial {
                white: 150e-6 * STANDARD_GRAVITY,
                turn_on: 20.0 * MILLI_G,
                // Chosen, from here on.
                in_run: 0.5 * MILLI_G,
                correlation_s: 300.0,
                scale: 3e-3,
                range: 8.0 * STANDARD_GRAVITY,
            },
            Unit::Tactical | Unit::Rtk => Inertial {
                white: 0.03 / 60.0,
                in_run: 0.1 * MILLI_G,
                // Chosen, from here on.
                turn_on: 1.0 * MILLI_G,
                correlation_s: 300.0,
                scale: 3e-4,
                range: 10.0 * STANDARD_GRAVITY,
            },
        }
    }

    /// Its satellite receiver.
    pub fn receiver(self) -> Receiver {
        let single = Receiver {
            deviation_m: [1.2, 1.2, 2.5],
            quality: FixQuality::Single,
            // Chosen, from here on.
            wander_share: 0.7,
            wander_s: 100.0,
            multipath_m: 5.0,
            multipath_every_s: 8.0,
            multipath_lasts_s: 4.0,
            between_buildings: 2.0,
            latency_ms: [40.0, 90.0],
        };
        match self {
            Unit::Consumer | Unit::Tactical => single,
            Unit::Rtk => Receiver {
                deviation_m: [0.015, 0.015, 0.03],
                quality: FixQuality::Differential,
                // Chosen: a wrong ambiguity.
                multipath_m: 0.8,
                ..single
            },
        }
    }

    /// Its wheels, which are the same with all units. All chosen.
    pub fn wheels(self) -> Wheels {
        Wheels {
            scale: 0.005,
            noise: 0.03,
            stops: 0.02,
            latency_ms: [4.0, 14.0],
        }
    }

    /// Its errors as a filter models them.
    pub fn noise(self) -> UnitNoise {
        let (gyroscopes, accelerometers) = (self.gyroscopes(), self.accelerometers());
        let (receiver, wheels) = (self.receiver(), self.wheels());
        let at_start =
            |of: &Inertial, gravity: f64| libm::hypot(libm::hypot(of.turn_on, of.in_run), of.scale * gravity);
        UnitNoise {
            gyro_noise: gyroscopes.white,
            gyro_bias_start: at_start(&gyroscopes, 0.0),
            gyro_bias_in_run: gyroscopes.in_run,
            gyro_scale: gyroscopes.scale,
            gyro_range: gyroscopes.range,
            accel_noise: accelerometers.white,
            accel_bias_start: at_start(&accelerometers, STANDARD_GRAVITY),
            accel_bias_in_run: accelerometers.in_run,
            accel_range: accelerometers.range,
            bias_s: gyroscopes.correlation_s,
            gnss: receiver.deviation_m,
            gnss_wander_share: receiver.wander_share,
            gnss_wander_s: receiver.wander_s,
            gnss_multipath_s: receiver.multipath_lasts_s,
            wheel: wheels.noise,
            wheel_scale: wheels.scale,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_found_by_their_names_and_sheets_are_read_in_their_units() {
        for (unit, name, _) in Unit::ALL {
            assert_eq!((Unit::named(name), unit.name()), (Some(*unit), *name));
        }
        assert_eq!(Unit::named("Tactical"), None);
        let tactical = Unit::Tactical.noise();
        // After an hour a walk of 0.0667 °/√h has come 0.0667°, one of 0.03 m/s/√h 0.03 m/s.
        assert!((tactical.gyro_noise * 3600f64.sqrt() - 0.0667f64.to_radians()).abs() < 1e-12);
        assert!((tactical.accel_noise * 3600f64.sqrt() - 0.03).abs() < 1e-12);
        let gyroscopes = Unit::Tactical.gyroscopes();
        // 0.0667 °/√h at 100 Hz are 0.011 °/s a sample.
        assert!((gyroscopes.white * 10.0 / DEG - 0.011_1).abs() < 1e-4);
        assert!((gyroscopes.turn_on.to_degrees() * 3600.0 - 3.0).abs() < 1e-9);
        assert_eq!(Unit::Rtk.noise().gyro_noise, tactical.gyro_noise);
    }
}
