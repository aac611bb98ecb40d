//! An agent among its peers: what goes out to each, and what came in, without socket or clock.

mod air;
mod peer;

use std::collections::{BTreeMap, VecDeque};

use bytes::Bytes;
use realo_schemas::report::OnAir;
use realo_schemas::{Kind, Name, Nanos};

use crate::books::{Heard, News, Sent};
use crate::offset::{Estimate, Offset, Said};
use crate::protocol::{Arrived, FrameError, Offer, Receiver, ReceiverCounts, Sender, Settings};
use crate::refusal::{Refusal, Refusals};
use crate::seal::{SEAL_BYTES, Seal};
use air::Air;
use peer::{Peer, note};

const MS: Nanos = 1_000_000;
/// Peers at a time at most, so that strangers cannot take all memory.
pub const MOST_PEERS: usize = 64;
/// What is kept of all peers' messages, in messages of the largest size.
const MOST_KEPT: usize = 4;
/// Bytes of a frame, a question or a sheet at most, with its seal.
pub const MOST_BYTES: usize = (128 << 10) + SEAL_BYTES;
/// Between two sheets of the books.
const SHEETS: Nanos = 500 * MS;
/// Between two questions for the peer's time, at first and later.
const QUESTIONS: [Nanos; 2] = [100 * MS, 500 * MS];
/// Questions at first.
const FIRST_QUESTIONS: u32 = 20;
/// Messages of a peer and a kind that wait for the first answer about time.
const UNPLACED: usize = 4;

/// What a message between agents is about; each has a key of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Topic {
    /// Parts of points and features, under the window.
    Bulk,
    /// Boxes and states.
    Small,
    /// Acknowledgements.
    Ack,
    /// Questions and answers about time.
    Clock,
    /// Sheets of the books.
    Books,
}

impl Topic {
    /// All.
    pub const ALL: [Topic; 5] = [Topic::Bulk, Topic::Small, Topic::Ack, Topic::Clock, Topic::Books];

    /// Its part of a key.
    pub fn as_str(self) -> &'static str {
        match self {
            Topic::Bulk => "bulk",
            Topic::Small => "small",
            Topic::Ack => "ack",
            Topic::Clock => "clock",
            Topic::Books => "books",
        }
    }
}

/// One moment, on the clocks that count.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Moment {
    /// On a clock that never steps.
    pub steady: Nanos,
    /// On the graph's time line, once it is known.
    pub log: Option<Nanos>,
    /// On the machine's wall clock, ns since 1970.
    pub wall: Nanos,
    /// What the wall clock is off by at most, where the machine says that it is synchronised, ns.
    pub wall_error: Option<Nanos>,
}

impl Moment {
    /// Where the time line lies by the wall clock, if that is synchronised.
    fn said(&self) -> Option<Said> {
        let line = self.log?.checked_sub(self.wall)?;
        let error = self.wall_error?;
        Some(Said { line, error })
    }
}

/// Bytes for a peer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outgoing {
    /// Who gets them.
    pub to: Name,
    /// What they are about.
    pub topic: Topic,
    /// What they are.
    pub bytes: Bytes,
}

/// What came of frames, for the graph.
#[derive(Debug)]
pub enum Event {
    /// A message of a peer is whole; with how far the peer's time line lies from this agent's.
    Arrived(Name, Arrived, Estimate),
    /// The same that is not given, for newer ones were before it, or because it was not known until the end where its sender's time
    /// line lies.
    Skipped(Name, MessageId),
    /// What became of messages of a peer.
    Books(Name, News),
    /// What became of bulk of this agent on the way to a peer.
    OnAir(Name, OnAir),
}

/// Which message of a peer it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MessageId {
    /// What it carried.
    pub kind: Kind,
    /// Its number.
    pub seq: u64,
    /// When what it reports was measured, as its sender said.
    pub stamp: Nanos,
}

impl From<&Arrived> for MessageId {
    fn from(message: &Arrived) -> Self {
        let Arrived { kind, seq, stamp, .. } = message;
        MessageId {
            kind: *kind,
            seq: *seq,
            stamp: *stamp,
        }
    }
}

/// What is known of a peer.
#[derive(Clone, Debug, PartialEq)]
pub struct Report {
    /// Its name.
    pub peer: Name,
    /// How far its time line lies from this agent's.
    pub clock: Option<Estimate>,
    /// Smallest round trip of late of parts, ns.
    pub round_trip: Option<Nanos>,
    /// Bytes a second that the way to it carries, as far as it was used.
    pub rate: Option<f64>,
    /// What came in.
    pub received: ReceiverCounts,
    /// What came in its name and was not taken.
    pub refused: Refusals,
}

/// The agent.
pub struct Station {
    name: Name,
    settings: Settings,
    largest: usize,
    session: u64,
    seal: Option<Seal>,
    peers: BTreeMap<Name, Peer>,
    /// The peer whose turn it is.
    turn: usize,
    events: Vec<Event>,
    /// By the name in which it came, of which there may be so many as peers.
    refused: BTreeMap<Name, Refusals>,
    total: Refusals,
}

impl Station {
    /// An agent that knows nobody; `session` is greater than that of its earlier starts, messages have `largest` bytes at most.
    /// With a `seal` all that goes out is signed, and nothing else is taken.
    pub fn new(name: Name, settings: Settings, largest: usize, session: u64, seal: Option<Seal>) -> Self {
        Station {
            name,
            settings,
            largest,
            session,
            seal,
            peers: BTreeMap::new(),
            turn: 0,
            events: Vec::new(),
            refused: BTreeMap::new(),
            total: Refusals::default(),
        }
    }

    /// A peer has come.
    pub fn up(&mut self, name: &Name, now: Moment) {
        let is_trusted = self.seal.as_ref().is_none_or(|seal| seal.trusts(name));
        match is_trusted.then(|| self.peer(name, now)).flatten() {
            Some(peer) => {
                peer.is_up = true;
                peer.questions = 0;
                peer.asks_at = now.steady;
            }
            None => self.refuse(name, Refusal::Stranger),
        }
    }

    /// A peer has gone.
    pub fn down(&mut self, name: &Name) {
        if let Some(peer) = self.peers.get_mut(name) {
            peer.is_up = false;
            peer.sender.disconnected();
            peer.sent.reported(&peer.sender.take_reported());
            peer.outgoing.clear();
        }
    }

    /// A message for all peers that are there.
    pub fn offer(&mut self, offer: &Offer) {
        for peer in self.peers.values_mut().filter(|peer| peer.is_up) {
            peer.sent.offered(offer.kind, offer.seq, offer.bytes.len());
            peer.air.offered(offer);
            peer.sender.offer(offer.clone());
        }
    }

    /// Takes what came in a peer's name.
    pub fn take(&mut self, from: &Name, topic: Topic, bytes: &Bytes, now: Moment) {
        if let Err(refusal) = self.opened(from, topic, bytes, now) {
            self.refuse(from, refusal);
        }
    }

    fn opened(&mut self, from: &Name, topic: Topic, bytes: &Bytes, now: Moment) -> Result<(), Refusal> {
        if bytes.len() > MOST_BYTES {
            return Err(Refusal::Oversized);
        }
        let bytes = match &self.seal {
            Some(seal) => seal.open(from, topic, bytes, now.wall)?,
            None => bytes.clone(),
        };
        let own = self.session;
        let peer = self.peer(from, now).ok_or(Refusal::Stranger)?;
        peer.heard_at = now.steady;
        let mut events = Vec::new();
        let taken = match topic {
            Topic::Bulk | Topic::Small | Topic::Ack => peer.frame(&bytes, now, from, &mut events),
            Topic::Clock => peer.time(&bytes, own, now, from, &mut events),
            Topic::Books => peer.sheet(&bytes, now, from, &mut events),
        };
        self.events.append(&mut events);
        self.keep_within_bounds();
        taken
    }

    /// Has those forget of whom most is kept, if it is too much.
    fn keep_within_bounds(&mut self) {
        while self.kept() > MOST_KEPT * self.largest {
            let Some((name, peer)) = self.peers.iter_mut().max_by_key(|(_, peer)| peer.kept()) else {
                return;
            };
            if !peer.unplaced.is_empty() {
                self.events.push(peer.skip(0, name));
            } else if !peer.receiver.forget_largest() {
                return;
            }
        }
    }

    /// Something in a peer's name was not taken.
    fn refuse(&mut self, from: &Name, refusal: Refusal) {
        *self.total.entry(refusal).or_default() += 1;
        if self.refused.len() < MOST_PEERS || self.refused.contains_key(from) {
            let refused = self.refused.entry(from.clone()).or_default();
            *refused.entry(refusal).or_default() += 1;
        }
    }

    /// What goes out now; ask until there is nothing. Peers take turns.
    pub fn next(&mut self, now: Moment) -> Option<Outgoing> {
        let count = self.peers.len();
        for k in 0..count {
            let place = (self.turn + k) % count;
            let (name, peer) = self.peers.iter_mut().nth(place)?;
            if let Some((topic, bytes)) = peer.next(now, self.session) {
                self.turn = (place + 1) % count;
                let bytes = match &self.seal {
                    Some(seal) => seal.close(name, topic, &bytes, now.wall),
                    None => bytes,
                };
                return Some(Outgoing {
                    to: name.clone(),
                    topic,
                    bytes,
                });
            }
        }
        None
    }

    /// When [`Station::next`] should be asked again though nothing came in.
    pub fn wakes_at(&self) -> Option<Nanos> {
        let up = self.peers.values().filter(|peer| peer.is_up);
        up.flat_map(|peer| {
            let own = [peer.asks_at, peer.sheet_at];
            peer.sender.wakes_at().into_iter().chain(own)
        })
        .min()
    }

    /// What came in for the graph since the last call.
    pub fn take_events(&mut self, now: Moment) -> Vec<Event> {
        for (name, peer) in &mut self.peers {
            let mut news = News::default();
            peer.heard.settle(Some(now.steady), &mut news);
            note(&mut self.events, name, news);
            let words = peer.air.take().into_iter();
            self.events.extend(words.map(|word| Event::OnAir(name.clone(), word)));
        }
        std::mem::take(&mut self.events)
    }

    /// The last words about messages that have not come in.
    pub fn end(&mut self) -> Vec<Event> {
        for (name, peer) in &mut self.peers {
            let mut news = News::default();
            peer.heard.settle(None, &mut news);
            note(&mut self.events, name, news);
            peer.pass_all_over(name, &mut self.events);
        }
        std::mem::take(&mut self.events)
    }

    /// Has the next sheets go out now: nothing will be offered any more.
    pub fn close(&mut self, now: Moment) {
        for peer in self.peers.values_mut() {
            peer.sheet_at = now.steady;
        }
    }

    /// Bytes that wait or are on their way to peers that are there.
    pub fn held(&self) -> usize {
        let up = self.peers.values().filter(|peer| peer.is_up);
        up.map(|peer| peer.sender.held()).sum()
    }

    /// Bytes of peers' messages that are incomplete, or wait to be placed in time.
    pub fn kept(&self) -> usize {
        self.peers.values().map(Peer::kept).sum()
    }

    /// How far the time line of a peer lies from this agent's, now.
    pub fn clock_of(&self, peer: &str, now: Moment) -> Option<Estimate> {
        self.peers.get(peer)?.offset.estimate(now.log?)
    }

    /// What is known of all peers, and of those in whose names only what was refused came.
    pub fn reports(&self, now: Moment) -> Vec<Report> {
        let refused = |name: &Name| self.refused.get(name).cloned().unwrap_or_default();
        let peers = self.peers.iter().map(|(name, peer)| Report {
            peer: name.clone(),
            clock: self.clock_of(name, now),
            round_trip: peer.sender.window().round_trip(),
            rate: peer.sender.window().rate(),
            received: peer.receiver.counts(),
            refused: refused(name),
        });
        let unknown = self.refused.keys().filter(|name| !self.peers.contains_key(*name));
        let unknown = unknown.map(|name| Report {
            peer: name.clone(),
            clock: None,
            round_trip: None,
            rate: None,
            received: ReceiverCounts::default(),
            refused: refused(name),
        });
        peers.chain(unknown).collect()
    }

    /// What was not taken, in all names together.
    pub fn refused(&self) -> &Refusals {
        &self.total
    }

    /// A peer, known or new; `None` if there are too many. Who has gone longest ago makes room.
    fn peer(&mut self, name: &Name, now: Moment) -> Option<&mut Peer> {
        if !self.peers.contains_key(name) {
            if **name == *self.name || (self.peers.len() >= MOST_PEERS && !self.forget_who_has_gone()) {
                return None;
            }
            let peer = Peer {
                is_up: false,
                heard_at: now.steady,
                sender: Sender::new(self.settings.clone(), self.session),
                sent: Sent::default(),
                air: Air::default(),
                receiver: Receiver::new(self.largest),
                heard: Heard::new(name.clone(), self.name.clone()),
                session: 0,
                offset: Offset::default(),
                unplaced: Vec::new(),
                questions: 0,
                asked: None,
                asks_at: Nanos::MIN,
                sheet_at: Nanos::MIN,
                outgoing: VecDeque::new(),
            };
            self.peers.insert(name.clone(), peer);
        }
        self.peers.get_mut(name)
    }

    /// Forgets the peer that is not there and was heard longest ago; `false` if all are there.
    fn forget_who_has_gone(&mut self) -> bool {
        let gone = self.peers.iter().filter(|(_, peer)| !peer.is_up);
        let Some(name) = gone.min_by_key(|(_, peer)| peer.heard_at).map(|(name, _)| name.clone()) else {
            return false;
        };
        if let Some(mut peer) = self.peers.remove(&name) {
            let mut news = News::default();
            peer.heard.settle(None, &mut news);
            note(&mut self.events, &name, news);
            peer.pass_all_over(&name, &mut self.events);
        }
        true
    }
}

impl From<FrameError> for Refusal {
    fn from(_: FrameError) -> Self {
        Refusal::Malformed
    }
}
