//! The LiDARs: beam tables, firing times, optics.

use std::sync::OnceLock;

/// A spinning LiDAR. It turns clockwise (seen from above), from the rear over the left, the front and the right back
/// to the rear: half-way through a sweep it looks ahead.
#[derive(Clone, Debug)]
pub(crate) struct Sensor {
    /// Model, for a log's metadata.
    pub model: &'static str,
    /// Columns of a turn of 0.1 s.
    pub columns: usize,
    /// In the order in which they fire.
    pub beams: Vec<Beam>,
    /// Greatest rise or fall of a beam, as a sine.
    pub steepest: f64,
    pub optics: Optics,
}

/// One beam.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Beam {
    /// Direction with the column straight ahead: unit vector.
    pub direction: [f64; 3],
    /// Clockwise offset from the column's azimuth, rad.
    pub azimuth: f64,
    /// Time after the column's start, s.
    pub fires: f64,
    /// Number from the lowest beam up.
    pub ring: u16,
}

/// What comes back: signal-to-noise `q = √3 · ρ cos(incidence) / ρ₀ · (R₀/R)²` relative to the level of even chance;
/// a return is seen with probability `q⁴ / (q⁴ + 1)`, which is 0.9 for reflectivity ρ₀ at range R₀ (the data sheet's
/// point), and its range scatters by `floor + slope / √q`, at most `ceiling`.
#[derive(Clone, Copy, Debug)]
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
}

/// Share of the rays that give nothing whatever they meet.
pub(crate) const DROPOUT: f64 = 0.004;

/// The reach at 10 % (200 m) and the noise are modelling choices: public text gives neither for this unit.
const RUBY_PLUS: Optics = Optics {
    strength: 1.732_050_807_568_877_2 / 0.1,
    reference_range: 200.0,
    nearest: 0.4,
    farthest: 250.0,
    step: 0.005,
    steps_per_metre: 200.0,
    noise_floor: 0.008,
    noise_slope: 0.012,
    noise_ceiling: 0.06,
};

/// Data sheet: 120 m at 80 %, 1σ from 0.015 m (strong) to 0.1 m (weak), steps of 12 mm.
const OS1: Optics = Optics {
    strength: 1.732_050_807_568_877_2 / 0.8,
    reference_range: 120.0,
    nearest: 0.8,
    farthest: 150.0,
    step: 0.012,
    steps_per_metre: 1.0 / 0.012,
    noise_floor: 0.01,
    noise_slope: 0.03,
    noise_ceiling: 0.1,
};

impl Sensor {
    /// 128 beams of a RoboSense Ruby Plus, 1,800 columns.
    pub fn ruby_plus() -> &'static Sensor {
        static SENSOR: OnceLock<Sensor> = OnceLock::new();
        let table = include_str!("../sensors/robosense_ruby_plus_128.csv");
        SENSOR.get_or_init(|| Sensor::from_table("robosense-ruby-plus-128", 1800, table, RUBY_PLUS))
    }

    /// 128 beams of an Ouster OS1-128, 1,024 columns.
    pub fn os1_128() -> &'static Sensor {
        static SENSOR: OnceLock<Sensor> = OnceLock::new();
        let table = include_str!("../sensors/ouster_os1_128.csv");
        SENSOR.get_or_init(|| Sensor::from_table("ouster-os1-128", 1024, table, OS1))
    }

    /// 64 beams of a first-generation Ouster OS1-64, 1,024 columns.
    pub fn os1_64() -> &'static Sensor {
        static SENSOR: OnceLock<Sensor> = OnceLock::new();
        let table = include_str!("../sensors/ouster_os1_64_gen1.csv");
        SENSOR.get_or_init(|| Sensor::from_table("ouster-os1-64", 1024, table, OS1))
    }

    /// Columns: number, elevation (degrees), azimuth offset (degrees); with five columns also the firing offset (µs).
    fn from_table(model: &'static str, columns: usize, table: &str, optics: Optics) -> Sensor {
        let number = |text: &str| {
            text.trim()
                .parse::<f64>()
                .expect("an embedded beam table holds numbers")
        };
        let rows: Vec<Vec<f64>> = table
            .lines()
            .skip(1)
            .map(|line| line.split(',').map(number).collect())
            .collect();
        let below = |elevation: f64| rows.iter().filter(|row| row[1] < elevation).count() as u16;
        let beams: Vec<Beam> = rows
            .iter()
            .map(|row| {
                let (sin_el, cos_el) = libm::sincos(row[1].to_radians());
                let azimuth = row[2].to_radians();
                let (sin, cos) = libm::sincos(-azimuth);
                let fires = row.get(4).copied().unwrap_or(0.0) * 1e-6;
                Beam {
                    direction: [cos_el * cos, cos_el * sin, sin_el],
                    azimuth,
                    fires,
                    ring: below(row[1]),
                }
            })
            .collect();
        let steepest = beams.iter().map(|beam| beam.direction[2].abs()).fold(0.0, f64::max);
        Sensor {
            model,
            columns,
            beams,
            steepest,
            optics,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_are_complete() {
        for (sensor, beams, lowest, highest) in [
            (Sensor::ruby_plus(), 128, -25.05, 15.03),
            (Sensor::os1_128(), 128, -21.82, 20.95),
            (Sensor::os1_64(), 64, -16.679, 16.729),
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
        let last = Sensor::ruby_plus().beams.last().unwrap();
        assert!((last.fires - 53.771e-6).abs() < 1e-12 && (last.azimuth.to_degrees() + 5.9).abs() < 1e-9);
    }
}
