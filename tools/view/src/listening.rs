//! Takes connections, within bounds.

use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use rustix::process::{getpriority_process, setpriority_process};

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

/// What is done with connections.
pub trait Serve: Send + Sync + 'static {
    /// Answers one, on a thread of its own.
    fn serve(&self, stream: TcpStream);

    /// Tells one that there are too many.
    fn turn_away(&self, stream: TcpStream);
}

/// Takes connections until it is dropped.
pub struct Listening {
    address: SocketAddr,
    closed: Arc<AtomicBool>,
}

impl Listening {
    /// Takes connections at an address.
    ///
    /// # Errors
    /// An address that is taken or not of this machine.
    pub fn start(at: SocketAddr, serve: Arc<impl Serve>) -> Result<Self, ServerError> {
        let failed = |reason: io::Error| ServerError::Bind {
            at,
            hint: match reason.kind() {
                io::ErrorKind::AddrInUse => "another program serves there: choose another port, or 0 for a free one",
                io::ErrorKind::PermissionDenied => "choose a port above 1023",
                io::ErrorKind::AddrNotAvailable => "choose an address of this machine, or 127.0.0.1",
                _ => "choose another address, as 127.0.0.1",
            },
            reason,
        };
        let listener = TcpListener::bind(at).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let closed = Arc::new(AtomicBool::new(false));
        let of_thread = closed.clone();
        let listening = std::thread::Builder::new().name("realo-view".into());
        listening
            .spawn(move || take_all(&listener, &serve, &of_thread))
            .map_err(failed)?;
        Ok(Listening { address, closed })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The address by which this machine reaches it.
    pub fn reachable(&self) -> SocketAddr {
        let ip = match self.address.ip() {
            IpAddr::V4(ip) if ip.is_unspecified() => IpAddr::V4(Ipv4Addr::LOCALHOST),
            IpAddr::V6(ip) if ip.is_unspecified() => IpAddr::V6(Ipv6Addr::LOCALHOST),
            ip => ip,
        };
        SocketAddr::new(ip, self.address.port())
    }
}

/// The addresses by which other machines may reach what listens at `at`. Where it listens on all interfaces, these are the address of this
/// machine towards others, and its name.
pub fn from_elsewhere(at: SocketAddr) -> Vec<String> {
    if !at.ip().is_unspecified() {
        return vec![at.to_string()];
    }
    let own = hostname().map(|name| format!("{name}:{}", at.port()));
    towards_others(at.ip())
        .map(|ip| SocketAddr::new(ip, at.port()).to_string())
        .into_iter()
        .chain(own)
        .collect()
}

/// The address of this machine towards others. Nothing is sent.
fn towards_others(of: IpAddr) -> Option<IpAddr> {
    // Addresses that documents use for examples.
    let far = match of {
        IpAddr::V4(_) => SocketAddr::from(([192, 0, 2, 1], 9)),
        IpAddr::V6(_) => SocketAddr::from(([0x2001, 0xdb8, 0, 0, 0, 0, 0, 1], 9)),
    };
    let socket = UdpSocket::bind((of, 0)).ok()?;
    socket.connect(far).ok()?;
    socket.local_addr().ok().map(|address| address.ip())
}

impl Drop for Listening {
    fn drop(&mut self) {
        self.closed.store(true, Ordering::SeqCst);
        // Wakes the thread that listens.
        let _ = TcpStream::connect_timeout(&self.reachable(), Duration::from_millis(200));
    }
}

/// The names by which browsers know this machine.
pub fn names() -> Vec<String> {
    let own = hostname().map(|own| [format!("{own}.local"), own]);
    std::iter::once("localhost".to_string())
        .chain(own.into_iter().flatten())
        .collect()
}

/// The name of this machine, if it has one.
fn hostname() -> Option<String> {
    let own = std::fs::read_to_string("/proc/sys/kernel/hostname").ok()?;
    Some(own.trim().to_string()).filter(|own| !own.is_empty())
}

fn take_all(listener: &TcpListener, serve: &Arc<impl Serve>, closed: &AtomicBool) {
    // Threads that this one starts have its priority.
    let _ = getpriority_process(None).and_then(|own| setpriority_process(None, own + LOWER));
    let connections = Arc::new(AtomicUsize::new(0));
    for stream in listener.incoming() {
        if closed.load(Ordering::SeqCst) {
            return;
        }
        if let Ok(stream) = stream {
            begin(stream, serve, &connections);
        }
        // Also where no file is left for a connection.
        std::thread::sleep(BETWEEN);
    }
}

/// Serves a connection on a thread of its own.
fn begin(stream: TcpStream, serve: &Arc<impl Serve>, connections: &Arc<AtomicUsize>) {
    let others = connections.fetch_add(1, Ordering::SeqCst);
    let place = Connection(connections.clone());
    if others >= MOST {
        return serve.turn_away(stream);
    }
    let serve = serve.clone();
    // Where no thread can be had, the connection ends.
    let _ = std::thread::Builder::new().spawn(move || {
        serve.serve(stream);
        drop(place);
    });
}

/// One of the connections that may be open at a time.
struct Connection(Arc<AtomicUsize>);

impl Drop for Connection {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::SeqCst);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn others_are_told_an_address_that_is_not_of_all_interfaces() {
        let at = |text: &str| text.parse::<SocketAddr>().unwrap();
        assert_eq!(from_elsewhere(at("10.1.2.3:80")), ["10.1.2.3:80"]);
        let all = from_elsewhere(at("0.0.0.0:8800"));
        assert!(
            all.iter()
                .all(|one| one.ends_with(":8800") && !one.starts_with("0.0.0.0")),
            "{all:?}"
        );
        assert_eq!(
            hostname().is_some_and(|own| all.contains(&format!("{own}:8800"))),
            hostname().is_some()
        );
    }
}
