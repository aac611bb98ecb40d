//! Recorded detections and packets as they are played.

use realo_logs::{Entry, LogError, Stream, WrongHeadings};
use realo_schemas::{Kind, Nanos, Packet};

use super::Feed;
use crate::Output;
use crate::counters::{DETECTION_HEADINGS, DETECTIONS_WITHOUT_INFO, DETECTIONS_WITHOUT_SWEEP};
use crate::joins::Recorded;

impl Feed {
    pub(super) fn send_packet(&mut self, entry: &Entry) -> Result<(), LogError> {
        let sent = entry.packet()?;
        let packet = Packet {
            codec: sent.codec,
            bytes: sent.bytes.into(),
        };
        let times = [entry.stamp(), self.release(entry)];
        let from = (self.rank(entry), times);
        let mut output = self.output(from, sent.seq, sent.kind, [Output::Packets; 2], packet);
        output.header_mut().frame = sent.frame.into();
        self.queue((from.0, times[1]), output);
        Ok(())
    }

    pub(super) fn take_detections(&mut self, entry: &Entry) -> Result<(), LogError> {
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

    pub(super) fn take_info(&mut self, entry: &Entry) -> Result<(), LogError> {
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
    pub(super) fn expire(&mut self, now: Nanos) {
        for recorded in self.joins.alone(now) {
            self.take_recorded(Some(recorded), true);
        }
        for recorded in self.joins.lost(now) {
            self.send_detections(recorded);
        }
    }

    pub(super) fn sweep_of(&self, entry: &Entry) -> Option<(u64, Nanos)> {
        self.sweeps.get(&entry.agent)?.get(&entry.stamp()).copied()
    }

    /// Sends detections with the number of their sweep, or counts that there is none.
    pub(super) fn send_detections(&mut self, recorded: Recorded) {
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
        let output = self.output(from, seq, Kind::Boxes, [Output::EgoRecorded, Output::Recorded], boxes);
        self.queue((from.0, release), output);
    }
}
