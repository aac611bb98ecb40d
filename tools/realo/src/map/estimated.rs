//! Poses of drives by the vehicles' own sensors, from logs.

use std::collections::BTreeMap;

use eyre::{Result, bail};
use realo_cli::Progress;
use realo_logs::{Log, MAX_GAP, Stream, levelled_while_played, pose_track};
use realo_mapping::{
    Drive, Errors, Lean, Mapped, MappedDrive, MappingError, Odometry, OdometrySettings, Summary, errors, solve,
};
use realo_registration::Closure;
use realo_schemas::Nanos;
use realo_schemas::geometry::PoseTrack;
use realo_sync::{OwnBody, clean};

use super::report;
use super::sweeps::{Agent, cloud_of, is_vehicle};

/// How often drives are followed anew because their sensors lean. Each time finds most of what is left, and all of it on straight ways.
const LEVELLINGS: usize = 3;

/// A drive of a log.
pub struct Driven {
    /// Number of its log.
    pub log: usize,
    /// The log's path and the agent, for people.
    pub name: String,
    pub agent: String,
    pub drive: Drive,
    /// Stamps of its sweeps.
    pub sweeps: Vec<Nanos>,
    /// Messages of motion sensors that cannot be read, and the first reason.
    pub unusable: Option<(u64, String)>,
    /// Whether its log has positions of GNSS.
    pub has_fixes: bool,
    /// How its sensor leans by what loops said, and how sure that is; sweeps were levelled by it.
    pub lean: Option<Lean>,
    /// Whether its log's sweeps lean with the vehicle.
    pub leans: bool,
    /// Where the log has the truth.
    truth: Option<PoseTrack>,
}

/// What was found.
pub struct Estimated {
    /// The agents of each log that have poses.
    pub posed: Vec<BTreeMap<String, Agent>>,
    pub driven: Vec<Driven>,
    pub mapped: Vec<MappedDrive>,
    pub summary: Summary,
    /// Errors against the truth before and after loops were closed.
    pub errors: Option<[Errors; 2]>,
}

impl Estimated {
    /// What the map says of it.
    pub fn closure(&self) -> Closure {
        let [before, after] = self.summary.residuals;
        Closure {
            keyframes: self.summary.keyframes as u64,
            loops: self.summary.loops as u64,
            residuals_m: [before[0], after[0]],
            residuals_rad: [before[1], after[1]],
        }
    }
}

/// Finds the poses of all vehicles among the agents of logs.
pub fn estimate(logs: &[Log], agents: &[Vec<String>], voxel_m: f64) -> Result<Estimated> {
    let vehicles = vehicles(logs, agents)?;
    let sweeps = vehicles
        .iter()
        .map(|(log, agent)| logs[*log].count(agent, Stream::Points))
        .sum::<u64>();
    let progress = Progress::new("following the drives", "sweeps", Some(sweeps as f64));
    let mut driven = Vec::new();
    for (log, agent) in &vehicles {
        driven.push(follow(logs, *log, agent, None, voxel_m, &progress)?);
    }
    progress.finish();
    let mut found = solve_all(&driven, voxel_m)?;
    for _ in 0..LEVELLINGS {
        let leaning: Vec<usize> = (0..driven.len())
            .filter(|at| found.drives[*at].lean.is_some())
            .collect();
        if leaning.is_empty() {
            break;
        }
        let sweeps: usize = leaning.iter().map(|at| driven[*at].sweeps.len()).sum();
        let progress = Progress::new("following drives with level sensors", "sweeps", Some(sweeps as f64));
        for at in leaning {
            let (log, agent) = vehicles[at];
            let known = driven[at].lean.map_or(0.0, |lean| lean.slope);
            let lean = found.drives[at].lean.map(|lean| Lean {
                slope: known + lean.slope,
                ..lean
            });
            driven[at] = follow(logs, log, agent, lean, voxel_m, &progress)?;
        }
        progress.finish();
        found = solve_all(&driven, voxel_m)?;
    }
    let mut posed: Vec<BTreeMap<String, Agent>> = logs.iter().map(|_| BTreeMap::new()).collect();
    for (of, mapped) in driven
        .iter()
        .zip(&found.drives)
        .filter(|(_, mapped)| mapped.keyframes > 0)
    {
        let agent = Agent::with(&logs[of.log], &of.agent, mapped.track.clone(), mapped.sigmas);
        let agent = agent.leaning(of.lean.map_or(0.0, |lean| lean.slope));
        posed[of.log].insert(of.agent.clone(), agent);
    }
    Ok(Estimated {
        errors: against_truth(&driven, &found.drives),
        posed,
        driven,
        mapped: found.drives,
        summary: found.summary,
    })
}

fn solve_all(driven: &[Driven], voxel_m: f64) -> Result<Mapped, MappingError> {
    let drives: Vec<&Drive> = driven.iter().map(|driven| &driven.drive).collect();
    solve(&drives, voxel_m).inspect_err(|_| report::print_faults(driven))
}

/// The vehicles, each with the number of its log; all must measure their motion.
fn vehicles<'a>(logs: &[Log], agents: &'a [Vec<String>]) -> Result<Vec<(usize, &'a str)>> {
    let mut vehicles = Vec::new();
    for (number, (log, agents)) in logs.iter().zip(agents).enumerate() {
        for agent in agents {
            let path = log.path().display();
            if !is_vehicle(log.info().agent(agent)) {
                eprintln!(
                    "realo: {path}: `{agent}` does not drive: its sweeps are left out, for --poses estimated follows vehicles"
                );
            } else if log.has(agent, Stream::Imu) {
                vehicles.push((number, agent.as_str()));
            } else {
                bail!(
                    "{path}: `{agent}` has no motion sensors to be followed by: expected the topic /{agent}/{}, found none; take a log with \
                     them (`realo-lab simulate --inertial tactical` makes one), name other --agents, or take --poses recorded",
                    Stream::Imu.as_str()
                );
            }
        }
    }
    match vehicles.is_empty() {
        true => bail!(
            "--poses estimated: expected a vehicle with sweeps and motion sensors, found none; `realo info` lists agents"
        ),
        false => Ok(vehicles),
    }
}

/// Follows one vehicle through its log.
fn follow(
    logs: &[Log],
    number: usize,
    agent: &str,
    lean: Option<Lean>,
    voxel_m: f64,
    progress: &Progress,
) -> Result<Driven> {
    let log = &logs[number];
    let mut odometry = Odometry::new(OdometrySettings {
        voxel_m,
        slope: lean.map_or(0.0, |lean| lean.slope),
        ..OdometrySettings::default()
    })?;
    let has_fixes = log.has(agent, Stream::Fix);
    let streams = [Stream::Imu, Stream::Fix, Stream::Wheels, Stream::Points].into_iter();
    let wanted: Vec<_> = streams.filter(|of| log.has(agent, *of)).map(|of| (agent, of)).collect();
    let (mut sweeps, mut unusable) = (Vec::new(), None);
    let mut reader = log.read_all(&wanted)?;
    while let Some(entry) = reader.next()? {
        if entry.stream != Stream::Points {
            match entry.motion() {
                Ok(motion) => odometry.measure(&motion)?,
                Err(error) => unusable.get_or_insert_with(|| (0, error.to_string())).0 += 1,
            }
            continue;
        }
        if let Some(cloud) = cloud_of(&entry)? {
            let cloud = clean(&cloud, Some(OwnBody::V2X_REAL), None).cloud;
            odometry.sweep(entry.stamp(), &cloud)?;
            sweeps.push(entry.stamp());
        }
        progress.add(1.0);
    }
    let truth = log.has(agent, Stream::PoseTruth);
    Ok(Driven {
        log: number,
        name: format!("{} {agent}", log.path().display()),
        agent: agent.into(),
        drive: odometry.finish(),
        sweeps,
        unusable,
        has_fixes,
        lean,
        leans: levelled_while_played(log)?.contains_key(agent),
        truth: truth
            .then(|| pose_track(log, agent, Stream::PoseTruth, MAX_GAP))
            .transpose()?,
    })
}

/// Errors of the poses at sweeps, before and after loops were closed, where logs have the truth.
fn against_truth(driven: &[Driven], mapped: &[MappedDrive]) -> Option<[Errors; 2]> {
    let (mut before, mut after) = (Vec::new(), Vec::new());
    for (of, mapped) in driven.iter().zip(mapped) {
        let Some(truth) = &of.truth else { continue };
        for stamp in &of.sweeps {
            let poses = (truth.at(*stamp), mapped.before.at(*stamp), mapped.track.at(*stamp));
            if let (Some(truth), Some(old), Some(new)) = poses {
                before.push([old, truth]);
                after.push([new, truth]);
            }
        }
    }
    Some([errors(&before)?, errors(&after)?])
}
