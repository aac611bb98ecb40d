//! Zenoh between agents: two sessions of one's own, and a thread that has the [`Station`] send and listen.
//!
//! Keys are `<site>/<from>/<topic>/<to>`, and `<site>/<agent>/live` is the liveliness token of an agent. Bulk has a session,
//! and so connections, of its own at the port behind that of everything else: what stands in its queues, and its closing, concern
//! nobody else.

use std::collections::BTreeMap;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
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
use crate::station::{Event, Moment, Outgoing, Passed, Report, Station, Topic};

/// What has come in and the station has not seen yet; more is lost, as on the way.
const WAITING: usize = 4096;
/// Its bytes at most.
const WAITING_BYTES: usize = 32 << 20;
/// What comes in one name takes so much of both at most, a half: the others are heard beside it.
const SHARE: usize = 2;
/// Messages that the thread reads before it sends and reports again.
const AT_A_TIME: usize = 64;
/// Events that wait for the graph; of more the oldest go.
const EVENTS: usize = 65_536;
/// Bytes of the messages among them; of more the oldest messages are skipped.
const EVENT_BYTES: usize = 64 << 20;
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
}

/// What the graph's calls and the thread share.
#[derive(Default)]
struct Shared {
    /// A moment at which the graph's time was known.
    clock: Option<(Nanos, Nanos)>,
    events: Vec<Event>,
    /// Bytes of the messages among the events.
    event_bytes: usize,
    reports: Vec<Report>,
    refused: Refusals,
    /// Messages that came while too many waited.
    overrun: u64,
    /// What has come in and the station has not seen yet, by the name in which it came: frames and bytes.
    waiting: BTreeMap<Name, (usize, usize)>,
    /// Bytes of all that waits so.
    waiting_bytes: usize,
    /// Nothing will be offered any more.
    is_over: bool,
}

impl Shared {
    /// Whether there is room for what came in somebody's name, which waits then.
    fn admits(&mut self, from: &Name, bytes: usize) -> bool {
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
    fn leaves(&mut self, from: &Name, bytes: usize) {
        if let Some((frames, own)) = self.waiting.get_mut(from) {
            (*frames, *own) = (*frames - 1, *own - bytes);
            self.waiting_bytes -= bytes;
            if *frames == 0 {
                self.waiting.remove(from);
            }
        }
    }

    /// Events wait for the graph, which may stand still.
    fn keep(&mut self, events: Vec<Event>) {
        let bytes = |event: &Event| match event {
            Event::Arrived(_, message, _) => message.bytes.len(),
            Event::PassedOver(..) | Event::Books(..) => 0,
        };
        self.event_bytes += events.iter().map(bytes).sum::<usize>();
        self.events.extend(events);
        let mut oldest = self.events.iter_mut();
        while self.event_bytes > EVENT_BYTES
            && let Some(event) = oldest.next()
        {
            self.event_bytes -= bytes(event);
            if let Event::Arrived(from, message, _) = event {
                *event = Event::PassedOver(from.clone(), Passed::from(&*message));
            }
        }
        let surplus = self.events.len().saturating_sub(EVENTS);
        for event in self.events.drain(..surplus) {
            self.event_bytes -= bytes(&event);
            self.overrun += 1;
        }
    }

    /// What waited for the graph.
    fn take_events(&mut self) -> Vec<Event> {
        self.event_bytes = 0;
        std::mem::take(&mut self.events)
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
            events: shared.take_events(),
            reports: shared.reports.clone(),
            refused: shared.refused.clone(),
            overrun: shared.overrun,
        }
    }

    /// Leaves, after what is on its way has arrived or a moment has passed.
    pub fn leave(&mut self) {
        lock(&self.shared).is_over = true;
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
        if !lock(&shared).admits(&from, length) {
            return;
        }
        let bytes = Bytes::from(sample.payload().to_bytes().into_owned());
        if let Err(TrySendError::Full(Heard::Bytes(from, ..))) = heard.try_send(Heard::Bytes(from, topic, bytes)) {
            let mut shared = lock(&shared);
            shared.leaves(&from, length);
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
    /// When what is known of peers is reported again though nothing came of them.
    report_at: Nanos,
    /// What the user says that the wall clock is off by at most.
    clock_error: Option<Nanos>,
    /// The same, or what the kernel said last.
    wall_error: Option<Nanos>,
}

impl Loop {
    fn run(mut self) {
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

    fn hear(&mut self, heard: Heard) {
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
        lock(&self.shared).keep(events);
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
    use realo_schemas::Kind;

    use super::*;
    use crate::offset::{Basis, Estimate};
    use crate::protocol::Arrived;

    #[test]
    fn a_flood_is_dropped_before_it_fills_the_memory_and_others_are_heard_beside_it() {
        let (mut shared, frame) = (Shared::default(), 128 << 10);
        let [loud, quiet, third] = ["loud", "quiet", "third"].map(Name::from);
        let admitted = (0..WAITING).filter(|_| shared.admits(&loud, frame)).count();
        assert_eq!(admitted * frame, WAITING_BYTES / SHARE);
        assert_eq!(shared.overrun as usize, WAITING - admitted);
        let admitted = (0..WAITING).filter(|_| shared.admits(&quiet, 1)).count();
        assert_eq!(admitted, WAITING / SHARE);
        shared.leaves(&loud, frame);
        assert!(shared.admits(&loud, frame) && !shared.admits(&loud, 1));
        let admitted = (0..WAITING).filter(|_| shared.admits(&third, frame)).count();
        assert!(admitted * frame < WAITING_BYTES / SHARE);
        (0..WAITING / SHARE).for_each(|_| shared.leaves(&quiet, 1));
        assert!(!shared.waiting.contains_key(&quiet));
    }

    #[test]
    fn a_graph_that_stands_still_is_reported_of_every_message_and_given_the_newest() {
        let mut shared = Shared::default();
        let bytes = Bytes::from(vec![0; EVENT_BYTES / 8]);
        for seq in 0..100 {
            let message = Arrived {
                kind: Kind::Points,
                seq,
                stamp: 0,
                bytes: bytes.clone(),
                took: 0,
            };
            shared.keep(vec![Event::Arrived("rsu1".into(), message, AT_ONCE)]);
        }
        let given = |event: &Event| matches!(event, Event::Arrived(..));
        assert_eq!((shared.events.len(), shared.overrun), (100, 0));
        assert!(shared.events[..92].iter().all(|event| !given(event)) && shared.events[92..].iter().all(given));
    }

    /// The clock of an agent of the same machine.
    const AT_ONCE: Estimate = Estimate {
        offset: 0,
        uncertainty: 0,
        bound: 0,
        drift: 0.0,
        basis: Basis::Exchanges,
    };
}
