//! Poses as they are played.

use realo_logs::{Entry, LEVEL, LogError, level_state};
use realo_schemas::geometry::tilt_degrees;
use realo_schemas::{AgentState, Kind, to_seconds};

use super::{Feed, MAX_SPEED_MPS, MIN_JUMP_M};
use crate::Output;
use crate::counters::{POSES_JUMP, POSES_UNUSABLE, TILTED_POSES, WRONG_COVARIANCES};

impl Feed {
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

    pub(super) fn send_pose(&mut self, entry: &Entry) {
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
            let sides = [Output::EgoPoses, Output::Poses];
            self.send(entry, entry.seq(), Kind::AgentState, sides, state);
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
}
