//! The sending side: which message goes when, and what became of those that did not.

mod schedule;
mod silence;

use std::collections::{BTreeMap, VecDeque};

use bytes::Bytes;
use realo_schemas::{Kind, Nanos};
use serde::{Deserialize, Serialize};

use super::frame::{Acknowledgement, Frame, Head};
use super::is_bulk;
use super::transfer::Transfer;
use super::window::Window;

const MS: Nanos = 1_000_000;
/// Transfers of which the last parts are awaited at most.
const TRANSFERS: usize = 4;
/// A part is taken for lost if so many that went out later came in,
const OVERTAKEN: usize = 3;
/// and one of them went out so much later: the network may change the order of those that follow each other closely.
const CLOSELY: Nanos = 20 * MS;
/// Parts that are on their way are taken for lost after so long without a word, or after four round trips.
const SILENCE: Nanos = 1_000 * MS;
/// Beyond two round trips, the last parts that went out wait so long for a word before one of them goes again.
const QUIET: Nanos = 40 * MS;
/// Messages cross side by side if all would arrive in time though it took longer than is known by this fraction of it.
const SLACK: Nanos = 16;
/// Time that parts of a trial take on the way together, by what is known of it, s.
const TRIAL_TIME: f64 = 0.03;
/// Parts of a trial at least.
const TRIAL_PARTS: u32 = 4;
/// and its bytes at least: fewer, spread by the jitter of the way, show no more than is known of a slow one.
const TRIAL_BYTES: usize = 8192;

/// How a sender weighs freshness against completeness.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Bytes of a part at most.
    pub part: usize,
    /// Data that may stand in queues on the way, as time.
    pub queue: Nanos,
    /// Age at which bulk must have arrived, by when it was measured.
    pub deadline: Nanos,
    /// A kind that does not fit is tried again after so long, for the way may have become better.
    pub trial: Nanos,
}

impl Default for Settings {
    fn default() -> Self {
        Settings {
            part: 16_384,
            queue: 20 * MS,
            deadline: 400 * MS,
            trial: 1_000 * MS,
        }
    }
}

/// A message that should cross.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Offer {
    /// What it carries.
    pub kind: Kind,
    /// Counts the messages of a kind.
    pub seq: u64,
    /// When what it reports was measured, on the log's time line; messages of several kinds with one stamp say the same.
    pub stamp: Nanos,
    /// The same on the sender's clock.
    pub born: Nanos,
    /// What crosses.
    pub bytes: Bytes,
}

/// What became of a message at its sender.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// It went out whole; bulk is known to have arrived.
    Sent,
    /// A newer one took its place, or a richer one of the same moment crossed.
    Superseded,
    /// It would have arrived after its deadline, or began and could not.
    Late,
    /// The peer went, or the way was lost, while it crossed.
    Lost,
}

/// That a message left the sender's hands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Report {
    /// Which.
    pub kind: Kind,
    /// Which.
    pub seq: u64,
    /// How.
    pub outcome: Outcome,
}

/// A part that is on its way.
#[derive(Clone, Copy, Debug)]
struct Flying {
    kind: Kind,
    seq: u64,
    index: u32,
    bytes: usize,
    sent: Nanos,
    /// How many that went out later came in.
    overtaken: usize,
}

/// The sending side of a way to a peer.
#[derive(Debug)]
pub struct Sender {
    settings: Settings,
    session: u64,
    window: Window,
    /// Small messages; all go out at once.
    small: BTreeMap<Kind, Offer>,
    /// Bulk that waits.
    waiting: BTreeMap<Kind, Offer>,
    /// Bulk that has begun, oldest first.
    transfers: VecDeque<Transfer>,
    flying: VecDeque<Flying>,
    flying_bytes: usize,
    /// Number of the last start of each kind, so that they take turns.
    started: BTreeMap<Kind, u64>,
    starts: u64,
    /// When each kind was last tried although it did not fit.
    tried: BTreeMap<Kind, Nanos>,
    reported: Vec<Report>,
    /// When it was last asked what goes out.
    asked: Nanos,
    /// When parts last went out or came in.
    moved: Nanos,
    /// When parts last came in.
    heard: Nanos,
    /// How often a part went again since one came in, because nothing moved.
    probes: u32,
}

impl Sender {
    /// To a peer of whom nothing is known; `session` is greater for a sender that is started later.
    pub fn new(settings: Settings, session: u64) -> Self {
        Sender {
            window: Window::new(settings.part, settings.queue),
            settings,
            session,
            small: BTreeMap::new(),
            waiting: BTreeMap::new(),
            transfers: VecDeque::new(),
            flying: VecDeque::new(),
            flying_bytes: 0,
            started: BTreeMap::new(),
            starts: 0,
            tried: BTreeMap::new(),
            reported: Vec::new(),
            asked: Nanos::MIN,
            moved: Nanos::MIN,
            heard: Nanos::MIN,
            probes: 0,
        }
    }

    /// Takes the place of the message of its kind that waits.
    pub fn offer(&mut self, offer: Offer) {
        let slots = match is_bulk(offer.kind) {
            true => &mut self.waiting,
            false => &mut self.small,
        };
        if let Some(older) = slots.insert(offer.kind, offer) {
            self.report(&older, Outcome::Superseded);
        }
    }

    /// A frame that goes out now; ask until there is none.
    pub fn next(&mut self, now: Nanos) -> Option<Frame> {
        self.asked = now;
        if let Some((_, offer)) = self.small.pop_first() {
            return Some(self.whole(&offer, now));
        }
        self.give_up_silence(now);
        self.probe(now);
        if self.flying.is_empty() {
            self.window.empties(now);
        }
        loop {
            self.give_up_late(now);
            if !self.has_room() {
                return None;
            }
            while self.squeeze_in(now) {}
            match self.next_transfer() {
                // A trial that goes at the pace of what is believed would confirm it.
                Some(place) if self.transfers[place].trial.is_some() || self.window.opens_at() <= now => {
                    return Some(self.part(place, now));
                }
                None if self.start(now) => {}
                Some(_) => return None,
                None => {
                    self.window.runs_out(self.flying.is_empty());
                    return None;
                }
            }
        }
    }

    /// When [`Sender::next`] should be asked again though nothing came in; `None`: not before.
    pub fn wakes_at(&self) -> Option<Nanos> {
        let silence = self.silent_at().into_iter().chain(self.probes_at());
        let more = !self.waiting.is_empty() || self.transfers.iter().any(|transfer| transfer.due().is_some());
        let opens = (more && self.has_room()).then(|| self.window.opens_at());
        silence.chain(opens.filter(|time| *time > self.asked)).min()
    }

    /// Parts came in.
    pub fn acknowledged(&mut self, ack: &Acknowledgement, now: Nanos) {
        if ack.session != self.session {
            return;
        }
        let (mut arrived, mut bytes) = (0, 0);
        for part in &self.flying {
            if (part.kind, part.seq) == (ack.kind, ack.seq) && ack.covers(part.index) {
                arrived += 1;
                bytes += part.bytes;
            }
        }
        if arrived == 0 {
            return;
        }
        (self.moved, self.heard, self.probes) = (now, now, 0);
        self.window.acknowledged(now, ack.sent, ack.received, bytes);
        if let Some(transfer) = self.transfers.iter_mut().find(|transfer| transfer.is_of(ack)) {
            (ack.index.saturating_sub(32)..=ack.index)
                .filter(|index| ack.covers(*index))
                .for_each(|index| transfer.arrived(index));
        }
        // Of a part that went again, the word may be of its first copy, which overtook nothing that went later.
        let sent_before = self.flying.iter().take_while(|part| part.sent <= ack.sent).count();
        let (mut lost, mut kept) = (Vec::new(), VecDeque::with_capacity(self.flying.len()));
        let mut later = arrived;
        for (place, mut part) in self.flying.drain(..).enumerate() {
            if (part.kind, part.seq) == (ack.kind, ack.seq) && ack.covers(part.index) {
                self.flying_bytes -= part.bytes;
                later -= 1;
                continue;
            }
            if place < sent_before {
                part.overtaken += later;
            }
            if part.overtaken >= OVERTAKEN && ack.sent.saturating_sub(part.sent) >= CLOSELY {
                self.flying_bytes -= part.bytes;
                lost.push(part);
            } else {
                kept.push_back(part);
            }
        }
        self.flying = kept;
        lost.iter().for_each(|part| self.repeat(part));
        self.finish();
    }

    /// The peer is gone: what is on its way is lost; what waits stays, and the newest goes when it is back.
    pub fn disconnected(&mut self) {
        let lost: Vec<Transfer> = self.transfers.drain(..).collect();
        lost.iter()
            .for_each(|transfer| self.report(&transfer.offer, Outcome::Lost));
        self.flying.clear();
        self.flying_bytes = 0;
        self.window.lost();
    }

    /// Messages that left the sender's hands since the last call, in that order.
    pub fn take_reported(&mut self) -> Vec<Report> {
        std::mem::take(&mut self.reported)
    }

    /// What is known of the way.
    pub fn window(&self) -> &Window {
        &self.window
    }

    /// Bytes that are kept: those that wait, and those that cross.
    pub fn held(&self) -> usize {
        let slots = self.small.values().chain(self.waiting.values());
        let crossing = self.transfers.iter().map(|transfer| &transfer.offer);
        slots.chain(crossing).map(|offer| offer.bytes.len()).sum()
    }

    /// Bytes of bulk that are on the way.
    pub fn on_the_way(&self) -> usize {
        self.flying_bytes
    }

    fn report(&mut self, offer: &Offer, outcome: Outcome) {
        self.reported.push(Report {
            kind: offer.kind,
            seq: offer.seq,
            outcome,
        });
    }

    fn whole(&mut self, offer: &Offer, now: Nanos) -> Frame {
        self.report(offer, Outcome::Sent);
        let head = Head {
            kind: offer.kind,
            asks: false,
            waits: false,
            session: self.session,
            seq: offer.seq,
            index: 0,
            count: 1,
            sent: now,
            stamp: offer.stamp,
        };
        Frame::Part(head, offer.bytes.clone())
    }

    fn part(&mut self, place: usize, now: Nanos) -> Frame {
        let transfer = &mut self.transfers[place];
        let index = transfer.due().expect("the caller looked");
        transfer.take(index);
        let bytes = transfer.bytes(index).len();
        self.window.sent(now, bytes);
        self.flying.push_back(Flying {
            kind: transfer.offer.kind,
            seq: transfer.offer.seq,
            index,
            bytes,
            sent: now,
            overtaken: 0,
        });
        self.flying_bytes += bytes;
        self.moved = now;
        let waits = !self.has_room() || self.transfers.iter().all(|transfer| transfer.due().is_none());
        self.transfers[place].frame(index, waits, self.session, now)
    }

    fn supersede_fallbacks(&mut self, kind: Kind, stamp: Nanos) {
        let fallback = self
            .waiting
            .extract_if(.., |other, offer| *other > kind && offer.stamp == stamp);
        let fallback: Vec<Offer> = fallback.map(|(_, offer)| offer).collect();
        fallback
            .iter()
            .for_each(|offer| self.report(offer, Outcome::Superseded));
    }

    fn finish(&mut self) {
        while let Some(place) = self.transfers.iter().position(Transfer::is_complete) {
            let transfer = self.transfers.remove(place).expect("it was just there");
            self.report(&transfer.offer, Outcome::Sent);
            self.supersede_fallbacks(transfer.offer.kind, transfer.offer.stamp);
        }
    }
}
