//! The LiDARs: beam tables, firing times, optics, where they are mounted.

mod file;

use std::f64::consts::{PI, TAU};
use std::sync::{Arc, OnceLock};

use realo_schemas::Name;

pub use file::SensorError;

/// No sensor sees farther, m.
pub(crate) const FARTHEST: f64 = 320.0;

/// A LiDAR whose columns turn clockwise (seen from above): a spinning one from the rear over the left, the front and
/// the right back to the rear, one that looks ahead from the left to the right of its field. Half-way through a sweep
/// both look ahead.
#[derive(Clone, Debug, PartialEq)]
pub struct Sensor {
    /// Model, for a log's metadata.
    pub(crate) model: Name,
    /// Columns of a sweep of 0.1 s.
    pub(crate) columns: usize,
    /// In the order in which they fire.
    pub(crate) beams: Vec<Beam>,
    /// Largest rise or fall of a beam, as a sine.
    pub(crate) steepest: f64,
    /// How far azimuths move for a small tilt, at most: the largest slope of a beam, with a margin.
    pub(crate) slant: f64,
    pub(crate) scan: Scan,
    /// Where it is mounted; `None` leaves that to the agent's kind, level and without error.
    pub(crate) mount: Option<Mount>,
    pub(crate) optics: Optics,
}

/// What the columns of a sweep cover.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Scan {
    /// Azimuth of the first column, clockwise from the sensor's rear, rad.
    pub first: f64,
    /// Width of all columns, rad.
    pub width: f64,
}

impl Scan {
    fn turn() -> Self {
        Scan { first: 0.0, width: TAU }
    }

    fn ahead(field: f64) -> Self {
        Scan {
            first: PI - 0.5 * field,
            width: field,
        }
    }
}

/// Where a sensor is mounted on its carrier; angles right-handed, rad: turned by yaw, then pitch (positive looks down),
/// then roll.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Mount {
    /// Over the ground, m.
    pub height: f64,
    pub pitch: f64,
    pub roll: f64,
    pub yaw: f64,
    /// Standard deviation of the pitch and roll that nobody knows of: they stay in the points.
    pub misalignment: f64,
}

/// One beam.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Beam {
    /// Direction with the column straight ahead: unit vector.
    pub direction: [f64; 3],
    /// Clockwise offset from the column's azimuth, rad.
    pub azimuth: f64,
    /// Time after the column's start, s.
    pub fires: f64,
    /// Number from the lowest beam up.
    pub ring: u16,
    /// It fires in every n-th column.
    pub every: usize,
}

impl Beam {
    /// From degrees and microseconds; the ring is still to be reported.
    fn new(elevation: f64, azimuth: f64, fires: f64, every: usize) -> Beam {
        let (sin_el, cos_el) = libm::sincos(elevation.to_radians());
        let azimuth = azimuth.to_radians();
        let (sin, cos) = libm::sincos(-azimuth);
        Beam {
            direction: [cos_el * cos, cos_el * sin, sin_el],
            azimuth,
            fires: fires * 1e-6,
            ring: 0,
            every,
        }
    }
}

/// What comes back: signal-to-noise `q = √3 · ρ cos(incidence) / ρ₀ · (R₀/R)²` relative to the level of even chance;
/// a return is seen with probability `q⁴ / (q⁴ + 1)`, which is 0.9 for reflectivity ρ₀ at range R₀ (the data sheet's
/// point), and its range scatters by `floor + slope / √q`, at most `ceiling`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Optics {
    /// `√3 / ρ₀`.
    pub strength: f64,
    /// R₀, m.
    pub reference_range: f64,
    pub nearest: f64,
    pub farthest: f64,
    /// Step of the reported range, m.
    pub step: f64,
    pub steps_per_metre: f64,
    pub noise_floor: f64,
    pub noise_slope: f64,
    pub noise_ceiling: f64,
    /// Share of the rays that give nothing whatever they meet.
    pub unanswered: f64,
    /// What the air takes of the light, 1/m: rain, fog.
    pub extinction: f64,
}

/// Share of the rays that give nothing, of the sensors of the first places.
const DROPOUT: f64 = 0.004;

impl Sensor {
    /// 128 beams of a RoboSense Ruby Plus, 1,800 columns.
    pub(crate) fn ruby_plus() -> Arc<Sensor> {
        static SENSOR: OnceLock<Arc<Sensor>> = OnceLock::new();
        SENSOR.get_or_init(|| Sensor::of_first_places("ruby-plus-128")).clone()
    }

    /// 128 beams of an Ouster OS1-128, 1,024 columns.
    pub(crate) fn os1_128() -> Arc<Sensor> {
        static SENSOR: OnceLock<Arc<Sensor>> = OnceLock::new();
        SENSOR.get_or_init(|| Sensor::of_first_places("os1-128")).clone()
    }

    /// 64 beams of a first-generation Ouster OS1-64, 1,024 columns.
    pub(crate) fn os1_64() -> Arc<Sensor> {
        static SENSOR: OnceLock<Arc<Sensor>> = OnceLock::new();
        SENSOR.get_or_init(|| Sensor::of_first_places("os1-64")).clone()
    }

    /// A built-in sensor as agents have it where none is named: mounted by their kind, level, and with hardly a ray that
    /// gives nothing.
    fn of_first_places(name: &str) -> Arc<Sensor> {
        let sensor = Sensor::named(name).expect("a built-in sensor");
        Arc::new(Sensor {
            mount: None,
            optics: Optics {
                unanswered: DROPOUT,
                ..sensor.optics
            },
            ..Sensor::clone(&sensor)
        })
    }

    /// A spinning sensor that is not mounted yet.
    fn of(model: Name, columns: usize, mut beams: Vec<Beam>, optics: Optics) -> Sensor {
        let rises: Vec<f64> = beams.iter().map(|beam| beam.direction[2]).collect();
        for beam in &mut beams {
            beam.ring = rises.iter().filter(|rise| **rise < beam.direction[2]).count() as u16;
        }
        let steepest = rises.iter().map(|rise| rise.abs()).fold(0.0, f64::max);
        Sensor {
            model,
            columns,
            beams,
            steepest,
            slant: 0.05 + 1.2 * steepest / (1.0 - steepest * steepest).sqrt(),
            scan: Scan::turn(),
            mount: None,
            optics,
        }
    }

    /// Elevations of the beams, rad, from the lowest up.
    pub fn elevations(&self) -> Vec<f64> {
        let mut all: Vec<f64> = self.beams.iter().map(|beam| libm::asin(beam.direction[2])).collect();
        all.sort_by(f64::total_cmp);
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_are_complete() {
        for (sensor, beams, lowest, highest) in [
            (&*Sensor::ruby_plus(), 128, -25.05, 15.03),
            (&*Sensor::os1_128(), 128, -21.82, 20.95),
            (&*Sensor::os1_64(), 64, -16.679, 16.729),
        ] {
            assert_eq!(sensor.beams.len(), beams);
            let mut rings: Vec<u16> = sensor.beams.iter().map(|beam| beam.ring).collect();
            rings.sort_unstable();
            assert!(
                rings.iter().enumerate().all(|(i, ring)| i == usize::from(*ring)),
                "{rings:?}"
            );
            let up = |ring: u16| sensor.beams.iter().find(|b| b.ring == ring).unwrap().direction[2];
            assert!((up(0) - libm::sin(f64::to_radians(lowest))).abs() < 1e-9);
            assert!((up(beams as u16 - 1) - libm::sin(f64::to_radians(highest))).abs() < 1e-9);
            assert!(sensor.beams.windows(2).all(|b| b[0].fires <= b[1].fires));
        }
        let ruby = Sensor::ruby_plus();
        let last = ruby.beams.last().unwrap();
        assert!((last.fires - 53.771e-6).abs() < 1e-12 && (last.azimuth.to_degrees() + 5.9).abs() < 1e-9);
    }
}
