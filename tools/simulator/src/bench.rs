//! How fast the world is cast.

use std::time::Instant;

use crate::options::{AGENTS, Error, Options};
use crate::simulation::Simulation;

/// What a bench measured on one thread.
#[derive(Clone, Debug, PartialEq)]
pub struct Bench {
    /// For each agent: its sensor's model, and finished points per second of one core (the best of its sweeps).
    pub sensors: Vec<(String, f64)>,
    /// Finished points of all sweeps per second of one core: the sum of points over the sum of times.
    pub points_per_second: f64,
    /// Finished points.
    pub points: usize,
    /// Processor time that they took, s; wall time where the system does not tell.
    pub cpu_seconds: f64,
}

/// Casts sweeps of all four sensors at a dense intersection on the calling thread for about `seconds` and counts the
/// finished points: truth, noise, rounding and recorded detections included, building the world not.
///
/// # Errors
/// Those of [`Simulation::new`].
pub fn bench(seconds: f64) -> Result<Bench, Error> {
    let simulation = Simulation::new(&Options { dense: true, seed: 1, seconds: 2.0, ..Options::default() })?;
    let began = Instant::now();
    let mut sensors = vec![0f64; AGENTS.len()];
    let (mut points, mut cpu_seconds) = (0, 0.0);
    for seq in 0.. {
        for (agent, best) in sensors.iter_mut().enumerate() {
            let before = cpu_time(began);
            let (_, finished) = std::hint::black_box(simulation.sweep(agent, seq % 20));
            let took = cpu_time(began) - before;
            points += finished;
            cpu_seconds += took;
            *best = best.max(finished as f64 / took);
        }
        if began.elapsed().as_secs_f64() >= seconds {
            break;
        }
    }
    let models = simulation.agents().map(|agent| format!("{} ({})", agent.sensor, agent.name));
    let sensors = models.zip(sensors).collect();
    Ok(Bench { sensors, points_per_second: points as f64 / cpu_seconds, points, cpu_seconds })
}

/// Processor time of this thread, s, from an arbitrary origin.
fn cpu_time(began: Instant) -> f64 {
    let told = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let nanos = told.and_then(|text| text.split_whitespace().next()?.parse::<f64>().ok());
    nanos.map_or_else(|| began.elapsed().as_secs_f64(), |nanos| nanos * 1e-9)
}
