use std::collections::VecDeque;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll, Wake, Waker};
use std::thread::Thread;
use std::time::Duration;

use arrow::array::{Array, ArrayRef};
use dora_node_api::{Event, EventStream, StopCause};
use realo_clock::wall_now;
use realo_schemas::Nanos;

use super::marks::End;

/// Events that are taken from dora and wait to be looked into, at most.
const MOST: usize = 1024;
/// Bytes of theirs, at most; twice what a process asks of dora's shared memory.
const MOST_BYTES: usize = 64 << 20;

/// What a process hears from dora.
pub(super) enum Heard {
    /// A message on an input, with the wall time at which it was taken.
    Input(String, ArrayRef, Nanos),
    /// The last word on an input.
    End(String, Result<End, String>),
    /// The node behind an input has closed it.
    Closed(String),
    /// A node above died.
    Failed { node: String, reason: String },
    /// The user stopped the run.
    Stopped,
    /// dora had something to say.
    Trouble(String),
}

impl Heard {
    fn bytes(&self) -> usize {
        match self {
            Heard::Input(_, row, _) => row.to_data().get_slice_memory_size().unwrap_or(0),
            _ => 0,
        }
    }
}

/// Takes events from dora on the thread that waits for them: one more thread would cost a change of threads at every hop.
///
/// dora holds ten events of an input and drops the oldest in silence. What is there is taken before one is looked into:
/// a burst of clouds, each a few milliseconds to read, would cost poses that came meanwhile. What is taken is bounded
/// ([`MOST_BYTES`], [`MOST`]); beyond it dora drops, and the hops that are missing are counted.
pub(super) struct Inbox {
    events: EventStream,
    taken: VecDeque<Heard>,
    /// Of the messages in `taken`.
    bytes: usize,
    /// The stream has ended.
    over: bool,
    waker: Waker,
    wake: WakeHandle,
}

/// Ends another thread's wait.
#[derive(Clone)]
pub(super) struct WakeHandle(Arc<(Thread, AtomicBool)>);

impl WakeHandle {
    /// Lets [`Inbox::wait`] return at once.
    pub fn give(&self) {
        self.0.1.store(true, Ordering::Release);
        self.0.0.unpark();
    }

    fn taken(&self) -> bool {
        self.0.1.swap(false, Ordering::AcqRel)
    }
}

struct Unpark(Thread);

impl Wake for Unpark {
    fn wake(self: Arc<Self>) {
        self.0.unpark();
    }
}

impl Inbox {
    /// For the thread that calls this, and no other.
    pub fn new(events: EventStream) -> Self {
        let here = std::thread::current();
        Inbox {
            events,
            taken: VecDeque::new(),
            bytes: 0,
            over: false,
            waker: Waker::from(Arc::new(Unpark(here.clone()))),
            wake: WakeHandle(Arc::new((here, AtomicBool::new(false)))),
        }
    }

    /// What other threads end a wait with.
    pub fn wake(&self) -> WakeHandle {
        self.wake.clone()
    }

    /// The next event before wall time `until`; `None` when that time has come, or after a wake.
    pub fn wait(&mut self, until: Nanos) -> Option<Heard> {
        loop {
            if let Some(heard) = self.poll() {
                return Some(heard);
            }
            // Once the stream is closed, the time still has to pass for what is held.
            if self.wake.taken() {
                return None;
            }
            std::thread::park_timeout(left(until)?);
        }
    }

    /// An event that is there already.
    pub fn poll(&mut self) -> Option<Heard> {
        self.take();
        let heard = self.taken.pop_front()?;
        self.bytes -= heard.bytes();
        Some(heard)
    }

    /// How many events are there already.
    pub fn there(&mut self) -> usize {
        self.take();
        self.taken.len()
    }

    fn take(&mut self) {
        while !self.over && self.taken.len() < MOST && self.bytes < MOST_BYTES {
            match self.next() {
                Poll::Ready(Some(event)) => {
                    let heard = heard(event);
                    self.bytes += heard.as_ref().map_or(0, Heard::bytes);
                    match heard {
                        // What ends the process does not wait behind messages.
                        Some(heard @ (Heard::Failed { .. } | Heard::Stopped)) => self.taken.push_front(heard),
                        heard => self.taken.extend(heard),
                    }
                }
                Poll::Ready(None) => self.over = true,
                Poll::Pending => break,
            }
        }
    }

    /// The next event; where there is none yet, the waker is called when one comes.
    fn next(&mut self) -> Poll<Option<Event>> {
        pin!(self.events.recv_async()).poll(&mut Context::from_waker(&self.waker))
    }
}

/// Until a wall time; `None` once it has come.
fn left(until: Nanos) -> Option<Duration> {
    let left = u64::try_from(until.saturating_sub(wall_now()))
        .ok()
        .filter(|left| *left > 0)?;
    Some(Duration::from_nanos(left))
}

/// What matters to a process.
fn heard(event: Event) -> Option<Heard> {
    match event {
        Event::Input { id, data, metadata } => Some(match End::of(&metadata.parameters) {
            Some(end) => Heard::End(id.to_string(), end),
            None => Heard::Input(id.to_string(), data.into_inner(), wall_now()),
        }),
        Event::InputClosed { id } => Some(Heard::Closed(id.to_string())),
        Event::NodeFailed {
            source_node_id, error, ..
        } => Some(Heard::Failed {
            node: source_node_id.to_string(),
            reason: error,
        }),
        Event::Stop(StopCause::Manual) => Some(Heard::Stopped),
        Event::Error(error) => Some(Heard::Trouble(error)),
        _ => None,
    }
}
