//! One run of which a frame is chosen.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use realo_logs::{Log, LogError};
use realo_recorder::{boxes_of, truth_of};
use realo_results::{Run, RunResult};
use realo_schemas::{Boxes, GroundTruth, Header, Message, Nanos};
use realo_scoring::{Collector, Evaluation, Frame, Protocol};

use super::{Chosen, KEPT, RECORDING, Request, open_log};
use crate::fused::{fused, fused_sweeps};
use crate::{Judged, RenderError};

/// A run of one log and ego, as it was recorded: which sweeps it has. What is in them is read when it is looked at.
pub(super) struct RecordedRun {
    pub result: RunResult,
    pub log: Log,
    pub protocol: Protocol,
    pub ego: String,
    pub recording: PathBuf,
    /// Sweeps with truth, and whether they are scored.
    pub truth: BTreeMap<u64, bool>,
    /// Sweeps with boxes.
    pub boxes: BTreeSet<u64>,
    /// Sweeps for which something was fused.
    pub fused: BTreeSet<u64>,
}

/// What was recorded of a sweep.
#[derive(Default)]
pub(super) struct Sweep {
    pub truth: Option<(Header, GroundTruth)>,
    pub boxes: Option<(Header, Boxes)>,
}

/// The candidate that shows most so far.
pub(super) struct Best {
    pub seq: u64,
    pub sweep: Sweep,
    pub frame: Frame,
    pub judged: Judged,
}

impl RecordedRun {
    pub(super) fn read(folder: &Path, run: Run, request: &Request) -> Result<Self, RenderError> {
        let recording = folder.join(RECORDING);
        if !recording.exists() {
            let mend = match folder.ends_with(KEPT) {
                true => "name the folder of a run that has one: these results are kept without a recording",
                false => "run it again, with a node `recorder` in its graph",
            };
            return Err(RenderError::NoRecording { file: recording, mend });
        }
        let log = open_log(&run, request)?;
        let mut boxes = BTreeSet::new();
        for message in boxes_of(&recording)? {
            boxes.insert(message?.header.seq);
        }
        let ego = run.result.settings.ego.clone();
        let mut truth = BTreeMap::new();
        for message in truth_of(&recording)? {
            let (header, content) = message?.into_parts::<GroundTruth>()?;
            truth.insert(header.seq, content.key);
        }
        let protocol = match run.samples.evaluation {
            Some(Evaluation { protocol, .. }) => protocol,
            None => Protocol::load(&log.info().protocol)?,
        };
        Ok(RecordedRun {
            result: run.result,
            log,
            protocol,
            fused: fused_sweeps(&recording, &ego)?,
            ego,
            recording,
            boxes,
            truth,
        })
    }

    pub(super) fn describe(&self) -> String {
        let sweeps: Vec<u64> = self.sweeps().collect();
        let keys: Vec<String> = self.keys().map(|seq| seq.to_string()).collect();
        let (first, last) = (sweeps.first().unwrap_or(&0), sweeps.last().unwrap_or(&0));
        let log = self.result.logs.join(", ");
        let sweeps = match sweeps.is_empty() {
            true => "no sweeps".into(),
            false => format!("sweeps {first} to {last}"),
        };
        let keys = match keys.is_empty() {
            true => "none is scored".into(),
            false => format!("scored: {}", keys.join(" ")),
        };
        format!("{log}, ego {}: {sweeps}, {keys}", self.ego)
    }

    fn sweeps(&self) -> impl Iterator<Item = u64> {
        let mut sweeps: Vec<u64> = self.truth.keys().chain(&self.boxes).copied().collect();
        sweeps.sort_unstable();
        sweeps.dedup();
        sweeps.into_iter()
    }

    fn keys(&self) -> impl Iterator<Item = u64> {
        self.truth.iter().filter(|(_, key)| **key).map(|(seq, _)| *seq)
    }

    /// The sweep of this number, or the key frame (without any: the sweep) that shows most.
    pub(super) fn choose(self, seq: Option<u64>, watch: &dyn Fn(usize, usize)) -> Result<Option<Chosen>, RenderError> {
        let candidates: BTreeSet<u64> = match seq {
            Some(seq) => self.sweeps().filter(|known| *known == seq).collect(),
            None if self.keys().next().is_some() => self.keys().collect(),
            None => self.sweeps().collect(),
        };
        let mut best: Option<Best> = None;
        // Of equal ones the first: they may come in another order.
        let gain = |judged: &Judged, seq: u64| (judged.added(), judged.hits(), Reverse(seq));
        let mut looked_at = 0;
        self.each(&candidates, |seq, sweep| {
            looked_at += 1;
            watch(looked_at, candidates.len());
            let frame = self.frame(&sweep)?;
            let judged = Judged::of(&frame, &self.protocol, self.protocol.ious[0], self.fused.contains(&seq));
            if best
                .as_ref()
                .is_none_or(|best| gain(&judged, seq) > gain(&best.judged, best.seq))
            {
                best = Some(Best {
                    seq,
                    sweep,
                    frame,
                    judged,
                });
            }
            Ok(())
        })?;
        best.map(|best| self.chosen(best)).transpose()
    }

    /// Gives each of these sweeps once, as soon as all that was recorded of it is read; the most that waits for its other
    /// half is what the graph had in work at a time.
    fn each(
        &self,
        wanted: &BTreeSet<u64>,
        mut give: impl FnMut(u64, Sweep) -> Result<(), RenderError>,
    ) -> Result<(), RenderError> {
        let footprint = self.log.info().agent(&self.ego).and_then(|agent| agent.footprint);
        let ready = |message: &Result<Message, LogError>| message.as_ref().map_or(Nanos::MIN, |one| one.header.ready);
        let (mut truth, mut boxes) = (
            truth_of(&self.recording)?.peekable(),
            boxes_of(&self.recording)?.peekable(),
        );
        let mut waiting: BTreeMap<u64, Sweep> = BTreeMap::new();
        loop {
            let truth_first = match (truth.peek(), boxes.peek()) {
                (None, None) => return Ok(()),
                (Some(truth), Some(boxes)) => ready(truth) <= ready(boxes),
                (truth, _) => truth.is_some(),
            };
            let next = if truth_first { truth.next() } else { boxes.next() };
            let Some(message) = next.transpose()? else { continue };
            let seq = message.header.seq;
            if !wanted.contains(&seq) {
                continue;
            }
            let sweep = waiting.entry(seq).or_default();
            if truth_first {
                let mut part = message.into_parts::<GroundTruth>()?;
                // A recording leaves the footprint out; detections in it are the ego itself.
                part.1.ego_footprint = footprint;
                sweep.truth = Some(part);
            } else {
                sweep.boxes = Some(message.into_parts::<Boxes>()?);
            }
            let complete = sweep.truth.is_some() == self.truth.contains_key(&seq)
                && sweep.boxes.is_some() == self.boxes.contains(&seq);
            if complete {
                give(seq, waiting.remove(&seq).unwrap_or_default())?;
            }
        }
    }

    pub(super) fn chosen(self, best: Best) -> Result<Chosen, RenderError> {
        let Best {
            seq,
            sweep: Sweep { truth, boxes },
            frame,
            judged,
        } = best;
        let key = truth.as_ref().is_some_and(|(_, truth)| truth.key);
        let has_truth = key || truth.as_ref().is_some_and(|(_, truth)| !truth.boxes.is_empty());
        let mut agents: Vec<String> = match &truth {
            Some((_, truth)) => truth.agents.iter().map(|agent| agent.to_string()).collect(),
            None => self.result.agents.clone(),
        };
        if agents.is_empty() {
            agents.push(self.ego.clone());
        }
        let (of_truth, truth) = truth.unzip();
        let header = boxes.map(|(header, _)| header).or(of_truth);
        let header = header.expect("a chosen sweep has boxes or truth");
        Ok(Chosen {
            fused: fused(&self.recording, &self.ego, seq)?,
            iou: self.protocol.ious[0],
            result: self.result,
            log: self.log,
            ego: self.ego,
            agents,
            protocol: self.protocol,
            seq,
            stamp: header.stamp,
            key,
            processed: frame.processed,
            has_truth,
            header,
            truth,
            judged,
        })
    }

    /// A sweep as the evaluator sees it, as if it were scored.
    pub(super) fn frame(&self, sweep: &Sweep) -> Result<Frame, RenderError> {
        let mut collector = Collector::new(self.protocol.clone());
        match (&sweep.truth, &sweep.boxes) {
            (Some((header, truth)), _) => {
                let mut truth = truth.clone();
                truth.key = true;
                if let Some(own) = &mut truth.own {
                    own.key = true;
                }
                collector.add_truth(header, &truth)?;
            }
            (None, Some((header, _))) => {
                let nothing_known = GroundTruth {
                    key: true,
                    ..GroundTruth::default()
                };
                collector.add_truth(header, &nothing_known)?;
            }
            (None, None) => {}
        }
        if let Some((header, boxes)) = &sweep.boxes {
            collector.add_boxes(header, boxes.clone())?;
        }
        let scenes = collector.finish().scenes;
        Ok(scenes
            .into_iter()
            .flat_map(|scene| scene.frames)
            .next()
            .unwrap_or_default())
    }
}
