//! A bulk message on its way, part by part.

use bytes::Bytes;
use realo_schemas::Nanos;

use super::frame::{Acknowledgement, Frame, Head};
use super::sender::Offer;

/// Parts that go out, to see what the way carries, before the others of their message may.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Trial {
    /// How many of the first parts.
    pub parts: u32,
    /// When the last of them were let go.
    pub since: Nanos,
}

/// A message that has begun to cross.
#[derive(Debug)]
pub(super) struct Transfer {
    pub offer: Offer,
    /// Bytes of each part but the last.
    part: usize,
    /// The next part that has not gone out yet.
    next: u32,
    /// Parts that went out and are taken for lost.
    again: Vec<u32>,
    /// By part: whether it is acknowledged.
    arrived: Vec<bool>,
    /// While it is not known whether the message arrives in time.
    pub trial: Option<Trial>,
}

impl Transfer {
    pub fn new(offer: Offer, part: usize, trial: Option<Trial>) -> Self {
        let count = offer.bytes.len().div_ceil(part).max(1);
        Transfer {
            offer,
            part,
            next: 0,
            again: Vec::new(),
            arrived: vec![false; count],
            trial,
        }
    }

    /// Bytes of a part; the last one may have fewer.
    pub fn part(&self) -> usize {
        self.part
    }

    pub fn count(&self) -> u32 {
        self.arrived.len() as u32
    }

    /// The part that goes out next; `None` if all are on the way, or a trial is.
    pub fn due(&self) -> Option<u32> {
        let fresh =
            (self.next < self.trial.map_or(u32::MAX, |trial| trial.parts).min(self.count())).then_some(self.next);
        self.again.last().copied().or(fresh)
    }

    /// A part goes out.
    pub fn take(&mut self, index: u32) {
        match self.again.last() == Some(&index) {
            true => drop(self.again.pop()),
            false => self.next = self.next.max(index + 1),
        }
    }

    /// The frame of a part.
    pub fn frame(&self, index: u32, waits: bool, session: u64, now: Nanos) -> Frame {
        let head = Head {
            kind: self.offer.kind,
            asks: true,
            waits,
            session,
            seq: self.offer.seq,
            index,
            count: self.count(),
            sent: now,
            stamp: self.offer.stamp,
        };
        Frame::Part(head, self.bytes(index))
    }

    pub fn bytes(&self, index: u32) -> Bytes {
        let start = index as usize * self.part;
        self.offer
            .bytes
            .slice(start..(start + self.part).min(self.offer.bytes.len()))
    }

    /// A part is taken for lost and will go out again.
    pub fn repeat(&mut self, index: u32) {
        if !self.arrived[index as usize] && !self.again.contains(&index) {
            self.again.push(index);
        }
    }

    pub fn is_of(&self, ack: &Acknowledgement) -> bool {
        (self.offer.kind, self.offer.seq) == (ack.kind, ack.seq)
    }

    pub fn arrived(&mut self, index: u32) {
        if let Some(arrived) = self.arrived.get_mut(index as usize) {
            *arrived = true;
            self.again.retain(|lost| *lost != index);
        }
    }

    pub fn is_complete(&self) -> bool {
        self.arrived.iter().all(|arrived| *arrived)
    }

    /// Bytes that have still to go out.
    pub fn remaining(&self) -> usize {
        let fresh = self.offer.bytes.len().saturating_sub(self.next as usize * self.part);
        fresh + self.again.iter().map(|index| self.bytes(*index).len()).sum::<usize>()
    }
}
