//! A log whose body frames are not level, made level.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Translation3};
use realo_logs::{Attitude, Attitudes, Entry, LEVEL, Levelled, Log, LogReader, LogWriter, Stream, level_state};
use realo_schemas::geometry::{View, tilt_degrees, transform_boxes, transform_cloud};
use realo_schemas::{AgentState, Boxes, Name, Nanos, PointCloud};

use crate::ImportError;
use crate::level::{Level, Plane, by_ground};

/// In a body frame that is not level, nor known to lie on the ground, the ground at the origin lies no higher, m.
const HIGHEST_GROUND: f64 = 1.0;

/// Copies a log with level body frames.
///
/// By the pose: the recorded roll and pitch turn the points, each at its own time, detections and views; ground truth by the
/// true pose where the log has one. By the ground: the plane in each sweep turns what is of it, the median height lowers the
/// frame, and poses keep their heading alone.
///
/// # Errors
/// A log that cannot be read or has packets; an agent without poses; a sweep without ground; boxes without their companion, or
/// companions without their boxes, unless the log was cut.
pub fn relevel(from: &Path, to: &Path, level: Level) -> Result<BTreeMap<String, Levelled>, ImportError> {
    relevel_with(from, to, level, |_, _| {})
}

/// As [`relevel`]; calls `progress` with the seconds of the log that are done and all of them.
///
/// # Errors
/// As [`relevel`].
pub fn relevel_with(
    from: &Path,
    to: &Path,
    level: Level,
    mut progress: impl FnMut(f64, f64),
) -> Result<BTreeMap<String, Levelled>, ImportError> {
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
    let lacking = |stream| {
        let lacks = |agent: &&Name| !log.has(agent, stream);
        agents.keys().filter(lacks).cloned().collect()
    };
    let mut copy = LevelCopy {
        from: from.into(),
        reader: reader(&log)?,
        writer: LogWriter::create_atomic(to, log.info())?,
        arrays: BTreeMap::new(),
        companions: BTreeMap::new(),
        bare: lacking(Stream::Points),
        without_info: lacking(Stream::DetectionsInfo),
        agents,
    };
    let [start, end] = log.span().map_or([0; 2], |(start, end)| [start, end]);
    let seconds = |nanos: Nanos| nanos as f64 / 1e9;
    while let Some(entry) = copy.reader.next()? {
        progress(seconds(entry.stamp() - start).max(0.0), seconds(end - start));
        copy.take(&entry)?;
    }
    if log.truncation().is_none() {
        copy.check_complete()?;
    }
    let levelled = levelled(&copy.agents, log.levelled()?, level);
    copy.writer.levelled(levelled.clone());
    copy.writer.clocks(log.clocks()?);
    copy.writer.finish()?;
    Ok(levelled)
}

/// What the copy says of its levelling; what was level by an earlier making stays so in words too.
fn levelled(
    agents: &BTreeMap<Name, Leveller>,
    mut before: BTreeMap<String, Levelled>,
    level: Level,
) -> BTreeMap<String, Levelled> {
    let reported = agents.iter().map(|(agent, leveller)| {
        let reported = leveller.reported(level);
        let before = before.remove(&**agent).filter(|before| match level {
            Level::None => true,
            Level::Pose => before.by != Levelled::BY_NOTHING && reported.degrees[1] <= LEVEL,
            Level::Ground => false,
        });
        (agent.to_string(), before.unwrap_or(reported))
    });
    reported.collect()
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
    /// Min and max tilt of its sweeps, degrees.
    degrees: Option<[f64; 2]>,
}

enum By {
    Pose(Attitudes),
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
                By::Pose(Attitudes::read(log, agent, Stream::Pose)?)
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
            By::Pose(attitudes) => {
                let attitude = if exact { &attitudes.truth } else { &attitudes.sweeps };
                attitude.at(stamp).ok_or_else(|| {
                    format!(
                        "no pose within {} s of {stamp} ns: expected poses from before the first sweep to behind the last",
                        Attitude::MAX_GAP / 1_000_000_000
                    )
                })
            }
            By::Ground(sweeps) => sweeps
                .get(&stamp)
                .copied()
                .ok_or_else(|| format!("no sweep with stamp {stamp} ns, by whose ground it could be levelled")),
        }
    }

    fn cloud(&mut self, stamp: Nanos, cloud: PointCloud) -> Result<PointCloud, String> {
        let whole = self.at(stamp, false)?;
        let tilt = tilt_degrees(&whole.rotation);
        let [min, most] = self.degrees.unwrap_or([tilt; 2]);
        self.degrees = Some([min.min(tilt), most.max(tilt)]);
        Ok(match &self.by {
            By::Pose(attitudes) => attitudes.sweeps.cloud(stamp, cloud),
            By::Ground(_) => transform_cloud(&whole, &cloud),
            By::Nothing => cloud,
        })
    }

    /// The pose of the level frame.
    fn state(&self, state: AgentState) -> AgentState {
        match &self.by {
            By::Nothing => state,
            By::Pose(_) => level_state(state),
            By::Ground(sweeps) => {
                let lowered = sweeps.values().next().map_or(0.0, |level| level.translation.z);
                let mut level = level_state(state);
                level.map_from_body *= Translation3::new(0.0, 0.0, -lowered);
                level
            }
        }
    }

    fn reported(&self, level: Level) -> Levelled {
        Levelled {
            by: level.as_str().into(),
            degrees: self.degrees.unwrap_or_default(),
        }
    }
}

/// Level from body for each sweep: its own tilt, and the median height of all.
fn grounds(log: &Log, agent: &str) -> Result<BTreeMap<Nanos, Isometry3<f64>>, ImportError> {
    let mut found = BTreeMap::new();
    let mut reader = log.read_all(&[(agent, Stream::Points)])?;
    while let Some(entry) = reader.next()? {
        let cloud = entry.cloud()?;
        let points = (0..cloud.len()).map(|i| [cloud.x[i], cloud.y[i], cloud.z[i]].map(f64::from));
        let plane = Plane::of_ground(points, HIGHEST_GROUND).map_err(|reason| at_entry(log.path(), &entry, reason))?;
        found.insert(entry.stamp(), by_ground(&plane));
    }
    let mut heights: Vec<f64> = found.values().map(|level| level.translation.z).collect();
    heights.sort_by(f64::total_cmp);
    let height = heights.get(heights.len() / 2).copied().unwrap_or_default();
    found.values_mut().for_each(|level| level.translation.z = height);
    Ok(found)
}

fn at_entry(log: &Path, entry: &Entry, reason: String) -> ImportError {
    let topic = entry.stream.topic(&entry.agent);
    ImportError::content(log, format!("{topic}, stamp {} ns: {reason}", entry.stamp()))
}

/// The copy in the making.
struct LevelCopy {
    /// The log that is read.
    from: PathBuf,
    reader: LogReader,
    writer: LogWriter,
    agents: BTreeMap<Name, Leveller>,
    /// Boxes that wait for their companion, by agent, stream and stamp, with their ready times.
    arrays: BTreeMap<Waiting, (Boxes, Nanos)>,
    /// Companions that wait for their boxes, by the stream of these.
    companions: BTreeMap<Waiting, Entry>,
    /// Agents without points.
    bare: Vec<Name>,
    /// Agents whose detections have no companion.
    without_info: Vec<Name>,
}

/// Agent, stream of boxes, and stamp.
type Waiting = (Name, Stream, Nanos);

impl LevelCopy {
    fn take(&mut self, entry: &Entry) -> Result<(), ImportError> {
        let (agent, stamp, ready) = (&*entry.agent, entry.stamp(), entry.ready());
        let bad = |reason| at_entry(&self.from, entry, reason);
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
            Stream::Imu | Stream::Fix | Stream::Wheels => self.writer.copy_motion(entry, stamp, ready)?,
            Stream::Detections if self.without_info.contains(&entry.agent) => {
                let mut boxes = entry.boxes()?;
                transform_boxes(&leveller.at(stamp, false).map_err(bad)?, &mut boxes.0);
                self.writer.detections(agent, stamp, ready, &boxes)?;
            }
            Stream::Detections | Stream::GroundTruth | Stream::OwnLabels => {
                let waiting = (entry.agent.clone(), entry.stream, stamp);
                match self.companions.remove(&waiting) {
                    Some(companion) => self.complete(&companion, &waiting, entry.boxes()?, ready)?,
                    None => _ = self.arrays.insert(waiting, (entry.boxes()?, ready)),
                }
            }
            Stream::DetectionsInfo | Stream::GroundTruthInfo | Stream::OwnLabelsInfo => {
                let array = match entry.stream {
                    Stream::DetectionsInfo => Stream::Detections,
                    Stream::GroundTruthInfo => Stream::GroundTruth,
                    _ => Stream::OwnLabels,
                };
                let waiting = (entry.agent.clone(), array, stamp);
                match self.arrays.remove(&waiting) {
                    Some((boxes, ready)) => self.complete(entry, &waiting, boxes, ready)?,
                    None => _ = self.companions.insert(waiting, entry.clone()),
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

    /// Writes boxes whose companion is there. `ready`: when the boxes were.
    fn complete(
        &mut self,
        companion: &Entry,
        (agent, array, stamp): &Waiting,
        mut boxes: Boxes,
        ready: Nanos,
    ) -> Result<(), ImportError> {
        let info = companion.info(&mut boxes)?;
        let Some(leveller) = self.agents.get(agent) else {
            return Ok(());
        };
        let level = leveller.at(*stamp, *array != Stream::Detections);
        let level = level.map_err(|reason| at_entry(&self.from, companion, reason))?;
        transform_boxes(&level, &mut boxes.0);
        let (ready, points) = (ready.max(companion.ready()), info.points.as_deref());
        match array {
            Stream::Detections => self.writer.detections(agent, *stamp, ready, &boxes)?,
            Stream::GroundTruth => self.writer.truth(agent, *stamp, ready, &boxes.0, points, info.key)?,
            _ => self
                .writer
                .own_labels(agent, *stamp, ready, &boxes.0, points, info.key)?,
        }
        Ok(())
    }

    /// Refuses boxes that would be lost.
    fn check_complete(&self) -> Result<(), ImportError> {
        let alone = self.arrays.keys().chain(self.companions.keys()).min();
        let Some((agent, stream, stamp)) = alone else {
            return Ok(());
        };
        let (arrays, companions) = (self.arrays.len(), self.companions.len());
        let reason = format!(
            "{arrays} messages of boxes are without their companion and {companions} companions without their boxes, the first \
             at {stamp} ns for {}: expected both with one stamp (within 1 µs); write them so where the log is made",
            stream.topic(agent)
        );
        Err(ImportError::content(&self.from, reason))
    }
}
