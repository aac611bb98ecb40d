//! An agent among its peers: what goes out to each, and what came in, without socket or clock.

use std::collections::{BTreeMap, VecDeque};

use bytes::Bytes;
use realo_schemas::{Kind, Name, Nanos};

use crate::books::{Heard, News, Sent, Sheet};
use crate::offset::{Estimate, Exchange, Offset, Said};
use crate::protocol::{Arrived, Frame, FrameError, Offer, Receiver, ReceiverCounts, Sender, Settings, is_bulk};
use crate::refusal::{Refusal, Refusals};
use crate::seal::{SEAL_BYTES, Seal};

const MS: Nanos = 1_000_000;
/// Peers at most, so that strangers cannot take all memory.
pub const MOST_PEERS: usize = 64;
/// Bytes of a frame, a question or a sheet at most, with its seal.
pub const MOST_BYTES: usize = (128 << 10) + SEAL_BYTES;
/// Between two sheets of the books.
const SHEETS: Nanos = 500 * MS;
/// Between two questions for the peer's time, at first and later.
const QUESTIONS: [Nanos; 2] = [100 * MS, 500 * MS];
/// Questions at first.
const FIRST_QUESTIONS: u32 = 20;
/// Messages of a peer and a kind that are given to the graph at once, or wait for the first answer about time.
pub(crate) const AT_ONCE: usize = 4;

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
    /// A message of a peer is whole, and where the peer's time line lies is known, but at the end.
    Arrived(Name, Arrived),
    /// The same of a message that waited for that until too many newer ones of its kind did.
    PassedOver(Name, Arrived),
    /// What became of messages of a peer.
    Books(Name, News),
}

/// What is known of a peer.
#[derive(Clone, Debug, PartialEq)]
pub struct Report {
    /// Its name.
    pub peer: Name,
    /// How far its time line lies from this agent's.
    pub clock: Option<Estimate>,
    /// Least round trip of late of parts, ns.
    pub round_trip: Option<Nanos>,
    /// Bytes a second that the way to it carries, as far as it was used.
    pub rate: Option<f64>,
    /// What came in.
    pub received: ReceiverCounts,
    /// What came in its name and was not taken.
    pub refused: Refusals,
}

/// All that an agent keeps of a peer.
struct Peer {
    is_up: bool,
    sender: Sender,
    sent: Sent,
    receiver: Receiver,
    heard: Heard,
    /// Its newest session that was heard of: with each its time line may be another.
    session: Option<u64>,
    offset: Offset,
    /// What came since before the first answer about time.
    unplaced: Vec<Arrived>,
    questions: u32,
    /// The question that has no answer yet.
    asked: Option<Nanos>,
    asks_at: Nanos,
    sheet_at: Nanos,
    outgoing: VecDeque<(Topic, Bytes)>,
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
        match self.peer(name).filter(|_| is_trusted) {
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
            peer.sent.told(&peer.sender.take_told());
            peer.outgoing.clear();
        }
    }

    /// A message for all peers that are there.
    pub fn offer(&mut self, offer: &Offer) {
        for peer in self.peers.values_mut().filter(|peer| peer.is_up) {
            peer.sent.offered(offer.kind, offer.seq, offer.bytes.len());
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
        let peer = self.peer(from).ok_or(Refusal::Stranger)?;
        let mut events = Vec::new();
        let taken = match topic {
            Topic::Bulk | Topic::Small | Topic::Ack => peer.frame(&bytes, now, from, &mut events),
            Topic::Clock => peer.time(&bytes, now, from, &mut events),
            Topic::Books => peer.sheet(&bytes, now, from, &mut events),
        };
        self.events.append(&mut events);
        taken
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
        }
        std::mem::take(&mut self.events)
    }

    /// The last words about messages that have not come in.
    pub fn end(&mut self) -> Vec<Event> {
        for (name, peer) in &mut self.peers {
            let mut news = News::default();
            peer.heard.settle(None, &mut news);
            note(&mut self.events, name, news);
            peer.place(name, &mut self.events);
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

    /// A peer, known or new; `None` if there are too many.
    fn peer(&mut self, name: &Name) -> Option<&mut Peer> {
        if !self.peers.contains_key(name) {
            if self.peers.len() >= MOST_PEERS || **name == *self.name {
                return None;
            }
            let peer = Peer {
                is_up: false,
                sender: Sender::new(self.settings.clone(), self.session),
                sent: Sent::default(),
                receiver: Receiver::new(self.largest),
                heard: Heard::new(name.clone(), self.name.clone()),
                session: None,
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
}

impl From<FrameError> for Refusal {
    fn from(_: FrameError) -> Self {
        Refusal::Malformed
    }
}

impl Peer {
    fn frame(&mut self, bytes: &Bytes, now: Moment, name: &Name, events: &mut Vec<Event>) -> Result<(), Refusal> {
        match Frame::parse(bytes)? {
            Frame::Part(head, part) => {
                let received = self.receiver.take(&head, part, now.steady)?;
                self.is_of(head.session, now);
                if let Some(ack) = received.acknowledgement {
                    let bytes = Frame::Acknowledgement(ack).to_bytes();
                    self.outgoing.push_back((Topic::Ack, bytes));
                }
                if let Some(message) = received.message {
                    let mut news = News::default();
                    let (kind, seq, bytes) = (message.kind, message.seq, message.bytes.len());
                    self.heard.arrived(head.session, kind, seq, bytes, &mut news);
                    note(events, name, news);
                    self.unplaced.push(message);
                    match now.log.and_then(|log| self.offset.estimate(log)) {
                        Some(_) => self.place(name, events),
                        None => self.pass_over(kind, name, events),
                    }
                }
            }
            Frame::Acknowledgement(ack) => {
                self.sender.acknowledged(&ack, now.steady);
                self.sent.told(&self.sender.take_told());
            }
        }
        Ok(())
    }

    /// A session that begins may have another time line, which is asked for at once.
    fn is_of(&mut self, session: u64, now: Moment) {
        if self.session.replace(session).is_some_and(|known| known != session) {
            (self.offset, self.asked) = (Offset::default(), None);
            (self.questions, self.asks_at) = (0, now.steady);
        }
    }

    /// Gives what waited to be placed in time.
    fn place(&mut self, name: &Name, events: &mut Vec<Event>) {
        let placed = self.unplaced.drain(..);
        events.extend(placed.map(|message| Event::Arrived(name.clone(), message)));
    }

    /// Of a kind only the newest messages wait to be placed.
    fn pass_over(&mut self, kind: Kind, name: &Name, events: &mut Vec<Event>) {
        let mut places = (0..self.unplaced.len()).filter(|place| self.unplaced[*place].kind == kind);
        if let (Some(oldest), AT_ONCE..) = (places.next(), places.count()) {
            events.push(Event::PassedOver(name.clone(), self.unplaced.remove(oldest)));
        }
    }

    fn sheet(&mut self, bytes: &[u8], now: Moment, name: &Name, events: &mut Vec<Event>) -> Result<(), Refusal> {
        let sheet: Sheet = serde_json::from_slice(bytes).map_err(|_| Refusal::Malformed)?;
        let mut news = News::default();
        self.heard.sheet(&sheet, now.steady, &mut news);
        note(events, name, news);
        Ok(())
    }

    fn time(&mut self, bytes: &[u8], now: Moment, name: &Name, events: &mut Vec<Event>) -> Result<(), Refusal> {
        let Some(log) = now.log else {
            return Ok(());
        };
        let (words, rest) = bytes.as_chunks();
        let words: Vec<Nanos> = words.iter().map(|word| Nanos::from_le_bytes(*word)).collect();
        match (&*words, rest) {
            ([asked], []) => {
                let said = now.said().map(|said| [said.line, said.error]);
                let answer = [*asked, log].into_iter().chain(said.into_iter().flatten());
                let answer: Vec<u8> = answer.flat_map(Nanos::to_le_bytes).collect();
                self.outgoing.push_back((Topic::Clock, answer.into()));
            }
            ([asked, answered], []) => self.answered(*asked, *answered, None, log, now),
            ([asked, answered, line, error], []) => {
                let (line, error) = (*line, *error);
                self.answered(*asked, *answered, Some(Said { line, error }), log, now);
            }
            _ => return Err(Refusal::Malformed),
        }
        if self.offset.estimate(log).is_some() {
            self.place(name, events);
        }
        Ok(())
    }

    /// The answer went out where the question came in: no time between them counts.
    fn answered(&mut self, asked: Nanos, answered: Nanos, said: Option<Said>, log: Nanos, now: Moment) {
        if self.asked.take_if(|open| *open == asked).is_some() {
            self.offset.take(Exchange {
                asked,
                heard: answered,
                answered,
                known: log,
            });
            self.offset.said(log, now.said(), said);
        }
    }

    fn next(&mut self, now: Moment, session: u64) -> Option<(Topic, Bytes)> {
        if let Some(outgoing) = self.outgoing.pop_front() {
            return Some(outgoing);
        }
        if !self.is_up {
            return None;
        }
        if let (true, Some(log)) = (now.steady >= self.asks_at, now.log) {
            let [often, seldom] = QUESTIONS;
            self.questions = self.questions.saturating_add(1);
            self.asks_at = now.steady
                + if self.questions < FIRST_QUESTIONS {
                    often
                } else {
                    seldom
                };
            self.asked = Some(log);
            return Some((Topic::Clock, log.to_le_bytes().to_vec().into()));
        }
        if now.steady >= self.asks_at {
            self.asks_at = now.steady + QUESTIONS[0];
        }
        if now.steady >= self.sheet_at {
            self.sheet_at = now.steady + SHEETS;
            if let Some(sheet) = self.sent.sheet(session) {
                let bytes = serde_json::to_vec(&sheet).expect("a sheet has numbers and names only");
                return Some((Topic::Books, bytes.into()));
            }
        }
        let frame = self.sender.next(now.steady);
        self.sent.told(&self.sender.take_told());
        frame.map(|frame| {
            let topic = match &frame {
                Frame::Part(head, _) if is_bulk(head.kind) => Topic::Bulk,
                Frame::Part(..) => Topic::Small,
                Frame::Acknowledgement(_) => Topic::Ack,
            };
            (topic, frame.to_bytes())
        })
    }
}

fn note(events: &mut Vec<Event>, peer: &Name, news: News) {
    if news != News::default() {
        events.push(Event::Books(peer.clone(), news));
    }
}
