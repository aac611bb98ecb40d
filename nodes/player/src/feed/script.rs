//! What is to be played of a log.

use std::collections::{BTreeMap, BTreeSet};

use realo_logs::{
    Attitudes, Levelled, Log, LogError, LogReader, Outside, Step, Stream, TransformsApart, TruthFault, TruthFinding,
    levelled_while_played, no_common_time, sweeps_of_one_topic, truth_faults,
};
use realo_operator::Counter;
use realo_schemas::{Name, Nanos};

use super::{LEAD_IN, sweeps_per_pass};
use crate::PlannedRun;
use crate::counters::{
    Counters, NO_COMMON_TIME, SWEEPS_OF_ONE_TOPIC, TRACKS_DIFFER, TRACKS_DOUBLED, TRACKS_SPLIT, TRANSFORMS_DIFFER,
    TRUTH_DOUBLED, TRUTH_PARTIAL, TRUTH_SHIFTED, TRUTH_WITHOUT_SWEEP, UNDECLARED,
};
use crate::nearest::Nearest;
use crate::standing::Held;
use crate::truth::TruthJoin;

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
    /// Whether what motion sensors measured is played.
    pub motion: bool,
    /// Whether stamps of another clock are played as they are.
    pub trusts_stamps: bool,
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

/// How an agent's body frames are made level.
pub(super) struct Levelling {
    pub attitudes: Attitudes,
    /// How far its body tilts at most by all poses, degrees.
    pub tilt: f64,
}

impl Script {
    pub(super) fn agents(&self) -> Vec<Name> {
        self.cast.agents().map(Name::from).collect()
    }

    fn pose_stream(&self, agent: &str) -> Stream {
        let truth = self.true_poses || (self.offline && self.log.has(agent, Stream::PoseTruth));
        if truth { Stream::PoseTruth } else { Stream::Pose }
    }

    pub(super) fn per_pass(&self, agent: &str) -> [u64; 3] {
        let poses = self.log.count(agent, self.pose_stream(agent));
        // A message has one measurement at least.
        let motion = self
            .motion_streams(agent)
            .map(|stream| self.log.count(agent, stream))
            .sum();
        [poses, sweeps_per_pass(&self.log, agent), motion]
    }

    /// The motion sensors of an agent that are played.
    fn motion_streams(&self, agent: &str) -> impl Iterator<Item = Stream> {
        let streams = [Stream::Imu, Stream::Fix, Stream::Wheels].into_iter();
        streams.filter(move |stream| self.motion && self.log.has(agent, *stream))
    }

    fn is_precomputed(&self, agent: &str) -> bool {
        self.precomputed && agent != self.cast.ego
    }

    pub(super) fn wants_points(&self, agent: &str) -> bool {
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
    pub(super) fn played(&self) -> impl Iterator<Item = &str> {
        self.cast.agents().take(if self.alone { 1 } else { usize::MAX })
    }

    /// What makes the frames of those level that tilt.
    pub(super) fn levels(&self) -> Result<BTreeMap<Name, Levelling>, LogError> {
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

    pub(super) fn nearest(&self, agents: &[Name]) -> Result<Option<Nearest>, LogError> {
        match self.fused_at_most {
            Some(limit) if limit + 1 < agents.len() && !self.alone => {
                Nearest::read(&self.log, agents, limit, self.offline, |agent| self.pose_stream(agent))
            }
            _ => Ok(None),
        }
    }

    /// The units whose pose holds at all times, by rank.
    pub(super) fn held(&self, agents: &[Name]) -> Result<BTreeMap<usize, Held>, LogError> {
        let mut held = BTreeMap::new();
        for (rank, agent) in agents.iter().take(self.played().count()).enumerate() {
            if let Some(pose) = Held::read(&self.log, agent, self.pose_stream(agent), self.begins())? {
                held.insert(rank, pose);
            }
        }
        Ok(held)
    }

    /// Whether all of the log is played.
    pub(super) fn is_whole(&self) -> bool {
        let span = self.log.span();
        span.is_none_or(|(first, last)| self.from <= first && self.until > last)
    }

    pub(super) fn begins(&self) -> Nanos {
        self.from.saturating_sub(LEAD_IN)
    }

    /// Counts the sweeps of collaborators that were all taken before or after those of the ego.
    pub(super) fn count_times_apart(&self, agents: &[Name]) -> Result<(), LogError> {
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
    pub(super) fn count_sweeps_of_one_topic(&self) {
        for agent in self.played().filter(|agent| !self.is_precomputed(agent)) {
            if let Some([count, of]) = sweeps_of_one_topic(&self.log, agent) {
                self.counters.add(&SWEEPS_OF_ONE_TOPIC, agent, count, of);
            }
        }
    }

    /// Counts sweeps whose transform from the map is not at the agent's pose.
    pub(super) fn count_transforms_apart(&self) -> Result<(), LogError> {
        for agent in self.played().filter(|agent| self.wants_points(agent)) {
            if let Some(apart) = TransformsApart::read(&self.log, agent)? {
                self.counters
                    .lost(&TRANSFORMS_DIFFER, agent, apart.count, apart.of, || apart.first);
            }
        }
        Ok(())
    }

    /// Counts truth of the ego before its first sweep or after its last one, beside sweeps that have none.
    pub(super) fn count_truth_outside(&self, ego: &str) -> Result<(), LogError> {
        for stream in [Stream::GroundTruth, Stream::OwnLabels] {
            if let Some(Outside { count, of, words }) = Outside::read(&self.log, ego, stream)? {
                self.counters.lost(&TRUTH_WITHOUT_SWEEP, ego, count, of, || words);
            }
        }
        Ok(())
    }

    /// Whether most of an agent's sweeps are of another clock than the log.
    pub(super) fn is_mostly_off(&self, agent: &str) -> Result<bool, LogError> {
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

    pub(super) fn along_ground(&self) -> Result<BTreeSet<Name>, LogError> {
        let levelled = self.log.levelled()?.into_iter();
        let ground = levelled.filter(|(_, levelled)| levelled.by == Levelled::BY_GROUND);
        Ok(ground.map(|(agent, _)| agent.as_str().into()).collect())
    }

    pub(super) fn truth(&self, agents: &[Name], levels: &BTreeMap<Name, Levelling>) -> Result<TruthJoin, LogError> {
        let level = levels.get(&agents[0]).map(|level| level.attitudes.truth.clone());
        TruthJoin::new(&self.log, agents, self.from, level)
    }

    pub(super) fn open(&self) -> Result<LogReader, LogError> {
        let mut wanted = Vec::new();
        for agent in self.played() {
            wanted.push((agent, self.pose_stream(agent)));
            wanted.push((agent, self.sweep_stream(agent)));
            wanted.extend(self.motion_streams(agent).map(|stream| (agent, stream)));
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
    pub(super) fn count_truth_faults(&self) -> Result<(), LogError> {
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
    pub(super) fn count_undeclared(&self) {
        for (agent, messages) in self.log.undeclared() {
            self.counters.add(&UNDECLARED, &agent, messages, messages);
        }
    }

    /// Counts one of an agent, if something is wrong with it.
    pub(super) fn count(&self, counter: &'static Counter, agent: &str, is_wrong: bool) {
        self.counters.add(counter, agent, u64::from(is_wrong), 1);
    }
}
