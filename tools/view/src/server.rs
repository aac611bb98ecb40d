//! All clients.

use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use rustix::process::{getpriority_process, setpriority_process};

use crate::client;
use crate::ring::{Ring, Shown};

/// Connections at a time.
const MOST: usize = 32;
/// From one connection to the next: who asks a million times takes little of this machine.
const BETWEEN: Duration = Duration::from_millis(10);
/// By how much the priority (`nice`) of the server's threads is lower than that of the process.
const LOWER: i32 = 10;

/// Why nothing is served.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The address cannot be had.
    #[error("{at}: {reason}; {hint}")]
    Bind {
        /// Where.
        at: SocketAddr,
        /// What the system says.
        reason: io::Error,
        /// What to try.
        hint: &'static str,
    },
}

/// What all threads share.
pub struct Shared {
    pub ring: Arc<Ring>,
    pub page: fn(&str) -> String,
    /// Names of this machine.
    pub names: Vec<String>,
    connections: AtomicUsize,
    closed: AtomicBool,
}

/// Serves until it is dropped.
pub struct Server {
    address: SocketAddr,
    shared: Arc<Shared>,
}

impl Server {
    /// Serves a page at an address; `page` makes it for the host (name or number, and port) by which a browser knows this server.
    ///
    /// # Errors
    /// An address that is taken or not of this machine.
    pub fn start(at: SocketAddr, page: fn(&str) -> String) -> Result<Self, ServerError> {
        let failed = |reason: io::Error| ServerError::Bind {
            at,
            hint: match reason.kind() {
                io::ErrorKind::AddrInUse => {
                    "another program serves there: choose another port, or none to have a free one"
                }
                io::ErrorKind::PermissionDenied => "choose a port above 1023",
                io::ErrorKind::AddrNotAvailable => "choose an address of this machine, or 127.0.0.1",
                _ => "choose another address, as 127.0.0.1",
            },
            reason,
        };
        let listener = TcpListener::bind(at).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let shared = Arc::new(Shared {
            ring: Arc::default(),
            page,
            names: names(),
            connections: AtomicUsize::new(0),
            closed: AtomicBool::new(false),
        });
        let of_thread = shared.clone();
        let listening = std::thread::Builder::new().name("realo-view".into());
        listening.spawn(move || serve(&listener, &of_thread)).map_err(failed)?;
        Ok(Server { address, shared })
    }

    /// Where it serves.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The address for a browser on this machine.
    pub fn url(&self) -> String {
        format!("http://{}/", reachable(self.address))
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
        self.shared.closed.store(true, Ordering::SeqCst);
        self.shared.ring.close();
        // Wakes the thread that listens.
        let _ = TcpStream::connect_timeout(&reachable(self.address), Duration::from_millis(200));
    }
}

/// The address by which this machine reaches a server that listens at `address`.
fn reachable(address: SocketAddr) -> SocketAddr {
    let ip = match address.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => IpAddr::V4(Ipv4Addr::LOCALHOST),
        IpAddr::V6(ip) if ip.is_unspecified() => IpAddr::V6(Ipv6Addr::LOCALHOST),
        ip => ip,
    };
    SocketAddr::new(ip, address.port())
}

/// The names by which browsers know this machine.
fn names() -> Vec<String> {
    let own = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let own = own.trim();
    let of_network = format!("{own}.local");
    let all = ["localhost", own, &of_network];
    all.into_iter()
        .filter(|name| !name.is_empty())
        .map(String::from)
        .collect()
}

fn serve(listener: &TcpListener, shared: &Arc<Shared>) {
    // Threads that this one starts have its priority.
    let _ = getpriority_process(None).and_then(|own| setpriority_process(None, own + LOWER));
    for stream in listener.incoming() {
        if shared.closed.load(Ordering::SeqCst) {
            return;
        }
        if let Ok(stream) = stream {
            begin(stream, shared);
        }
        // Also where no file is left for a connection.
        std::thread::sleep(BETWEEN);
    }
}

/// Serves a connection on a thread of its own.
fn begin(stream: TcpStream, shared: &Arc<Shared>) {
    let others = shared.connections.fetch_add(1, Ordering::SeqCst);
    let place = Connection(shared.clone());
    if others >= MOST {
        return client::turn_away(stream);
    }
    // Where no thread can be had, the connection ends.
    let _ = std::thread::Builder::new().spawn(move || client::serve(stream, &place.0));
}

/// One of the connections that may be open at a time.
struct Connection(Arc<Shared>);

impl Drop for Connection {
    fn drop(&mut self) {
        self.0.connections.fetch_sub(1, Ordering::SeqCst);
    }
}
