//! What the recording of one run over one log and ego holds.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use realo_logs::{MAX_GAP, McapFile, RECORDING_RECORD};
use realo_recorder::{FATES, boxes_of, footprints_of, reports_of, states_of, truth_of};
use realo_schemas::geometry::PoseTrack;
use realo_schemas::report::{Entry, Fate, Fated};
use realo_schemas::{Boxes, GroundTruth, Header, Kind, Name, Nanos};
use serde::Deserialize;

use crate::PageError;

/// What was recorded of a sweep of the ego.
#[derive(Debug, Default)]
pub struct Sweep {
    pub truth: Option<(Header, GroundTruth)>,
    pub boxes: Option<(Header, Boxes)>,
}

/// A recording, thinned to a number of sweeps.
pub struct Recorded {
    /// By number.
    pub sweeps: BTreeMap<u64, Sweep>,
    /// Of how many sweeps in a row one is kept.
    pub stride: u64,
    /// How many there are with those that are not kept.
    pub total: usize,
    /// What was said of each message that crossed a link.
    pub fates: Vec<Fated>,
    /// What was said of further messages, in number.
    pub fates_cut: usize,
    /// What was said already: stages of several processes may report the same.
    said: BTreeSet<Said>,
    /// How messages for fusion entered their channels, where that is known: sender and bytes, by the second of their time.
    pub carried: BTreeMap<(String, i64), Carried>,
    /// Reports of messages that are of an unknown form.
    pub unreadable: usize,
    /// Where each agent was in the map, as the graph knew it.
    pub poses: BTreeMap<Name, PoseTrack>,
    /// Name and version of the program that ran, where the recording says.
    pub program: Option<String>,
    /// Outlines of agents in their body frames, x min, x max, y min, y max, m.
    pub footprints: BTreeMap<Name, [f64; 4]>,
}

/// What entered a channel in a second.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Carried {
    pub messages: u64,
    pub bytes: u64,
}

/// What a report says of a message: its sender, kind and number; what became of it, for which sweep, and when it entered.
type Said = (Name, Kind, u64, Fate, Option<u64>, Option<Nanos>);

/// Stands in what is said of a recording of which not all sweeps are on the page.
pub const FEWER_SWEEPS: &str = "sweeps, one of";

/// Seconds of senders that are kept: more than a log has.
const MOST_SECONDS: usize = 100_000;

/// Reports of messages that are kept; later ones are not on the page.
const MOST_FATES: usize = 200_000;

/// Reports of messages, with those of how they entered their channels, that are told from what was said before.
const MOST_SAID: usize = 1_000_000;

impl Recorded {
    /// One that holds nothing yet.
    pub fn empty() -> Self {
        Recorded {
            sweeps: BTreeMap::new(),
            stride: 1,
            total: 0,
            fates: Vec::new(),
            fates_cut: 0,
            said: BTreeSet::new(),
            carried: BTreeMap::new(),
            unreadable: 0,
            poses: BTreeMap::new(),
            program: None,
            footprints: BTreeMap::new(),
        }
    }

    /// Reads a recording and keeps so many sweeps at most: all, or every 2nd, 4th, 8th …
    pub fn read(recording: &Path, ego: &str, most: usize) -> Result<Self, PageError> {
        let mut recorded = Recorded::empty();
        let mut numbers = BTreeSet::new();
        for message in truth_of(recording)? {
            let part = message?.into_parts::<GroundTruth>()?;
            numbers.insert(part.0.seq);
            if let Some(sweep) = recorded.kept(part.0.seq, most) {
                sweep.truth = Some(part);
            }
        }
        for message in boxes_of(recording)? {
            let part = message?.into_parts::<Boxes>()?;
            numbers.insert(part.0.seq);
            if let Some(sweep) = recorded.kept(part.0.seq, most) {
                sweep.boxes = Some(part);
            }
        }
        recorded.total = numbers.len();
        recorded.read_fates(recording, ego)?;
        recorded.read_poses(recording)?;
        recorded.footprints = footprints_of(recording)?;
        let file = McapFile::open(recording)?;
        let record = file.metadata().get(RECORDING_RECORD);
        recorded.program = record.and_then(|record| record.get("program").cloned());
        Ok(recorded)
    }

    /// Takes the ego's outline, which truth leaves out in a recording: boxes in it are the ego itself, and not false.
    pub fn take_footprint(&mut self, footprint: Option<[f64; 4]>) {
        let truths = self.sweeps.values_mut().filter_map(|sweep| sweep.truth.as_mut());
        truths.for_each(|(_, truth)| truth.ego_footprint = footprint);
    }

    fn kept(&mut self, seq: u64, most: usize) -> Option<&mut Sweep> {
        if !seq.is_multiple_of(self.stride) {
            return None;
        }
        self.sweeps.entry(seq).or_default();
        while self.sweeps.len() > most.max(1) {
            self.stride *= 2;
            let stride = self.stride;
            self.sweeps.retain(|seq, _| seq.is_multiple_of(stride));
        }
        self.sweeps.get_mut(&seq)
    }

    fn read_fates(&mut self, recording: &Path, ego: &str) -> Result<(), PageError> {
        for report in reports_of(recording)? {
            let report = report?;
            if report["topic"] != FATES {
                continue;
            }
            let Ok(fates) = Vec::<Fated>::deserialize(&report["report"]) else {
                self.unreadable += 1;
                continue;
            };
            fates
                .into_iter()
                .filter(|fated| fated.message.to == ego)
                .for_each(|fated| self.hear(fated));
        }
        self.said = BTreeSet::new();
        Ok(())
    }

    /// Takes what was said of a message, once.
    fn hear(&mut self, fated: Fated) {
        let message = &fated.message;
        let said = (
            message.from.as_str().into(),
            message.kind,
            message.seq,
            fated.fate,
            fated.r#use.map(|used| used.query),
            fated.entry.map(|entry| entry.at_ns),
        );
        if self.said.contains(&said) {
            return;
        }
        if self.said.len() >= MOST_SAID {
            self.fates_cut += 1;
            return;
        }
        self.said.insert(said);
        match fated.entry {
            Some(entry) => self.carry(&fated, &entry),
            None if self.fates.len() < MOST_FATES => self.fates.push(fated),
            None => self.fates_cut += 1,
        }
    }

    fn carry(&mut self, fated: &Fated, entry: &Entry) {
        let second = entry.at_ns.div_euclid(1_000_000_000);
        if fated.message.kind == Kind::AgentState || self.carried.len() >= MOST_SECONDS {
            return;
        }
        let carried = self.carried.entry((fated.message.from.clone(), second)).or_default();
        carried.messages += 1;
        carried.bytes = carried.bytes.saturating_add(entry.bytes);
    }

    /// What of the recording is not on the page, in words. `of`: the run and its recording.
    pub fn left_out(&self, of: &str) -> Vec<String> {
        let mut lines = Vec::new();
        if self.stride > 1 {
            lines.push(format!(
                "{of}: the player has {} of {} {FEWER_SWEEPS} {}; a report of fewer runs, or of one log and ego \
                 (`RUN/LOG/EGO`), has more",
                self.sweeps.len(),
                self.total,
                self.stride
            ));
        }
        if self.fates_cut > 0 {
            lines.push(format!(
                "{of}: the player has what was said of messages {} times of {}; the last are left out, and a shorter run has all",
                self.fates.len(),
                self.fates.len() + self.fates_cut
            ));
        }
        if self.unreadable > 0 {
            lines.push(format!(
                "{of}: {} reports of messages are of an unknown form, so the player lacks these messages; run it again with \
                 this version",
                self.unreadable
            ));
        }
        lines
    }

    fn read_poses(&mut self, recording: &Path) -> Result<(), PageError> {
        for state in states_of(recording)? {
            let (agent, stamp, state) = state?;
            let track = self
                .poses
                .entry(agent)
                .or_insert_with(|| PoseTrack::new(Nanos::MAX, MAX_GAP));
            track.insert(stamp, state.map_from_body);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use realo_schemas::report::{Crossing, Use};

    use super::*;

    #[test]
    fn what_entered_a_channel_is_summed_by_sender_and_second() {
        let mut recorded = Recorded::empty();
        let message = |from: &str, kind| Fated {
            message: Crossing {
                from: from.into(),
                to: "cav1".into(),
                kind,
                seq: 0,
            },
            fate: Fate::InFlight,
            r#use: None,
            entry: None,
        };
        for (from, kind, at_ns) in [
            ("rsu1", Kind::Boxes, 1_999_999_999),
            ("rsu1", Kind::Points, 1_000_000_000),
            ("rsu1", Kind::AgentState, 1_000_000_000),
            ("rsu1", Kind::Boxes, 2_000_000_000),
            ("cav2", Kind::Boxes, -1),
        ] {
            recorded.carry(&message(from, kind), &Entry { bytes: 100, at_ns });
        }
        let of = |from: &str, second| {
            recorded
                .carried
                .get(&(from.to_string(), second))
                .map(|of| [of.messages, of.bytes])
        };
        assert_eq!(of("rsu1", 1), Some([2, 200]));
        assert_eq!((of("rsu1", 2), of("cav2", -1)), (Some([1, 100]), Some([1, 100])));
        assert_eq!(recorded.carried.len(), 3);
    }

    #[test]
    fn what_is_said_again_counts_once() {
        let message = |seq| Crossing {
            from: "rsu1".into(),
            to: "cav1".into(),
            kind: Kind::Boxes,
            seq,
        };
        let of = |seq, fate, query: Option<u64>, at_ns: Option<Nanos>| Fated {
            message: message(seq),
            fate,
            r#use: query.map(|query| Use { query, age_ns: 5 }),
            entry: at_ns.map(|at_ns| Entry { bytes: 100, at_ns }),
        };
        // Several processes report the same; a message may be used for two sweeps, and one sent anew counts anew.
        let all = [
            of(1, Fate::InFlight, None, Some(10)),
            of(2, Fate::InFlight, None, Some(20)),
            of(1, Fate::Used, Some(3), None),
            of(1, Fate::Used, Some(4), None),
            of(2, Fate::Lost, None, None),
            of(1, Fate::InFlight, None, Some(1_500_000_000)),
        ];
        let mut recorded = Recorded::empty();
        for _ in 0..20 {
            all.iter().for_each(|fated| recorded.hear(fated.clone()));
        }
        assert_eq!((recorded.fates.len(), recorded.fates_cut), (3, 0));
        let carried: Vec<[u64; 2]> = recorded.carried.values().map(|of| [of.messages, of.bytes]).collect();
        assert_eq!(carried, [[2, 200], [1, 100]]);
    }

    #[test]
    fn a_long_recording_keeps_every_second_fourth_eighth_sweep() {
        let mut recorded = Recorded::empty();
        (0..1000).for_each(|seq| {
            recorded.kept(seq, 100);
        });
        assert_eq!(recorded.stride, 16);
        assert!(recorded.sweeps.keys().copied().eq((0..1000).step_by(16)));
        assert!(recorded.kept(1, 100).is_none() && recorded.kept(16, 100).is_some());
        (recorded.total, recorded.unreadable) = (1000, 3);
        let said = recorded.left_out("late: recording.mcap");
        assert_eq!(said.len(), 2, "{said:?}");
        assert!(
            said[0].contains("63 of 1000 sweeps, one of 16") && said[1].contains("3 reports"),
            "{said:?}"
        );
    }
}
