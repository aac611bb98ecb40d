//! The link as a relay of TCP on loopback, where there are no namespaces.
#![allow(unsafe_code)]

use std::io::{self, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::os::fd::AsRawFd;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex, mpsc};
use std::thread::{sleep, spawn};
use std::time::{Duration, Instant};

use crate::Link;
use crate::link::{Draws, Free, pass};

/// Bytes that are carried at once.
const PART: usize = 4096;
/// Parts that wait for their delay at most: beyond, the link is slower than it says.
const PARTS: usize = 4096;
/// What the relay's end of a connection takes before it is the link's turn, bytes: it adds to the queue.
const TAKEN: libc::c_int = 32 << 10;
/// Of Ethernet: loopback's own segments are as long as what the relay takes.
const SEGMENT: libc::c_int = 1448;
/// How often a state that nobody reports of is looked at.
const LOOK: Duration = Duration::from_millis(1);

/// Carries TCP connections with a link's rate, delay, jitter and queue; a cut holds what is on its way. It goes when this is
/// dropped, its connections when an end closes them.
///
/// What a stream cannot show is not there: nothing is lost, comes twice or overtakes, a full queue holds the sender up, connections
/// are made at once, and TCP's congestion control sees loopback. The rate counts what the streams carry, without headers.
pub struct Relay {
    over: Arc<AtomicBool>,
    addresses: Vec<SocketAddr>,
}

impl Relay {
    /// Carries what connects to the first address of each pair to the second; the first direction of the link is that from who
    /// connects to who listens.
    ///
    /// # Errors
    /// An address that is taken.
    pub fn start(link: Arc<Link>, ways: &[(SocketAddr, SocketAddr)]) -> io::Result<Relay> {
        let over = Arc::new(AtomicBool::new(false));
        let free = Arc::new(Mutex::new([Instant::now(); 2]));
        let mut relay = Relay {
            over: over.clone(),
            addresses: Vec::new(),
        };
        for (from, to) in ways {
            let listener =
                TcpListener::bind(from).map_err(|error| io::Error::new(error.kind(), format!("{from}: {error}")))?;
            relay.addresses.push(listener.local_addr()?);
            set(&listener, libc::SOL_SOCKET, libc::SO_RCVBUF, TAKEN)?;
            set(&listener, libc::IPPROTO_TCP, libc::TCP_MAXSEG, SEGMENT)?;
            listener.set_nonblocking(true)?;
            let (link, over, free, to) = (link.clone(), over.clone(), free.clone(), *to);
            spawn(move || {
                while !over.load(Relaxed) {
                    match listener.accept() {
                        Ok((near, _)) => {
                            let (link, free) = (link.clone(), free.clone());
                            spawn(move || {
                                // Who finds nobody tries again.
                                let _ = connect(&link, &free, near, to);
                            });
                        }
                        Err(_) => sleep(LOOK),
                    }
                }
            });
        }
        Ok(relay)
    }

    /// Where it listens, pair by pair: with the port that port 0 became.
    pub fn addresses(&self) -> &[SocketAddr] {
        &self.addresses
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.over.store(true, Relaxed);
    }
}

fn set(socket: &impl AsRawFd, level: libc::c_int, name: libc::c_int, value: libc::c_int) -> io::Result<()> {
    let length = size_of::<libc::c_int>() as libc::socklen_t;
    // SAFETY: the value is read while the call lasts, and as long as it says.
    match unsafe { libc::setsockopt(socket.as_raw_fd(), level, name, (&raw const value).cast(), length) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

fn connect(link: &Arc<Link>, free: &Arc<Free>, near: TcpStream, to: SocketAddr) -> io::Result<()> {
    while link.is_cut() {
        sleep(LOOK);
    }
    let far = TcpStream::connect(to)?;
    set(&far, libc::SOL_SOCKET, libc::SO_RCVBUF, TAKEN)?;
    near.set_nonblocking(false)?;
    for end in [&near, &far] {
        end.set_nodelay(true)?;
    }
    for (direction, from, to) in [(0, near.try_clone()?, far.try_clone()?), (1, far, near)] {
        let (link, free) = (link.clone(), free.clone());
        spawn(move || carry_one_way(&link, direction, from, to, &free));
    }
    Ok(())
}

fn carry_one_way(link: &Arc<Link>, direction: usize, mut from: TcpStream, to: TcpStream, free: &Free) {
    let (sender, leaving) = mpsc::sync_channel::<(Instant, Vec<u8>)>(PARTS);
    let (Ok(source), for_writer) = (from.try_clone(), link.clone()) else {
        return;
    };
    spawn(move || write(&for_writer, &source, to, leaving));
    let mut draws = Draws::of(direction);
    let (mut last, mut buffer) = (Instant::now(), [0; PART]);
    while let Some(length) = from.read(&mut buffer).ok().filter(|length| *length > 0) {
        let leaves = loop {
            if !link.is_cut()
                && let Some(leaves) = pass(link, direction, length, Instant::now(), free)
            {
                break leaves;
            }
            sleep(LOOK);
        };
        // Nothing overtakes.
        last = last.max(leaves + link.delay(&mut draws));
        link.carried(direction, length);
        if sender.send((last, buffer[..length].to_vec())).is_err() {
            return;
        }
    }
}

fn write(link: &Link, source: &TcpStream, mut to: TcpStream, leaving: mpsc::Receiver<(Instant, Vec<u8>)>) {
    for (at, part) in leaving {
        sleep(at.saturating_duration_since(Instant::now()));
        while link.is_cut() {
            sleep(LOOK);
        }
        if to.write_all(&part).is_err() {
            // Nobody reads any more: the source learns it too.
            let _ = source.shutdown(Shutdown::Both);
            return;
        }
    }
    let _ = to.shutdown(Shutdown::Write);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A relay, and the listener that it carries to.
    fn relay(link: &Arc<Link>) -> (Relay, TcpListener) {
        let any = "127.0.0.1:0".parse().unwrap();
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let relay = Relay::start(link.clone(), &[(any, listener.local_addr().unwrap())]).unwrap();
        (relay, listener)
    }

    /// A connection through a relay: the end that connected, and the other.
    fn joined(link: &Arc<Link>) -> (Relay, TcpStream, TcpStream) {
        let (relay, listener) = relay(link);
        let near = TcpStream::connect(relay.addresses()[0]).unwrap();
        let (far, _) = listener.accept().unwrap();
        near.set_nodelay(true).unwrap();
        far.set_nodelay(true).unwrap();
        (relay, near, far)
    }

    fn link(settings: &[(&str, f64)]) -> Arc<Link> {
        let link = Link::default();
        settings
            .iter()
            .for_each(|(what, value)| assert!(link.set(what, *value)));
        Arc::new(link)
    }

    #[test]
    fn a_byte_takes_the_delay_both_ways() {
        let link = link(&[("delay", 40.0)]);
        let (_relay, mut near, mut far) = joined(&link);
        let begun = Instant::now();
        near.write_all(b"x").unwrap();
        far.read_exact(&mut [0]).unwrap();
        let there = begun.elapsed();
        far.write_all(b"y").unwrap();
        near.read_exact(&mut [0]).unwrap();
        let back = begun.elapsed();
        assert!(
            there >= Duration::from_millis(40) && back >= Duration::from_millis(80),
            "{there:?}, {back:?}"
        );
        assert!(back < Duration::from_secs(5), "{back:?}");
        assert_eq!(link.counts().map(|counts| counts.bytes), [1, 1]);
    }

    #[test]
    fn bytes_take_as_long_as_the_rate_says_and_none_is_lost() {
        let link = link(&[("rate", 40.0), ("queue", 20.0)]);
        let (_relay, mut near, mut far) = joined(&link);
        let bytes: Vec<u8> = (0..500_000u32).map(|at| (at % 251) as u8).collect();
        let begun = Instant::now();
        let sent = bytes.clone();
        let sender = spawn(move || near.write_all(&sent).map(|()| near));
        let mut got = vec![0; bytes.len()];
        far.read_exact(&mut got).unwrap();
        let took = begun.elapsed();
        drop(sender.join().unwrap().unwrap());
        assert!(got == bytes);
        // 4,000,000 bits.
        assert!((100..5000).contains(&took.as_millis()), "{took:?}");
        assert_eq!(far.read(&mut [0]).unwrap(), 0, "the end of a stream crosses too");
    }

    #[test]
    fn connections_share_the_rate() {
        let (relay, listener) = relay(&link(&[("rate", 40.0)]));
        let begun = Instant::now();
        let carried = [0, 1].map(|_| {
            let mut near = TcpStream::connect(relay.addresses()[0]).unwrap();
            let (mut far, _) = listener.accept().unwrap();
            let sender = spawn(move || near.write_all(&[1; 250_000]).map(|()| near));
            spawn(move || (far.read_exact(&mut [0; 250_000]), sender.join()))
        });
        for one in carried {
            assert!(one.join().unwrap().0.is_ok());
        }
        // 4,000,000 bits in all.
        assert!(begun.elapsed() >= Duration::from_millis(100), "{:?}", begun.elapsed());
    }

    #[test]
    fn a_full_queue_holds_the_sender_up() {
        let link = link(&[("rate", 1.0), ("queue", 20.0)]);
        let (_relay, near, _far) = joined(&link);
        near.set_nonblocking(true).unwrap();
        // What buffers hold passes at once; a relay without a bound would take all.
        let (mut near, mut taken) = (near, 0);
        let begun = Instant::now();
        while begun.elapsed() < Duration::from_millis(500) {
            match near.write(&[0; 16384]) {
                Ok(length) => taken += length,
                Err(_) => sleep(LOOK),
            }
        }
        assert!(taken < 32 << 20, "{taken}");
        let carried = link.counts()[0].bytes;
        let most = 1e6 / 8.0 * (begun.elapsed().as_secs_f64() + 0.02) + 2.0 * PART as f64;
        assert!((carried as f64) <= most, "{carried} of {most}");
    }

    #[test]
    fn nothing_crosses_a_cut_and_all_of_it_afterwards() {
        let link = link(&[]);
        let (_relay, mut near, mut far) = joined(&link);
        near.write_all(b"a").unwrap();
        far.read_exact(&mut [0]).unwrap();
        link.set("cut", 1.0);
        near.write_all(b"b").unwrap();
        far.set_read_timeout(Some(Duration::from_millis(200))).unwrap();
        assert!(far.read(&mut [0]).is_err());
        link.set("cut", 0.0);
        far.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        let mut got = [0];
        far.read_exact(&mut got).unwrap();
        assert_eq!(&got, b"b");
    }

    #[test]
    fn an_end_that_goes_is_gone_for_the_other() {
        let (_relay, mut near, far) = joined(&link(&[]));
        drop(far);
        near.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        assert_eq!(near.read(&mut [0]).unwrap_or(0), 0);
    }
}
