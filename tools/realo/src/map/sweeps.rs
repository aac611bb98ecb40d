//! Sweeps of a log, and the poses that place them on a map.

use std::collections::BTreeMap;

use eyre::Result;
use realo_cli::Progress;
use realo_logs::{AgentInfo, AgentKind, Entry, Log, LogError, MAX_GAP, Stream, pose_track};
use realo_mapping::levelled;
use realo_registration::{MapBuilder, PosedSweep};
use realo_schemas::geometry::{Motion, PoseTrack};
use realo_schemas::{Nanos, PointCloud};
use realo_sync::{OwnBody, clean};

/// What recorded poses are taken to be off by where they do not say it: on the ground and up, m, and the heading, rad.
const UNKNOWN: [f64; 3] = [0.05, 0.1, 1.2e-3];
/// Larger variances are none, m² and rad².
const MAX_VARIANCE: f64 = 1e8;

/// How high LiDARs are where a log does not say, m: on vehicles, on roadside units. It matters only to what was seen empty.
const SENSOR_HEIGHTS: [f64; 2] = [1.9, 5.0];

/// Sweeps that were not used as they should be.
#[derive(Default)]
pub struct Counts {
    no_pose: u64,
    unplaced: u64,
    not_deskewed: u64,
}

/// Adds the sweeps of a log, in order of time.
pub fn add(
    log: &Log,
    agents: &BTreeMap<String, Agent>,
    builder: &mut MapBuilder,
    counts: &mut Counts,
    progress: &Progress,
) -> Result<()> {
    if agents.is_empty() {
        return Ok(());
    }
    let wanted: Vec<(&str, Stream)> = agents.keys().map(|agent| (&**agent, Stream::Points)).collect();
    let mut reader = log.read_all(&wanted)?;
    while let Some(entry) = reader.next()? {
        if let Some(agent) = agents.get(&*entry.agent) {
            agent.add(&entry, builder, counts)?;
        }
        progress.add(1.0);
    }
    Ok(())
}

/// Whether an agent drives.
pub fn is_vehicle(info: Option<&AgentInfo>) -> bool {
    info.is_none_or(|info| info.kind == AgentKind::Vehicle)
}

/// The points of a sweep; `None` where nothing brings them to the body frame.
pub fn cloud_of(entry: &Entry) -> Result<Option<PointCloud>> {
    match entry.cloud() {
        Err(LogError::Unplaced { .. }) => Ok(None),
        cloud => Ok(Some(cloud?)),
    }
}

/// What must be known of an agent to use its sweeps.
pub struct Agent {
    track: PoseTrack,
    sigmas: [f64; 3],
    sensor: [f64; 3],
    own_body: Option<OwnBody>,
    /// As [`realo_mapping::Lean`] has it.
    slope: f64,
}

impl Agent {
    /// An agent with the poses of a log.
    pub fn of(log: &Log, name: &str, stream: Stream) -> Result<Self, LogError> {
        let track = pose_track(log, name, stream, MAX_GAP)?;
        Ok(Agent::with(log, name, track, sigmas(log, name, stream)?))
    }

    /// An agent with other poses; `sigmas` as [`PosedSweep::sigmas`].
    pub fn with(log: &Log, name: &str, track: PoseTrack, sigmas: [f64; 3]) -> Self {
        let info = log.info().agent(name);
        let is_vehicle = is_vehicle(info);
        let [vehicle, roadside] = SENSOR_HEIGHTS;
        let unknown = [0.0, 0.0, if is_vehicle { vehicle } else { roadside }];
        Agent {
            track,
            sigmas,
            sensor: info.and_then(|info| info.sensor_position).unwrap_or(unknown),
            own_body: is_vehicle.then_some(OwnBody::V2X_REAL),
            slope: 0.0,
        }
    }

    /// The same with a sensor that leans; `slope` as in [`realo_mapping::Lean`].
    pub fn leaning(self, slope: f64) -> Self {
        Agent { slope, ..self }
    }

    /// Adds a sweep, without the agent's motion and body.
    fn add(&self, entry: &Entry, builder: &mut MapBuilder, counts: &mut Counts) -> Result<()> {
        let stamp = entry.stamp();
        let Some(map_from_body) = self.track.at(stamp) else {
            counts.no_pose += 1;
            return Ok(());
        };
        let Some(cloud) = cloud_of(entry)? else {
            counts.unplaced += 1;
            return Ok(());
        };
        let times = [cloud.time.iter().min(), cloud.time.iter().max()];
        let [first, last] = times.map(|time| time.map_or(0, |time| Nanos::from(*time)));
        let motion = Motion::new(&self.track, stamp, first, last);
        counts.not_deskewed += u64::from(motion.is_none());
        let mut cloud = clean(&cloud, self.own_body, motion.as_ref()).cloud;
        if self.slope != 0.0 {
            cloud = levelled(&cloud, self.slope);
        }
        builder.add(&PosedSweep {
            agent: &entry.agent,
            stamp,
            cloud: &cloud,
            map_from_body: &map_from_body,
            sensor: self.sensor,
            sigmas: self.sigmas,
        })?;
        Ok(())
    }
}

/// Standard deviations of an agent's poses in the mean, as [`PosedSweep::sigmas`] has them.
fn sigmas(log: &Log, agent: &str, stream: Stream) -> Result<[f64; 3], LogError> {
    if stream == Stream::PoseTruth {
        return Ok([0.0; 3]);
    }
    let (mut sums, mut poses) = ([0.0; 3], 0.0);
    let mut reader = log.read_all(&[(agent, stream)])?;
    while let Some(entry) = reader.next()? {
        let Ok(state) = entry.pose() else { continue };
        let said = state.covariance.map(|of| [0.5 * (of[0] + of[7]), of[14], of[35]]);
        // False for what is not a number too.
        let said = said.filter(|of| of.iter().all(|variance| (0.0..=MAX_VARIANCE).contains(variance)));
        let variances = said.unwrap_or(UNKNOWN.map(|sigma| sigma * sigma));
        sums.iter_mut().zip(variances).for_each(|(sum, of)| *sum += of);
        poses += 1.0;
    }
    Ok(match poses > 0.0 {
        true => sums.map(|sum| (sum / poses).sqrt()),
        false => UNKNOWN,
    })
}

impl Counts {
    /// Says what was not used.
    pub fn report(&self, log: &Log) {
        let path = log.path().display();
        for (count, what) in [
            (
                self.no_pose,
                "sweeps were left out, for no pose is known at their stamps",
            ),
            (
                self.unplaced,
                "sweeps were left out, for no transform brings them to the body frame",
            ),
            (
                self.not_deskewed,
                "sweeps keep the agent's motion, for no poses are known during them",
            ),
        ] {
            if count > 0 {
                eprintln!("realo: {path}: {count} {what}");
            }
        }
    }
}
