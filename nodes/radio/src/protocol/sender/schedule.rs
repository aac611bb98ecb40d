//! Which transfer goes on next.

use realo_schemas::{Kind, Nanos};

use super::{Offer, Outcome, SLACK, Sender, TRANSFERS, TRIAL_BYTES, TRIAL_PARTS, TRIAL_TIME};
use crate::protocol::transfer::{Transfer, Trial};

impl Sender {
    pub(super) fn has_room(&self) -> bool {
        self.flying.is_empty() || self.flying_bytes + self.window.part() <= self.window.bytes()
    }

    /// The transfer whose part goes next: the one that is over first, so that little waits for much.
    pub(super) fn next_transfer(&self) -> Option<usize> {
        let due = self.transfers.iter().enumerate();
        let due = due.filter(|(_, transfer)| transfer.due().is_some());
        due.min_by_key(|(_, transfer)| transfer.remaining())
            .map(|(place, _)| place)
    }

    /// Begins with a message of another kind beside those that cross, if all of them arrive in time nevertheless.
    pub(super) fn squeeze_in(&mut self, now: Nanos) -> bool {
        let crossing = || self.transfers.iter().filter(|transfer| transfer.due().is_some());
        let is_full =
            self.transfers.len() >= TRANSFERS || self.transfers.iter().any(|transfer| transfer.trial.is_some());
        if is_full || crossing().next().is_none() {
            return false;
        }
        let Some(offer) = self.turn().and_then(|kind| self.waiting.get(&kind)) else {
            return false;
        };
        if crossing().any(|transfer| transfer.offer.kind == offer.kind) {
            return false;
        }
        let bytes = crossing().map(Transfer::remaining).sum::<usize>() + offer.bytes.len();
        let born = crossing()
            .map(|transfer| transfer.offer.born)
            .fold(offer.born, Nanos::min);
        let takes = self.arrival(now, bytes) - now;
        now + takes + takes / SLACK <= born + self.settings.deadline && self.start(now)
    }

    /// Begins with a message that waits and arrives in time, or tries one; `false` if there is none.
    pub(super) fn start(&mut self, now: Nanos) -> bool {
        while self.transfers.len() < TRANSFERS {
            let Some(kind) = self.turn() else {
                return false;
            };
            let offer = self.waiting.remove(&kind).expect("it is its turn");
            let arrives = self.arrival(now, offer.bytes.len());
            let must = offer.born + self.settings.deadline;
            let trial = match arrives <= must {
                true => None,
                // However fast the way is.
                false if now > must => {
                    self.report(&offer, Outcome::Late);
                    continue;
                }
                // What else crosses would be in the way of what a trial is to find out.
                false if self.may_try(kind, now) && !self.transfers.is_empty() => {
                    self.waiting.insert(kind, offer);
                    return false;
                }
                false if self.may_try(kind, now) => {
                    self.tried.insert(kind, now);
                    Some(Trial {
                        parts: self.trial_parts(self.window.part()),
                        since: now,
                    })
                }
                false => {
                    self.report(&offer, Outcome::Late);
                    continue;
                }
            };
            self.starts += 1;
            self.started.insert(kind, self.starts);
            if trial.is_none() {
                self.supersede_fallbacks(kind, offer.stamp);
            }
            self.transfers
                .push_back(Transfer::new(offer, self.window.part(), trial));
            return true;
        }
        false
    }

    /// The kind that begins next: of those that carry the same moment the richest, else the one that began longest ago.
    fn turn(&self) -> Option<Kind> {
        let crossing = |offer: &Offer| {
            let mut richer = self.transfers.iter().map(|transfer| &transfer.offer);
            richer.any(|other| other.stamp == offer.stamp && other.kind < offer.kind)
        };
        let waiting = self.waiting.values().filter(|offer| !crossing(offer));
        let longest_ago = waiting.min_by_key(|offer| self.started.get(&offer.kind))?;
        let same = self.waiting.values().filter(|offer| offer.stamp == longest_ago.stamp);
        same.map(|offer| offer.kind).min()
    }

    /// Whether a kind that does not fit may be tried again.
    fn may_try(&self, kind: Kind, now: Nanos) -> bool {
        let last = self.tried.get(&kind);
        last.is_none_or(|last| now - last >= self.settings.trial)
    }

    /// So many parts of so many bytes that they show more than is known, should the way carry more; the first only begins the
    /// measurement.
    pub(super) fn trial_parts(&self, part: usize) -> u32 {
        let rate = self.window.rate().unwrap_or(0.0);
        let parts = (rate * TRIAL_TIME / part as f64).ceil() as u32 + 1;
        parts.max(TRIAL_PARTS).max(TRIAL_BYTES.div_ceil(part) as u32)
    }

    /// When so many bytes more will have arrived, as far as is known.
    pub(super) fn arrival(&self, now: Nanos, bytes: usize) -> Nanos {
        let Some(rate) = self.window.rate() else {
            return now;
        };
        let takes = |bytes: usize| (bytes as f64 / rate * 1e9) as Nanos;
        let round_trip = self.window.round_trip().unwrap_or(0);
        // Of what is on its way as much has left the queue, or is acknowledged, as crosses in a round trip.
        let queue = (takes(self.flying_bytes) - round_trip).max(0);
        now.saturating_add(queue + takes(bytes)) + round_trip / 2
    }
}
