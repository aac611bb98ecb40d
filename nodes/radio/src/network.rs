//! Zenoh between agents: two sessions of one's own, and a thread that has the [`Station`] send and listen.
//!
//! Keys are `<site>/<from>/<topic>/<to>`, and `<site>/<agent>/live` is the liveliness token of an agent. Bulk has a session,
//! and so connections, of its own at the port behind that of everything else: what stands in its queues, and its closing, concern
//! nobody else.

use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::Duration;

use bytes::Bytes;
use realo_operator::Waker;
use realo_schemas::{Name, Nanos};
use zenoh::bytes::ZBytes;
use zenoh::pubsub::Subscriber;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Session, Wait};

use crate::clock::{steady, wall, wall_error};
use crate::protocol::Offer;
use crate::refusal::Refusals;
use crate::session::{NetworkError, Place, open, zenoh_error};
use crate::station::{Event, Moment, Outgoing, Report, Station, Topic};

/// What has come in and the station has not seen yet; more is lost, as on the way.
const WAITING: usize = 4096;
/// Its bytes at most.
const WAITING_BYTES: usize = 32 << 20;
/// Events that wait for the graph; of more the oldest go.
const EVENTS: usize = 1024;
/// How long the thread sleeps at most.
const LOOK: Nanos = 100_000_000;
/// How long what is on its way is waited for at the end.
const LINGER: Nanos = 500_000_000;

/// What the thread hears.
enum Heard {
    Came(Name),
    Went(Name),
    Bytes(Name, Topic, Bytes),
    Offer(Offer),
    Stop,
}

/// What the graph's calls and the thread share.
#[derive(Default)]
struct Shared {
    /// A moment at which the graph's time was known.
    clock: Option<(Nanos, Nanos)>,
    events: Vec<Event>,
    reports: Vec<Report>,
    refused: Refusals,
    /// Messages that came while too many waited.
    overrun: u64,
    /// Bytes that have come in and the station has not seen yet.
    waiting_bytes: usize,
}

impl Shared {
    /// Whether there is room for what came in, which waits then.
    fn admits(&mut self, bytes: usize) -> bool {
        let is_admitted = self.waiting_bytes + bytes <= WAITING_BYTES;
        match is_admitted {
            true => self.waiting_bytes += bytes,
            false => self.overrun += 1,
        }
        is_admitted
    }
}

/// An agent on its network.
pub struct Network {
    shared: Arc<Mutex<Shared>>,
    heard: SyncSender<Heard>,
    thread: Option<JoinHandle<()>>,
}

/// What has come of the time since the last call.
pub struct Taken {
    /// Messages, and what became of others.
    pub events: Vec<Event>,
    /// What is known of all peers.
    pub reports: Vec<Report>,
    /// What was not taken.
    pub refused: Refusals,
    /// Messages that came while too many waited.
    pub overrun: u64,
}

impl Network {
    /// Joins the network.
    ///
    /// # Errors
    /// [`NetworkError`], for an address that cannot be had.
    pub fn join(place: &Place, station: Station, waker: Waker) -> Result<Network, NetworkError> {
        let (heard, hears) = sync_channel(WAITING);
        let shared = Arc::new(Mutex::new(Shared::default()));
        let urgent = open(place, 0)?;
        let bulk = open(place, 1)?;
        let subscribers = vec![
            listen(&urgent, place, "*", &heard, &shared)?,
            listen(&bulk, place, Topic::Bulk.as_str(), &heard, &shared)?,
        ];
        let live = watch(&urgent, place, &heard)?;
        let token = urgent
            .liveliness()
            .declare_token(format!("{}/{}/live", place.site, place.agent))
            .wait()
            .map_err(|error| zenoh_error("liveliness", &error))?;
        let posts = Posts::new(place, urgent, bulk);
        let thread = Loop {
            station,
            posts,
            hears,
            shared: shared.clone(),
            waker,
            report_at: Nanos::MIN,
            clock_error: place.clock_error,
            wall_error: None,
        };
        let thread = std::thread::spawn(move || {
            thread.run();
            drop((token, live, subscribers));
        });
        Ok(Network {
            shared,
            heard,
            thread: Some(thread),
        })
    }

    /// Has a message sent to all peers that are there.
    pub fn offer(&self, offer: Offer) -> bool {
        self.heard.try_send(Heard::Offer(offer)).is_ok()
    }

    /// Says what time it is in the graph.
    pub fn set_time(&self, log: Nanos) {
        lock(&self.shared).clock = Some((steady(), log));
    }

    /// What has come since the last call.
    pub fn take(&self) -> Taken {
        let mut shared = lock(&self.shared);
        Taken {
            events: std::mem::take(&mut shared.events),
            reports: shared.reports.clone(),
            refused: shared.refused.clone(),
            overrun: shared.overrun,
        }
    }

    /// Leaves, after what is on its way has arrived or a moment has passed.
    pub fn leave(&mut self) {
        // If it is full, the thread hears of the end when this end of the channel is dropped.
        let _ = self.heard.try_send(Heard::Stop);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn lock(shared: &Mutex<Shared>) -> MutexGuard<'_, Shared> {
    shared.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

/// Passes on what comes for this agent about a topic.
fn listen(
    session: &Session,
    place: &Place,
    topic: &str,
    heard: &SyncSender<Heard>,
    shared: &Arc<Mutex<Shared>>,
) -> Result<Subscriber<()>, NetworkError> {
    let key = format!("{}/*/{topic}/{}", place.site, place.agent);
    let (heard, shared) = (heard.clone(), shared.clone());
    let hear = move |sample: Sample| {
        let Some((from, topic)) = parts(sample.key_expr().as_str()) else {
            return;
        };
        let length = sample.payload().len();
        if !lock(&shared).admits(length) {
            return;
        }
        let bytes = Bytes::from(sample.payload().to_bytes().into_owned());
        if let Err(TrySendError::Full(_)) = heard.try_send(Heard::Bytes(from, topic, bytes)) {
            let mut shared = lock(&shared);
            shared.waiting_bytes -= length;
            shared.overrun += 1;
        }
    };
    session
        .declare_subscriber(&key)
        .callback(hear)
        .wait()
        .map_err(|error| zenoh_error(key, &error))
}

/// Passes on who comes and goes.
fn watch(session: &Session, place: &Place, heard: &SyncSender<Heard>) -> Result<Subscriber<()>, NetworkError> {
    let key = format!("{}/*/live", place.site);
    let (heard, me) = (heard.clone(), place.agent.clone());
    let see = move |sample: Sample| {
        let mut words = sample.key_expr().as_str().rsplit('/');
        let Some(name) = words.nth(1).filter(|name| **name != *me).map(Name::from) else {
            return;
        };
        let seen = match sample.kind() {
            SampleKind::Put => Heard::Came(name),
            SampleKind::Delete => Heard::Went(name),
        };
        // Rare, and must not be missed: zenoh may wait for the thread, which never waits for zenoh's.
        let _ = heard.send(seen);
    };
    session
        .liveliness()
        .declare_subscriber(&key)
        .history(true)
        .callback(see)
        .wait()
        .map_err(|error| zenoh_error(key, &error))
}

/// Sender and topic of a key `<site>/<from>/<topic>/<to>`; a site may have several parts.
fn parts(key: &str) -> Option<(Name, Topic)> {
    let mut words = key.rsplit('/');
    let (_, topic, from) = (words.next()?, words.next()?, words.next()?);
    let topic = Topic::ALL.into_iter().find(|known| known.as_str() == topic)?;
    Some((from.into(), topic))
}

/// What sends: urgent things at once, bulk on a thread that may have to wait.
struct Posts {
    prefix: String,
    urgent: Session,
    bulk: SyncSender<(String, Bytes)>,
}

impl Posts {
    fn new(place: &Place, urgent: Session, bulk: Session) -> Posts {
        let (sender, parts) = sync_channel::<(String, Bytes)>(WAITING);
        std::thread::spawn(move || {
            for (key, bytes) in parts {
                // What does not go out counts as lost on the way.
                let _ = bulk
                    .put(&key, ZBytes::from(bytes))
                    .priority(Priority::Data)
                    .congestion_control(CongestionControl::Block)
                    .express(true)
                    .wait();
            }
        });
        Posts {
            prefix: format!("{}/{}", place.site, place.agent),
            urgent,
            bulk: sender,
        }
    }

    fn send(&self, outgoing: Outgoing) {
        let key = format!("{}/{}/{}", self.prefix, outgoing.topic.as_str(), outgoing.to);
        if outgoing.topic == Topic::Bulk {
            let _ = self.bulk.try_send((key, outgoing.bytes));
            return;
        }
        let priority = match outgoing.topic {
            Topic::Books => Priority::InteractiveLow,
            _ => Priority::RealTime,
        };
        let _ = self
            .urgent
            .put(&key, ZBytes::from(outgoing.bytes))
            .priority(priority)
            .congestion_control(CongestionControl::Drop)
            .express(true)
            .wait();
    }
}

/// The thread.
struct Loop {
    station: Station,
    posts: Posts,
    hears: Receiver<Heard>,
    shared: Arc<Mutex<Shared>>,
    waker: Waker,
    /// When what is known of peers is told again though nothing came of them.
    report_at: Nanos,
    /// What the user says that the wall clock is off by at most.
    clock_error: Option<Nanos>,
    /// The same, or what the kernel said last.
    wall_error: Option<Nanos>,
}

impl Loop {
    fn run(mut self) {
        while self.turn() {}
        let until = steady() + LINGER;
        while self.station.held() > 0 && steady() < until && self.turn() {}
        let now = self.now();
        self.station.close(now);
        self.send();
        let last = self.station.end();
        self.pass(last);
        self.report();
    }

    /// Sends and listens once; `false` if it is to stop.
    fn turn(&mut self) -> bool {
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
        let wait = (wakes_at.saturating_sub(now.steady)).clamp(0, LOOK);
        let first = match self.hears.recv_timeout(Duration::from_nanos(wait as u64)) {
            Ok(first) => first,
            Err(RecvTimeoutError::Timeout) => return true,
            Err(RecvTimeoutError::Disconnected) => return false,
        };
        let mut goes_on = self.hear(first);
        while let Ok(next) = self.hears.try_recv() {
            goes_on &= self.hear(next);
        }
        goes_on
    }

    fn hear(&mut self, heard: Heard) -> bool {
        let now = self.now();
        match heard {
            Heard::Came(name) => self.station.up(&name, now),
            Heard::Went(name) => self.station.down(&name),
            Heard::Bytes(from, topic, bytes) => {
                lock(&self.shared).waiting_bytes -= bytes.len();
                self.station.take(&from, topic, &bytes, now);
            }
            Heard::Offer(offer) => self.station.offer(&offer),
            Heard::Stop => return false,
        }
        true
    }

    fn send(&mut self) {
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
        let mut shared = lock(&self.shared);
        shared.events.extend(events);
        let surplus = shared.events.len().saturating_sub(EVENTS);
        shared.overrun += shared.events.drain(..surplus).count() as u64;
        drop(shared);
        self.waker.wake();
    }

    fn report(&self) {
        let reports = self.station.reports(self.now());
        let mut shared = lock(&self.shared);
        (shared.reports, shared.refused) = (reports, self.station.refused().clone());
    }

    fn now(&self) -> Moment {
        let steady = steady();
        let clock = lock(&self.shared).clock;
        Moment {
            steady,
            log: clock.map(|(then, log)| log + (steady - then)),
            wall: wall(),
            wall_error: self.wall_error,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_is_dropped_before_it_fills_the_memory() {
        let mut shared = Shared::default();
        let frame = 128 << 10;
        let admitted = (0..WAITING).filter(|_| shared.admits(frame)).count();
        assert_eq!(admitted * frame, WAITING_BYTES);
        assert_eq!(shared.overrun as usize, WAITING - admitted);
        shared.waiting_bytes -= frame;
        assert!(shared.admits(frame) && !shared.admits(1));
    }
}
