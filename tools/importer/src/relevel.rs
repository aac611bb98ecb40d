//! A log whose body frames are not level, made level.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Isometry3, Point3, Translation3};
use realo_logs::{Entry, Levelled, Log, LogReader, LogWriter, Stream};
use realo_schemas::geometry::{PoseTrack, View, tilt_degrees, transform_box};
use realo_schemas::{Boxes, EgoState, Name, Nanos, PointCloud};

use crate::ImportError;
use crate::level::{Level, Plane, by_ground, by_pose};

/// In a body frame that is not level, nor known to lie on the ground, the ground at the origin lies no higher, m.
const HIGHEST_GROUND: f64 = 1.0;

/// Poses further apart say nothing of what lies between.
const MAX_GAP: Nanos = 1_000_000_000;

/// Copies a log with level body frames.
///
/// By the pose: the recorded roll and pitch turn the points, each at its own time, detections and views; ground truth by the
/// true pose where the log has one. By the ground: the plane in each sweep turns what is of it, the median height lowers the
/// frame, and poses keep their heading alone.
///
/// # Errors
/// A log that cannot be read or has packets; an agent without poses; a sweep without ground.
pub fn relevel(from: &Path, to: &Path, level: Level) -> Result<BTreeMap<String, Levelled>, ImportError> {
    let log = Log::open(from)?;
    let same = [from, to].map(|path| path.canonicalize().ok());
    if same[0].is_some() && same[0] == same[1] {
        return Err(ImportError::content(
            to,
            "it is the log that is read; choose another file",
        ));
    }
    if log.info().precomputed.is_some() {
        let reason = "it has precomputed packets: level the log that it was made from, then precompute";
        return Err(ImportError::content(from, reason));
    }
    let mut agents = BTreeMap::new();
    for agent in &log.info().agents {
        agents.insert(Name::from(&*agent.name), Leveller::of(&log, &agent.name, level)?);
    }
    let mut copy = Copy {
        reader: reader(&log)?,
        writer: LogWriter::create_atomic(to, log.info())?,
        boxes: BTreeMap::new(),
        bare: agents
            .keys()
            .filter(|agent| !log.has(agent, Stream::Points))
            .cloned()
            .collect(),
        agents,
    };
    while let Some(entry) = copy.reader.next()? {
        copy.take(&entry)?;
    }
    let levelled: BTreeMap<String, Levelled> = copy
        .agents
        .iter()
        .map(|(agent, leveller)| (agent.to_string(), leveller.told(level)))
        .collect();
    copy.writer.levelled(levelled.clone());
    copy.writer.clocks(log.clocks()?);
    copy.writer.finish()?;
    Ok(levelled)
}

/// Everything but what follows from other things.
fn reader(log: &Log) -> Result<LogReader, ImportError> {
    let is_read = |stream: &Stream| *stream != Stream::GroundTruthMarkers;
    let names = log.info().agents.iter().map(|agent| agent.name.as_str());
    let all = names.flat_map(|agent| {
        Stream::ALL
            .into_iter()
            .filter(is_read)
            .map(move |stream| (agent, stream))
    });
    let wanted: Vec<(&str, Stream)> = all.filter(|(agent, stream)| log.has(agent, *stream)).collect();
    Ok(log.read_all(&wanted)?)
}

/// How an agent's frames are levelled.
struct Leveller {
    by: By,
    /// Least and greatest tilt of its sweeps, degrees.
    degrees: Option<[f64; 2]>,
}

enum By {
    /// Poses as believed, and true ones.
    Pose {
        believed: PoseTrack,
        exact: PoseTrack,
    },
    /// By the stamp of the sweep: level from body.
    Ground(BTreeMap<Nanos, Isometry3<f64>>),
    Nothing,
}

impl Leveller {
    fn of(log: &Log, agent: &str, level: Level) -> Result<Self, ImportError> {
        let by = match level {
            Level::None => By::Nothing,
            Level::Pose => {
                log.need(agent, Stream::Pose)?;
                let believed = track(log, agent, Stream::Pose)?;
                let exact = match log.has(agent, Stream::PoseTruth) {
                    true => track(log, agent, Stream::PoseTruth)?,
                    false => believed.clone(),
                };
                By::Pose { believed, exact }
            }
            Level::Ground => {
                log.need(agent, Stream::Points)?;
                By::Ground(grounds(log, agent)?)
            }
        };
        Ok(Leveller { by, degrees: None })
    }

    /// Level from body at a time.
    fn at(&self, stamp: Nanos, exact: bool) -> Result<Isometry3<f64>, String> {
        match &self.by {
            By::Nothing => Ok(Isometry3::identity()),
            By::Pose { believed, exact: known } => {
                let pose = if exact { known } else { believed }.at(stamp);
                let pose = pose.ok_or_else(|| {
                    format!(
                        "no pose within {} s of {stamp} ns: expected poses from before the first sweep to behind the last",
                        MAX_GAP / 1_000_000_000
                    )
                })?;
                Ok(by_pose(&pose.rotation, 0.0))
            }
            By::Ground(sweeps) => sweeps
                .get(&stamp)
                .copied()
                .ok_or_else(|| format!("no sweep with stamp {stamp} ns, by whose ground it could be levelled")),
        }
    }

    fn cloud(&mut self, stamp: Nanos, mut cloud: PointCloud) -> Result<PointCloud, String> {
        let whole = self.at(stamp, false)?;
        let tilt = tilt_degrees(&whole.rotation);
        let [least, most] = self.degrees.unwrap_or([tilt; 2]);
        self.degrees = Some([least.min(tilt), most.max(tilt)]);
        let n = cloud.len();
        let [mut x, mut y, mut z] = [(); 3].map(|()| Vec::with_capacity(n));
        let mut known = (0, whole);
        for i in 0..n {
            let time = cloud.time[i];
            if known.0 != time && matches!(self.by, By::Pose { .. }) {
                // Points that reach behind the last pose turn with the sweep.
                known = (time, self.at(stamp + Nanos::from(time), false).unwrap_or(whole));
            }
            let point = known.1 * Point3::new(cloud.x[i], cloud.y[i], cloud.z[i]).cast::<f64>();
            x.push(point.x as f32);
            y.push(point.y as f32);
            z.push(point.z as f32);
        }
        (cloud.x, cloud.y, cloud.z) = (x.into(), y.into(), z.into());
        Ok(cloud)
    }

    /// The pose of the level frame.
    fn state(&self, state: EgoState) -> EgoState {
        let lowered = match &self.by {
            By::Nothing => return state,
            By::Pose { .. } => 0.0,
            By::Ground(sweeps) => sweeps.values().next().map_or(0.0, |level| level.translation.z),
        };
        let pose = state.map_from_body;
        let turn = by_pose(&pose.rotation, 0.0).inverse();
        EgoState {
            map_from_body: pose * turn * Translation3::new(0.0, 0.0, -lowered),
            ..state
        }
    }

    fn told(&self, level: Level) -> Levelled {
        Levelled {
            by: level.as_str().into(),
            degrees: self.degrees.unwrap_or_default(),
        }
    }
}

fn track(log: &Log, agent: &str, stream: Stream) -> Result<PoseTrack, ImportError> {
    let mut track = PoseTrack::new(Nanos::MAX, MAX_GAP);
    let mut reader = log.read_all(&[(agent, stream)])?;
    while let Some(entry) = reader.next()? {
        // The player counts poses that are none; they level nothing.
        if let Ok(state) = entry.pose() {
            track.insert(entry.stamp(), state.map_from_body);
        }
    }
    Ok(track)
}

/// Level from body for each sweep: its own tilt, and the median height of all.
fn grounds(log: &Log, agent: &str) -> Result<BTreeMap<Nanos, Isometry3<f64>>, ImportError> {
    let mut found = BTreeMap::new();
    let mut reader = log.read_all(&[(agent, Stream::Points)])?;
    while let Some(entry) = reader.next()? {
        let cloud = entry.cloud()?;
        let points = (0..cloud.len()).map(|i| [cloud.x[i], cloud.y[i], cloud.z[i]].map(f64::from));
        let plane = Plane::of_ground(points, HIGHEST_GROUND).map_err(|reason| of(log, &entry, reason))?;
        found.insert(entry.stamp(), by_ground(&plane));
    }
    let mut heights: Vec<f64> = found.values().map(|level| level.translation.z).collect();
    heights.sort_by(f64::total_cmp);
    let height = heights.get(heights.len() / 2).copied().unwrap_or_default();
    found.values_mut().for_each(|level| level.translation.z = height);
    Ok(found)
}

fn of(log: &Log, entry: &Entry, reason: String) -> ImportError {
    let topic = entry.stream.topic(&entry.agent);
    ImportError::content(log.path(), format!("{topic}, stamp {} ns: {reason}", entry.stamp()))
}

/// The copy in the making.
struct Copy {
    reader: LogReader,
    writer: LogWriter,
    agents: BTreeMap<Name, Leveller>,
    /// Boxes that wait for their companion, by agent and stream.
    boxes: BTreeMap<(Name, Stream), Boxes>,
    /// Agents without points.
    bare: Vec<Name>,
}

impl Copy {
    fn take(&mut self, entry: &Entry) -> Result<(), ImportError> {
        let (agent, stamp, ready) = (&*entry.agent, entry.stamp(), entry.ready());
        let bad = |reason: String| ImportError::content(Path::new(&entry.stream.topic(agent)), reason);
        let Some(leveller) = self.agents.get_mut(&entry.agent) else {
            return Ok(());
        };
        match entry.stream {
            Stream::Points => {
                let cloud = leveller.cloud(stamp, entry.cloud()?).map_err(bad)?;
                self.writer.cloud(agent, stamp, ready, &cloud)?;
            }
            Stream::Sweeps if self.bare.contains(&entry.agent) => self.writer.sweep(agent, stamp, ready)?,
            Stream::Pose => {
                let state = leveller.state(entry.pose()?);
                self.writer.pose(agent, stamp, ready, &state)?;
            }
            Stream::PoseTruth => {
                let state = leveller.state(entry.pose()?);
                self.writer.pose_truth(agent, stamp, ready, &state)?;
            }
            Stream::Detections | Stream::GroundTruth | Stream::OwnLabels => {
                self.boxes.insert((entry.agent.clone(), entry.stream), entry.boxes()?);
            }
            Stream::DetectionsInfo | Stream::GroundTruthInfo | Stream::OwnLabelsInfo => {
                let (array, exact) = match entry.stream {
                    Stream::DetectionsInfo => (Stream::Detections, false),
                    Stream::GroundTruthInfo => (Stream::GroundTruth, true),
                    _ => (Stream::OwnLabels, true),
                };
                let mut boxes = self.boxes.remove(&(entry.agent.clone(), array)).unwrap_or_default();
                let info = entry.info(&mut boxes)?;
                let level = leveller.at(stamp, exact).map_err(bad)?;
                boxes
                    .0
                    .iter_mut()
                    .for_each(|object| *object = transform_box(&level, object));
                let points = info.points.as_deref();
                match array {
                    Stream::Detections => self.writer.detections(agent, stamp, ready, &boxes)?,
                    Stream::GroundTruth => self.writer.truth(agent, stamp, ready, &boxes.0, points, info.key)?,
                    _ => self
                        .writer
                        .own_labels(agent, stamp, ready, &boxes.0, points, info.key)?,
                }
            }
            Stream::GroundTruthViews | Stream::OwnLabelsViews => {
                let level = leveller.at(stamp, true).map_err(bad)?;
                let views: Vec<View> = entry.views()?.iter().map(|view| view.moved(&level)).collect();
                match entry.stream {
                    Stream::GroundTruthViews => self.writer.truth_views(agent, stamp, ready, &views)?,
                    _ => self.writer.own_views(agent, stamp, ready, &views)?,
                }
            }
            Stream::Sweeps | Stream::GroundTruthMarkers | Stream::Packets => {}
        }
        Ok(())
    }
}
