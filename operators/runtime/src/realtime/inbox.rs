use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::Duration;

use arrow::array::ArrayRef;
use dora_node_api::{Event, EventStream, StopCause};
use realo_schemas::Nanos;

use super::wall_now;

/// Events that may wait here; what dora holds beyond that it drops, and `hop` shows it.
const CAPACITY: usize = 4096;

/// What a node hears from dora.
pub(super) enum Heard {
    /// A message on an input, with the wall time of its arrival.
    Input(String, ArrayRef, Nanos),
    /// The node behind an input has closed it.
    Closed(String),
    /// A node above died.
    Failed { node: String, reason: String },
    /// The user stopped the run.
    Stopped,
    /// dora had something to say.
    Trouble(String),
}

/// Takes events from dora as they come, also while the stage computes.
pub(super) struct Inbox(Receiver<Heard>);

impl Inbox {
    pub fn start(mut events: EventStream) -> Self {
        let (sender, receiver) = sync_channel(CAPACITY);
        std::thread::spawn(move || {
            while let Some(event) = events.recv() {
                let heard = match event {
                    Event::Input { id, data, .. } => Heard::Input(id.to_string(), data.into_inner(), wall_now()),
                    Event::InputClosed { id } => Heard::Closed(id.to_string()),
                    Event::NodeFailed {
                        source_node_id, error, ..
                    } => Heard::Failed {
                        node: source_node_id.to_string(),
                        reason: error,
                    },
                    Event::Stop(StopCause::Manual) => Heard::Stopped,
                    Event::Error(error) => Heard::Trouble(error),
                    _ => continue,
                };
                if sender.send(heard).is_err() {
                    return;
                }
            }
        });
        Inbox(receiver)
    }

    /// The next event before wall time `until`; `None` when that time has come or nothing more can come.
    pub fn wait(&self, until: Nanos) -> Option<Heard> {
        let wait = Duration::from_nanos((until - wall_now()).max(0) as u64);
        match self.0.recv_timeout(wait) {
            Ok(heard) => Some(heard),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => {
                // The stream is closed; the time still has to pass for what is held.
                std::thread::sleep(Duration::from_nanos((until - wall_now()).max(0) as u64));
                None
            }
        }
    }

    /// An event that is there already.
    pub fn poll(&self) -> Option<Heard> {
        self.0.try_recv().ok()
    }
}
