//! What the loop and its owner share.

use std::collections::BTreeMap;

use realo_schemas::{Clock, Name};

use super::{EVENT_BYTES, EVENTS, SHARE, WAITING, WAITING_BYTES};
use crate::refusal::Refusals;
use crate::station::{Event, MessageId, Report};

/// What the graph's calls and the thread share.
#[derive(Default)]
pub(super) struct Shared {
    /// Where the graph's time lies, once that is known.
    pub clock: Option<Clock>,
    pub events: Vec<Event>,
    /// Bytes of the messages among the events.
    event_bytes: usize,
    pub reports: Vec<Report>,
    pub refused: Refusals,
    /// Messages that came while too many waited.
    pub overrun: u64,
    /// What has come in and the station has not seen yet, by the name in which it came: frames and bytes.
    pub waiting: BTreeMap<Name, (usize, usize)>,
    /// Bytes of all that waits so.
    waiting_bytes: usize,
    /// Nothing will be offered any more.
    pub is_over: bool,
}

impl Shared {
    /// Whether there is room for what came in somebody's name, which waits then.
    pub(super) fn admits(&mut self, from: &Name, bytes: usize) -> bool {
        let (frames, own) = self.waiting.get(from).copied().unwrap_or_default();
        let has_room = self.waiting_bytes + bytes <= WAITING_BYTES;
        let has_share = own + bytes <= WAITING_BYTES / SHARE && frames < WAITING / SHARE;
        if has_room && has_share {
            self.waiting.insert(from.clone(), (frames + 1, own + bytes));
            self.waiting_bytes += bytes;
        } else {
            self.overrun += 1;
        }
        has_room && has_share
    }

    /// What waited is heard, or does not wait any more.
    pub(super) fn leaves(&mut self, from: &Name, bytes: usize) {
        if let Some((frames, own)) = self.waiting.get_mut(from) {
            (*frames, *own) = (*frames - 1, *own - bytes);
            self.waiting_bytes -= bytes;
            if *frames == 0 {
                self.waiting.remove(from);
            }
        }
    }

    /// Events wait for the graph, which may stand still.
    pub(super) fn keep(&mut self, events: Vec<Event>) {
        let bytes = |event: &Event| match event {
            Event::Arrived(_, message, _) => message.bytes.len(),
            Event::Skipped(..) | Event::Books(..) | Event::OnAir(..) => 0,
        };
        self.event_bytes += events.iter().map(bytes).sum::<usize>();
        self.events.extend(events);
        let mut oldest = self.events.iter_mut();
        while self.event_bytes > EVENT_BYTES
            && let Some(event) = oldest.next()
        {
            self.event_bytes -= bytes(event);
            if let Event::Arrived(from, message, _) = event {
                *event = Event::Skipped(from.clone(), MessageId::from(&*message));
            }
        }
        let surplus = self.events.len().saturating_sub(EVENTS);
        for event in self.events.drain(..surplus) {
            self.event_bytes -= bytes(&event);
            self.overrun += 1;
        }
    }

    /// What waited for the graph.
    pub(super) fn take_events(&mut self) -> Vec<Event> {
        self.event_bytes = 0;
        std::mem::take(&mut self.events)
    }
}
