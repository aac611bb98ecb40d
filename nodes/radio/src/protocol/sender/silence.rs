//! What is done when nothing is acknowledged.

use realo_schemas::Nanos;

use super::{Flying, Outcome, QUIET, SILENCE, Sender};
use crate::protocol::transfer::{Transfer, Trial};

impl Sender {
    /// Gives up transfers that cannot arrive in time, and decides about trials.
    pub(super) fn give_up_late(&mut self, now: Nanos) {
        for place in (0..self.transfers.len()).rev() {
            let transfer = &self.transfers[place];
            if transfer.due().is_some() && transfer.trial.is_some() {
                continue;
            }
            let is_under_trial = transfer.trial.is_some() && !transfer.is_complete();
            if is_under_trial && self.is_flying(transfer) {
                continue;
            }
            // What has begun is not given up for a little: what waits in queues is not known any better.
            let must = transfer.offer.born + self.settings.deadline + self.settings.queue;
            let late = self.arrival(now, transfer.remaining()) > must;
            let in_time = now <= transfer.offer.born + self.settings.deadline;
            if let Some(trial) = transfer
                .trial
                .filter(|trial| late && in_time && self.window.grew_since(trial.since))
            {
                // The parts came in faster than was known: some more say how fast the way is.
                let more = Trial {
                    parts: trial.parts.saturating_add(self.trial_parts(transfer.part())),
                    since: now,
                };
                self.transfers[place].trial = Some(more);
            } else if transfer.remaining() > 0 && late {
                let transfer = self.transfers.remove(place).expect("it was just there");
                self.report(&transfer.offer, Outcome::Late);
            } else if is_under_trial {
                self.transfers[place].trial = None;
            }
        }
    }

    fn is_flying(&self, transfer: &Transfer) -> bool {
        let offer = &transfer.offer;
        self.flying
            .iter()
            .any(|part| (part.kind, part.seq) == (offer.kind, offer.seq))
    }

    /// When the oldest part on its way goes again: the last parts of a message are overtaken by none that would show their loss.
    pub(super) fn probes_at(&self) -> Option<Nanos> {
        let waits = !self.flying.is_empty() && self.next_transfer().is_none();
        let quiet = (2 * self.window.round_trip().unwrap_or(0) + QUIET) << self.probes.min(4);
        waits.then(|| self.moved + quiet)
    }

    pub(super) fn probe(&mut self, now: Nanos) {
        if self.probes_at().is_none_or(|time| now < time) {
            return;
        }
        if let Some(part) = self.flying.pop_front() {
            self.flying_bytes -= part.bytes;
            self.repeat(&part);
            (self.moved, self.probes) = (now, self.probes + 1);
        }
    }

    /// Takes everything for lost that is on its way, if nothing came back for too long.
    pub(super) fn give_up_silence(&mut self, now: Nanos) {
        if self.silent_at().is_none_or(|time| now < time) {
            return;
        }
        self.window.lost();
        self.flying_bytes = 0;
        let lost: Vec<Flying> = self.flying.drain(..).rev().collect();
        lost.iter().for_each(|part| self.repeat(part));
    }

    /// When nothing will have come back for too long.
    pub(super) fn silent_at(&self) -> Option<Nanos> {
        let silence = SILENCE.max(4 * self.window.round_trip().unwrap_or(0));
        let first = self.flying.front()?;
        Some(first.sent.max(self.heard) + silence)
    }

    pub(super) fn repeat(&mut self, part: &Flying) {
        let mut transfers = self.transfers.iter_mut();
        let transfer = transfers.find(|transfer| (transfer.offer.kind, transfer.offer.seq) == (part.kind, part.seq));
        if let Some(transfer) = transfer {
            transfer.repeat(part.index);
        }
    }
}
