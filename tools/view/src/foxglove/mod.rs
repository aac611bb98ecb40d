//! Channels of messages for viewers of Foxglove's WebSocket protocol, as Foxglove and Lichtblick.
//!
//! Its texts and opcodes: <https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md>. A viewer may ask for channels; nothing that
//! it says changes the run.

mod client;
mod feed;
mod talk;

use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use crate::listening::{Listening, Serve, ServerError, names};
use feed::Feed;

/// What all threads share.
struct Shared {
    feed: Arc<Feed>,
    /// Names of this machine.
    names: Vec<String>,
    /// A page was refused, and that was said.
    has_refused: AtomicBool,
}

impl Serve for Shared {
    fn serve(&self, stream: TcpStream) {
        client::serve(stream, self);
    }

    fn turn_away(&self, stream: TcpStream) {
        crate::client::turn_away(stream);
    }
}

/// Serves until it is dropped.
pub struct Foxglove {
    listening: Listening,
    feed: Arc<Feed>,
}

impl Foxglove {
    /// Serves at an address.
    ///
    /// # Errors
    /// An address that is taken or not of this machine.
    pub fn start(at: SocketAddr) -> Result<Self, ServerError> {
        let feed = Arc::new(Feed::default());
        let shared = Arc::new(Shared {
            feed: feed.clone(),
            names: names(),
            has_refused: AtomicBool::new(false),
        });
        let listening = Listening::start(at, shared)?;
        Ok(Foxglove { listening, feed })
    }

    /// Where it serves.
    pub fn address(&self) -> SocketAddr {
        self.listening.address()
    }

    /// The address for a viewer on this machine.
    pub fn url(&self) -> String {
        format!("ws://{}", self.listening.reachable())
    }

    /// Begins a new run: the channels of the one before go.
    pub fn open(&self, name: &str) -> Session {
        self.feed.open(name);
        Session(self.feed.clone())
    }
}

impl Drop for Foxglove {
    fn drop(&mut self) {
        self.feed.close();
    }
}

/// A run that is shown.
#[derive(Clone)]
pub struct Session(Arc<Feed>);

impl Session {
    /// A channel of CDR messages with a schema of ROS 2; `None` where there are too many.
    pub fn channel(&self, topic: &str, schema_name: &str, schema: &str) -> Option<u32> {
        self.0.channel(topic, schema_name, schema)
    }

    /// Shows a message of an agent; what belongs to an earlier run is shown to nobody. `time`: when it existed, ns. Who comes late gets
    /// the newest of each agent.
    pub fn send(&self, channel: u32, agent: &str, time: u64, payload: Vec<u8>) {
        self.0.send(channel, agent, time, payload.into());
    }
}
