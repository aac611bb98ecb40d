//! `realo simulate`: a simulated world to a log.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::ValueEnum;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use eyre::{Result, WrapErr};
use realo_logs::{AgentInfo, AgentKind, LogInfo, LogWriter};
use realo_schemas::Nanos;
use realo_simulator::{Options, Phase, PoseSample, Scenario, Sensor, Simulation, Sweep, Weather, fleet};

use crate::output::{Force, Output};
use crate::progress::Progress;
use crate::{Outcome, statistics, unfinished};

/// Simulates a place, its traffic and the agents that record it
#[derive(clap::Args)]
pub struct Args {
    /// Which place; mixed: one of all, as the place's number says
    #[arg(long, value_parser = scenarios(), default_value = "intersection")]
    scenario: Scenario,
    /// Heavy traffic: at least 120 road users, or as many as there is room for
    #[arg(long)]
    dense: bool,
    /// Fixes roads and buildings [default: from the seed]
    #[arg(long)]
    place: Option<u64>,
    /// Sweeps start together (locked) or, of four agents, at least 15 ms apart (spread)
    #[arg(long, value_enum, default_value = "locked")]
    phase: PhaseArg,
    /// Fixes traffic and noise; 0–799 train, 800–899 validate, 900–999 test
    #[arg(long, required_unless_present = "statistics")]
    seed: Option<u64>,
    /// Length of the log
    #[arg(long, required_unless_present = "statistics")]
    seconds: Option<f64>,
    /// Agents that record
    #[arg(long, value_delimiter = ',', default_values_t = realo_simulator::AGENTS.map(String::from))]
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
    /// Where the place lies in the map: east,north in metres
    #[arg(long, value_delimiter = ',', num_args = 1, default_values_t = [0.0, 0.0])]
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
    let names = Scenario::PLACES.map(Scenario::name).into_iter();
    PossibleValuesParser::new(names.chain([Scenario::Mixed.name()])).try_map(|name| Scenario::from_name(&name))
}

#[derive(Clone, Copy, ValueEnum)]
enum PhaseArg {
    Locked,
    Spread,
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
            phase: match self.phase {
                PhaseArg::Locked => Phase::Locked,
                PhaseArg::Spread => Phase::Spread,
            },
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
            ..Options::default()
        })
    }
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
    if let Some(folder) = output.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).wrap_err_with(|| format!("{}", folder.display()))?;
    }
    let simulation = Simulation::new(options)?;
    unfinished::note(output);
    let mut writer = LogWriter::create_atomic(output, &log_info(&simulation))?;
    let progress = Progress::new("simulating", "sweeps", Some(simulation.sweep_count() as f64));
    let mut poses: Vec<(String, VecDeque<PoseSample>)> = simulation
        .agents()
        .map(|agent| {
            (
                agent.name.to_string(),
                simulation.poses(&agent.name).unwrap_or_default().into(),
            )
        })
        .collect();
    for sweep in simulation.sweeps() {
        write_poses(&mut writer, &mut poses, sweep.ready)?;
        write_sweep(&mut writer, &sweep, options.clouds)?;
        progress.add(1.0);
    }
    write_poses(&mut writer, &mut poses, Nanos::MAX)?;
    writer.finish()?;
    unfinished::done(output);
    progress.finish();
    Ok(())
}

fn write_poses(writer: &mut LogWriter, poses: &mut [(String, VecDeque<PoseSample>)], until: Nanos) -> Result<()> {
    loop {
        let earliest = poses
            .iter_mut()
            .filter(|(_, queue)| queue.front().is_some_and(|pose| pose.stamp <= until));
        let Some((agent, queue)) = earliest.min_by_key(|(_, queue)| queue.front().map(|pose| pose.stamp)) else {
            return Ok(());
        };
        let Some(pose) = queue.pop_front() else { return Ok(()) };
        writer.pose(agent, pose.stamp, pose.stamp, &pose.believed)?;
        writer.pose_truth(agent, pose.stamp, pose.stamp, &pose.truth)?;
    }
}

fn write_sweep(writer: &mut LogWriter, sweep: &Sweep, clouds: bool) -> Result<()> {
    let (agent, stamp, ready) = (&*sweep.agent, sweep.stamp, sweep.ready);
    if clouds {
        writer.cloud(agent, stamp, ready, &sweep.cloud)?;
    } else {
        writer.sweep(agent, stamp, ready)?;
    }
    writer.truth(agent, stamp, ready, &sweep.truth, Some(&sweep.points), sweep.key)?;
    writer.detections(agent, stamp, ready, &sweep.detections)?;
    Ok(())
}

/// Road users that heavy traffic has where there is room.
const DENSE: usize = 120;

fn log_info(simulation: &Simulation) -> LogInfo {
    let options = simulation.options();
    let agents = simulation.agents().map(|agent| AgentInfo {
        name: agent.name.to_string(),
        kind: match agent.kind {
            realo_simulator::AgentKind::Vehicle => AgentKind::Vehicle,
            realo_simulator::AgentKind::Roadside => AgentKind::Roadside,
        },
        footprint: agent.footprint,
        sensor: agent.sensor.to_string(),
        sensor_position: Some([0.0, 0.0, agent.sensor_height]),
    });
    let place = match (options.scenario, simulation.scenario()) {
        (Scenario::Mixed, drawn) => format!("mixed ({})", drawn.name()),
        (own, _) => own.name().into(),
    };
    let users = match (simulation.road_users(), simulation.scenario()) {
        (_, Scenario::Intersection | Scenario::Corridor) => String::new(),
        (found, _) if options.dense && found < DENSE => {
            format!(", {found} road users of {DENSE}: there is room for no more")
        }
        (found, _) => format!(", {found} road users"),
    };
    let source = format!(
        "realo simulate: {}{}, place {}, seed {}, {} s, phase {:?}{}",
        place,
        if options.dense { ", dense" } else { "" },
        simulation.place(),
        options.seed,
        options.seconds,
        options.phase,
        users,
    );
    let mut info = LogInfo::new(source.to_lowercase(), agents.collect());
    info.key_frames = format!("{} a second", options.key_hz);
    info
}
