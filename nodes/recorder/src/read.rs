use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use realo_logs::cdr::CdrReader;
use realo_logs::{BoxesInfo, LogError, McapFile, RECORDING_RECORD, RawMessage, Schema, boxes, views};
use realo_schemas::geometry::View;
use realo_schemas::{Boxes, GroundTruth, Header, Kind, Message, Name, Nanos, OwnLabels, Pose};
use serde_json::Value;

/// The final boxes of a recording, in order of their ready time, bit for bit as the recorder got them.
///
/// Headers have agent, seq, stamp, ready, frame and pose. Of a recording that was cut all before the cut is read.
///
/// # Errors
/// A file that cannot be read or is no recording; messages that cannot be read.
pub fn read_boxes(recording: impl AsRef<Path>) -> Result<Vec<Message>, LogError> {
    read_all_boxes(recording.as_ref(), "/boxes")
}

/// What each agent detected alone, as [`read_boxes`].
///
/// # Errors
/// As [`read_boxes`].
pub fn read_detections(recording: impl AsRef<Path>) -> Result<Vec<Message>, LogError> {
    read_all_boxes(recording.as_ref(), "/detections")
}

fn read_all_boxes(recording: &Path, ending: &str) -> Result<Vec<Message>, LogError> {
    let messages = read_with_companions(recording, ending, Kind::Boxes)?;
    let message = |(header, boxes, _): WithCompanion| Message::new(header, boxes);
    Ok(messages.into_iter().map(message).collect())
}

/// The recorded ground truth, as [`read_boxes`]; without the ego's footprint.
///
/// # Errors
/// As [`read_boxes`].
pub fn read_truth(recording: impl AsRef<Path>) -> Result<Vec<Message>, LogError> {
    let recording = recording.as_ref();
    let messages = read_with_companions(recording, "/ground_truth", Kind::Truth)?;
    let mut views = read_views(recording, "/ground_truth_views")?;
    let mut own_views = read_views(recording, "/own_labels_views")?;
    let mut own = BTreeMap::new();
    for (header, boxes, info) in read_with_companions(recording, "/own_labels", Kind::Truth)? {
        let at = (header.agent.clone(), header.stamp);
        let labels = OwnLabels {
            boxes: boxes.0,
            points: info.points.unwrap_or_default(),
            key: info.key,
            views: own_views.remove(&at).unwrap_or_default(),
        };
        own.insert(at, labels);
    }
    let message = |(header, boxes, info): WithCompanion| {
        let at = (header.agent.clone(), header.stamp);
        let truth = GroundTruth {
            boxes: boxes.0,
            agents: info.agents,
            points: info.points.unwrap_or_default(),
            ego_footprint: None,
            key: info.key,
            views: views.remove(&at).unwrap_or_default(),
            own: own.remove(&at),
        };
        Message::new(header, truth)
    };
    Ok(messages.into_iter().map(message).collect())
}

/// Views by agent and stamp.
fn read_views(recording: &Path, ending: &str) -> Result<BTreeMap<(Name, Nanos), Vec<View>>, LogError> {
    let file = open(recording)?;
    let topics = topics(&file, |topic| topic.ends_with(ending));
    let mut messages = file.messages(topics.keys().copied().collect(), 0..u64::MAX)?;
    let mut found = BTreeMap::new();
    while let Some(raw) = messages.next()? {
        let topic = &topics[&raw.channel];
        let agent: Name = topic.split('/').nth(1).unwrap_or_default().into();
        let (stamp, views) = views::decode(raw.data()).map_err(|reason| LogError::Content {
            topic: topic.clone(),
            log_time: raw.log_time as Nanos,
            reason,
        })?;
        found.insert((agent, stamp), views);
    }
    Ok(found)
}

type WithCompanion = (Header, Boxes, BoxesInfo);

fn read_with_companions(recording: &Path, ending: &str, kind: Kind) -> Result<Vec<WithCompanion>, LogError> {
    let file = open(recording)?;
    let mut parts: BTreeMap<Name, RawMessage> = BTreeMap::new();
    let mut found = Vec::new();
    let topics = topics(&file, |topic| {
        topic.strip_suffix("_info").unwrap_or(topic).ends_with(ending)
    });
    let mut messages = file.messages(topics.keys().copied().collect(), 0..u64::MAX)?;
    while let Some(raw) = messages.next()? {
        let topic = &topics[&raw.channel];
        let agent: Name = topic.split('/').nth(1).unwrap_or_default().into();
        if !topic.ends_with("_info") {
            parts.insert(agent, raw);
            continue;
        }
        let Some(array) = parts
            .remove(&agent)
            .filter(|array| array.publish_time == raw.publish_time)
        else {
            continue;
        };
        found.push(
            read_pair(&agent, kind, &array, &raw).map_err(|reason| LogError::Content {
                topic: topic.clone(),
                log_time: raw.log_time as Nanos,
                reason,
            })?,
        );
    }
    Ok(found)
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

/// The reports of a recording, in order: topic, agent where one reported, and document. The last of a finished run are
/// its `books`.
///
/// # Errors
/// As [`read_boxes`].
pub fn read_reports(recording: impl AsRef<Path>) -> Result<Vec<Value>, LogError> {
    let file = open(recording.as_ref())?;
    let topics = topics(&file, |topic| topic == "/reports");
    let mut messages = file.messages(topics.keys().copied().collect(), 0..u64::MAX)?;
    let mut found = Vec::new();
    while let Some(raw) = messages.next()? {
        let bad = |reason: String| LogError::Content {
            topic: "/reports".into(),
            log_time: raw.log_time as Nanos,
            reason,
        };
        let text = CdrReader::new(raw.data())
            .and_then(|mut input| input.string())
            .map_err(bad)?;
        found.push(serde_json::from_str(text).map_err(|error| bad(error.to_string()))?);
    }
    Ok(found)
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
        hint: "the node `recorder` of a graph makes recordings",
    })
}

fn topics(file: &McapFile, wanted: impl Fn(&str) -> bool) -> BTreeMap<u16, String> {
    let of_ours = |schema: &str| {
        [
            Schema::Detection3DArray,
            Schema::BoxesInfo,
            Schema::Views,
            Schema::String,
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
