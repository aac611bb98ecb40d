use std::fmt;

use eyre::Result;
use serde::Serialize;

/// How fast the world is cast, on one core.
#[derive(Serialize)]
pub struct Simulate {
    /// Finished points per second of one core, all sensors together.
    points_per_second: f64,
    /// By sensor model: the best sweep.
    sensors: Vec<(String, f64)>,
    points: usize,
    cpu_seconds: f64,
}

/// Casts sweeps at a dense intersection for about `seconds`.
pub fn bench(seconds: f64) -> Result<Simulate> {
    let bench = realo_simulator::bench(seconds)?;
    Ok(Simulate {
        points_per_second: bench.points_per_second,
        sensors: bench.sensors,
        points: bench.points,
        cpu_seconds: bench.cpu_seconds,
    })
}

impl fmt::Display for Simulate {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "finished points per second and core (goal: 5.0 million)")?;
        for (sensor, rate) in &self.sensors {
            writeln!(f, "  {sensor:<20} {:6.2} million (best sweep)", rate / 1e6)?;
        }
        let all = self.points_per_second / 1e6;
        write!(f, "  {:<20} {all:6.2} million ({} points in {:.1} s of CPU)", "all", self.points, self.cpu_seconds)
    }
}
