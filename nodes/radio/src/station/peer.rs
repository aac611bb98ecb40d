//! What an agent knows of another one.

use std::collections::VecDeque;

use bytes::Bytes;
use realo_schemas::{Name, Nanos};

use super::air::Air;
use super::{Event, FIRST_QUESTIONS, MessageId, Moment, QUESTIONS, SHEETS, Topic, UNPLACED};
use crate::books::{Heard, News, Sent, Sheet};
use crate::offset::{Exchange, Offset, Said};
use crate::protocol::{Arrived, Frame, Receiver, Sender, is_bulk};
use crate::refusal::Refusal;

/// All that an agent keeps of a peer.
pub(super) struct Peer {
    pub is_up: bool,
    /// When it was last heard.
    pub heard_at: Nanos,
    pub sender: Sender,
    pub sent: Sent,
    pub air: Air,
    pub receiver: Receiver,
    pub heard: Heard,
    /// Its newest session that was heard of, 0 before: with each its time line may be another.
    pub session: u64,
    pub offset: Offset,
    /// What came since before the first answer about time.
    pub unplaced: Vec<Arrived>,
    pub questions: u32,
    /// The question that has no answer yet.
    pub asked: Option<Nanos>,
    pub asks_at: Nanos,
    pub sheet_at: Nanos,
    pub outgoing: VecDeque<(Topic, Bytes)>,
}

impl Peer {
    pub(super) fn frame(
        &mut self,
        bytes: &Bytes,
        now: Moment,
        name: &Name,
        events: &mut Vec<Event>,
    ) -> Result<(), Refusal> {
        match Frame::parse(bytes)? {
            Frame::Part(head, part) => {
                let received = self.receiver.take(&head, part, now.steady)?;
                self.is_of(head.session, now, name, events)?;
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
                    self.place(now.log, name, events);
                    let mut same = (0..self.unplaced.len()).filter(|place| self.unplaced[*place].kind == kind);
                    if let (Some(oldest), UNPLACED..) = (same.next(), same.count()) {
                        events.push(self.skip(oldest, name));
                    }
                }
            }
            Frame::Acknowledgement(ack) => {
                self.sender.acknowledged(&ack, now.steady);
                self.settle(now.steady);
            }
        }
        Ok(())
    }

    /// Something is of a session of the peer. One that begins may have another time line, which is asked for at once; what waited for
    /// that of the session before is skipped.
    fn is_of(&mut self, session: u64, now: Moment, name: &Name, events: &mut Vec<Event>) -> Result<(), Refusal> {
        if session < self.session {
            return Err(Refusal::Replayed);
        }
        if session > self.session {
            self.session = session;
            self.pass_all_over(name, events);
            (self.offset, self.asked) = (Offset::default(), None);
            (self.questions, self.asks_at) = (0, now.steady);
        }
        Ok(())
    }

    /// Gives what waited to be placed in time, once that is known.
    pub(super) fn place(&mut self, log: Option<Nanos>, name: &Name, events: &mut Vec<Event>) {
        if let Some(clock) = log.and_then(|log| self.offset.estimate(log)) {
            let placed = self.unplaced.drain(..);
            events.extend(placed.map(|message| Event::Arrived(name.clone(), message, clock)));
        }
    }

    pub(super) fn skip(&mut self, place: usize, name: &Name) -> Event {
        let message = self.unplaced.remove(place);
        Event::Skipped(name.clone(), MessageId::from(&message))
    }

    pub(super) fn pass_all_over(&mut self, name: &Name, events: &mut Vec<Event>) {
        let skipped = self.unplaced.drain(..);
        events.extend(skipped.map(|message| Event::Skipped(name.clone(), MessageId::from(&message))));
    }

    /// Bytes of messages that are kept.
    pub(super) fn kept(&self) -> usize {
        let unplaced = self.unplaced.iter().map(|message| message.bytes.len());
        self.receiver.held() + unplaced.sum::<usize>()
    }

    pub(super) fn sheet(
        &mut self,
        bytes: &[u8],
        now: Moment,
        name: &Name,
        events: &mut Vec<Event>,
    ) -> Result<(), Refusal> {
        let sheet: Sheet = serde_json::from_slice(bytes).map_err(|_| Refusal::Malformed)?;
        let mut news = News::default();
        let taken = self.heard.sheet(&sheet, now.steady, &mut news);
        note(events, name, news);
        taken
    }

    /// A question has its time and session, `[asked, session]`; an answer repeats the time, and has that of its sender and the sender's
    /// session, `[asked, answered, session]`, and what its machine says of its clock, `[…, line, error]`.
    pub(super) fn time(
        &mut self,
        bytes: &[u8],
        own: u64,
        now: Moment,
        name: &Name,
        events: &mut Vec<Event>,
    ) -> Result<(), Refusal> {
        let Some(log) = now.log else {
            return Ok(());
        };
        let (words, rest) = bytes.as_chunks();
        let words: Vec<Nanos> = words.iter().map(|word| Nanos::from_le_bytes(*word)).collect();
        match (&*words, rest) {
            ([asked, session], []) => {
                self.is_of(*session as u64, now, name, events)?;
                let said = now.said().map(|said| [said.line, said.error]);
                let answer = [*asked, log, own as Nanos].into_iter();
                let answer = answer.chain(said.into_iter().flatten());
                let answer: Vec<u8> = answer.flat_map(Nanos::to_le_bytes).collect();
                self.outgoing.push_back((Topic::Clock, answer.into()));
            }
            ([asked, answered, session, said @ ..], []) if matches!(said.len(), 0 | 2) => {
                // Who answers in a session that begins has heard the question in it.
                let is_open = self.asked.take_if(|open| *open == *asked).is_some();
                self.is_of(*session as u64, now, name, events)?;
                if is_open {
                    let said = said.as_array().map(|[line, error]| Said {
                        line: *line,
                        error: *error,
                    });
                    self.answered(*asked, *answered, said, log, now);
                    self.place(now.log, name, events);
                }
            }
            _ => return Err(Refusal::Malformed),
        }
        Ok(())
    }

    /// The answer went out where the question came in: no time between them counts.
    fn answered(&mut self, asked: Nanos, answered: Nanos, said: Option<Said>, log: Nanos, now: Moment) {
        self.offset.take(Exchange {
            asked,
            heard: answered,
            answered,
            known: log,
        });
        self.offset.said(log, now.said(), said);
    }

    /// Takes down what left the sender's hands.
    fn settle(&mut self, now: Nanos) {
        let reported = self.sender.take_reported();
        self.air.reported(&reported, self.sender.window().round_trip(), now);
        self.sent.reported(&reported);
    }

    pub(super) fn next(&mut self, now: Moment, session: u64) -> Option<(Topic, Bytes)> {
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
            let question = [log, session as Nanos].map(Nanos::to_le_bytes).concat();
            return Some((Topic::Clock, question.into()));
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
        self.air.looked(now.steady);
        let frame = self.sender.next(now.steady);
        self.settle(now.steady);
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

pub(super) fn note(events: &mut Vec<Event>, peer: &Name, news: News) {
    if news != News::default() {
        events.push(Event::Books(peer.clone(), news));
    }
}
