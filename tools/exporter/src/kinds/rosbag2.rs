//! A bag of ROS 2: a folder with `metadata.yaml` and one MCAP file of standard messages.

mod metadata;

use std::collections::BTreeMap;

use realo_logs::{
    AgentKind, ChannelId, ChunkGroup, Entry, Failure, Log, LogError, McapWriter, Schema, Stream, boxes, cloud, objects,
    pose, program,
};
use realo_schemas::{AgentState, Boxes, Nanos, body_frame};

use self::metadata::{Topic, metadata};
use super::{Exporter, Kind, Report};
use crate::places::numbers;
use crate::{ExportError, Exported, ExportedAgent, Folder, Options};

/// A bag of ROS 2.
pub struct Rosbag2;

static KIND: Kind = Kind {
    name: "rosbag2",
    title: "A bag of ROS 2 in MCAP",
    writes: "metadata.yaml and bag_0.mcap: /AGENT/points, pose, objects, detected_objects and markers, and /tf; map.yml for its import",
    unit: "sweeps",
    options: &[("agents", "")],
};

/// The file of messages.
const FILE: &str = "bag_0.mcap";
/// Whose topics are which, for `realo-lab import bag`.
const MAP: &str = "map.yml";
/// Name of the record behind the file's head.
const RECORD: &str = "realo_export";

impl Exporter for Rosbag2 {
    fn kind(&self) -> &'static Kind {
        &KIND
    }

    fn write(
        &self,
        log: &Log,
        folder: &mut Folder,
        options: &Options,
        report: Report,
    ) -> Result<Exported, ExportError> {
        let agents = agents(log, options)?;
        let record = BTreeMap::from([("source".to_string(), log.info().source.clone())]);
        let mcap = McapWriter::new(folder.file(FILE)?, &program(), RECORD, &record);
        let mut bag = Bag {
            log,
            mcap: mcap.map_err(|reason| folder.failed(FILE, reason))?,
            topics: BTreeMap::new(),
            span: None,
            agents: agents.iter().map(|agent| agent.summary.clone()).collect(),
            boxes: vec![Boxes::default(); agents.len()],
            without_way: 0,
            velocities: false,
            unlabelled: BTreeMap::new(),
        };
        bag.messages(&agents, report).map_err(|failure| failure.named(folder))?;
        let Bag {
            mcap,
            topics,
            span,
            agents: summaries,
            without_way,
            velocities,
            unlabelled,
            ..
        } = bag;
        mcap.finish().map_err(|failure| failed(folder, failure))?;
        folder.take(FILE)?;
        let topics: Vec<Topic> = topics.into_values().map(|(_, topic)| topic).collect();
        folder.write(
            "metadata.yaml",
            metadata(FILE, &topics, span.unwrap_or((0, 0))).as_bytes(),
        )?;
        folder.write(MAP, map_file(log, &agents).as_bytes())?;
        Ok(Exported {
            agents: summaries,
            left_out: left_out(without_way),
            lost: lost(log, &agents, velocities)
                .into_iter()
                .chain(without_label(&unlabelled))
                .collect(),
            read_back: format!("realo-lab import bag PATH -o LOG.mcap --map PATH/{MAP}"),
            ..Exported::default()
        })
    }
}

/// An agent that is written.
struct BagAgent<'a> {
    name: &'a str,
    /// Its true poses, or where the log has none, its believed ones.
    poses: Stream,
    has_objects: bool,
    has_info: bool,
    summary: ExportedAgent,
}

fn agents<'a>(log: &'a Log, options: &'a Options) -> Result<Vec<BagAgent<'a>>, ExportError> {
    options.agents.iter().try_for_each(|name| log.need_agent(name))?;
    let mut found = Vec::new();
    for info in &log.info().agents {
        let name = info.name.as_str();
        let is_wanted = options.agents.is_empty() || options.agents.iter().any(|wanted| wanted == name);
        if !is_wanted || !log.has(name, Stream::Points) {
            continue;
        }
        let poses = match log.has(name, Stream::PoseTruth) {
            true => Stream::PoseTruth,
            false => Stream::Pose,
        };
        log.need(name, poses)?;
        found.push(BagAgent {
            name,
            poses,
            has_objects: log.has(name, Stream::GroundTruth),
            has_info: log.has(name, Stream::GroundTruthInfo),
            summary: ExportedAgent {
                name: name.into(),
                place: format!("topics `/{name}/…`"),
                height_m: Some(info.sensor_position.map_or(0.0, |[.., z]| z)),
                ..ExportedAgent::default()
            },
        });
    }
    match found.is_empty() {
        false => Ok(found),
        true => Err(ExportError::unfit(
            log.path(),
            "topic `/AGENT/points`: expected clouds of at least one agent, found none; see what it has by `realo info`",
        )),
    }
}

/// Why writing stopped: the log, or the file.
enum Stopped {
    Log(LogError),
    File(Failure),
}

impl From<LogError> for Stopped {
    fn from(error: LogError) -> Self {
        Stopped::Log(error)
    }
}

impl From<Failure> for Stopped {
    fn from(failure: Failure) -> Self {
        Stopped::File(failure)
    }
}

impl Stopped {
    fn named(self, folder: &Folder) -> ExportError {
        match self {
            Stopped::Log(error) => error.into(),
            Stopped::File(failure) => failed(folder, failure),
        }
    }
}

fn failed(folder: &Folder, failure: Failure) -> ExportError {
    folder.failed_behind(FILE, failure.written, std::io::Error::other(failure.reason))
}

struct Bag<'a> {
    log: &'a Log,
    mcap: McapWriter,
    /// Channels by the names of their topics.
    topics: BTreeMap<String, (ChannelId, Topic)>,
    /// First and last log time.
    span: Option<(Nanos, Nanos)>,
    agents: Vec<ExportedAgent>,
    /// What waits for its companion, by agent.
    boxes: Vec<Boxes>,
    without_way: u64,
    velocities: bool,
    /// Boxes for whose class Autoware has no label, by class.
    unlabelled: BTreeMap<String, usize>,
}

impl Bag<'_> {
    fn messages(&mut self, agents: &[BagAgent], report: Report) -> Result<(), Stopped> {
        let streams = |agent: &BagAgent| {
            [
                Stream::Points,
                agent.poses,
                Stream::GroundTruth,
                Stream::GroundTruthInfo,
            ]
        };
        let all = agents
            .iter()
            .flat_map(|agent| streams(agent).map(|stream| (agent.name, stream)));
        let wanted: Vec<_> = all.filter(|(name, stream)| self.log.has(name, *stream)).collect();
        let sweeps = agents
            .iter()
            .map(|agent| self.log.count(agent.name, Stream::Points))
            .sum();
        let mut done = 0;
        report(done, sweeps);
        let mut reader = self.log.read_all(&wanted)?;
        while let Some(entry) = reader.next()? {
            let Some(index) = agents.iter().position(|agent| *agent.name == *entry.agent) else {
                continue;
            };
            match entry.stream {
                Stream::Points => {
                    self.cloud(index, &entry)?;
                    done += 1;
                    report(done, sweeps);
                }
                Stream::GroundTruth => {
                    self.boxes[index] = entry.boxes()?;
                    if !agents[index].has_info {
                        self.objects(index, &entry)?;
                    }
                }
                Stream::GroundTruthInfo => {
                    entry.info(&mut self.boxes[index])?;
                    self.objects(index, &entry)?;
                }
                _ => self.pose(&entry)?,
            }
        }
        Ok(())
    }

    fn put(
        &mut self,
        topic: String,
        schema: Schema,
        entry: &Entry,
        encode: impl FnOnce(&mut Vec<u8>),
    ) -> Result<(), Failure> {
        let mcap = &mut self.mcap;
        let (channel, known) = self.topics.entry(topic.clone()).or_insert_with(|| {
            let channel = mcap.channel(&topic, schema, ChunkGroup::of(&schema.name()));
            let topic = Topic {
                name: topic,
                kind: schema.name(),
                messages: 0,
            };
            (channel, topic)
        });
        known.messages += 1;
        let ready = entry.ready();
        let (first, last) = self.span.unwrap_or((ready, ready));
        self.span = Some((first.min(ready), last.max(ready)));
        mcap.write(*channel, ready as u64, entry.stamp().max(0) as u64, encode)
            .map(|_| ())
    }

    fn cloud(&mut self, index: usize, entry: &Entry) -> Result<(), Stopped> {
        let points = match entry.cloud() {
            Ok(points) => points,
            Err(LogError::Unplaced { .. }) => {
                self.without_way += 1;
                return Ok(());
            }
            Err(error) => return Err(error.into()),
        };
        let (stamp, frame) = (entry.stamp(), body_frame(&entry.agent));
        let summary = &mut self.agents[index];
        summary.sweeps += 1;
        summary.points += points.len();
        let topic = format!("/{}/points", entry.agent);
        self.put(topic, Schema::PointCloud2, entry, |out| {
            cloud::encode(out, stamp, &frame, &points)
        })?;
        Ok(())
    }

    fn pose(&mut self, entry: &Entry) -> Result<(), Stopped> {
        // What is no pose is counted when the log is played.
        let Ok(state) = entry.pose() else { return Ok(()) };
        let state: &AgentState = &state;
        let (stamp, frame, map) = (
            entry.stamp(),
            body_frame(&entry.agent),
            &self.log.info().map_frame.clone(),
        );
        let topic = format!("/{}/pose", entry.agent);
        self.put(topic, Schema::PoseWithCovarianceStamped, entry, |out| {
            pose::encode(out, stamp, map, state)
        })?;
        self.put("/tf".into(), Schema::TfMessage, entry, |out| {
            pose::encode_transform(out, stamp, map, &frame, &state.map_from_body);
        })?;
        Ok(())
    }

    fn objects(&mut self, index: usize, entry: &Entry) -> Result<(), Stopped> {
        let boxes = std::mem::take(&mut self.boxes[index]).0;
        let (stamp, frame) = (entry.stamp(), body_frame(&entry.agent));
        self.agents[index].boxes += boxes.len();
        self.velocities |= boxes.iter().any(|object| object.velocity.is_some());
        for object in boxes
            .iter()
            .filter(|object| objects::label(&object.class) == objects::UNKNOWN)
        {
            *self.unlabelled.entry(object.class.to_string()).or_default() += 1;
        }
        let topic = |end: &str| format!("/{}/{end}", entry.agent);
        self.put(topic("objects"), Schema::Detection3DArray, entry, |out| {
            boxes::encode(out, stamp, &frame, &boxes);
        })?;
        self.put(topic("markers"), Schema::MarkerArray, entry, |out| {
            boxes::encode_markers(out, stamp, &frame, "objects", &boxes);
        })?;
        self.put(topic("detected_objects"), Schema::DetectedObjects, entry, |out| {
            objects::encode(out, stamp, &frame, &boxes);
        })?;
        Ok(())
    }
}

fn left_out(without_way: u64) -> Vec<String> {
    let lines = (without_way > 0).then(|| format!("{without_way} sweeps without a transform to the body frame"));
    lines.into_iter().collect()
}

/// Classes for which Autoware has no label.
fn without_label(unlabelled: &BTreeMap<String, usize>) -> Option<String> {
    let classes: Vec<String> = unlabelled
        .iter()
        .map(|(class, count)| format!("{class} ({count})"))
        .collect();
    (!classes.is_empty()).then(|| {
        format!(
            "classes in `detected_objects`, whose label is UNKNOWN there: {}; `objects` and `markers` have them",
            classes.join(", ")
        )
    })
}

/// What standard messages do not hold, of what the log has, a line each.
fn lost(log: &Log, agents: &[BagAgent], velocities: bool) -> Vec<String> {
    let has = |stream: Stream| agents.iter().any(|agent| log.has(agent.name, stream));
    let is_motion = [Stream::Imu, Stream::Fix, Stream::Wheels].into_iter().any(has);
    let all = [
        (
            velocities,
            "velocities of objects in `objects`: they are in `detected_objects`, which the import does not read",
        ),
        (
            has(Stream::GroundTruth),
            "which frames are scored, and points on objects: they are counted again",
        ),
        (
            has(Stream::Pose) && has(Stream::PoseTruth),
            "poses that agents believed; the true ones are written",
        ),
        (has(Stream::OwnLabels), "own labels of agents"),
        (has(Stream::Detections), "recorded detections"),
        (is_motion, "motion sensors"),
        (has(Stream::Packets), "precomputed packets"),
        (
            has(Stream::GroundTruthViews) || has(Stream::OwnLabelsViews),
            "views of cameras",
        ),
        (true, "words about the log and its sensors"),
    ];
    let lines = all.into_iter().filter(|(is_there, _)| *is_there);
    lines.map(|(_, line)| line.into()).collect()
}

/// The map file of the bag, for its import.
fn map_file(log: &Log, agents: &[BagAgent]) -> String {
    let quoted = |text: &str| serde_json::to_string(text).expect("a text is plain data");
    let mut text = format!("world: {}\nclock: header\nagents:\n", quoted(&log.info().map_frame));
    for agent in agents {
        let name = agent.name;
        let info = log.info().agent(name);
        let kind = info.map_or(AgentKind::Vehicle, |info| info.kind).as_str();
        text += &format!("  {}:\n    kind: {kind}\n    clouds: /{name}/points\n", quoted(name));
        text += &format!(
            "    frame: {}\n    height: 0\n    pose: /{name}/pose\n",
            quoted(&body_frame(name))
        );
        if agent.has_objects {
            text += &format!("    truth: /{name}/objects\n");
        }
        if let Some(footprint) = info.and_then(|info| info.footprint) {
            text += &format!("    footprint: [{}]\n", numbers(&footprint));
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn classes_without_a_label_are_counted_by_name() {
        assert_eq!(without_label(&BTreeMap::new()), None);
        let unlabelled = BTreeMap::from([("Kite".to_string(), 3), ("Deer".to_string(), 1)]);
        let said = without_label(&unlabelled).unwrap();
        assert!(said.contains("UNKNOWN there: Deer (1), Kite (3);"), "{said}");
    }
}
