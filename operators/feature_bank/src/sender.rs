//! What the bank holds of one collaborator.

use std::collections::VecDeque;

use realo_schemas::report::Fate;
use realo_schemas::{Boxes, Header, Kind, Message, Nanos, PayloadType};

/// Ids that are remembered of a sender, to know copies by.
const REMEMBERED: usize = 64;

/// Messages that left the bank, and what became of them there.
pub type Departed = Vec<(Header, Fate)>;

/// A message in the bank and what happened to it there.
struct Held {
    message: Message,
    payload: PayloadType,
    selected: bool,
    stale: bool,
    skipped: bool,
}

impl Held {
    /// Leaves the bank; `unasked` is the fate of a message which no query asked for. Of one that was selected whoever
    /// takes the selection says what became of it.
    fn leave(&self, unasked: Fate, departed: &mut Departed) {
        let fate = match (self.selected, self.stale, self.skipped) {
            (true, _, _) => return,
            (_, _, true) => Fate::Superseded,
            (_, true, _) => Fate::Stale,
            _ => unasked,
        };
        departed.push((self.message.header.clone(), fate));
    }
}

/// The newest message of a sender, and how far apart its messages come.
#[derive(Clone, Copy)]
struct Rhythm {
    stamp: Nanos,
    ready: Nanos,
    seq: u64,
    /// From one stamp to the next, ns; 0 until two messages have come.
    period: Nanos,
}

/// One collaborator.
pub(crate) struct Sender {
    /// By stamp; of one stamp the latest arrival last.
    held: Vec<Held>,
    /// Offline: beyond the limit, without their content; the next query or the end decides their fate.
    dropped: Vec<Held>,
    seen: VecDeque<(Kind, u64, Nanos)>,
    rhythm: Option<Rhythm>,
    /// When it was last heard of.
    pub last: Nanos,
}

impl Sender {
    pub fn new() -> Self {
        Sender {
            held: Vec::new(),
            dropped: Vec::new(),
            seen: VecDeque::new(),
            rhythm: None,
            last: Nanos::MIN,
        }
    }

    /// Remembers a message; `false` if it was seen before.
    pub fn is_new(&mut self, header: &Header) -> bool {
        let id = (header.kind, header.seq, header.stamp);
        if self.seen.contains(&id) {
            return false;
        }
        if self.seen.len() == REMEMBERED {
            self.seen.pop_front();
        }
        self.seen.push_back(id);
        true
    }

    /// Learns when messages of this sender come; whether this one is newer than all before.
    pub fn follow(&mut self, header: &Header) -> bool {
        let Header { stamp, ready, seq, .. } = *header;
        let mut period = 0;
        if let Some(before) = self.rhythm {
            if before.stamp >= stamp {
                return false;
            }
            let messages = Nanos::try_from(seq.saturating_sub(before.seq).max(1)).unwrap_or(Nanos::MAX);
            period = stamp.saturating_sub(before.stamp) / messages;
        }
        self.rhythm = Some(Rhythm {
            stamp,
            ready,
            seq,
            period,
        });
        true
    }

    /// Whether its next message is to be expected within `patience` of `time`; of one whose newest message is older than
    /// the window nothing is.
    pub fn is_due(&self, time: Nanos, window: Nanos, patience: Nanos) -> bool {
        let Some(Rhythm {
            stamp, ready, period, ..
        }) = self.rhythm.filter(|rhythm| rhythm.period > 0)
        else {
            return false;
        };
        if time.saturating_sub(stamp) > window {
            return false;
        }
        // As many periods after the newest message as come nearest to the time, but at least one.
        let since = time.saturating_sub(ready);
        let periods = (since.saturating_add(period / 2) / period).max(1);
        let from_time = period.saturating_mul(periods).saturating_sub(since);
        from_time.abs() <= patience
    }

    /// Holds a message. Which one a query takes is decided when it asks, because a query that has waited for its turn
    /// must not see what became ready after it.
    pub fn hold(&mut self, message: Message, limit: usize, offline: bool, departed: &mut Departed) {
        let at = self
            .held
            .partition_point(|held| held.message.header.stamp <= message.header.stamp);
        self.held.insert(
            at,
            Held {
                payload: message.payload.payload_type(),
                message,
                selected: false,
                stale: false,
                skipped: false,
            },
        );
        if self.held.len() > limit {
            let mut oldest = self.held.remove(0);
            if offline {
                let Message { header, payload } = &mut oldest.message;
                (header.pose, header.trace, *payload) = (None, Vec::new(), Boxes::default().into());
                self.dropped.push(oldest);
            } else {
                oldest.leave(Fate::Superseded, departed);
            }
        }
    }

    /// Gives up what cannot be fused with a payload of this type.
    pub fn keep_only(&mut self, expected: PayloadType, departed: &mut Departed) {
        let mut keep = |held: &Held| {
            let keep = held.payload == expected;
            if !keep {
                held.leave(Fate::Rejected, departed);
            }
            keep
        };
        self.dropped.retain(&mut keep);
        self.held.retain(keep);
    }

    /// Online: the message of newest stamp that is ready at `ready`, unless its stamp lies before `oldest`. One that is not
    /// `wanted` is skipped.
    pub fn newest(&mut self, ready: Nanos, oldest: Nanos, wanted: bool, departed: &mut Departed) -> Option<Message> {
        let newest = self.held.iter().rposition(|held| held.message.header.ready <= ready)?;
        let mut place = 0;
        self.held.retain(|held| {
            let keep = place >= newest || held.message.header.ready > ready;
            if !keep {
                held.leave(Fate::Superseded, departed);
            }
            place += 1;
            keep
        });
        let held = self.held.iter_mut().rfind(|held| held.message.header.ready <= ready)?;
        let in_time = held.message.header.stamp >= oldest;
        held.selected |= in_time && wanted;
        held.skipped |= in_time && !wanted;
        held.stale |= !in_time;
        (in_time && wanted).then(|| held.message.clone())
    }

    /// Offline: the message whose stamp is nearest, at most `reach` away; of two the earlier one.
    pub fn nearest(&mut self, stamp: Nanos, reach: Nanos, wanted: bool, departed: &mut Departed) -> Option<Message> {
        let distance = |held: &Held| held.message.header.stamp.abs_diff(stamp);
        // The first of smallest distance is the earlier one, and of one stamp the one that came first.
        let nearest = self
            .held
            .iter()
            .enumerate()
            .min_by_key(|(_, held)| distance(held))
            .map(|(at, _)| at);
        let nearest = nearest.filter(|at| distance(&self.held[*at]) <= reach.unsigned_abs());
        for (at, held) in self.held.iter_mut().chain(&mut self.dropped).enumerate() {
            let within = distance(held) <= reach.unsigned_abs();
            let is_selected = wanted && nearest == Some(at);
            held.selected |= is_selected;
            held.skipped |= within && !is_selected;
        }
        let selected = nearest.filter(|_| wanted).map(|at| self.held[at].message.clone());
        let mut keep = |held: &Held| {
            let keep = held.message.header.stamp >= stamp.saturating_sub(reach);
            if !keep {
                held.leave(Fate::Stale, departed);
            }
            keep
        };
        self.dropped.retain(&mut keep);
        self.held.retain(keep);
        selected
    }

    /// Gives up everything. Online all but the newest message have been superseded, asked for or not.
    pub fn leave(&mut self, offline: bool, departed: &mut Departed) {
        self.dropped
            .drain(..)
            .for_each(|held| held.leave(Fate::InFlight, departed));
        let last = self.held.len().saturating_sub(1);
        for (at, held) in self.held.drain(..).enumerate() {
            let unasked = if at == last || offline {
                Fate::InFlight
            } else {
                Fate::Superseded
            };
            held.leave(unasked, departed);
        }
    }
}
