//! Zenoh between agents: two sessions of one's own, and a thread that has the [`Station`] send and listen.
//!
//! Keys are `<site>/<from>/<topic>/<to>`, and `<site>/<agent>/live` is the liveliness token of an agent. Bulk has a session,
//! and so connections, of its own at the port behind that of everything else: what stands in its queues, and its closing, concern
//! nobody else.

mod shared;
mod turns;

use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;

use bytes::Bytes;
use realo_operator::Waker;
use realo_schemas::{Clock, Name, Nanos};
use zenoh::bytes::ZBytes;
use zenoh::pubsub::Subscriber;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Session, Wait};

use crate::protocol::Offer;
use crate::refusal::Refusals;
use crate::session::{NetworkError, Place, open, zenoh_error};
use crate::station::{Event, Outgoing, Report, Station, Topic};
use shared::Shared;
use turns::Loop;

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

    /// Says where the graph's time lies on that of [`wall_now`](crate::clock::wall_now).
    pub fn set_clock(&self, clock: Clock) {
        lock(&self.shared).clock = Some(clock);
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
