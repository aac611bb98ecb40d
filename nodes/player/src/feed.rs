use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

use nalgebra::Vector3;
use realo_logs::limits::TRUTH_WINDOW;
use realo_logs::{
    Attitudes, BEHIND_MOST, Bare, Entry, Gaps, LEVEL, Lack, Levelled, Log, LogError, LogReader, Missing, Outside, Step,
    Stream, TransformsApart, TruthFault, TruthFinding, WrongHeadings, clock_words, level_state, levelled_while_played,
    nearest_words, no_common_time, side, sweeps_of_one_topic, truth_faults,
};
use realo_operator::{Counter, PortId};
use realo_schemas::geometry::{box_fault, tilt_degrees};
use realo_schemas::{
    AgentState, GroundTruth, Header, Kind, Message, Name, Nanos, Packet, Payload, PointCloud, to_seconds,
};

use crate::counters::{
    CLOCK_AHEAD, CLOCK_OFF, Counters, DETECTION_HEADINGS, DETECTIONS_WITHOUT_INFO, DETECTIONS_WITHOUT_SWEEP,
    INTENSITIES_LIMITED, INVALID_TRUTH, LEVELLED, NO_COMMON_TIME, NO_POSE, POSES_HELD, POSES_JUMP, POSES_UNUSABLE,
    STAMPS_DIFFER, SWEEPS_MISSING, SWEEPS_OF_ONE_TOPIC, SWEEPS_WITHOUT_DETECTIONS, TILTED_POSES, TOO_FAR,
    TRACKS_DIFFER, TRACKS_DOUBLED, TRACKS_SPLIT, TRANSFORMS_DIFFER, TRUTH_DOUBLED, TRUTH_HEADINGS, TRUTH_NOT_JOINED,
    TRUTH_PARTIAL, TRUTH_SHIFTED, TRUTH_WITHOUT_INFO, TRUTH_WITHOUT_SWEEP, UNDECLARED, WRONG_COVARIANCES,
};
use crate::joins::{Joins, PATIENCE, Recorded};
use crate::nearest::Nearest;
use crate::standing::{Held, STEP};
use crate::truth::TruthJoin;
use crate::{PlannedRun, ports};

/// Offline, messages leave in order of stamp, which may lie this much before they were ready.
const LATENCY: Nanos = 500_000_000;
/// Poses from so long before the first sweep are sent too, so that it has some.
const LEAD_IN: Nanos = 500_000_000;
/// Nothing on wheels is faster, m/s.
const MAX_SPEED_MPS: f64 = 150.0;
/// Noise of recorded poses is less, m.
const MIN_JUMP_M: f64 = 5.0;
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
    /// By agent and stamp: number and release of recent sweeps.
    sweeps: BTreeMap<Name, BTreeMap<Nanos, (u64, Nanos)>>,
    /// By agent: stamp and position of its newest pose, m.
    last_positions: BTreeMap<Name, (Nanos, Vector3<f64>)>,
    /// By agent: the stamps of all sweeps of this pass.
    stamps: BTreeMap<Name, BTreeSet<Nanos>>,
    gaps: Gaps,
    joins: Joins,
    /// By rank: units whose pose holds at all times.
    held: BTreeMap<usize, Held>,
    /// By agent: the sweeps for which no detections have come.
    bare: BTreeMap<Name, Bare>,
    /// Agents some of whose sweeps are of another clock.
    off: BTreeSet<Name>,
    /// Whether it was looked how many of the ego's sweeps are of another clock.
    is_ego_checked: bool,
    /// By agent: intensities that did not fit, as they were counted.
    limited: BTreeMap<String, u64>,
    queue: BinaryHeap<Reverse<Queued>>,
    ended: bool,
    released_to: Nanos,
}

/// How an agent's body frames are made level.
struct Levelling {
    attitudes: Attitudes,
    /// How far its body tilts at most by all poses, degrees.
    tilt: f64,
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
                    tilt: *tilt,
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

    /// The units whose pose holds at all times, by rank.
    fn held(&self, agents: &[Name]) -> Result<BTreeMap<usize, Held>, LogError> {
        let mut held = BTreeMap::new();
        for (rank, agent) in agents.iter().take(self.played().count()).enumerate() {
            if let Some(pose) = Held::read(&self.log, agent, self.pose_stream(agent), self.begins())? {
                held.insert(rank, pose);
            }
        }
        Ok(held)
    }

    /// Whether all of the log is played.
    fn is_whole(&self) -> bool {
        let span = self.log.span();
        span.is_none_or(|(first, last)| self.from <= first && self.until > last)
    }

    fn begins(&self) -> Nanos {
        self.from.saturating_sub(LEAD_IN)
    }

    /// Counts the sweeps of collaborators that were all taken before or after those of the ego.
    fn count_times_apart(&self, agents: &[Name]) -> Result<(), LogError> {
        let span = |agent: &str| self.log.times(&self.sweep_stream(agent).topic(agent));
        let Some((ego_first, ego_last)) = span(&agents[0])?.filter(|_| !self.alone) else {
            return Ok(());
        };
        for agent in &agents[1..] {
            let Some((first, last)) = span(agent)? else { continue };
            let apart = no_common_time([ego_first, ego_last], [first, last], "those of the ego");
            let sweeps = self.log.count(agent, self.sweep_stream(agent));
            let lost = if apart.is_some() { sweeps } else { 0 };
            let words = || apart.unwrap_or_default();
            self.counters.lost(&NO_COMMON_TIME, agent, lost, sweeps, words);
        }
        Ok(())
    }

    /// Counts sweeps that are on one of two topics alone.
    fn count_sweeps_of_one_topic(&self) {
        for agent in self.played().filter(|agent| !self.is_precomputed(agent)) {
            if let Some([count, of]) = sweeps_of_one_topic(&self.log, agent) {
                self.counters.add(&SWEEPS_OF_ONE_TOPIC, agent, count, of);
            }
        }
    }

    /// Counts sweeps whose transform from the map is not at the agent's pose.
    fn count_transforms_apart(&self) -> Result<(), LogError> {
        for agent in self.played().filter(|agent| self.wants_points(agent)) {
            if let Some(apart) = TransformsApart::read(&self.log, agent)? {
                self.counters
                    .lost(&TRANSFORMS_DIFFER, agent, apart.count, apart.of, || apart.first);
            }
        }
        Ok(())
    }

    /// Counts truth of the ego before its first sweep or after its last one, beside sweeps that have none.
    fn count_truth_outside(&self, ego: &str) -> Result<(), LogError> {
        for stream in [Stream::GroundTruth, Stream::OwnLabels] {
            if let Some(Outside { count, of, words }) = Outside::read(&self.log, ego, stream)? {
                self.counters.lost(&TRUTH_WITHOUT_SWEEP, ego, count, of, || words);
            }
        }
        Ok(())
    }

    /// Whether most of an agent's sweeps are of another clock than the log.
    fn is_mostly_off(&self, agent: &str) -> Result<bool, LogError> {
        let streams = [Stream::Sweeps, self.sweep_stream(agent)].into_iter();
        let Some(stream) = streams.into_iter().find(|stream| self.log.has(agent, *stream)) else {
            return Ok(false);
        };
        let mut reader = self.log.read(&[(agent, stream)], self.from, self.until)?;
        let (mut off, mut all) = (0, 0);
        while let Some(entry) = reader.next()? {
            all += 1;
            off += u64::from(Step::of(stream, entry.stamp(), entry.ready()) == Step::Off);
        }
        Ok(2 * off > all)
    }

    fn along_ground(&self) -> Result<BTreeSet<Name>, LogError> {
        let levelled = self.log.levelled()?.into_iter();
        let ground = levelled.filter(|(_, levelled)| levelled.by == Levelled::BY_GROUND);
        Ok(ground.map(|(agent, _)| agent.as_str().into()).collect())
    }

    fn truth(&self, agents: &[Name], levels: &BTreeMap<Name, Levelling>) -> Result<TruthJoin, LogError> {
        let level = levels.get(&agents[0]).map(|level| level.attitudes.truth.clone());
        TruthJoin::new(&self.log, agents, self.from, level)
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

    /// Counts the faults of the agents' ground truth.
    fn count_truth_faults(&self) -> Result<(), LogError> {
        let agents = self.agents();
        let plays = |name: &String| agents.iter().any(|agent| **agent == **name);
        if agents.len() < 2 {
            return Ok(());
        }
        // What is around others is not scored.
        let concerns = |found: &&TruthFinding| match found.fault {
            TruthFault::Lacking => found.agents.first().is_some_and(|agent| **agent == *agents[0]),
            _ => true,
        };
        for found in truth_faults(&self.log)?
            .iter()
            .filter(|found| found.agents.iter().all(plays))
            .filter(concerns)
        {
            let counter = match found.fault {
                TruthFault::Apart(_) => &TRACKS_DIFFER,
                TruthFault::Shifted(_) => &TRUTH_SHIFTED,
                TruthFault::Split => &TRACKS_SPLIT,
                TruthFault::Doubled => &TRACKS_DOUBLED,
                TruthFault::Twice => &TRUTH_DOUBLED,
                TruthFault::Lacking => &TRUTH_PARTIAL,
            };
            let (count, of) = (found.count as u64, found.of as u64);
            let agents = match (found.fault, &found.agents[..]) {
                // It is the first agent's truth that lacks them.
                (TruthFault::Lacking, [agent, ..]) => agent.clone(),
                (_, agents) => agents.join(" and "),
            };
            match found.fault {
                TruthFault::Apart(median) | TruthFault::Shifted(median) => {
                    let words = || format!("{median:.1} m in the median");
                    self.counters.lost(counter, &agents, count, of, words);
                }
                _ => self.counters.add(counter, &agents, count, of),
            }
        }
        Ok(())
    }

    /// Counts messages of agents that the log's record does not name.
    fn count_undeclared(&self) {
        for (agent, messages) in self.log.undeclared() {
            self.counters.add(&UNDECLARED, &agent, messages, messages);
        }
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
        let held = script.held(&agents)?;
        let mut per_pass: Vec<[u64; 2]> = agents.iter().map(|agent| script.per_pass(agent)).collect();
        held.keys()
            .for_each(|rank| per_pass[*rank][0] = (period / STEP).unsigned_abs() + 1);
        script.count_truth_faults()?;
        script.count_times_apart(&agents)?;
        script.count_sweeps_of_one_topic();
        script.count_undeclared();
        script.count_transforms_apart()?;
        script.count_truth_outside(&agents[0])?;
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
            last_positions: BTreeMap::new(),
            stamps: BTreeMap::new(),
            gaps: Gaps::default(),
            joins: Joins::default(),
            held,
            bare: BTreeMap::new(),
            off: BTreeSet::new(),
            is_ego_checked: false,
            limited: BTreeMap::new(),
            queue: BinaryHeap::new(),
            ended: false,
            released_to: Nanos::MIN,
            pass: 0,
            per_pass,
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
        self.script.begins()
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
                None => self.end()?,
            }
        }
    }

    fn rewind(&mut self) -> Result<(), LogError> {
        self.pass += 1;
        self.ended = false;
        self.sweeps.clear();
        self.last_positions.clear();
        self.reader = self.script.open()?;
        self.truth = self.script.truth(&self.agents, &self.levels)?;
        let begins = self.begins();
        self.held.values_mut().for_each(|held| held.rewind(begins));
        self.released_to = Nanos::MIN;
        Ok(())
    }

    fn end(&mut self) -> Result<(), LogError> {
        self.expire(Nanos::MAX);
        let lost = self.truth.finish();
        self.count_lost_truth(lost);
        self.count_found_of_truth();
        let has_sweep = |agent: &Name, stamp: Nanos| {
            let stamps = self.stamps.get(agent);
            let near = stamp.saturating_sub(TRUTH_WINDOW)..=stamp.saturating_add(TRUTH_WINDOW);
            stamps.is_some_and(|stamps| stamps.range(near).next().is_some())
        };
        for (agent, [sweeps, of]) in self.truth.unjoined(self.script.is_whole(), has_sweep) {
            self.script.counters.add(&TRUTH_NOT_JOINED, &agent, sweeps, of);
        }
        self.stamps.clear();
        for (agent, Missing { sweeps, place }) in self.gaps.end(Some(&self.agents[0])) {
            self.script
                .counters
                .lost(&SWEEPS_MISSING, &agent, sweeps, sweeps, || place);
        }
        self.count_bare();
        for (agent, n) in self.script.log.limited_intensities() {
            let counted = self.limited.insert(agent.clone(), n).unwrap_or(0);
            self.script
                .counters
                .add(&INTENSITIES_LIMITED, &agent, n.saturating_sub(counted), 0);
        }
        self.ended = true;
        self.released_to = Nanos::MAX;
        Ok(())
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
        let late = entry.ready().saturating_sub(entry.stamp());
        self.hold(entry.ready());
        self.expire(entry.ready());
        let reach = if self.script.offline { LATENCY + PATIENCE } else { 0 };
        self.released_to = self.released_to.max(entry.ready().saturating_sub(reach));
        if self.is_off(entry)? {
            return Ok(());
        }
        let apart = entry.published_apart();
        let differ = u64::from(apart.is_some());
        self.script
            .counters
            .lost(&STAMPS_DIFFER, &entry.agent, differ, 1, || apart_words(entry, apart));
        // Detections of another clock match no sweep, which is counted.
        let is_strange = late > BEHIND_MOST && self.sweep_of(entry).is_none();
        if self.script.offline && late > LATENCY && !is_strange {
            let (late, most) = (to_seconds(late), to_seconds(LATENCY));
            let reason =
                format!("it was ready {late:.3} s after its stamp; played offline at most {most} s are expected");
            return Err(content(entry, reason));
        }
        let playing = entry.ready() >= self.script.from;
        match entry.stream {
            Stream::Pose | Stream::PoseTruth => self.send_pose(entry),
            _ if !playing => {}
            Stream::Points => {
                let cloud = self.cloud(entry)?;
                self.send_sweep(entry, cloud)?;
            }
            Stream::Sweeps => self.send_sweep(entry, Some(PointCloud::empty()))?,
            Stream::Detections => self.take_detections(entry)?,
            Stream::DetectionsInfo => self.take_info(entry)?,
            Stream::Packets => self.send_packet(entry)?,
            _ => {}
        }
        Ok(())
    }

    /// The points of a sweep; `None` where no transform brings them to the body frame, which is counted.
    fn cloud(&self, entry: &Entry) -> Result<Option<PointCloud>, LogError> {
        if !self.script.wants_points(&entry.agent) {
            return Ok(Some(PointCloud::empty()));
        }
        let counters = &self.script.counters;
        match entry.cloud() {
            Ok(cloud) => {
                counters.add(&NO_POSE, &entry.agent, 0, 1);
                Ok(Some(cloud))
            }
            Err(LogError::Unplaced { reason, .. }) => {
                counters.lost(&NO_POSE, &entry.agent, 1, 1, || reason);
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    /// Whether a message is of another clock than the log. An ego of whom most sweeps are is an error.
    fn is_off(&mut self, entry: &Entry) -> Result<bool, LogError> {
        let is_pose = matches!(entry.stream, Stream::Pose | Stream::PoseTruth);
        let is_sweep = matches!(entry.stream, Stream::Points | Stream::Sweeps);
        if is_pose && self.held.contains_key(&self.rank(entry)) {
            return Ok(false);
        }
        let step = Step::of(entry.stream, entry.stamp(), entry.ready());
        let words = || clock_words(entry.stamp(), entry.ready());
        if is_sweep && step == Step::Off {
            let is_unchecked = self.rank(entry) == 0 && !std::mem::replace(&mut self.is_ego_checked, true);
            if is_unchecked && self.script.is_mostly_off(&entry.agent)? {
                let reason = format!(
                    "the clock of `{}`, the ego, is off: {}; {}",
                    entry.agent,
                    words(),
                    CLOCK_OFF.remedy
                );
                return Err(content(entry, reason));
            }
            self.off.insert(entry.agent.clone());
        }
        let [off, ahead] = [Step::Off, Step::Ahead].map(|wrong| step == wrong);
        let counters = &self.script.counters;
        counters.judged(&entry.agent, [(&CLOCK_OFF, off), (&CLOCK_AHEAD, ahead)], words);
        Ok(off)
    }

    /// Sends the poses of units that stand still until a time.
    fn hold(&mut self, until: Nanos) {
        let mut held = std::mem::take(&mut self.held);
        for (rank, held) in &mut held {
            while let Some((seq, time, state)) = held.due(until) {
                let agent = self.agents[*rank].clone();
                let state = match self.levels.contains_key(&agent) {
                    true => level_state(state),
                    false => state,
                };
                let ports = [ports::EGO_POSES, ports::POSES];
                let (port, message) = self.message((*rank, [time; 2]), seq, Kind::AgentState, ports, state);
                self.queue((*rank, time), port, message);
                self.script.counters.add(&POSES_HELD, &agent, 1, 0);
            }
        }
        self.held = held;
    }

    /// Counts a pose further from the one before than anything drives.
    fn count_jump(&mut self, entry: &Entry, state: &AgentState) {
        let (stamp, place) = (entry.stamp(), state.map_from_body.translation.vector);
        let before = self.last_positions.insert(entry.agent.clone(), (stamp, place));
        let jump = before.and_then(|(from, known)| {
            let (far, seconds) = ((place - known).norm(), to_seconds(stamp - from));
            (far > MIN_JUMP_M && far > MAX_SPEED_MPS * seconds).then_some((far, seconds))
        });
        let count = u64::from(jump.is_some());
        self.script.counters.lost(&POSES_JUMP, &entry.agent, count, 1, || {
            jump.map(|(far, seconds)| format!("the first by {far:.1} m in {:.0} ms", 1e3 * seconds))
                .unwrap_or_default()
        });
    }

    fn send_pose(&mut self, entry: &Entry) {
        let fault = entry.wrong_covariance();
        let wrong = u64::from(fault.is_some());
        self.script
            .counters
            .lost(&WRONG_COVARIANCES, &entry.agent, wrong, 1, || {
                format!("the first has {}", fault.unwrap_or_default())
            });
        if self.held.contains_key(&self.rank(entry)) {
            return;
        }
        let pose = entry.pose();
        self.gaps.pose(&entry.agent, entry.stamp());
        let lost = u64::from(pose.is_err());
        self.script.counters.lost(&POSES_UNUSABLE, &entry.agent, lost, 1, || {
            pose.as_ref().err().map(LogError::reason).unwrap_or_default()
        });
        if let Ok(state) = pose {
            self.count_jump(entry, &state);
            let state = self.level_pose(entry, state);
            let ports = [ports::EGO_POSES, ports::POSES];
            self.send(entry, entry.seq(), Kind::AgentState, ports, state);
        }
    }

    fn level_pose(&self, entry: &Entry, state: AgentState) -> AgentState {
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
        let found = || format!("its body tilts by up to {:.2}°", level.tilt);
        self.script.counters.lost(&LEVELLED, &entry.agent, 1, 1, found);
        level.attitudes.sweeps.cloud(entry.stamp(), cloud)
    }

    /// Sends a sweep and its truth; without `cloud` the truth alone.
    fn send_sweep(&mut self, entry: &Entry, cloud: Option<PointCloud>) -> Result<(), LogError> {
        self.gaps.sweep(&entry.agent, entry.stamp());
        self.stamps
            .entry(entry.agent.clone())
            .or_default()
            .insert(entry.stamp());
        self.script.counters.add(&SWEEPS_MISSING, &entry.agent, 0, 1);
        let known = self.sweeps.entry(entry.agent.clone()).or_default();
        // Writers may leave `sequence` at 0, and it wraps at 2³²: stamps rise, so the sweeps are counted on.
        let next = known.values().map(|(seq, _)| *seq).max().map_or(0, |last| last + 1);
        let seq = entry.seq().max(next);
        let rank = self.agents.iter().position(|agent| *agent == entry.agent).unwrap_or(0);
        let nearest = self.nearest.as_ref();
        let is_too_far = nearest.is_some_and(|nearest| nearest.is_too_far(rank, entry.stamp(), entry.ready()));
        self.script.count(&TOO_FAR, &entry.agent, is_too_far);
        if is_too_far {
            return Ok(());
        }
        let release = match self.script.offline {
            true => entry.stamp(),
            false => entry.ready(),
        };
        known.insert(entry.stamp(), (seq, release));
        if self.script.detections && self.script.log.has(&entry.agent, Stream::Detections) {
            let bare = self.bare.entry(entry.agent.clone()).or_default();
            bare.sweep(entry.stamp(), entry.ready());
        }
        while known.len() > 64 {
            known.pop_first();
        }
        if let Some(cloud) = cloud {
            let cloud = self.level_cloud(entry, cloud);
            self.send(entry, seq, Kind::Points, [ports::EGO_CLOUDS, ports::CLOUDS], cloud);
        }
        if entry.agent == self.agents[0] {
            let (truth, lost): (GroundTruth, _) = self.truth.at(entry.stamp())?;
            self.count_invalid(&entry.agent, &truth);
            self.send(entry, seq, Kind::Truth, [ports::TRUTH; 2], truth);
            self.count_lost_truth(lost);
            self.count_found_of_truth();
        }
        if let Some(recorded) = self.joins.of_sweep(entry) {
            self.send_detections(recorded);
        }
        Ok(())
    }

    /// Counts what was found of the truth that was read since the last call.
    fn count_found_of_truth(&mut self) {
        let counters = &self.script.counters;
        for (agent, (n, words)) in self.truth.take_apart() {
            counters.lost(&STAMPS_DIFFER, &agent, n, n, || words);
        }
        for (agent, (n, words)) in self.truth.take_ahead() {
            counters.lost(&CLOCK_AHEAD, &agent, n, n, || words);
        }
        for (agent, n) in self.truth.take_unpaired() {
            counters.add(&TRUTH_WITHOUT_INFO, &agent, n, 0);
        }
        for (agent, (wrong, all)) in self.truth.take_wrong_headings() {
            let words = || format!("the first has {}", wrong.first);
            counters.lost(&TRUTH_HEADINGS, &agent, wrong.count, all, words);
        }
    }

    /// Counts objects of the truth that no object can be.
    fn count_invalid(&self, ego: &Name, truth: &GroundTruth) {
        let objects = || truth.boxes.iter().chain(truth.own.iter().flat_map(|own| &own.boxes));
        let faults: Vec<String> = objects().filter_map(box_fault).collect();
        let (lost, all) = (faults.len() as u64, objects().count() as u64);
        self.script.counters.lost(&INVALID_TRUTH, ego, lost, all, || {
            format!("the first has {}", faults[0])
        });
    }

    fn send_packet(&mut self, entry: &Entry) -> Result<(), LogError> {
        let sent = entry.packet()?;
        let packet = Packet {
            codec: sent.codec,
            bytes: sent.bytes.into(),
        };
        let times = [entry.stamp(), self.release(entry)];
        let from = (self.rank(entry), times);
        let (port, mut message) = self.message(from, sent.seq, sent.kind, [ports::PACKETS; 2], packet);
        message.header.frame = sent.frame.into();
        self.queue((from.0, times[1]), port, message);
        Ok(())
    }

    fn take_detections(&mut self, entry: &Entry) -> Result<(), LogError> {
        let boxes = entry.boxes()?;
        let whole = match self.script.log.has(&entry.agent, Stream::DetectionsInfo) {
            true => self.joins.array(entry, boxes)?,
            false => Some(Recorded {
                entry: entry.clone(),
                boxes,
                known: entry.ready(),
                wrong_headings: WrongHeadings::default(),
            }),
        };
        self.take_recorded(whole, false);
        Ok(())
    }

    fn take_info(&mut self, entry: &Entry) -> Result<(), LogError> {
        let whole = self.joins.companion(entry)?;
        self.take_recorded(whole, false);
        Ok(())
    }

    /// Detections without their companion, where that did not come, go on to their sweep.
    fn take_recorded(&mut self, recorded: Option<Recorded>, lacks_info: bool) {
        let Some(recorded) = recorded else { return };
        self.script
            .count(&DETECTIONS_WITHOUT_INFO, &recorded.entry.agent, lacks_info);
        let (wrong, all) = (&recorded.wrong_headings, recorded.boxes.0.len() as u64);
        let counters = &self.script.counters;
        counters.lost(&DETECTION_HEADINGS, &recorded.entry.agent, wrong.count, all, || {
            format!("the first has {}", wrong.first)
        });
        match self.sweep_of(&recorded.entry) {
            Some(_) => self.send_detections(recorded),
            None => self.joins.wait(recorded),
        }
    }

    /// Gives up on what waited too long.
    fn expire(&mut self, now: Nanos) {
        for recorded in self.joins.alone(now) {
            self.take_recorded(Some(recorded), true);
        }
        for recorded in self.joins.lost(now) {
            self.send_detections(recorded);
        }
    }

    fn sweep_of(&self, entry: &Entry) -> Option<(u64, Nanos)> {
        self.sweeps.get(&entry.agent)?.get(&entry.stamp()).copied()
    }

    /// Sends detections with the number of their sweep, or counts that there is none.
    fn send_detections(&mut self, recorded: Recorded) {
        let Recorded {
            entry,
            mut boxes,
            known,
            ..
        } = recorded;
        let sweep = self.sweep_of(&entry);
        // Of an agent whose sweeps are of another clock that is said already.
        let is_lost = sweep.is_none() && !self.is_left_out(&entry) && !self.off.contains(&entry.agent);
        self.script
            .counters
            .lost(&DETECTIONS_WITHOUT_SWEEP, &entry.agent, u64::from(is_lost), 1, || {
                self.nearest_sweep(&entry)
            });
        let Some((seq, sweep)) = sweep else { return };
        if let Some(bare) = self.bare.get_mut(&entry.agent) {
            bare.detections(entry.stamp(), entry.ready());
        }
        if let Some(level) = self.levels.get(&entry.agent) {
            level.attitudes.sweeps.boxes(entry.stamp(), &mut boxes.0);
        }
        // They do not go before their sweep, nor before they are complete.
        let release = match self.script.offline {
            true => entry.stamp(),
            false => known.min(self.released_to).max(entry.ready()),
        };
        let release = release.max(sweep);
        let from = (self.rank(&entry), [entry.stamp(), release]);
        let ports = [ports::EGO_RECORDED, ports::RECORDED];
        let (port, message) = self.message(from, seq, Kind::Boxes, ports, boxes);
        self.queue((from.0, release), port, message);
    }

    /// Counts sweeps without detections. Those of the last moments may have come after the log ended.
    fn count_bare(&mut self) {
        let until = self.script.until.saturating_sub(1);
        let end = self.script.log.span().map_or(until, |(_, last)| last.min(until));
        for (agent, bare) in std::mem::take(&mut self.bare) {
            let counters = &self.script.counters;
            // Where their stamps are wrong that is said already.
            let said = [&DETECTIONS_WITHOUT_SWEEP, &CLOCK_OFF].map(|counter| counters.of(counter, &agent));
            if let Some(Lack { count, of, place }) = bare.end(end, said.into_iter().sum()) {
                counters.lost(&SWEEPS_WITHOUT_DETECTIONS, &agent, count, of, || place);
            }
        }
    }

    /// How far a message lies from the nearest sweep of its agent, in words.
    fn nearest_sweep(&self, entry: &Entry) -> String {
        let stamps = self.sweeps.get(&entry.agent).into_iter().flat_map(BTreeMap::keys);
        nearest_words(
            stamps
                .map(|stamp| stamp.saturating_sub(entry.stamp()).saturating_abs())
                .min(),
        )
    }

    /// Counts truth that was joined to no sweep, by how far the nearest sweep without any lies.
    fn count_lost_truth(&self, lost: Vec<Nanos>) {
        let ego = &self.agents[0];
        for far in lost {
            let words = || nearest_words(Some(far));
            self.script.counters.lost(&TRUTH_WITHOUT_SWEEP, ego, 1, 0, words);
        }
    }

    /// Whether the sweep of a message is left out.
    fn is_left_out(&self, entry: &Entry) -> bool {
        let nearest = self.nearest.as_ref();
        nearest.is_some_and(|nearest| nearest.is_too_far(self.rank(entry), entry.stamp(), entry.ready()))
    }

    fn send(&mut self, entry: &Entry, seq: u64, kind: Kind, ports: [PortId; 2], payload: impl Into<Payload>) {
        let release = self.release(entry);
        let from = (self.rank(entry), [entry.stamp(), release]);
        let (port, message) = self.message(from, seq, kind, ports, payload);
        self.queue((from.0, release), port, message);
    }

    /// A message of this pass, by the rank of its agent, stamp and release, and the port of its agent's lane.
    fn message(
        &self,
        (rank, [stamp, release]): (usize, [Nanos; 2]),
        seq: u64,
        kind: Kind,
        [ego, other]: [PortId; 2],
        payload: impl Into<Payload>,
    ) -> (PortId, Message) {
        let shift = Nanos::from(self.pass) * self.period;
        let [poses, sweeps] = self.per_pass[rank];
        let per_pass = if kind == Kind::AgentState { poses } else { sweeps };
        let seq = seq + u64::from(self.pass) * per_pass;
        let (run, agent) = (&self.script.run, &self.agents[rank]);
        let header = Header::origin(run, agent, kind, seq, stamp + shift, release + shift);
        let port = if rank == 0 { ego } else { other };
        (port, Message::new(header, payload))
    }

    fn queue(&mut self, (rank, release): (usize, Nanos), port: PortId, message: Message) {
        let order = ports::ORDER.iter().position(|known| *known == port).unwrap_or(0);
        self.queue.push(Reverse(Queued {
            key: (release, order, rank, message.header.seq),
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

fn content(entry: &Entry, reason: String) -> LogError {
    LogError::Content {
        topic: entry.stream.topic(&entry.agent),
        log_time: entry.ready(),
        reason,
    }
}

/// Topic and times of a message whose publish time is not its stamp.
pub(crate) fn apart_words(entry: &Entry, apart: Option<Nanos>) -> String {
    let apart = apart.unwrap_or(0);
    let (topic, far) = (entry.stream.topic(&entry.agent), apart.abs() as f64 / 1e6);
    format!("the first on {topic} is {far:.1} ms {} the header's", side(apart))
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
