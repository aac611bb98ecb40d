//! What somebody who watches a run sees of it: copies of some outputs, and what became of messages.
//!
//! **Invariant:** a tap holds up nothing. A message is shared, not copied; behind a lock that nobody holds for long there is
//! room for few, and what finds none is dropped. A thread of low priority thins clouds and gives all to whoever watches.
//! A graph does not know of it: no stage, message or account of a run differs.

mod gate;
mod remote;
mod thin;

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use realo_schemas::report::Fated;
use realo_schemas::{Message, Payload};
use rustix::process::{getpriority_process, setpriority_process};

use gate::Gate;
pub(crate) use remote::tap_of_this_process;
pub use remote::{Inlet, TAP_VARIABLE};

/// Sweeps that wait at most.
const MOST_CLOUDS: usize = 12;
/// Other things that wait at most.
const MOST_WAITING: usize = 512;
/// By how much the priority (`nice`) of the thread that gives is lower than that of the process.
const LOWER: i32 = 10;

/// One thing that is seen.
#[derive(Clone, Debug, PartialEq)]
pub enum Seen {
    /// A message of an output that was asked for, and the number of this output; of a sweep so many points that they can be drawn.
    Message(u32, Box<Message>),
    /// What became of messages that crossed links.
    Fates(Vec<Fated>),
}

impl Seen {
    fn is_cloud(&self) -> bool {
        matches!(self, Seen::Message(_, message) if matches!(message.payload, Payload::PointCloud(_)))
    }
}

/// Which sweeps are seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Sweeps {
    /// So many a second as one can look at, by the wall clock: in virtual time.
    ByClock,
    /// One of so many tenths of a second of the log's time, the same in all processes.
    OneOf(u32),
}

/// A tap on the outputs of stages. Clones share it.
#[derive(Clone)]
pub struct Tap(Arc<Shared>);

struct Shared {
    /// Stage and output.
    outputs: Vec<(String, String)>,
    waiting: Mutex<Waiting>,
    changed: Condvar,
}

struct Waiting {
    gate: Gate,
    seen: VecDeque<Seen>,
    /// What is being given.
    giving: bool,
    /// Nobody watches any more.
    closed: bool,
}

impl Tap {
    /// A tap on outputs (stage, output); `give` gets what is seen on a thread of its own, and says whether it wants more.
    ///
    /// # Errors
    /// A system without threads.
    pub fn new(
        outputs: Vec<(String, String)>,
        sweeps: Sweeps,
        mut give: impl FnMut(Seen) -> bool + Send + 'static,
    ) -> std::io::Result<Self> {
        let shared = Arc::new(Shared {
            outputs,
            waiting: Mutex::new(Waiting {
                gate: Gate::new(sweeps),
                seen: VecDeque::new(),
                giving: false,
                closed: false,
            }),
            changed: Condvar::new(),
        });
        let of_thread = shared.clone();
        std::thread::Builder::new().name("realo-tap".into()).spawn(move || {
            // Watching may wait, the graph may not. Where the system refuses, it only has the priority of the rest.
            let _ = getpriority_process(None).and_then(|own| setpriority_process(None, own + LOWER));
            of_thread.give_all(&mut give);
        })?;
        Ok(Tap(shared))
    }

    /// The number of an output of a stage among those that are seen, if it is one of them.
    pub fn wants(&self, stage: &str, output: &str) -> Option<u32> {
        let mut outputs = self.0.outputs.iter();
        let found = outputs.position(|(of, name)| of == stage && name == output)?;
        u32::try_from(found).ok()
    }

    /// Shows a message of the output with this number.
    pub fn see(&self, output: u32, message: &Message) {
        let mut waiting = self.0.lock();
        if !waiting.closed && waiting.gate.lets_through(message, Instant::now()) {
            waiting.put(Seen::Message(output, Box::new(message.clone())));
            self.0.changed.notify_all();
        }
    }

    /// Shows what became of messages.
    pub fn see_fates(&self, fates: &[Fated]) {
        if fates.is_empty() {
            return;
        }
        let mut waiting = self.0.lock();
        if !waiting.closed {
            waiting.put(Seen::Fates(fates.to_vec()));
            self.0.changed.notify_all();
        }
    }

    /// Waits until all that was seen is given, but not longer than this.
    pub fn flush(&self, patience: Duration) {
        let waiting = self.0.lock();
        let is_open = |waiting: &mut Waiting| !waiting.closed && (waiting.giving || !waiting.seen.is_empty());
        drop(self.0.changed.wait_timeout_while(waiting, patience, is_open));
    }

    /// Nothing more is seen.
    pub fn close(&self) {
        self.0.close();
    }
}

impl Waiting {
    /// Puts a thing behind the others; where there is no room, the oldest of its kind goes.
    fn put(&mut self, seen: Seen) {
        let is_cloud = seen.is_cloud();
        let of_kind = self.seen.iter().filter(|other| other.is_cloud() == is_cloud).count();
        if of_kind >= if is_cloud { MOST_CLOUDS } else { MOST_WAITING }
            && let Some(oldest) = self.seen.iter().position(|other| other.is_cloud() == is_cloud)
        {
            self.seen.remove(oldest);
        }
        self.seen.push_back(seen);
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    fn close(&self) {
        let mut waiting = self.lock();
        waiting.closed = true;
        waiting.seen.clear();
        self.changed.notify_all();
    }

    fn give_all(&self, give: &mut dyn FnMut(Seen) -> bool) {
        while let Some(seen) = self.take() {
            let wants_more = give(match seen {
                Seen::Message(output, message) => Seen::Message(output, Box::new(thin::thinned(*message))),
                other => other,
            });
            if !wants_more {
                self.close();
            }
        }
    }

    fn take(&self) -> Option<Seen> {
        let mut waiting = self.lock();
        waiting.giving = false;
        loop {
            self.changed.notify_all();
            if waiting.closed {
                return None;
            }
            if let Some(seen) = waiting.seen.pop_front() {
                waiting.giving = true;
                return Some(seen);
            }
            waiting = self
                .changed
                .wait(waiting)
                .unwrap_or_else(|poisoned| poisoned.into_inner());
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;

    use realo_schemas::{Boxes, Header, Kind, Nanos, PointCloud};

    use super::*;

    fn message(kind: Kind, stamp: Nanos, payload: impl Into<Payload>) -> Message {
        let header = Header::origin(&"run".into(), &"cav1".into(), kind, stamp as u64, stamp, stamp);
        Message::new(header, payload)
    }

    #[test]
    fn who_watches_gets_what_is_wanted_and_then_no_more() {
        let (sender, given) = channel();
        let outputs = vec![("fusion.nms".to_string(), "boxes".to_string())];
        let tap = Tap::new(outputs, Sweeps::OneOf(1), move |seen| {
            sender.send(seen).unwrap();
            false
        })
        .unwrap();
        assert_eq!(
            (tap.wants("fusion.nms", "boxes"), tap.wants("ego.nms", "boxes")),
            (Some(0), None)
        );
        let boxes = message(Kind::Boxes, 7, Boxes::default());
        tap.see(0, &boxes);
        tap.flush(Duration::from_secs(60));
        assert_eq!(given.recv().unwrap(), Seen::Message(0, Box::new(boxes.clone())));
        tap.see(0, &boxes);
        tap.see_fates(&[]);
        assert!(given.recv().is_err(), "it wanted no more");
    }

    #[test]
    fn nobody_waits_for_who_watches_and_memory_is_bounded() {
        let (let_go, held) = channel::<()>();
        let tap = Tap::new(Vec::new(), Sweeps::OneOf(1), move |_| held.recv().is_ok()).unwrap();
        for at in 0..10_000 {
            tap.see(0, &message(Kind::Boxes, at, Boxes::default()));
            tap.see(1, &message(Kind::Points, at, PointCloud::empty()));
        }
        let waiting = tap.0.lock();
        let clouds = waiting.seen.iter().filter(|seen| seen.is_cloud()).count();
        assert_eq!((clouds, waiting.seen.len()), (MOST_CLOUDS, MOST_CLOUDS + MOST_WAITING));
        let Some(Seen::Message(1, newest)) = waiting.seen.back() else {
            panic!("a message is the newest");
        };
        assert_eq!(newest.header.stamp, 9_999);
        drop(waiting);
        drop(let_go);
    }
}
