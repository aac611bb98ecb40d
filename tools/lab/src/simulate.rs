//! `realo-lab simulate`: a simulated world to a log.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::builder::{PossibleValuesParser, TypedValueParser};
use eyre::Result;
use realo_cli::{Force, Outcome, Output, Progress, one_of, unfinished};
use realo_logs::ClockError;
use realo_schemas::Nanos;
use realo_simulator::{MotionUnit, Options, Phase, Scenario, Sensor, Weather, fleet, write_log};

use crate::statistics;

/// Simulates a place, its traffic and the agents that record it
#[derive(clap::Args)]
pub struct Args {
    /// Which place; mixed: one of all but loop, as the place's number says
    #[arg(long, value_parser = scenarios(), default_value = "intersection")]
    scenario: Scenario,
    /// Heavy traffic: at least 120 road users, or as many as there is room for
    #[arg(long)]
    dense: bool,
    /// Fixes roads and buildings [default: from the seed]
    #[arg(long)]
    place: Option<u64>,
    /// Sweeps start together (locked) or, of four agents, at least 15 ms apart (spread)
    #[arg(long, value_parser = one_of(Phase::ALL), default_value = "locked")]
    phase: Phase,
    /// When an agent's first sweep starts, ms after the log's beginning, in the place of what --phase says; repeatable
    #[arg(long, value_name = "AGENT=MS", value_parser = sweep_phase)]
    sweep_phase: Vec<(String, f64)>,
    /// How wrong an agent's clock is: offset at the beginning, drift, and a jump at a time; repeatable
    #[arg(long, value_name = "AGENT=OFFSET_MS[,DRIFT_PPM[,STEP_MS@S]]", value_parser = clock_error)]
    clock_error: Vec<(String, ClockError)>,
    /// Motion sensors: IMU, satellite receiver and wheels of each vehicle, receivers of roadside units
    #[arg(long, value_name = "UNIT", value_parser = one_of(MotionUnit::ALL))]
    inertial: Option<MotionUnit>,
    /// The day: another one has other traffic, parked cars and foliage in the same place
    #[arg(long, value_name = "N", default_value_t = 0)]
    day: u64,
    /// Fixes traffic and noise; 0–799 train, 800–899 validate, 900–999 test
    #[arg(long, required_unless_present = "statistics")]
    seed: Option<u64>,
    /// Length of the log
    #[arg(long, required_unless_present = "statistics")]
    seconds: Option<f64>,
    /// Agents that record [default: cav1,cav2,rsu1,rsu2]
    #[arg(long, value_delimiter = ',', hide_default_value = true, default_values_t = realo_simulator::AGENTS.map(String::from))]
    agents: Vec<String>,
    /// Vehicles that record, instead of --agents; at most 16 agents in all
    #[arg(long, value_name = "COUNT", conflicts_with = "agents")]
    vehicles: Option<usize>,
    /// Roadside units that record, instead of --agents
    #[arg(long, value_name = "COUNT", conflicts_with = "agents")]
    roadside: Option<usize>,
    /// Rain, mm/h
    #[arg(long, value_name = "MM_H", default_value_t = 0.0)]
    rain: f64,
    /// Fog in which one sees so far, m
    #[arg(long, value_name = "METRES")]
    visibility: Option<f64>,
    /// Scored frames per second
    #[arg(long, default_value_t = 1.0)]
    key_hz: f64,
    /// Records only scored sweeps and each agent's first, for offline runs over many seeds
    #[arg(long)]
    key_sweeps_only: bool,
    /// Recorded detections without noise: the truth of what the agent has points on
    #[arg(long)]
    noise_free_detections: bool,
    /// Own points from which an object can be in the recorded detections
    #[arg(long, default_value_t = 5)]
    detection_min_points: u32,
    /// Leaves the points out; poses, truth and recorded detections are the same
    #[arg(long)]
    no_clouds: bool,
    /// Origin of the place in the map: east,north in metres [default: 0,0]
    #[arg(long, value_delimiter = ',', hide_default_value = true, num_args = 1, default_values_t = [0.0, 0.0])]
    map_offset: Vec<f64>,
    /// The vehicles' sensors, dealt out in turn: names of built-in ones, or files that end in .toml
    #[arg(long, value_delimiter = ',', value_name = "SENSOR")]
    vehicle_sensor: Vec<String>,
    /// The roadside units' sensors, as above
    #[arg(long, value_delimiter = ',', value_name = "SENSOR")]
    roadside_sensor: Vec<String>,
    /// The log to write
    #[arg(short = 'o', long = "output", required_unless_present = "statistics")]
    output: Option<PathBuf>,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    force: Force,
    /// Simulates nothing: prints what the clouds of logs are like, real or simulated
    #[arg(long, num_args = 1.., value_name = "LOG", conflicts_with_all = ["seed", "seconds", "output", "vehicles", "roadside"])]
    statistics: Vec<PathBuf>,
    /// With --statistics: counts of each cloud only the rings nearest to the beams of this sensor
    #[arg(long, value_name = "SENSOR", requires = "statistics")]
    like: Option<String>,
}

/// The scenarios by their names.
fn scenarios() -> impl TypedValueParser<Value = Scenario> {
    let names = Scenario::ALL.map(Scenario::name).into_iter();
    PossibleValuesParser::new(names.chain([Scenario::Mixed.name()])).try_map(|name| Scenario::from_name(&name))
}

impl Args {
    fn options(&self) -> Result<Options> {
        let map_offset_m = <[f64; 2]>::try_from(&self.map_offset[..]).map_err(|_| {
            eyre::eyre!(
                "--map-offset: expected east,north, found {} numbers",
                self.map_offset.len()
            )
        })?;
        Ok(Options {
            scenario: self.scenario,
            phase: self.phase,
            dense: self.dense,
            place: self.place,
            seed: self.seed.unwrap_or_default(),
            seconds: self.seconds.unwrap_or_default(),
            key_hz: self.key_hz,
            key_sweeps_only: self.key_sweeps_only,
            map_offset_m,
            noise_free_detections: self.noise_free_detections,
            detection_min_points: self.detection_min_points,
            agents: match (self.vehicles, self.roadside) {
                (None, None) => self.agents.clone(),
                (vehicles, roadside) => fleet(vehicles.unwrap_or(0), roadside.unwrap_or(0))?,
            },
            weather: Weather {
                rain_mm_h: self.rain,
                visibility_m: self.visibility,
            },
            clouds: !self.no_clouds,
            vehicle_sensors: sensors(&self.vehicle_sensor)?,
            roadside_sensors: sensors(&self.roadside_sensor)?,
            day: self.day,
            inertial: self.inertial,
            clock_errors: self.clock_error.iter().cloned().collect(),
            sweep_phase_ms: self.sweep_phase.iter().cloned().collect(),
            ..Options::default()
        })
    }
}

/// A name and what follows its `=`.
fn named<'a>(text: &'a str, form: &str) -> Result<(String, &'a str), String> {
    let (agent, rest) = text
        .split_once('=')
        .ok_or_else(|| format!("expected {form}, found no `=`"))?;
    Ok((agent.into(), rest))
}

fn number(text: &str, what: &str) -> Result<f64, String> {
    let number: Option<f64> = text.trim().parse().ok();
    number
        .filter(|number| number.is_finite())
        .ok_or_else(|| format!("expected a number for {what}, found `{text}`"))
}

fn sweep_phase(text: &str) -> Result<(String, f64), String> {
    let (agent, phase) = named(text, "AGENT=MS")?;
    Ok((agent, number(phase, "MS")?))
}

fn clock_error(text: &str) -> Result<(String, ClockError), String> {
    const FORM: &str = "AGENT=OFFSET_MS[,DRIFT_PPM[,STEP_MS@S]]";
    let (agent, rest) = named(text, FORM)?;
    let parts: Vec<&str> = rest.split(',').collect();
    let nanos = |ms: f64| (ms * 1e6).round() as Nanos;
    let mut error = ClockError::default();
    match parts[..] {
        [offset] | [offset, _] | [offset, _, _] => error.offset = nanos(number(offset, "OFFSET_MS")?),
        _ => return Err(format!("expected {FORM}, found {} parts behind `=`", parts.len())),
    }
    if let Some(drift) = parts.get(1) {
        error.drift = number(drift, "DRIFT_PPM")? / 1e6;
    }
    if let Some(step) = parts.get(2) {
        let (step, at) = step
            .split_once('@')
            .ok_or_else(|| format!("expected STEP_MS@S, found `{step}`"))?;
        error.step = nanos(number(step, "STEP_MS")?);
        error.step_at = nanos(1e3 * number(at, "S")?);
    }
    Ok((agent, error))
}

fn sensors(names: &[String]) -> Result<Vec<Arc<Sensor>>> {
    Ok(names.iter().map(|name| Sensor::named(name)).collect::<Result<_, _>>()?)
}

/// Writes the log; nothing is left at its place unless it is complete.
pub fn main(args: &Args) -> Result<Outcome> {
    let Some(output) = args.output.as_ref().filter(|_| args.statistics.is_empty()) else {
        return statistics::print(&args.statistics, args.like.as_deref());
    };
    args.force.check(output, Output::Log)?;
    unfinished::end_with_signals(output);
    write(&args.options()?, output)?;
    println!("{}", realo_logs::describe(output)?);
    Ok(Outcome::Complete)
}

/// Simulates to a log, and reports how far it is.
///
/// # Errors
/// Options that cannot be met; why writing failed.
pub fn write(options: &Options, output: &Path) -> Result<()> {
    unfinished::note(output);
    let progress = Progress::new("simulating", "sweeps", Some(0.0));
    write_log(options, output, |far| match far.sweeps {
        0 => progress.begin(0.0, far.of as f64),
        sweeps => progress.set(sweeps as f64),
    })?;
    unfinished::done(output);
    progress.finish();
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_of_clocks_are_read_or_refused_with_the_form() {
        let read = |text: &str| {
            clock_error(text).map(|(agent, error)| (agent, error.offset, error.drift, error.step, error.step_at))
        };
        assert_eq!(read("cav1=-30"), Ok(("cav1".into(), -30_000_000, 0.0, 0, 0)));
        assert_eq!(read("rsu1=37000,20"), Ok(("rsu1".into(), 37_000_000_000, 2e-5, 0, 0)));
        assert_eq!(
            read("cav2=0,0,-1000@4.5"),
            Ok(("cav2".into(), 0, 0.0, -1_000_000_000, 4_500_000_000))
        );
        for (wrong, words) in [
            ("cav1", "no `=`"),
            ("cav1=fast", "OFFSET_MS, found `fast`"),
            ("cav1=1,inf", "DRIFT_PPM"),
            ("cav1=1,2,3", "STEP_MS@S"),
            ("cav1=1,2,3@4,5", "4 parts"),
        ] {
            let error = read(wrong).unwrap_err();
            assert!(error.contains(words), "{wrong}: {error}");
        }
        assert_eq!(sweep_phase("cav1=12.5"), Ok(("cav1".into(), 12.5)));
        assert!(sweep_phase("cav1=x").unwrap_err().contains("MS, found `x`"));
    }
}
