use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

use realo_logs::{
    Attitudes, Entry, LEVEL, Levelled, Log, LogError, LogReader, Stream, level_state, levelled_while_played,
    track_conflicts,
};
use realo_operator::{Counter, PortId};
use realo_schemas::geometry::tilt_degrees;
use realo_schemas::{
    Boxes, EgoState, GroundTruth, Header, Kind, Message, Name, Nanos, Packet, Payload, PointCloud, to_seconds,
};

use crate::counters::{
    Counters, DETECTIONS_WITHOUT_SWEEP, INTENSITIES_LIMITED, POSES_UNUSABLE, TILTED_POSES, TOO_FAR, TRACKS_DIFFER,
};
use crate::nearest::Nearest;
use crate::truth::TruthJoin;
use crate::{PlannedRun, ports};

/// Offline, messages leave in order of stamp, which may lie this much before they were ready.
const LATENCY: Nanos = 500_000_000;
/// Poses from so long before the first sweep are sent too, so that it has some.
const LEAD_IN: Nanos = 500_000_000;
/// Log time between the end of a pass and the start of the next, too long for a pose to be carried across.
const PAUSE: Nanos = 1_000_000_000;

/// What to play of a log, and how.
#[derive(Clone)]
pub struct Script {
    pub log: Log,
    pub run: Name,
    pub cast: PlannedRun,
    pub offline: bool,
    pub true_poses: bool,
    pub points: bool,
    pub detections: bool,
    /// Whether the collaborators' packets are played.
    pub precomputed: bool,
    /// Whether only the ego's streams are played.
    pub alone: bool,
    /// Collaborators that the fusion of the graph takes, where sweeps that it cannot take are left out.
    pub fused_at_most: Option<usize>,
    pub repeat: u32,
    /// Log times from (inclusive) and until (exclusive) which sweeps are played.
    pub from: Nanos,
    pub until: Nanos,
    /// A pass takes a multiple of this.
    pub slot: Option<Nanos>,
    pub counters: Counters,
}

/// A message on its way out: release time, port, message.
pub type Release = (Nanos, PortId, Message);

/// Turns a log into messages in order of release.
pub struct Feed {
    script: Script,
    agents: Vec<Name>,
    /// By rank, how many numbers a pass takes: of poses, and of sweeps and all that is of them.
    per_pass: Vec<[u64; 2]>,
    pass: u32,
    period: Nanos,
    reader: LogReader,
    truth: TruthJoin,
    /// Says which sweeps are left out.
    nearest: Option<Nearest>,
    /// Agents whose body frames are made level.
    levels: BTreeMap<Name, Levelling>,
    /// Agents whose frames were levelled otherwise when the log was made: along the ground, where poses need not be level.
    along_ground: BTreeSet<Name>,
    sweeps: BTreeMap<Name, BTreeMap<Nanos, u64>>,
    unjoined: BTreeMap<Name, (Entry, Boxes)>,
    /// By agent: intensities that did not fit, as they were counted.
    limited: BTreeMap<String, u64>,
    queue: BinaryHeap<Reverse<Queued>>,
    ended: bool,
    released_to: Nanos,
}

/// How an agent's body frames are made level.
struct Levelling {
    attitudes: Attitudes,
    /// Counts its sweeps, and says by how much its body tilts.
    counter: String,
}

struct Queued {
    key: (Nanos, usize, usize, u64),
    port: PortId,
    message: Message,
}

impl PartialEq for Queued {
    fn eq(&self, other: &Self) -> bool {
        self.key == other.key
    }
}
impl Eq for Queued {}
impl PartialOrd for Queued {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Queued {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.key.cmp(&other.key)
    }
}

impl Script {
    fn agents(&self) -> Vec<Name> {
        self.cast.agents().map(Name::from).collect()
    }

    fn pose_stream(&self, agent: &str) -> Stream {
        let truth = self.true_poses || (self.offline && self.log.has(agent, Stream::PoseTruth));
        if truth { Stream::PoseTruth } else { Stream::Pose }
    }

    fn per_pass(&self, agent: &str) -> [u64; 2] {
        let poses = self.log.count(agent, self.pose_stream(agent));
        [poses, sweeps_per_pass(&self.log, agent)]
    }

    fn is_precomputed(&self, agent: &str) -> bool {
        self.precomputed && agent != self.cast.ego
    }

    fn wants_points(&self, agent: &str) -> bool {
        self.points && !self.is_precomputed(agent)
    }

    /// Sweeps by their points, or, where nobody wants these, by the topic that only says when they were taken.
    fn sweep_stream(&self, agent: &str) -> Stream {
        match self.wants_points(agent) || !self.log.has(agent, Stream::Sweeps) {
            true => Stream::Points,
            false => Stream::Sweeps,
        }
    }

    /// The agents whose sensors are played.
    fn played(&self) -> impl Iterator<Item = &str> {
        self.cast.agents().take(if self.alone { 1 } else { usize::MAX })
    }

    /// What makes the frames of those level that tilt.
    fn levels(&self) -> Result<BTreeMap<Name, Levelling>, LogError> {
        let tilts = levelled_while_played(&self.log)?;
        let mut levels = BTreeMap::new();
        for agent in self.played() {
            if let Some(tilt) = tilts.get(agent) {
                let level = Levelling {
                    attitudes: Attitudes::read(&self.log, agent, self.pose_stream(agent))?,
                    counter: format!("levelled_{agent}_by_{tilt:.2}"),
                };
                levels.insert(agent.into(), level);
            }
        }
        Ok(levels)
    }

    fn nearest(&self, agents: &[Name]) -> Result<Option<Nearest>, LogError> {
        match self.fused_at_most {
            Some(limit) if limit + 1 < agents.len() && !self.alone => {
                Nearest::read(&self.log, agents, limit, self.offline, |agent| self.pose_stream(agent))
            }
            _ => Ok(None),
        }
    }

    fn along_ground(&self) -> Result<BTreeSet<Name>, LogError> {
        let levelled = self.log.levelled()?.into_iter();
        let ground = levelled.filter(|(_, levelled)| levelled.by == Levelled::BY_GROUND);
        Ok(ground.map(|(agent, _)| agent.as_str().into()).collect())
    }

    fn truth(&self, agents: &[Name], levels: &BTreeMap<Name, Levelling>) -> Result<TruthJoin, LogError> {
        let level = levels.get(&agents[0]).map(|level| level.attitudes.truth.clone());
        TruthJoin::new(&self.log, agents, self.from, self.until, level)
    }

    fn open(&self) -> Result<LogReader, LogError> {
        let mut wanted = Vec::new();
        for agent in self.played() {
            wanted.push((agent, self.pose_stream(agent)));
            wanted.push((agent, self.sweep_stream(agent)));
            if self.is_precomputed(agent) {
                wanted.push((agent, Stream::Packets));
            }
            if self.detections {
                let streams = [Stream::Detections, Stream::DetectionsInfo];
                let there = streams.into_iter().filter(|stream| self.log.has(agent, *stream));
                wanted.extend(there.map(|stream| (agent, stream)));
            }
        }
        self.log.read(&wanted, self.from.saturating_sub(LEAD_IN), self.until)
    }

    /// Counts the tracks that two of the agents give to different objects: the points on these cannot be joined.
    fn count_track_conflicts(&self) -> Result<(), LogError> {
        let agents = self.agents();
        if agents.len() < 2 {
            return Ok(());
        }
        for conflict in track_conflicts(&self.log)? {
            let [one, other] = &conflict.agents;
            if [one, other]
                .iter()
                .all(|name| agents.iter().any(|agent| &**agent == name.as_str()))
            {
                self.counters
                    .add(&TRACKS_DIFFER, &format!("{one} and {other}"), conflict.apart as u64, 0);
            }
        }
        Ok(())
    }

    /// Counts one of an agent, if something is wrong with it.
    fn count(&self, counter: &'static Counter, agent: &str, is_wrong: bool) {
        self.counters.add(counter, agent, u64::from(is_wrong), 1);
    }
}

impl Feed {
    pub fn new(script: Script) -> Result<Self, LogError> {
        let agents = script.agents();
        let (first, last) = script.log.span().unwrap_or_default();
        let played = script.until.min(last) - script.from.max(first);
        let period = played.max(0) + PAUSE + LEAD_IN;
        let levels = script.levels()?;
        script.count_track_conflicts()?;
        Ok(Feed {
            reader: script.open()?,
            truth: script.truth(&agents, &levels)?,
            along_ground: script.along_ground()?,
            nearest: script.nearest(&agents)?,
            levels,
            period: script
                .slot
                .map_or(period, |slot| (period + slot - 1).div_euclid(slot) * slot),
            sweeps: BTreeMap::new(),
            unjoined: BTreeMap::new(),
            limited: BTreeMap::new(),
            queue: BinaryHeap::new(),
            ended: false,
            released_to: Nanos::MIN,
            pass: 0,
            per_pass: agents.iter().map(|agent| script.per_pass(agent)).collect(),
            agents,
            script,
        })
    }

    /// From one pass to the next, ns.
    pub fn period(&self) -> Nanos {
        self.period
    }

    /// By agent, how many numbers a pass takes: of poses, and of all else.
    pub fn per_pass(&self) -> BTreeMap<Name, [u64; 2]> {
        self.agents.iter().cloned().zip(self.per_pass.iter().copied()).collect()
    }

    /// The first time of the log that is played.
    pub fn begins(&self) -> Nanos {
        self.script.from.saturating_sub(LEAD_IN)
    }

    /// The next message, `None` after the last pass.
    pub fn next(&mut self) -> Result<Option<Release>, LogError> {
        loop {
            if let Some(release) = self.ripe() {
                return Ok(Some(release));
            }
            if self.ended {
                if self.pass + 1 >= self.script.repeat {
                    return Ok(None);
                }
                self.rewind()?;
            }
            match self.reader.next()? {
                Some(entry) => self.take(&entry)?,
                None => self.end(),
            }
        }
    }

    fn rewind(&mut self) -> Result<(), LogError> {
        self.pass += 1;
        self.ended = false;
        self.sweeps.clear();
        self.reader = self.script.open()?;
        self.truth = self.script.truth(&self.agents, &self.levels)?;
        self.released_to = Nanos::MIN;
        Ok(())
    }

    fn end(&mut self) {
        for (entry, boxes) in std::mem::take(&mut self.unjoined).into_values() {
            self.send_detections(&entry, boxes);
        }
        for (agent, n) in self.script.log.limited_intensities() {
            let counted = self.limited.insert(agent.clone(), n).unwrap_or(0);
            self.script
                .counters
                .add(&INTENSITIES_LIMITED, &agent, n.saturating_sub(counted), 0);
        }
        self.ended = true;
        self.released_to = Nanos::MAX;
    }

    /// The first waiting message, once nothing earlier can come.
    fn ripe(&mut self) -> Option<Release> {
        let first = self.queue.peek()?;
        if first.0.key.0 >= self.released_to {
            return None;
        }
        let Reverse(first) = self.queue.pop()?;
        Some((first.message.header.ready, first.port, first.message))
    }

    fn take(&mut self, entry: &Entry) -> Result<(), LogError> {
        let reach = if self.script.offline { LATENCY } else { 0 };
        if self.script.offline && entry.ready().saturating_sub(entry.stamp()) > LATENCY {
            let (late, most) = (to_seconds(entry.ready() - entry.stamp()), to_seconds(LATENCY));
            let reason =
                format!("it was ready {late:.3} s after its stamp; played offline at most {most} s are expected");
            return Err(LogError::Content {
                topic: entry.stream.topic(&entry.agent),
                log_time: entry.ready(),
                reason,
            });
        }
        self.released_to = self.released_to.max(entry.ready().saturating_sub(reach));
        let playing = entry.ready() >= self.script.from;
        match entry.stream {
            Stream::Pose | Stream::PoseTruth => self.send_pose(entry),
            _ if !playing => {}
            Stream::Points => {
                let cloud = if self.script.wants_points(&entry.agent) {
                    entry.cloud()?
                } else {
                    PointCloud::empty()
                };
                self.send_sweep(entry, cloud)?;
            }
            Stream::Sweeps => self.send_sweep(entry, PointCloud::empty())?,
            Stream::Detections => self.take_detections(entry)?,
            Stream::DetectionsInfo => self.take_info(entry)?,
            Stream::Packets => self.send_packet(entry)?,
            _ => {}
        }
        Ok(())
    }

    fn send_pose(&mut self, entry: &Entry) {
        let pose = entry.pose();
        self.script.count(&POSES_UNUSABLE, &entry.agent, pose.is_err());
        match pose {
            Ok(state) => {
                let state = self.level_pose(entry, state);
                let ports = [ports::EGO_POSES, ports::POSES];
                self.send(entry, entry.seq(), Kind::EgoState, ports, state);
            }
            Err(_) => {}
        }
    }

    fn level_pose(&self, entry: &Entry, state: EgoState) -> EgoState {
        if self.levels.contains_key(&entry.agent) {
            return level_state(state);
        }
        let tilts = tilt_degrees(&state.map_from_body.rotation) > LEVEL;
        let is_tilted = tilts && !self.along_ground.contains(&entry.agent);
        self.script.count(&TILTED_POSES, &entry.agent, is_tilted);
        state
    }

    fn level_cloud(&self, entry: &Entry, cloud: PointCloud) -> PointCloud {
        let Some(level) = self.levels.get(&entry.agent) else {
            return cloud;
        };
        self.script.counters.add_named(&level.counter);
        level.attitudes.sweeps.cloud(entry.stamp(), cloud)
    }

    fn send_sweep(&mut self, entry: &Entry, cloud: PointCloud) -> Result<(), LogError> {
        let known = self.sweeps.entry(entry.agent.clone()).or_default();
        // Writers may leave `sequence` at 0, and it wraps at 2³²: stamps rise, so the sweeps are counted on.
        let next = known.values().max().map_or(0, |last| last + 1);
        let seq = entry.seq().max(next);
        let rank = self.agents.iter().position(|agent| *agent == entry.agent).unwrap_or(0);
        let nearest = self.nearest.as_ref();
        let is_too_far = nearest.is_some_and(|nearest| nearest.is_too_far(rank, entry.stamp(), entry.ready()));
        self.script.count(&TOO_FAR, &entry.agent, is_too_far);
        if is_too_far {
            return Ok(());
        }
        known.insert(entry.stamp(), seq);
        while known.len() > 64 {
            known.pop_first();
        }
        let cloud = self.level_cloud(entry, cloud);
        self.send(entry, seq, Kind::Points, [ports::EGO_CLOUDS, ports::CLOUDS], cloud);
        if entry.agent == self.agents[0] {
            let truth: GroundTruth = self.truth.at(entry.stamp())?;
            self.send(entry, seq, Kind::Truth, [ports::TRUTH; 2], truth);
        }
        Ok(())
    }

    fn send_packet(&mut self, entry: &Entry) -> Result<(), LogError> {
        let sent = entry.packet()?;
        let packet = Packet {
            codec: sent.codec,
            bytes: sent.bytes.into(),
        };
        let (port, mut message) = self.message(entry, sent.seq, sent.kind, [ports::PACKETS; 2], packet);
        message.header.frame = sent.frame.into();
        self.queue(entry, port, message);
        Ok(())
    }

    fn take_detections(&mut self, entry: &Entry) -> Result<(), LogError> {
        let boxes = entry.boxes()?;
        if !self.script.log.has(&entry.agent, Stream::DetectionsInfo) {
            self.send_detections(entry, boxes);
        } else if let Some((entry, boxes)) = self.unjoined.insert(entry.agent.clone(), (entry.clone(), boxes)) {
            self.send_detections(&entry, boxes);
        }
        Ok(())
    }

    fn take_info(&mut self, entry: &Entry) -> Result<(), LogError> {
        if let Some((detections, mut boxes)) = self.unjoined.remove(&entry.agent) {
            if detections.stamp() == entry.stamp() {
                entry.info(&mut boxes)?;
            }
            self.send_detections(&detections, boxes);
        }
        Ok(())
    }

    fn send_detections(&mut self, entry: &Entry, mut boxes: Boxes) {
        if let Some(level) = self.levels.get(&entry.agent) {
            level.attitudes.sweeps.boxes(entry.stamp(), &mut boxes.0);
        }
        let seq = self
            .sweeps
            .get(&entry.agent)
            .and_then(|sweeps| sweeps.get(&entry.stamp()))
            .copied();
        let is_lost = seq.is_none() && !self.is_left_out(entry);
        self.script.count(&DETECTIONS_WITHOUT_SWEEP, &entry.agent, is_lost);
        if let Some(seq) = seq {
            self.send(entry, seq, Kind::Boxes, [ports::EGO_RECORDED, ports::RECORDED], boxes);
        }
    }

    /// Whether the sweep of a message is left out.
    fn is_left_out(&self, entry: &Entry) -> bool {
        let nearest = self.nearest.as_ref();
        nearest.is_some_and(|nearest| nearest.is_too_far(self.rank(entry), entry.stamp(), entry.ready()))
    }

    fn send(&mut self, entry: &Entry, seq: u64, kind: Kind, ports: [PortId; 2], payload: impl Into<Payload>) {
        let (port, message) = self.message(entry, seq, kind, ports, payload);
        self.queue(entry, port, message);
    }

    /// A message of this pass, and the port of its agent's lane.
    fn message(
        &self,
        entry: &Entry,
        seq: u64,
        kind: Kind,
        [ego, other]: [PortId; 2],
        payload: impl Into<Payload>,
    ) -> (PortId, Message) {
        let rank = self.rank(entry);
        let shift = Nanos::from(self.pass) * self.period;
        let [poses, sweeps] = self.per_pass[rank];
        let per_pass = if kind == Kind::EgoState { poses } else { sweeps };
        let seq = seq + u64::from(self.pass) * per_pass;
        let (run, agent) = (&self.script.run, &self.agents[rank]);
        let header = Header::origin(
            run,
            agent,
            kind,
            seq,
            entry.stamp() + shift,
            self.release(entry) + shift,
        );
        let port = if rank == 0 { ego } else { other };
        (port, Message::new(header, payload))
    }

    fn queue(&mut self, entry: &Entry, port: PortId, message: Message) {
        let order = ports::ORDER.iter().position(|known| *known == port).unwrap_or(0);
        self.queue.push(Reverse(Queued {
            key: (self.release(entry), order, self.rank(entry), message.header.seq),
            port,
            message,
        }));
    }

    fn rank(&self, entry: &Entry) -> usize {
        self.agents.iter().position(|agent| *agent == entry.agent).unwrap_or(0)
    }

    fn release(&self, entry: &Entry) -> Nanos {
        match self.script.offline {
            true => entry.stamp(),
            false => entry.ready(),
        }
    }
}

/// By how much the number of a sweep, of its detections and of its truth rises from one pass over a log to the next.
pub fn sweeps_per_pass(log: &Log, agent: &str) -> u64 {
    // Of a log that was cut, one of the two topics may reach further.
    let streams = [Stream::Points, Stream::Sweeps];
    streams
        .map(|stream| log.count(agent, stream))
        .into_iter()
        .max()
        .unwrap_or(0)
}
