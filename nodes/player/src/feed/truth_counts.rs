//! What of the truth could not be played.

use std::collections::BTreeMap;

use realo_logs::{Entry, Lack, nearest_words};
use realo_schemas::geometry::box_fault;
use realo_schemas::{GroundTruth, Name, Nanos};

use super::Feed;
use crate::counters::{
    CLOCK_AHEAD, CLOCK_OFF, DETECTIONS_WITHOUT_SWEEP, INVALID_TRUTH, STAMPS_DIFFER, SWEEPS_WITHOUT_DETECTIONS,
    TRUTH_HEADINGS, TRUTH_WITHOUT_INFO, TRUTH_WITHOUT_SWEEP,
};

impl Feed {
    /// Counts what was found of the truth that was read since the last call.
    pub(super) fn count_found_of_truth(&mut self) {
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
    pub(super) fn count_invalid(&self, ego: &Name, truth: &GroundTruth) {
        let objects = || truth.boxes.iter().chain(truth.own.iter().flat_map(|own| &own.boxes));
        let faults: Vec<String> = objects().filter_map(box_fault).collect();
        let (lost, all) = (faults.len() as u64, objects().count() as u64);
        self.script.counters.lost(&INVALID_TRUTH, ego, lost, all, || {
            format!("the first has {}", faults[0])
        });
    }

    /// Counts sweeps without detections. Those of the last moments may have come after the log ended.
    pub(super) fn count_bare(&mut self) {
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
    pub(super) fn nearest_sweep(&self, entry: &Entry) -> String {
        let stamps = self.sweeps.get(&entry.agent).into_iter().flat_map(BTreeMap::keys);
        nearest_words(
            stamps
                .map(|stamp| stamp.saturating_sub(entry.stamp()).saturating_abs())
                .min(),
        )
    }

    /// Counts truth that was joined to no sweep, by how far the nearest sweep without any lies.
    pub(super) fn count_lost_truth(&self, lost: Vec<Nanos>) {
        let ego = &self.agents[0];
        for far in lost {
            let words = || nearest_words(Some(far));
            self.script.counters.lost(&TRUTH_WITHOUT_SWEEP, ego, 1, 0, words);
        }
    }
}
