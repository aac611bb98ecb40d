//! The page's server.

use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;

use crate::client;
use crate::listening::{Listening, Serve, ServerError, names};
use crate::ring::{Ring, Shown};

/// What all threads share.
pub struct Shared {
    pub ring: Arc<Ring>,
    pub page: fn(&str) -> String,
    /// Names of this machine.
    pub names: Vec<String>,
}

impl Serve for Shared {
    fn serve(&self, stream: TcpStream) {
        client::serve(stream, self);
    }

    fn turn_away(&self, stream: TcpStream) {
        client::turn_away(stream);
    }
}

/// Serves until it is dropped.
pub struct Server {
    listening: Listening,
    shared: Arc<Shared>,
}

impl Server {
    /// Serves a page at an address; `page` makes it for the host (name or number, and port) by which a browser knows this server.
    ///
    /// # Errors
    /// An address that is taken or not of this machine.
    pub fn start(at: SocketAddr, page: fn(&str) -> String) -> Result<Self, ServerError> {
        let shared = Arc::new(Shared {
            ring: Arc::default(),
            page,
            names: names(),
        });
        let listening = Listening::start(at, shared.clone())?;
        Ok(Server { listening, shared })
    }

    /// Where it serves.
    pub fn address(&self) -> SocketAddr {
        self.listening.address()
    }

    /// The address for a browser on this machine.
    pub fn url(&self) -> String {
        format!("http://{}/", self.listening.reachable())
    }

    /// Begins a new scene: what was shown before goes.
    pub fn open(&self, opening: &str) {
        self.shared.ring.open(Shown::Text(opening.into()));
    }

    /// Shows a picture.
    pub fn picture(&self, bytes: Vec<u8>) {
        self.shared.ring.push(Shown::Picture(bytes.into()));
    }

    /// Says something about pictures.
    pub fn say(&self, text: &str) {
        self.shared.ring.push(Shown::Text(text.into()));
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.shared.ring.close();
    }
}
