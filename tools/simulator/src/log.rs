//! A simulation as a log.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use realo_logs::{
    ANTENNA_FRAME, AXLE_FRAME, AgentInfo, AgentKind, FixReading, IMU_FRAME, ImuReading, LogError, LogInfo, LogWriter,
    WheelReading, sensor_frame,
};
use realo_schemas::{Name, Nanos};

use crate::{EPOCH, Error, MAP_ORIGIN, MotionRecord, Options, PoseSample, SWEEP_PERIOD, Scenario, Simulation, Sweep};

/// Road users that heavy traffic has where there is room.
const DENSE: usize = 120;

/// Why no log was written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// Options that cannot be met.
    #[error(transparent)]
    Options(#[from] Error),
    /// The folder of the log cannot be made.
    #[error("{}: {reason}", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// Why.
        reason: std::io::Error,
    },
    /// The log cannot be written.
    #[error(transparent)]
    Log(#[from] LogError),
}

/// How far writing is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Written {
    /// Sweeps so far; 0 before the log is begun.
    pub sweeps: usize,
    /// Sweeps in all.
    pub of: usize,
}

/// Simulates to a log, and says how far it is. Nothing is left at its place unless it is complete.
///
/// # Errors
/// Options that cannot be met; why writing failed.
pub fn write_log(options: &Options, output: &Path, mut far: impl FnMut(Written)) -> Result<(), WriteError> {
    if let Some(folder) = output.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).map_err(|reason| WriteError::Folder {
            path: folder.into(),
            reason,
        })?;
    }
    let simulation = Simulation::new(options)?;
    let of = simulation.sweep_count();
    far(Written { sweeps: 0, of });
    let mut writer = LogWriter::create_atomic(output, &log_info(&simulation))?;
    let mut poses: Vec<(String, VecDeque<PoseSample>)> = simulation
        .agents()
        .map(|agent| {
            (
                agent.name.to_string(),
                simulation.poses(&agent.name).unwrap_or_default().into(),
            )
        })
        .collect();
    let mut motion = MotionLog::begin(&mut writer, &simulation)?;
    for (before, sweep) in simulation.sweeps().enumerate() {
        write_poses(&mut writer, options, &mut poses, sweep.ready)?;
        motion.write(&mut writer, options, sweep.ready)?;
        write_sweep(&mut writer, options, &sweep)?;
        far(Written { sweeps: before + 1, of });
    }
    write_poses(&mut writer, options, &mut poses, Nanos::MAX)?;
    motion.write(&mut writer, options, Nanos::MAX)?;
    writer.finish()?;
    Ok(())
}

/// What an agent's motion sensors say, in order of arrival.
enum Reading {
    Imu(ImuReading),
    Fix(FixReading),
    Wheels(WheelReading),
}

/// A reading that waits: when it arrives, its agent, its true time.
type Waiting = (Nanos, Name, Nanos, Reading);

/// What the motion sensors of all agents say and is not written yet.
struct MotionLog(VecDeque<Waiting>);

impl MotionLog {
    /// Writes how the sensors are mounted.
    fn begin(writer: &mut LogWriter, simulation: &Simulation) -> Result<Self, LogError> {
        let mut all: Vec<Waiting> = Vec::new();
        for agent in simulation.agents() {
            let Some(record) = simulation.motion(&agent.name) else {
                continue;
            };
            let MotionRecord {
                imu,
                fixes,
                wheels,
                imu_mount,
                antenna,
                axle,
            } = record;
            let mounts = [
                (IMU_FRAME, imu_mount, !imu.is_empty()),
                (ANTENNA_FRAME, antenna, true),
                (AXLE_FRAME, axle, !wheels.is_empty()),
            ];
            for (sensor, at, _) in mounts.iter().filter(|(.., is_there)| *is_there) {
                let begins = EPOCH - SWEEP_PERIOD;
                writer.mount(&agent.name, begins, &sensor_frame(&agent.name, sensor), at)?;
            }
            let waiting = |(stamp, ready, reading)| (ready, agent.name.clone(), stamp, reading);
            all.extend(
                imu.into_iter()
                    .map(|(stamp, ready, r)| waiting((stamp, ready, Reading::Imu(r)))),
            );
            all.extend(
                fixes
                    .into_iter()
                    .map(|(stamp, ready, r)| waiting((stamp, ready, Reading::Fix(r)))),
            );
            all.extend(
                wheels
                    .into_iter()
                    .map(|(stamp, ready, r)| waiting((stamp, ready, Reading::Wheels(r)))),
            );
        }
        // Stable: one agent's sensors keep their order.
        all.sort_by_key(|(ready, ..)| *ready);
        Ok(MotionLog(all.into()))
    }

    /// Writes what has arrived until a time.
    fn write(&mut self, writer: &mut LogWriter, options: &Options, until: Nanos) -> Result<(), LogError> {
        while let Some((ready, agent, time, reading)) = self.0.pop_front_if(|(ready, ..)| *ready <= until) {
            let stamp = options.stamp_of(&agent, time);
            match reading {
                Reading::Imu(reading) => writer.imu(&agent, stamp, ready, &reading)?,
                Reading::Fix(reading) => writer.fix(&agent, stamp, ready, &reading)?,
                Reading::Wheels(reading) => writer.wheels(&agent, stamp, ready, &reading)?,
            }
        }
        Ok(())
    }
}

fn write_poses(
    writer: &mut LogWriter,
    options: &Options,
    poses: &mut [(String, VecDeque<PoseSample>)],
    until: Nanos,
) -> Result<(), LogError> {
    loop {
        let earliest = poses
            .iter_mut()
            .filter(|(_, queue)| queue.front().is_some_and(|pose| pose.stamp <= until));
        let Some((agent, queue)) = earliest.min_by_key(|(_, queue)| queue.front().map(|pose| pose.stamp)) else {
            return Ok(());
        };
        let Some(pose) = queue.pop_front() else { return Ok(()) };
        let stamp = options.stamp_of(agent, pose.stamp);
        writer.pose(agent, stamp, pose.stamp, &pose.believed)?;
        writer.pose_truth(agent, stamp, pose.stamp, &pose.truth)?;
    }
}

fn write_sweep(writer: &mut LogWriter, options: &Options, sweep: &Sweep) -> Result<(), LogError> {
    let (agent, ready) = (&*sweep.agent, sweep.ready);
    let stamp = options.stamp_of(agent, sweep.stamp);
    if options.clouds {
        writer.cloud(agent, stamp, ready, &sweep.cloud)?;
    } else {
        writer.sweep(agent, stamp, ready)?;
    }
    writer.truth(agent, stamp, ready, &sweep.truth, Some(&sweep.points), sweep.key)?;
    writer.detections(agent, stamp, ready, &sweep.detections)?;
    Ok(())
}

fn log_info(simulation: &Simulation) -> LogInfo {
    let options = simulation.asked();
    let agents = simulation.agents().map(|agent| AgentInfo {
        name: agent.name.to_string(),
        kind: match agent.kind {
            crate::AgentKind::Vehicle => AgentKind::Vehicle,
            crate::AgentKind::Roadside => AgentKind::Roadside,
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
        "realo-lab simulate: {}{}, place number {}, seed {}{}, {} s, {}{}{}",
        place,
        if options.dense { ", dense" } else { "" },
        simulation.place(),
        options.seed,
        if options.day > 0 {
            format!(", day {}", options.day)
        } else {
            String::new()
        },
        options.seconds,
        options.phase.about(),
        users,
        options
            .inertial
            .map_or_else(String::new, |unit| format!(", {} motion sensors", unit.name())),
    );
    let mut info = LogInfo::new(source.to_lowercase(), agents.collect());
    info.key_frames = format!("{} a second", options.key_hz);
    info.map_origin = options.inertial.map(|_| MAP_ORIGIN);
    info.clock_errors = options.clock_errors.clone();
    info
}
