use std::fmt;

use eyre::Result;
use realo_simulator::{PlaceBench, Scenario, points_per_second};
use serde::Serialize;

use crate::progress::Progress;

/// How fast the world is cast, on one core.
#[derive(Serialize)]
pub struct Simulate {
    threads: usize,
    seed: u64,
    /// Of each of the four sensors at each place, in a round.
    sweeps: usize,
    rounds: usize,
    places: Vec<Place>,
    /// By sensor: dense traffic at the intersection.
    dense_intersection: Vec<(String, Rate)>,
    over_all: Rate,
}

/// Finished points per second of one core.
#[derive(Clone, Copy, Serialize)]
struct Rate {
    /// From each sensor's quickest round.
    best: f64,
    /// From its median round.
    median: f64,
}

#[derive(Serialize)]
struct Place {
    name: &'static str,
    usual: Rate,
    dense: Rate,
}

impl Rate {
    fn of<'a>(places: impl IntoIterator<Item = &'a PlaceBench>) -> Self {
        let [best, median] = points_per_second(places.into_iter().flat_map(|place| &place.sensors));
        Rate { best, median }
    }
}

/// Casts sweeps of every place in rounds for about `seconds`.
pub fn bench(seconds: f64, progress: &Progress) -> Result<Simulate> {
    progress.count("s", seconds);
    let bench = realo_simulator::bench(seconds, |done| progress.set(done.min(seconds)))?;
    let rate = |scenario: Scenario, dense: bool| {
        let own = |place: &&PlaceBench| place.scenario == scenario && place.dense == dense;
        Rate::of(bench.places.iter().filter(own))
    };
    let old = |place: &&PlaceBench| place.scenario == Scenario::Intersection && place.dense;
    let sensors = bench.places.iter().filter(old).flat_map(|place| &place.sensors);
    Ok(Simulate {
        threads: 1,
        seed: bench.seed,
        sweeps: bench.sweeps,
        rounds: bench.rounds,
        places: Scenario::PLACES
            .map(|scenario| Place {
                name: scenario.name(),
                usual: rate(scenario, false),
                dense: rate(scenario, true),
            })
            .into(),
        dense_intersection: sensors
            .map(|sensor| {
                let [best, median] = points_per_second([sensor]);
                (format!("{} ({})", sensor.model, sensor.agent), Rate { best, median })
            })
            .collect(),
        over_all: Rate::of(&bench.places),
    })
}

impl fmt::Display for Rate {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{:6.2} {:6.2}", self.median / 1e6, self.best / 1e6)
    }
}

impl fmt::Display for Simulate {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Simulate {
            threads,
            seed,
            sweeps,
            rounds,
            ..
        } = self;
        writeln!(
            f,
            "finished points per second and core, millions (bar: 5.0 over all); {threads} thread, seed {seed}, {sweeps} sweeps of \
             each of the four usual sensors a round, {rounds} rounds; from each sensor's median and quickest round"
        )?;
        writeln!(f, "  {:<32} usual traffic  dense traffic", "")?;
        writeln!(f, "  {:<32} median   best  median   best", "place")?;
        for Place { name, usual, dense } in &self.places {
            writeln!(f, "  {name:<32} {usual}  {dense}")?;
        }
        let all = self
            .places
            .iter()
            .flat_map(|place| [(place, "usual", place.usual), (place, "dense", place.dense)]);
        if let Some((place, traffic, rate)) = all.min_by(|a, b| a.2.median.total_cmp(&b.2.median)) {
            writeln!(f, "  {:<32} {rate}", format!("min: {}, {traffic}", place.name))?;
        }
        writeln!(f, "  {:<32} {}", "over all", self.over_all)?;
        write!(f, "dense intersection by sensor")?;
        for (sensor, rate) in &self.dense_intersection {
            write!(f, "\n  {sensor:<32} {rate}")?;
        }
        Ok(())
    }
}
