//! How fast the world is cast.

use std::time::{Duration, Instant};

use realo_schemas::Name;

use crate::options::{Error, Options, Scenario};
use crate::simulation::Simulation;

/// Log seconds that are simulated, and the sweeps of each agent that are cast in a round.
const SECONDS: f64 = 3.0;
const SWEEPS: [u64; 2] = [8, 21];

/// What was measured on one thread: every place, with usual and with dense traffic.
#[derive(Clone, Debug, PartialEq)]
pub struct Bench {
    /// Seed of all places.
    pub seed: u64,
    /// Sweeps of each agent in a round.
    pub sweeps: usize,
    /// How often everything was cast.
    pub rounds: usize,
    /// One entry for each.
    pub places: Vec<PlaceBench>,
}

/// One place's part of a [`Bench`].
#[derive(Clone, Debug, PartialEq)]
pub struct PlaceBench {
    /// The place.
    pub scenario: Scenario,
    /// Whether the traffic is heavy.
    pub dense: bool,
    /// One entry for each agent.
    pub sensors: Vec<SensorBench>,
}

/// One sensor's part of a [`PlaceBench`].
#[derive(Clone, Debug, PartialEq)]
pub struct SensorBench {
    /// The agent that carries it.
    pub agent: String,
    /// Its model.
    pub model: Name,
    /// Finished points of a round.
    pub points: usize,
    /// Processor time of the quickest round, s; wall time where the system does not tell.
    pub min_seconds: f64,
    /// The same of the median round.
    pub median_seconds: f64,
}

/// Finished points per second of one core over some sensors: in each one's quickest round, and in its median one.
pub fn points_per_second<'a>(sensors: impl IntoIterator<Item = &'a SensorBench>) -> [f64; 2] {
    let sums = sensors.into_iter().fold([0.0; 3], |[points, min, median], sensor| {
        [
            points + sensor.points as f64,
            min + sensor.min_seconds,
            median + sensor.median_seconds,
        ]
    });
    [sums[0] / sums[1], sums[0] / sums[2]]
}

/// Casts sweeps of the four usual sensors at every place, usual and dense, on the calling thread, in rounds for about
/// `seconds` but at least once, and counts the finished points: truth, noise, rounding and recorded detections included,
/// building the world not. `progress` is called with the seconds that went by, between places.
///
/// # Errors
/// Those of [`Simulation::new`].
pub fn bench(seconds: f64, progress: impl FnMut(f64)) -> Result<Bench, Error> {
    let places = Scenario::PLACES.map(|scenario| [(scenario, false), (scenario, true)]);
    measure(places.as_flattened(), seconds, progress)
}

/// Of a sensor the points of a round, and the times of all rounds, s.
type Cast = (usize, Vec<f64>);

fn measure(places: &[(Scenario, bool)], seconds: f64, mut progress: impl FnMut(f64)) -> Result<Bench, Error> {
    let seed = 1;
    let simulations = places.iter().map(|(scenario, dense)| {
        Simulation::new(&Options {
            scenario: *scenario,
            dense: *dense,
            seed,
            seconds: SECONDS,
            ..Options::default()
        })
    });
    let simulations = simulations.collect::<Result<Vec<_>, _>>()?;
    let mut found: Vec<Vec<Cast>> = simulations
        .iter()
        .map(|simulation| vec![(0, Vec::new()); simulation.agents().count()])
        .collect();
    let began = Instant::now();
    loop {
        for (simulation, found) in simulations.iter().zip(&mut found) {
            progress(began.elapsed().as_secs_f64());
            for (agent, (points, times)) in found.iter_mut().enumerate() {
                let before = cpu_time(began);
                let cast = SWEEPS.map(|seq| std::hint::black_box(simulation.sweep(agent, seq)).1);
                times.push(cpu_time(began) - before);
                *points = cast.iter().sum();
            }
        }
        if began.elapsed().as_secs_f64() >= seconds {
            break;
        }
    }
    let rounds = found[0][0].1.len();
    let place = |((scenario, dense), (simulation, found)): (&(Scenario, bool), (&Simulation, Vec<Cast>))| {
        let sensor = |(agent, (points, mut times)): (&crate::AgentInfo, Cast)| {
            times.sort_by(f64::total_cmp);
            SensorBench {
                agent: agent.name.to_string(),
                model: agent.sensor.clone(),
                points,
                min_seconds: times[0],
                median_seconds: times[times.len() / 2],
            }
        };
        PlaceBench {
            scenario: *scenario,
            dense: *dense,
            sensors: simulation.agents().zip(found).map(sensor).collect(),
        }
    };
    Ok(Bench {
        seed,
        sweeps: SWEEPS.len(),
        rounds,
        places: places.iter().zip(simulations.iter().zip(found)).map(place).collect(),
    })
}

/// Processor time of this thread, s, from an arbitrary origin.
fn cpu_time(began: Instant) -> f64 {
    // The system adds up a thread's time when it leaves the processor, else only at each tick.
    std::thread::sleep(Duration::from_micros(1));
    let reported = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let nanos = reported.and_then(|text| text.split_whitespace().next()?.parse::<f64>().ok());
    nanos.map_or_else(|| began.elapsed().as_secs_f64(), |nanos| nanos * 1e-9)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bench_counts_points_of_every_sensor_of_every_place() {
        let asked = [(Scenario::Corridor, false), (Scenario::Motorway, true)];
        let bench = measure(&asked, 0.0, |_| ()).unwrap();
        assert_eq!(bench.rounds, 1);
        let places: Vec<_> = bench.places.iter().map(|place| (place.scenario, place.dense)).collect();
        assert_eq!(places, asked);
        for place in &bench.places {
            let agents: Vec<&str> = place.sensors.iter().map(|sensor| &*sensor.agent).collect();
            assert_eq!(agents, ["cav1", "cav2", "rsu1", "rsu2"]);
            assert!(place.sensors.iter().all(|sensor| sensor.points > 40_000));
            assert!(place.sensors.iter().all(|sensor| sensor.min_seconds > 0.0));
        }
        let sensor = |points, min_seconds, median_seconds| SensorBench {
            agent: "a".into(),
            model: "m".into(),
            points,
            min_seconds,
            median_seconds,
        };
        let two = [sensor(300, 1.0, 2.0), sensor(100, 1.0, 3.0)];
        assert_eq!(points_per_second(&two), [200.0, 80.0]);
    }
}
