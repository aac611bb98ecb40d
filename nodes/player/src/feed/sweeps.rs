//! Sweeps as they are played.

use realo_logs::{Entry, LogError, Step, Stream, clock_words, level_state};
use realo_schemas::{GroundTruth, Kind, Nanos, PointCloud};

use super::{Feed, content};
use crate::Output;
use crate::counters::{CLOCK_AHEAD, CLOCK_OFF, LEVELLED, NO_POSE, POSES_HELD, SWEEPS_MISSING, TOO_FAR};

impl Feed {
    /// The points of a sweep; `None` where no transform brings them to the body frame, which is counted.
    pub(super) fn cloud(&self, entry: &Entry) -> Result<Option<PointCloud>, LogError> {
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
    pub(super) fn is_off(&mut self, entry: &Entry) -> Result<bool, LogError> {
        let is_pose = matches!(entry.stream, Stream::Pose | Stream::PoseTruth);
        let is_sweep = matches!(entry.stream, Stream::Points | Stream::Sweeps);
        if self.script.trusts_stamps || is_pose && self.held.contains_key(&self.rank(entry)) {
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
    pub(super) fn hold(&mut self, until: Nanos) {
        let mut held = std::mem::take(&mut self.held);
        for (rank, held) in &mut held {
            while let Some((seq, time, state)) = held.due(until) {
                let agent = self.agents[*rank].clone();
                let state = match self.levels.contains_key(&agent) {
                    true => level_state(state),
                    false => state,
                };
                let sides = [Output::EgoPoses, Output::Poses];
                let output = self.output((*rank, [time; 2]), seq, Kind::AgentState, sides, state);
                self.queue((*rank, time), output);
                self.script.counters.add(&POSES_HELD, &agent, 1, 0);
            }
        }
        self.held = held;
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
    pub(super) fn send_sweep(&mut self, entry: &Entry, cloud: Option<PointCloud>) -> Result<(), LogError> {
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
        self.send_motion(rank, [entry.stamp(), release]);
        let known = self.sweeps.entry(entry.agent.clone()).or_default();
        if self.script.detections && self.script.log.has(&entry.agent, Stream::Detections) {
            let bare = self.bare.entry(entry.agent.clone()).or_default();
            bare.sweep(entry.stamp(), entry.ready());
        }
        while known.len() > 64 {
            known.pop_first();
        }
        if let Some(cloud) = cloud {
            let cloud = self.level_cloud(entry, cloud);
            self.send(entry, seq, Kind::Points, [Output::EgoClouds, Output::Clouds], cloud);
        }
        if entry.agent == self.agents[0] {
            let (truth, lost): (GroundTruth, _) = self.truth.at(entry.stamp())?;
            self.count_invalid(&entry.agent, &truth);
            self.send(entry, seq, Kind::Truth, [Output::Truth; 2], truth);
            self.count_lost_truth(lost);
            self.count_found_of_truth();
        }
        if let Some(recorded) = self.joins.of_sweep(entry) {
            self.send_detections(recorded);
        }
        Ok(())
    }
}
