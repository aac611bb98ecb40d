use std::fmt;

use eyre::Result;
use serde::Serialize;

/// How fast the world is cast, on one core.
#[derive(Serialize)]
pub struct Simulate {
    /// Finished points per second of one core, all sensors together.
    points_per_second: f64,
    /// The same from all sweeps, on a machine that may do other things.
    mean_points_per_second: f64,
    /// By sensor: the fastest group of sweeps.
    sensors: Vec<(String, f64)>,
    points: usize,
    cpu_seconds: f64,
}

/// Casts sweeps at a dense intersection for about `seconds`.
pub fn bench(seconds: f64) -> Result<Simulate> {
    let bench = realo_simulator::bench(seconds)?;
    Ok(Simulate {
        points_per_second: bench.points_per_second,
        mean_points_per_second: bench.mean_points_per_second,
        sensors: bench
            .sensors
            .iter()
            .map(|s| (format!("{} ({})", s.model, s.agent), s.points_per_second))
            .collect(),
        points: bench.points,
        cpu_seconds: bench.cpu_seconds,
    })
}

impl fmt::Display for Simulate {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "finished points per second and core (goal: 5.0 million)")?;
        for (sensor, rate) in &self.sensors {
            writeln!(f, "  {sensor:<24} {:6.2} million", rate / 1e6)?;
        }
        let all = self.points_per_second / 1e6;
        let mean = self.mean_points_per_second / 1e6;
        writeln!(
            f,
            "  {:<24} {all:6.2} million (from each sensor's fastest sweeps)",
            "all"
        )?;
        write!(
            f,
            "  {:<24} {mean:6.2} million ({} points in {:.1} s of CPU)",
            "all sweeps", self.points, self.cpu_seconds
        )
    }
}
