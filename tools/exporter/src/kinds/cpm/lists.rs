//! Lists of boxes of a log or of the recording of a run, with where their agents are.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::Path;

use nalgebra::Isometry3;
use realo_logs::cdr::CdrReader;
use realo_logs::{AgentKind, BoxesInfo, Log, MAX_GAP, McapFile, Schema, Stream, boxes, pose_track};
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

/// Where lists are read.
pub enum Source<'a> {
    /// A log.
    Log(&'a Log),
    /// The recording of a run.
    Recording(&'a McapFile),
}

impl Source<'_> {
    /// The file.
    pub fn path(&self) -> &Path {
        match self {
            Source::Log(log) => log.path(),
            Source::Recording(file) => file.path(),
        }
    }
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
        let mut named = options.agents.iter().chain(&options.roadside);
        named.try_for_each(|name| log.need_agent(name))?;
        let [stream, _] = streams(log, options.boxes)?;
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

/// Boxes of a log, and their companions.
fn streams(log: &Log, boxes: BoxSource) -> Result<[Stream; 2], ExportError> {
    match boxes {
        BoxSource::Detections => Ok([Stream::Detections, Stream::DetectionsInfo]),
        BoxSource::Truth => Ok([Stream::GroundTruth, Stream::GroundTruthInfo]),
        BoxSource::Own => Ok([Stream::OwnLabels, Stream::OwnLabelsInfo]),
        BoxSource::Fused => {
            let reason = "--boxes fused: expected the recording of a run, found a log; give the folder of the run";
            Err(ExportError::unfit(log.path(), reason))
        }
    }
}

/// What a file has of only one half: lists of boxes and their companions go together by agent and stamp.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Unpaired {
    /// Lists without a companion, although their agent has some.
    pub lists: u64,
    /// Companions without a list.
    pub companions: u64,
}

/// Calls `each` with all lists, mostly in the order of time, and `report` with lists that were read, and all.
///
/// # Errors
/// A file that cannot be read; boxes in another frame than their agent's body; why `each` failed.
pub fn each_list(
    source: &Source,
    agents: &Agents,
    options: &Options,
    report: Report,
    each: impl FnMut(List) -> Result<(), ExportError>,
) -> Result<Unpaired, ExportError> {
    match source {
        Source::Log(log) => each_of_log(log, agents, options, report, each),
        Source::Recording(file) => each_of_recording(file, agents, options, report, each),
    }
}

/// By the log's own reader, which checks frames and joins tracks as for a run.
fn each_of_log(
    log: &Log,
    agents: &Agents,
    options: &Options,
    report: Report,
    mut each: impl FnMut(List) -> Result<(), ExportError>,
) -> Result<Unpaired, ExportError> {
    let [of_boxes, of_info] = streams(log, options.boxes)?;
    let all = agents.names().flat_map(|name| [(name, of_boxes), (name, of_info)]);
    let wanted: Vec<(&str, Stream)> = all.filter(|(name, stream)| log.has(name, *stream)).collect();
    let mut open = Waiting::of(agents.names().filter(|name| log.has(name, of_info)));
    let all = agents.names().map(|name| log.count(name, of_boxes)).sum();
    report(0, all);
    let mut reader = log.read_all(&wanted)?;
    while let Some(entry) = reader.next()? {
        let paired = match entry.stream == of_info {
            true => {
                let (agent, stamp) = (entry.agent.to_string(), entry.stamp());
                open.companion(&agent, stamp, entry)
            }
            false => open.list(List {
                agent: entry.agent.to_string(),
                stamp: entry.stamp(),
                ready: entry.ready(),
                seq: open.done,
                map_from_body: None,
                boxes: entry.boxes()?.0,
            }),
        };
        report(open.done, all);
        let Some((mut list, info)) = paired else { continue };
        let mut found = Boxes(std::mem::take(&mut list.boxes));
        let info = info.map(|entry| entry.info(&mut found)).transpose()?;
        list.boxes = found.0;
        each(list.completed(agents, info))?;
    }
    Ok(open.unpaired())
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

fn each_of_recording(
    file: &McapFile,
    agents: &Agents,
    options: &Options,
    report: Report,
    mut each: impl FnMut(List) -> Result<(), ExportError>,
) -> Result<Unpaired, ExportError> {
    let wanted = wanted(file, agents, options.boxes.topic());
    let with_info = wanted.values().filter(|(_, is_info)| *is_info);
    let mut open = Waiting::of(with_info.map(|(agent, _)| agent.as_str()));
    let lists = wanted.iter().filter(|(_, (_, is_info))| !is_info);
    let all = lists
        .filter_map(|(id, _)| file.channels().get(id))
        .map(|channel| channel.messages)
        .sum();
    report(0, all);
    let mut messages = file.messages(wanted.keys().copied().collect(), 0..u64::MAX)?;
    while let Some(raw) = messages.next()? {
        let (agent, is_info) = &wanted[&raw.channel];
        let wrong = |reason: String| {
            ExportError::unfit(
                file.path(),
                format!("topic /{agent}/{}: {reason}", options.boxes.topic()),
            )
        };
        let paired = match *is_info {
            true => {
                let header = CdrReader::new(raw.data()).and_then(|mut input| Ok(input.header()?.0));
                open.companion(
                    agent,
                    header.map_err(|error| wrong(error.to_string()))?,
                    raw.data().to_vec(),
                )
            }
            false => {
                let (stamp, found) = boxes::decode(raw.data()).map_err(|error| wrong(error.to_string()))?;
                open.list(List {
                    agent: agent.clone(),
                    stamp,
                    ready: Nanos::try_from(raw.log_time).unwrap_or(Nanos::MAX),
                    seq: open.done,
                    map_from_body: None,
                    boxes: found.0,
                })
            }
        };
        report(open.done, all);
        let Some((mut list, info)) = paired else { continue };
        let mut found = Boxes(std::mem::take(&mut list.boxes));
        let info = info
            .map(|info| boxes::decode_info(&info, &mut found).map(|(_, info)| info))
            .transpose();
        let info = info.map_err(|error| wrong(error.to_string()))?;
        list.boxes = found.0;
        each(list.completed(agents, info))?;
    }
    Ok(open.unpaired())
}

/// So many of an agent wait for their other half; the one that waits for longest is given up then.
const WAITING: usize = 256;

/// Lists and companions that wait for each other.
struct Waiting<I> {
    /// Agents that have companions.
    with_info: BTreeSet<String>,
    lists: BTreeMap<String, VecDeque<List>>,
    companions: BTreeMap<String, VecDeque<(Nanos, I)>>,
    /// Lists that were read.
    done: u64,
    given_up: Unpaired,
}

impl<I> Waiting<I> {
    fn of<'a>(with_info: impl Iterator<Item = &'a str>) -> Self {
        Waiting {
            with_info: with_info.map(String::from).collect(),
            lists: BTreeMap::new(),
            companions: BTreeMap::new(),
            done: 0,
            given_up: Unpaired::default(),
        }
    }

    /// Takes a list; gives it back with its companion where that was there before, and without where none will come.
    fn list(&mut self, list: List) -> Option<(List, Option<I>)> {
        self.done += 1;
        if !self.with_info.contains(&list.agent) {
            return Some((list, None));
        }
        let companions = self.companions.entry(list.agent.clone()).or_default();
        if let Some(place) = companions.iter().position(|(stamp, _)| *stamp == list.stamp) {
            return Some((list, companions.remove(place).map(|(_, info)| info)));
        }
        let lists = self.lists.entry(list.agent.clone()).or_default();
        lists.push_back(list);
        if lists.len() > WAITING {
            lists.pop_front();
            self.given_up.lists += 1;
        }
        None
    }

    /// Takes the companion of an agent's list of this stamp; gives both back where the list was there before.
    fn companion(&mut self, agent: &str, stamp: Nanos, info: I) -> Option<(List, Option<I>)> {
        let lists = self.lists.entry(agent.into()).or_default();
        if let Some(place) = lists.iter().position(|list| list.stamp == stamp) {
            return Some((lists.remove(place)?, Some(info)));
        }
        let companions = self.companions.entry(agent.into()).or_default();
        companions.push_back((stamp, info));
        if companions.len() > WAITING {
            companions.pop_front();
            self.given_up.companions += 1;
        }
        None
    }

    /// Those without their other half, at the end.
    fn unpaired(&self) -> Unpaired {
        let lists: usize = self.lists.values().map(VecDeque::len).sum();
        let companions: usize = self.companions.values().map(VecDeque::len).sum();
        Unpaired {
            lists: self.given_up.lists + lists as u64,
            companions: self.given_up.companions + companions as u64,
        }
    }
}

impl List {
    /// With what its companion says, and its pose.
    fn completed(self, agents: &Agents, info: Option<BoxesInfo>) -> Self {
        let track = agents.0.get(&self.agent).and_then(|agent| agent.track.as_ref());
        let stated = info.as_ref().and_then(|info| info.map_from_frame);
        List {
            seq: info.map_or(self.seq, |info| info.seq),
            map_from_body: track.map_or(stated, |track| track.at(self.stamp)),
            ..self
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(stamp: Nanos) -> List {
        List {
            agent: "car".into(),
            stamp,
            ready: stamp,
            seq: 0,
            map_from_body: None,
            boxes: Vec::new(),
        }
    }

    #[test]
    fn lists_and_companions_are_joined_by_stamp_in_any_order() {
        let mut open = Waiting::of(["car"].into_iter());
        let mut joined = Vec::new();
        let mut take =
            |paired: Option<(List, Option<Nanos>)>| joined.extend(paired.map(|(list, info)| (list.stamp, info)));
        // Two lists before their companions, a companion before its list, and one of each that stays alone.
        take(open.list(list(1)));
        take(open.list(list(2)));
        take(open.companion("car", 2, 2));
        take(open.companion("car", 1, 1));
        take(open.companion("car", 3, 3));
        take(open.list(list(4)));
        take(open.list(list(3)));
        take(open.companion("car", 5, 5));
        take(open.companion("car", 6, 6));
        assert_eq!(joined, [(2, Some(2)), (1, Some(1)), (3, Some(3))]);
        assert_eq!(
            open.unpaired(),
            Unpaired {
                lists: 1,
                companions: 2
            }
        );
        assert_eq!(open.done, 4);
    }

    #[test]
    fn what_waits_is_bounded_and_counted() {
        let mut open = Waiting::of(["car"].into_iter());
        for stamp in 0..WAITING as Nanos + 10 {
            assert!(open.list(list(stamp)).is_none());
        }
        assert!(open.companion("car", 0, ()).is_none(), "it was given up");
        assert!(open.companion("car", 10, ()).is_some());
        let lists = WAITING as u64 + 9;
        assert_eq!(open.unpaired(), Unpaired { lists, companions: 1 });
        // Of an agent without companions nothing waits.
        let mut open = Waiting::<()>::of(std::iter::empty());
        assert!(open.list(list(0)).is_some());
    }
}
