//! Lists of boxes of a log or of the recording of a run, with where their agents are.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Isometry3;
use realo_logs::{AgentKind, Log, MAX_GAP, McapFile, RawMessage, Schema, Stream, boxes, pose_track};
use realo_schemas::geometry::PoseTrack;
use realo_schemas::{Box3, Boxes, Nanos};

use super::{BoxSource, ExportError, Options, Report};

/// What an agent found in a sweep.
pub struct List {
    pub agent: String,
    pub stamp: Nanos,
    /// When it was known.
    pub ready: Nanos,
    /// Number of the sweep.
    pub seq: u64,
    /// `None` where it is not known.
    pub map_from_body: Option<Isometry3<f64>>,
    /// In the body frame.
    pub boxes: Vec<Box3>,
}

/// What is known of the agents.
pub struct Agents(BTreeMap<String, Agent>);

struct Agent {
    is_roadside: bool,
    outline: Option<[f64; 4]>,
    /// Its poses; of a recording the lists have them.
    track: Option<PoseTrack>,
}

impl Agents {
    /// Of a log: its agents that are wanted and have boxes, with their true poses, or where it has none, those that they believed.
    pub fn of_log(log: &Log, options: &Options) -> Result<Self, ExportError> {
        options.agents.iter().try_for_each(|name| log.need_agent(name))?;
        let stream = match options.boxes {
            BoxSource::Detections => Stream::Detections,
            BoxSource::Truth => Stream::GroundTruth,
            BoxSource::Own => Stream::OwnLabels,
            BoxSource::Fused => {
                let reason = "--boxes fused: expected the recording of a run, found a log; give the folder of the run";
                return Err(ExportError::unfit(log.path(), reason));
            }
        };
        let mut agents = BTreeMap::new();
        for info in &log.info().agents {
            if !options.wants_agent(&info.name) || !log.has(&info.name, stream) {
                continue;
            }
            let poses = match log.has(&info.name, Stream::PoseTruth) {
                true => Stream::PoseTruth,
                false => Stream::Pose,
            };
            log.need(&info.name, poses)?;
            let agent = Agent {
                is_roadside: info.kind == AgentKind::Roadside || options.roadside.contains(&info.name),
                outline: info.footprint.filter(|_| info.kind == AgentKind::Vehicle),
                track: Some(pose_track(log, &info.name, poses, MAX_GAP)?),
            };
            agents.insert(info.name.clone(), agent);
        }
        Ok(Agents(agents))
    }

    /// Of a recording: those with boxes that are wanted; which are roadside units it does not say.
    pub fn of_recording(file: &McapFile, options: &Options) -> Result<Self, ExportError> {
        let mut names = BTreeSet::new();
        for channel in file.channels().values() {
            let Some((agent, topic)) = parts(&channel.topic) else {
                continue;
            };
            if topic == options.boxes.topic() && channel.schema == Schema::Detection3DArray.name() {
                // Names become folders.
                realo_logs::check_agent_name(agent).map_err(|reason| {
                    ExportError::unfit(file.path(), format!("topic `{}`: {reason}", channel.topic))
                })?;
                names.insert(agent.to_string());
            }
        }
        let wanted = options.agents.iter().chain(&options.roadside);
        if let Some(name) = wanted.clone().find(|name| !names.contains(*name)) {
            let has = names.into_iter().collect::<Vec<_>>().join(", ");
            let reason = format!(
                "agent `{name}`: expected one with the topic `{}`, found {}; choose others, or other boxes by --boxes",
                options.boxes.topic(),
                if has.is_empty() { "none" } else { &has }
            );
            return Err(ExportError::unfit(file.path(), reason));
        }
        let agent = |name: String| {
            let is_roadside = options.roadside.contains(&name);
            let agent = Agent {
                is_roadside,
                outline: None,
                track: None,
            };
            (name, agent)
        };
        let names = names.into_iter().filter(|name| options.wants_agent(name));
        Ok(Agents(names.map(agent).collect()))
    }

    /// Their names.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.0.keys().map(String::as_str)
    }

    /// Names of roadside units.
    pub fn roadside(&self) -> impl Iterator<Item = &str> {
        let units = self.0.iter().filter(|(_, agent)| agent.is_roadside);
        units.map(|(name, _)| name.as_str())
    }

    /// The outline of a vehicle about itself, m: a box centred in it is the vehicle.
    pub fn outline(&self, name: &str) -> Option<[f64; 4]> {
        self.0.get(name)?.outline
    }
}

fn parts(topic: &str) -> Option<(&str, &str)> {
    topic.strip_prefix('/')?.split_once('/')
}

/// A channel that is read: whose, and whether it has what boxes cannot say.
type Wanted = BTreeMap<u16, (String, bool)>;

fn wanted(file: &McapFile, agents: &Agents, topic: &str) -> Wanted {
    let info = format!("{topic}_info");
    let channels = file.channels().iter().filter_map(|(id, channel)| {
        let (agent, part) = parts(&channel.topic)?;
        let is_info = match channel.schema {
            ref schema if *schema == Schema::Detection3DArray.name() && part == topic => false,
            ref schema if *schema == Schema::BoxesInfo.name() && part == info => true,
            _ => return None,
        };
        agents
            .0
            .contains_key(agent)
            .then(|| (*id, (agent.to_string(), is_info)))
    });
    channels.collect()
}

/// Calls `each` with all lists in the order of time, and `report` with lists that were read, and all. Returns how many have no
/// companion although their agent has some.
///
/// # Errors
/// A file that cannot be read; why `each` failed.
pub fn each_list(
    file: &McapFile,
    agents: &Agents,
    options: &Options,
    report: Report,
    mut each: impl FnMut(List) -> Result<(), ExportError>,
) -> Result<u64, ExportError> {
    let wanted = wanted(file, agents, options.boxes.topic());
    let with_info: BTreeSet<&String> = wanted
        .values()
        .filter(|(_, is_info)| *is_info)
        .map(|(agent, _)| agent)
        .collect();
    let mut waiting: BTreeMap<&str, (RawMessage, Nanos, Boxes)> = BTreeMap::new();
    let (mut done, mut without) = (0, 0);
    let lists = wanted.iter().filter(|(_, (_, is_info))| !is_info);
    let all = lists
        .filter_map(|(id, _)| file.channels().get(id))
        .map(|channel| channel.messages)
        .sum();
    report(done, all);
    let mut messages = file.messages(wanted.keys().copied().collect(), 0..u64::MAX)?;
    while let Some(raw) = messages.next()? {
        let (agent, is_info) = &wanted[&raw.channel];
        let wrong = |reason: String| {
            ExportError::unfit(
                file.path(),
                format!("topic /{agent}/{}: {reason}", options.boxes.topic()),
            )
        };
        if *is_info {
            let Some((first, stamp, mut found)) = waiting.remove(agent.as_str()) else {
                continue;
            };
            let (of, info) = boxes::decode_info(raw.data(), &mut found).map_err(|error| wrong(error.to_string()))?;
            if of != stamp {
                without += 1;
                continue;
            }
            let seq = if info.seq == u64::MAX { done } else { info.seq };
            each(list(agents, agent, &first, stamp, seq, info.map_from_frame, found))?;
        } else {
            let (stamp, found) = boxes::decode(raw.data()).map_err(|error| wrong(error.to_string()))?;
            match with_info.contains(agent) {
                true => without += u64::from(waiting.insert(agent, (raw, stamp, found)).is_some()),
                false => each(list(agents, agent, &raw, stamp, done, None, found))?,
            }
            done += 1;
            report(done, all);
        }
    }
    Ok(without + waiting.len() as u64)
}

fn list(
    agents: &Agents,
    agent: &str,
    raw: &RawMessage,
    stamp: Nanos,
    seq: u64,
    stated: Option<Isometry3<f64>>,
    boxes: Boxes,
) -> List {
    let track = agents.0.get(agent).and_then(|agent| agent.track.as_ref());
    List {
        agent: agent.into(),
        stamp,
        ready: Nanos::try_from(raw.log_time).unwrap_or(Nanos::MAX),
        seq,
        map_from_body: track.map_or(stated, |track| track.at(stamp)),
        boxes: boxes.0,
    }
}
