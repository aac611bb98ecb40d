use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use crate::channels::FOOTPRINT;
use realo_logs::cdr::CdrReader;
use realo_logs::{
    BoxesInfo, LogError, McapFile, Messages, RECORDING_RECORD, RawMessage, Schema, boxes, outline, pose, views,
};
use realo_schemas::geometry::View;
use realo_schemas::{
    AgentState, Boxes, GroundTruth, Header, Kind, Message, Name, Nanos, OwnLabels, Pose, PoseStatus, is_same_stamp,
};
use serde_json::Value;

/// The final boxes of a recording, in order of their ready time, bit for bit as the recorder got them.
///
/// Headers have agent, seq, stamp, ready, frame and pose. Of a recording that was cut all before the cut is read.
///
/// # Errors
/// A file that cannot be read or is no recording; messages that cannot be read.
pub fn read_boxes(recording: impl AsRef<Path>) -> Result<Vec<Message>, LogError> {
    boxes_of(recording)?.collect()
}

/// What each agent detected alone, as [`read_boxes`].
///
/// # Errors
/// As [`read_boxes`].
pub fn read_detections(recording: impl AsRef<Path>) -> Result<Vec<Message>, LogError> {
    BoxesOf::open(recording.as_ref(), "/detections")?.collect()
}

/// The recorded ground truth, as [`read_boxes`]; without the footprints of agents, which [`footprints_of`] gives.
///
/// # Errors
/// As [`read_boxes`].
pub fn read_truth(recording: impl AsRef<Path>) -> Result<Vec<Message>, LogError> {
    truth_of(recording)?.collect()
}

/// The reports of a recording, in order: topic, agent where one reported, and document. The last of a finished run are
/// its `books`.
///
/// # Errors
/// As [`read_boxes`].
pub fn read_reports(recording: impl AsRef<Path>) -> Result<Vec<Value>, LogError> {
    reports_of(recording)?.collect()
}

/// As [`read_boxes`], one message after the other, in constant memory.
///
/// # Errors
/// A file that cannot be read or is no recording.
pub fn boxes_of(recording: impl AsRef<Path>) -> Result<BoxesOf, LogError> {
    BoxesOf::open(recording.as_ref(), "/boxes")
}

/// As [`read_truth`], one message after the other, in constant memory.
///
/// # Errors
/// A file that cannot be read or is no recording.
pub fn truth_of(recording: impl AsRef<Path>) -> Result<TruthOf, LogError> {
    let endings = [TRUTH, OWN, TRUTH_VIEWS, OWN_VIEWS];
    Ok(TruthOf {
        messages: Selected::open(recording.as_ref(), |topic| {
            endings.iter().any(|ending| named(topic).ends_with(ending))
        })?,
        pairs: Pairs::default(),
        growing: BTreeMap::new(),
        ended: false,
    })
}

/// As [`read_reports`], one document after the other, in constant memory.
///
/// # Errors
/// A file that cannot be read or is no recording.
pub fn reports_of(recording: impl AsRef<Path>) -> Result<ReportsOf, LogError> {
    let messages = Selected::open(recording.as_ref(), |topic| topic == "/reports")?;
    Ok(ReportsOf { messages })
}

/// The recorded poses of all agents, as their graph knew them, one after the other, in constant memory.
///
/// # Errors
/// A file that cannot be read or is no recording.
pub fn states_of(recording: impl AsRef<Path>) -> Result<StatesOf, LogError> {
    let messages = Selected::open(recording.as_ref(), |topic| topic.ends_with("/pose"))?;
    Ok(StatesOf { messages })
}

/// The outlines `[x min, x max, y min, y max]` of agents in their body frames, m, to single precision: the first of each agent that
/// has one.
///
/// # Errors
/// A file that cannot be read or is no recording; a message that cannot be read.
pub fn footprints_of(recording: impl AsRef<Path>) -> Result<BTreeMap<Name, [f64; 4]>, LogError> {
    let mut messages = Selected::open(recording.as_ref(), |topic| topic.ends_with(&format!("/{FOOTPRINT}")))?;
    let mut found = BTreeMap::new();
    // All begin with the first truth.
    while found.len() < messages.topics.len() {
        let Some((topic, raw)) = messages.next()? else { break };
        let read = outline::decode(raw.data()).map_err(bad_content(&topic, &raw))?;
        found.entry(agent_of(&topic)).or_insert(read);
    }
    Ok(found)
}

const TRUTH: &str = "/ground_truth";
const OWN: &str = "/own_labels";
const TRUTH_VIEWS: &str = "/ground_truth_views";
const OWN_VIEWS: &str = "/own_labels_views";
const COMPANION: &str = "_info";

/// The topic of boxes without what marks their companion.
fn named(topic: &str) -> &str {
    topic.strip_suffix(COMPANION).unwrap_or(topic)
}

/// Messages of some topics.
struct Selected {
    topics: BTreeMap<u16, String>,
    messages: Messages,
}

impl Selected {
    fn open(recording: &Path, wanted: impl Fn(&str) -> bool) -> Result<Self, LogError> {
        let file = open(recording)?;
        let topics = topics(&file, wanted);
        let messages = file.messages(topics.keys().copied().collect(), 0..u64::MAX)?;
        Ok(Selected { topics, messages })
    }

    /// The next message and its topic.
    fn next(&mut self) -> Result<Option<(String, RawMessage)>, LogError> {
        let next = self.messages.next()?;
        Ok(next.map(|raw| (self.topics[&raw.channel].clone(), raw)))
    }
}

fn agent_of(topic: &str) -> Name {
    topic.split('/').nth(1).unwrap_or_default().into()
}

fn bad_content<'a>(topic: &'a str, raw: &'a RawMessage) -> impl Fn(String) -> LogError + 'a {
    |reason| LogError::Content {
        topic: topic.into(),
        log_time: raw.log_time as Nanos,
        reason,
    }
}

type WithCompanion = (Header, Boxes, BoxesInfo);

/// Boxes that wait for their companions, the newest of each topic.
#[derive(Default)]
struct Pairs(BTreeMap<String, RawMessage>);

impl Pairs {
    /// Takes a message of boxes or a companion; gives both once they are there.
    fn take(&mut self, topic: &str, raw: RawMessage, kind: Kind) -> Result<Option<WithCompanion>, LogError> {
        if !topic.ends_with(COMPANION) {
            self.0.insert(topic.into(), raw);
            return Ok(None);
        }
        let array = self.0.remove(named(topic));
        let Some(array) = array.filter(|array| array.publish_time == raw.publish_time) else {
            return Ok(None);
        };
        let pair = read_pair(&agent_of(topic), kind, &array, &raw);
        pair.map(Some).map_err(bad_content(topic, &raw))
    }
}

/// The boxes of a recording.
pub struct BoxesOf {
    messages: Selected,
    pairs: Pairs,
}

impl BoxesOf {
    fn open(recording: &Path, ending: &str) -> Result<Self, LogError> {
        Ok(BoxesOf {
            messages: Selected::open(recording, |topic| named(topic).ends_with(ending))?,
            pairs: Pairs::default(),
        })
    }

    fn read(&mut self) -> Result<Option<Message>, LogError> {
        while let Some((topic, raw)) = self.messages.next()? {
            if let Some((header, boxes, _)) = self.pairs.take(&topic, raw, Kind::Boxes)? {
                return Ok(Some(Message::new(header, boxes)));
            }
        }
        Ok(None)
    }
}

impl Iterator for BoxesOf {
    type Item = Result<Message, LogError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.read().transpose()
    }
}

/// The ground truth of a recording. A message is given once the next one of its agent begins, for what belongs to it
/// follows it in the file.
pub struct TruthOf {
    messages: Selected,
    pairs: Pairs,
    /// By agent.
    growing: BTreeMap<Name, (Header, GroundTruth)>,
    ended: bool,
}

impl TruthOf {
    fn read(&mut self) -> Result<Option<Message>, LogError> {
        while !self.ended {
            let Some((topic, raw)) = self.messages.next()? else {
                self.ended = true;
                break;
            };
            let agent = agent_of(&topic);
            if topic.ends_with(TRUTH_VIEWS) || topic.ends_with(OWN_VIEWS) {
                let (stamp, views) = views::decode(raw.data()).map_err(bad_content(&topic, &raw))?;
                self.add_views(&agent, stamp, views, topic.ends_with(OWN_VIEWS));
                continue;
            }
            let Some(pair) = self.pairs.take(&topic, raw, Kind::Truth)? else {
                continue;
            };
            match named(&topic).ends_with(OWN) {
                true => self.add_own(&agent, pair),
                false => {
                    if let Some((header, truth)) = self.growing.insert(agent, truth(pair)) {
                        return Ok(Some(Message::new(header, truth)));
                    }
                }
            }
        }
        let last = self.growing.pop_first();
        Ok(last.map(|(_, (header, truth))| Message::new(header, truth)))
    }

    fn at(&mut self, agent: &Name, stamp: Nanos) -> Option<&mut GroundTruth> {
        let growing = self
            .growing
            .get_mut(agent)
            .filter(|(header, _)| is_same_stamp(header.stamp, stamp));
        growing.map(|(_, truth)| truth)
    }

    fn add_views(&mut self, agent: &Name, stamp: Nanos, views: Vec<View>, own: bool) {
        match self.at(agent, stamp) {
            Some(truth) if own => {
                if let Some(own) = &mut truth.own {
                    own.views = views;
                }
            }
            Some(truth) => truth.views = views,
            None => {}
        }
    }

    fn add_own(&mut self, agent: &Name, (header, boxes, info): WithCompanion) {
        if let Some(truth) = self.at(agent, header.stamp) {
            truth.own = Some(Box::new(OwnLabels {
                boxes: boxes.0,
                points: info.points.unwrap_or_default(),
                key: info.key,
                views: Vec::new(),
            }));
        }
    }

    /// Messages that are held, of boxes or of truth.
    #[cfg(test)]
    pub(crate) fn held(&self) -> usize {
        self.pairs.0.len() + self.growing.len()
    }
}

impl Iterator for TruthOf {
    type Item = Result<Message, LogError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.read().transpose()
    }
}

fn truth((header, boxes, info): WithCompanion) -> (Header, GroundTruth) {
    let truth = GroundTruth {
        boxes: boxes.0,
        agents: info.agents,
        points: info.points.unwrap_or_default(),
        key: info.key,
        ..GroundTruth::default()
    };
    (header, truth)
}

/// The poses of a recording: agent, stamp and state.
pub struct StatesOf {
    messages: Selected,
}

impl StatesOf {
    fn read(&mut self) -> Result<Option<(Name, Nanos, AgentState)>, LogError> {
        let Some((topic, raw)) = self.messages.next()? else {
            return Ok(None);
        };
        let bad = bad_content(&topic, &raw);
        let (stamp, state) = pose::decode(raw.data(), PoseStatus::Recorded).map_err(|error| bad(error.to_string()))?;
        Ok(Some((agent_of(&topic), stamp, state)))
    }
}

impl Iterator for StatesOf {
    type Item = Result<(Name, Nanos, AgentState), LogError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.read().transpose()
    }
}

/// The reports of a recording.
pub struct ReportsOf {
    messages: Selected,
}

impl ReportsOf {
    fn read(&mut self) -> Result<Option<Value>, LogError> {
        let Some((topic, raw)) = self.messages.next()? else {
            return Ok(None);
        };
        let bad = bad_content(&topic, &raw);
        let text = CdrReader::new(raw.data())
            .and_then(|mut input| input.string())
            .map_err(&bad)?;
        serde_json::from_str(text)
            .map(Some)
            .map_err(|error| bad(error.to_string()))
    }
}

impl Iterator for ReportsOf {
    type Item = Result<Value, LogError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.read().transpose()
    }
}

fn read_pair(agent: &Name, kind: Kind, array: &RawMessage, companion: &RawMessage) -> Result<WithCompanion, String> {
    let (stamp, mut boxes): (Nanos, Boxes) = boxes::decode(array.data())?;
    let (_, info) = boxes::decode_info(companion.data(), &mut boxes)?;
    let (_, frame) = CdrReader::new(array.data())?.header()?;
    let mut header = Header::origin(
        &"recording".into(),
        agent,
        kind,
        info.seq,
        stamp,
        array.log_time as Nanos,
    );
    header.frame = frame.into();
    header.pose = info.map_from_frame.map(Pose::exact);
    Ok((header, boxes, info))
}

fn open(path: &Path) -> Result<McapFile, LogError> {
    let file = McapFile::open(path)?;
    if file.metadata().contains_key(RECORDING_RECORD) {
        return Ok(file);
    }
    let names: BTreeSet<&str> = file.metadata().keys().map(String::as_str).collect();
    let found = if names.is_empty() {
        "none".into()
    } else {
        names.into_iter().collect::<Vec<_>>().join(", ")
    };
    Err(LogError::NotRealo {
        path: path.into(),
        expected: "recording of a run",
        record: RECORDING_RECORD,
        found,
        hint: "the node `recorder` of a graph makes recordings".into(),
    })
}

fn topics(file: &McapFile, wanted: impl Fn(&str) -> bool) -> BTreeMap<u16, String> {
    let of_ours = |schema: &str| {
        [
            Schema::Detection3DArray,
            Schema::BoxesInfo,
            Schema::Views,
            Schema::String,
            Schema::PoseWithCovarianceStamped,
            Schema::PolygonStamped,
        ]
        .iter()
        .any(|s| s.name() == schema)
    };
    let channels = file
        .channels()
        .iter()
        .filter(|(_, channel)| of_ours(&channel.schema) && wanted(&channel.topic));
    channels.map(|(id, channel)| (*id, channel.topic.clone())).collect()
}

#[cfg(test)]
mod tests {
    use realo_schemas::Box3;

    use super::*;
    use crate::channels::{put_boxes, put_state, put_truth};
    use crate::recording::Recording;

    fn object(x: f64) -> Box3 {
        Box3::new("Car", [x, 0.0, 0.8], [4.0, 2.0, 1.6], 0.0)
    }

    #[test]
    fn truth_of_any_length_is_read_with_one_message_in_hand() {
        const SWEEPS: u64 = 500;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("recording.mcap");
        let truth = |seq: u64| GroundTruth {
            boxes: vec![object(seq as f64)],
            agents: vec!["cav1".into()],
            points: vec![7],
            key: seq.is_multiple_of(10),
            own: Some(Box::new(OwnLabels {
                boxes: vec![object(-1.0)],
                points: vec![3],
                key: true,
                views: Vec::new(),
            })),
            ..GroundTruth::default()
        };
        let mut recording = Recording::create(&path).unwrap();
        for seq in 0..SWEEPS {
            let at = 1_000_000_000 + 100_000_000 * seq as Nanos;
            let header = Header::origin(&"run".into(), &"cav1".into(), Kind::Truth, seq, at, at + 5);
            put_truth(&mut recording, &header, &truth(seq)).unwrap();
            put_boxes(&mut recording, "boxes", &header, &Boxes(vec![object(1.0)])).unwrap();
        }
        recording.finish(&realo_operator::Books::default()).unwrap();
        let mut reader = truth_of(&path).unwrap();
        for seq in 0..SWEEPS {
            let message = reader.next().unwrap().unwrap();
            assert_eq!(message.header.seq, seq);
            assert_eq!(message.into_parts::<GroundTruth>().unwrap().1, truth(seq));
            assert!(reader.held() <= 3, "{} messages at sweep {seq}", reader.held());
        }
        assert!(reader.next().is_none());
        let mut reader = boxes_of(&path).unwrap();
        while let Some(message) = reader.next() {
            message.unwrap();
            assert_eq!(reader.pairs.0.len(), 0);
        }
    }

    #[test]
    fn poses_of_all_agents_come_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("recording.mcap");
        let state = |x: f64| AgentState {
            map_from_body: nalgebra::Isometry3::translation(x, 2.0, 0.0),
            covariance: None,
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Recorded,
        };
        let mut recording = Recording::create(&path).unwrap();
        let agents: [(Name, f64); 2] = [("cav1".into(), 1.0), ("rsu1".into(), 5.0)];
        for (agent, x) in &agents {
            let header = Header::origin(&"run".into(), agent, Kind::AgentState, 0, 7, 9);
            put_state(&mut recording, &header, &state(*x)).unwrap();
        }
        recording.finish(&realo_operator::Books::default()).unwrap();
        let found: Vec<_> = states_of(&path).unwrap().map(Result::unwrap).collect();
        let expected = agents.map(|(agent, x)| (agent, 7, state(x)));
        assert_eq!(found, expected);
    }
}
