//! How fast the world is cast.

use std::time::Instant;

use realo_schemas::Name;

use crate::options::{Error, Options};
use crate::simulation::Simulation;

/// Sweeps timed together: long enough that the clock's own steps do not matter.
const GROUP: u64 = 6;

/// What a bench measured on one thread.
#[derive(Clone, Debug, PartialEq)]
pub struct Bench {
    /// One entry for each agent.
    pub sensors: Vec<SensorBench>,
    /// Finished points per second of one core over all four sensors, from each one's fastest group of sweeps.
    pub points_per_second: f64,
    /// The same from all sweeps.
    pub mean_points_per_second: f64,
    /// Finished points of all sweeps.
    pub points: usize,
    /// Processor time that they took, s; wall time where the system does not tell.
    pub cpu_seconds: f64,
}

/// One sensor's part of a [`Bench`].
#[derive(Clone, Debug, PartialEq)]
pub struct SensorBench {
    /// The agent that carries it.
    pub agent: String,
    /// Its model.
    pub model: Name,
    /// Finished points per second of one core, in the fastest group of sweeps.
    pub points_per_second: f64,
}

/// Casts sweeps of all four sensors at a dense intersection on the calling thread for about `seconds` and counts the
/// finished points: truth, noise, rounding and recorded detections included, building the world not.
///
/// # Errors
/// Those of [`Simulation::new`].
pub fn bench(seconds: f64) -> Result<Bench, Error> {
    let simulation = Simulation::new(&Options {
        dense: true,
        seed: 1,
        seconds: 3.0,
        ..Options::default()
    })?;
    let began = Instant::now();
    let agents: Vec<_> = simulation.agents().collect();
    // Points and time of each agent's fastest group.
    let mut best = vec![(0usize, f64::INFINITY); agents.len()];
    let (mut points, mut cpu_seconds) = (0, 0.0);
    for round in 0.. {
        for (agent, best) in best.iter_mut().enumerate() {
            let first = round * GROUP % (simulation.options().sweeps_per_agent() - GROUP);
            let before = cpu_time(began);
            let finished: usize = (first..first + GROUP)
                .map(|seq| std::hint::black_box(simulation.sweep(agent, seq)).1)
                .sum();
            let took = cpu_time(began) - before;
            points += finished;
            cpu_seconds += took;
            if finished as f64 * best.1 > best.0 as f64 * took {
                *best = (finished, took);
            }
        }
        if began.elapsed().as_secs_f64() >= seconds {
            break;
        }
    }
    let of_all = best
        .iter()
        .fold((0, 0.0), |(points, time), (p, t)| (points + p, time + t));
    let sensors = agents.iter().zip(&best).map(|(agent, (points, time))| SensorBench {
        agent: agent.name.to_string(),
        model: agent.sensor.clone(),
        points_per_second: *points as f64 / time,
    });
    Ok(Bench {
        sensors: sensors.collect(),
        points_per_second: of_all.0 as f64 / of_all.1,
        mean_points_per_second: points as f64 / cpu_seconds,
        points,
        cpu_seconds,
    })
}

/// Processor time of this thread, s, from an arbitrary origin.
fn cpu_time(began: Instant) -> f64 {
    let told = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let nanos = told.and_then(|text| text.split_whitespace().next()?.parse::<f64>().ok());
    nanos.map_or_else(|| began.elapsed().as_secs_f64(), |nanos| nanos * 1e-9)
}

#[cfg(test)]
mod tests {
    #[test]
    fn bench_counts_points_of_every_sensor() {
        let bench = super::bench(0.0).unwrap();
        assert_eq!(
            bench.sensors.iter().map(|s| s.agent.as_str()).collect::<Vec<_>>(),
            ["cav1", "cav2", "rsu1", "rsu2"]
        );
        assert!(bench.sensors.iter().all(|sensor| sensor.points_per_second > 1e4));
        assert!(bench.points > 1_000_000 && bench.cpu_seconds > 0.0);
    }
}
