//! A simulation as a log.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use realo_logs::{AgentInfo, AgentKind, LogError, LogInfo, LogWriter};
use realo_schemas::Nanos;

use crate::{Error, Options, PoseSample, Scenario, Simulation, Sweep};

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
    for (before, sweep) in simulation.sweeps().enumerate() {
        write_poses(&mut writer, &mut poses, sweep.ready)?;
        write_sweep(&mut writer, &sweep, options.clouds)?;
        far(Written { sweeps: before + 1, of });
    }
    write_poses(&mut writer, &mut poses, Nanos::MAX)?;
    writer.finish()?;
    Ok(())
}

fn write_poses(
    writer: &mut LogWriter,
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
        writer.pose(agent, pose.stamp, pose.stamp, &pose.believed)?;
        writer.pose_truth(agent, pose.stamp, pose.stamp, &pose.truth)?;
    }
}

fn write_sweep(writer: &mut LogWriter, sweep: &Sweep, clouds: bool) -> Result<(), LogError> {
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

fn log_info(simulation: &Simulation) -> LogInfo {
    let options = simulation.options();
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
        "realo-lab simulate: {}{}, place number {}, seed {}, {} s, {}{}",
        place,
        if options.dense { ", dense" } else { "" },
        simulation.place(),
        options.seed,
        options.seconds,
        options.phase.about(),
        users,
    );
    let mut info = LogInfo::new(source.to_lowercase(), agents.collect());
    info.key_frames = format!("{} a second", options.key_hz);
    info
}
