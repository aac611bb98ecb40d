//! The loop that listens and sends.

use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use realo_operator::Waker;
use realo_schemas::Nanos;

use super::shared::Shared;
use super::{AT_A_TIME, Heard, LINGER, LOOK, Posts, lock};
use crate::clock::{steady, wall, wall_error, wall_now};
use crate::station::{Event, Moment, Station};

/// The thread.
pub(super) struct Loop {
    pub station: Station,
    pub posts: Posts,
    pub hears: Receiver<Heard>,
    pub shared: Arc<Mutex<Shared>>,
    pub waker: Waker,
    /// When what is known of peers is reported again though nothing came of them.
    pub report_at: Nanos,
    /// What the user says that the wall clock is off by at most.
    pub clock_error: Option<Nanos>,
    /// The same, or what the kernel said last.
    pub wall_error: Option<Nanos>,
}

impl Loop {
    pub(super) fn run(mut self) {
        while !lock(&self.shared).is_over {
            self.turn(LOOK);
        }
        // What was offered before the end is still to be heard, and what goes out to arrive.
        let until = steady() + LINGER;
        while steady() < until && (self.turn(0) || self.station.held() > 0) {}
        let now = self.now();
        self.station.close(now);
        self.send();
        let last = self.station.end();
        self.pass(last);
        self.report();
    }

    /// Sends and listens once, for so long at most; whether something was heard.
    fn turn(&mut self, longest: Nanos) -> bool {
        self.send();
        let now = self.now();
        let events = self.station.take_events(now);
        self.pass(events);
        if now.steady >= self.report_at {
            self.wall_error = self.clock_error.or_else(wall_error);
            self.report();
            self.report_at = now.steady + LOOK;
        }
        let wakes_at = self.station.wakes_at().unwrap_or(Nanos::MAX);
        let wait = wakes_at.saturating_sub(now.steady).clamp(0, longest);
        let Ok(first) = self.hears.recv_timeout(Duration::from_nanos(wait as u64)) else {
            return false;
        };
        self.hear(first);
        for _ in 1..AT_A_TIME {
            let Ok(next) = self.hears.try_recv() else { break };
            self.hear(next);
        }
        true
    }

    pub(super) fn hear(&mut self, heard: Heard) {
        let now = self.now();
        match heard {
            Heard::Came(name) => self.station.up(&name, now),
            Heard::Went(name) => self.station.down(&name),
            Heard::Bytes(from, topic, bytes) => {
                lock(&self.shared).leaves(&from, bytes.len());
                self.station.take(&from, topic, &bytes, now);
            }
            Heard::Offer(offer) => self.station.offer(&offer),
        }
    }

    pub(super) fn send(&mut self) {
        loop {
            let now = self.now();
            let Some(outgoing) = self.station.next(now) else { return };
            self.posts.send(outgoing);
        }
    }

    /// Gives events to the graph.
    fn pass(&mut self, events: Vec<Event>) {
        if events.is_empty() {
            return;
        }
        self.report();
        lock(&self.shared).keep(events);
        self.waker.wake();
    }

    fn report(&self) {
        let reports = self.station.reports(self.now());
        let mut shared = lock(&self.shared);
        (shared.reports, shared.refused) = (reports, self.station.refused().clone());
    }

    fn now(&self) -> Moment {
        let clock = lock(&self.shared).clock;
        Moment {
            steady: steady(),
            log: clock.map(|clock| clock.log_at(wall_now())),
            wall: wall(),
            wall_error: self.wall_error,
        }
    }
}
