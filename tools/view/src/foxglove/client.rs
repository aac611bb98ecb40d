//! One viewer.

use std::collections::BTreeSet;
use std::io;
use std::net::{IpAddr, Shutdown, TcpStream};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Instant;

use super::Shared;
use super::feed::{Feed, Message, Next, Place};
use super::talk::{Level, Talk, advertise, server_info, status, unadvertise};
use crate::client::{PING, TO_ANSWER, TO_READ, greet, refuse};
use crate::frames::{self, Kind, Reader, Received};
use crate::head::{self, Refusal, Request, is_name, name_of};

/// The protocol's names, of its versions that have all that is said here.
const PROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];
/// Largest text of a client, bytes.
const LARGEST: usize = 64 << 10;
/// Where Foxglove serves its own viewer.
const FOXGLOVE: &str = "foxglove.dev";

const MESSAGE_DATA: u8 = 1;
const TIME: u8 = 2;

const NO_VIEWER: Refusal = (
    "426 Upgrade Required",
    "This is no page: open this address, with ws:// before it, in Foxglove or Lichtblick, as a Foxglove WebSocket connection.",
);
const NO_PROTOCOL: Refusal = (
    "400 Bad Request",
    "Expected the WebSocket protocol foxglove.sdk.v1 or foxglove.websocket.v1 in Sec-WebSocket-Protocol.",
);
const STRANGER: Refusal = (
    "403 Forbidden",
    "This server answers viewers of this machine and of foxglove.dev. Serve the viewer on this machine, or use it as a program.",
);

/// Answers one connection.
pub fn serve(mut stream: TcpStream, shared: &Shared) {
    // What comes of a client that is gone concerns nobody.
    let _ = stream.set_write_timeout(Some(TO_READ));
    let Some(head) = head::read(&mut stream) else {
        return;
    };
    let _ = match asked(&head, &shared.names) {
        Ok((key, protocol)) => show(stream, &key, protocol, &shared.feed),
        Err(refusal) => {
            if refusal == STRANGER && !shared.has_refused.swap(true, Ordering::SeqCst) {
                eprintln!("realo: --foxglove: a page from elsewhere was refused: {}", STRANGER.1);
            }
            refuse(&mut stream, refusal)
        }
    };
}

/// The client's key and the protocol that it and this server speak.
fn asked(head: &str, here: &[String]) -> Result<(String, &'static str), Refusal> {
    let request = Request::read(head, here)?;
    if !request.upgrades()? {
        return Err(NO_VIEWER);
    }
    if let Some(origin) = request.origin()?
        && !is_viewer(origin, request.host, here)
    {
        return Err(STRANGER);
    }
    let mut spoken = request
        .protocols()
        .filter_map(|asked| PROTOCOLS.into_iter().find(|known| *known == asked));
    let protocol = spoken.next().ok_or(NO_PROTOCOL)?;
    Ok((request.key()?.into(), protocol))
}

/// Whether a page may look: one of this machine, one of Foxglove's own, or that of a program. Any other page that somebody has open in
/// the browser could read the run too.
fn is_viewer(origin: &str, host: &str, here: &[String]) -> bool {
    let (scheme, of) = origin.split_once("://").unwrap_or(("", ""));
    match scheme {
        // A page without an own origin, as within another.
        "" => false,
        "http" | "https" => {
            let Some(name) = name_of(of) else { return false };
            let is_loopback = name.parse().is_ok_and(|ip: IpAddr| ip.is_loopback());
            let is_foxglove = scheme == "https" && name.strip_suffix(FOXGLOVE).is_some_and(|rest| rest.ends_with('.'));
            is_loopback || is_name(name, here) || is_foxglove || Some(name) == name_of(host)
        }
        // Programs have `file` or schemes of their own.
        _ => true,
    }
}

/// What a client said, for the thread that sends.
#[derive(Default)]
struct Heard(Mutex<Talk>);

impl Heard {
    fn lock(&self) -> MutexGuard<'_, Talk> {
        self.0.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }
}

/// Shows messages to a client until it leaves.
fn show(mut stream: TcpStream, key: &str, protocol: &str, feed: &Arc<Feed>) -> io::Result<()> {
    stream.set_nodelay(true)?;
    greet(&mut stream, key, Some(protocol))?;
    let heard = Arc::new(Heard::default());
    let listening = listen(stream.try_clone()?, heard.clone(), feed.clone())?;
    let mut sender = Sender {
        stream: &mut stream,
        heard: &heard,
        feed,
        place: Place::default(),
        offered: BTreeSet::new(),
        time: None,
    };
    let shown = sender.send_all();
    // Ends the thread that listens.
    let _ = stream.shutdown(Shutdown::Both);
    let _ = listening.join();
    shown
}

fn listen(mut stream: TcpStream, heard: Arc<Heard>, feed: Arc<Feed>) -> io::Result<std::thread::JoinHandle<()>> {
    stream.set_read_timeout(Some(TO_ANSWER))?;
    std::thread::Builder::new().spawn(move || {
        let mut reader = Reader::new(LARGEST);
        while let Ok(Some(received)) = reader.read(&mut stream) {
            match received {
                Received::Ping(content) => heard.lock().ping = Some(content),
                Received::Text(text) => heard.lock().hear(&text, |channel| feed.has(channel)),
                Received::Binary => heard.lock().hear_bytes(),
                Received::Pong => continue,
            }
            feed.wake();
        }
        heard.lock().left = true;
        feed.wake();
    })
}

/// Sends to a client.
struct Sender<'a> {
    stream: &'a mut TcpStream,
    heard: &'a Heard,
    feed: &'a Feed,
    place: Place,
    /// Channels that the client knows.
    offered: BTreeSet<u32>,
    /// The newest time that the client knows, ns.
    time: Option<u64>,
}

impl Sender<'_> {
    fn send_all(&mut self) -> io::Result<()> {
        let mut pinged = Instant::now();
        loop {
            if !self.answer()? {
                return Ok(());
            }
            if pinged.elapsed() >= PING {
                frames::write(self.stream, Kind::Ping, b"")?;
                pinged = Instant::now();
            }
            match self.feed.next(&mut self.place, PING) {
                Next::Run(run) => {
                    let gone: Vec<u32> = std::mem::take(&mut self.offered).into_iter().collect();
                    self.heard.lock().forget();
                    self.time = None;
                    if !gone.is_empty() {
                        self.text(&unadvertise(&gone))?;
                    }
                    self.text(&server_info(&run))?;
                }
                Next::Channels(channels) => {
                    self.offered.extend(channels.iter().map(|channel| channel.id));
                    self.text(&advertise(&channels))?;
                }
                Next::Message(message) => self.message(&message)?,
                Next::Missed(count) => {
                    let words = format!("{count} messages were left out: this connection is slower than the run");
                    self.text(&status(Level::Warning, &words))?;
                }
                Next::Wait => {}
                // 1001: the server goes away.
                Next::Closed => return frames::write(self.stream, Kind::Close, &1001u16.to_be_bytes()),
            }
        }
    }

    /// Answers what the client said; whether it is still there.
    fn answer(&mut self) -> io::Result<bool> {
        let mut talk = self.heard.lock();
        let (ping, complaints, fresh, left) = (talk.ping.take(), talk.take_complaints(), talk.take_fresh(), talk.left);
        drop(talk);
        if let Some(content) = ping {
            frames::write(self.stream, Kind::Pong, &content)?;
        }
        for complaint in complaints {
            self.text(&complaint)?;
        }
        // Who comes late gets what is there.
        for channel in fresh {
            for message in self.feed.newest(channel, &self.place) {
                self.message(&message)?;
            }
        }
        Ok(!left)
    }

    fn text(&mut self, text: &str) -> io::Result<()> {
        frames::write(self.stream, Kind::Text, text.as_bytes())
    }

    /// Sends a message that was asked for, and before it the time, which never runs backwards.
    fn message(&mut self, message: &Message) -> io::Result<()> {
        let Some(subscription) = self.heard.lock().subscription(message.channel) else {
            return Ok(());
        };
        if self.time.is_none_or(|time| time < message.time) {
            self.time = Some(message.time);
            let time = message.time.to_le_bytes();
            frames::write_parts(self.stream, Kind::Binary, &[TIME], &time)?;
        }
        let mut begin = vec![MESSAGE_DATA];
        begin.extend(subscription.to_le_bytes());
        begin.extend(message.time.to_le_bytes());
        frames::write_parts(self.stream, Kind::Binary, &begin, &message.payload)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ask(more: &str) -> Result<(String, &'static str), Refusal> {
        let head = format!(
            "GET / HTTP/1.1\r\nHost: localhost:8765\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n\
             Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n{more}\r\n"
        );
        asked(&head, &["localhost".into(), "mine".into()])
    }

    #[test]
    fn the_first_protocol_that_both_speak_is_spoken() {
        let spoken = |list: &str| ask(&format!("Sec-WebSocket-Protocol: {list}\r\n")).map(|(_, protocol)| protocol);
        assert_eq!(spoken("foxglove.sdk.v1"), Ok("foxglove.sdk.v1"));
        assert_eq!(
            spoken("other, foxglove.websocket.v1,foxglove.sdk.v1"),
            Ok("foxglove.websocket.v1")
        );
        assert_eq!(
            spoken("x\r\nSec-WebSocket-Protocol: foxglove.sdk.v1"),
            Ok("foxglove.sdk.v1")
        );
        assert_eq!(spoken("foxglove.websocket.v2"), Err(NO_PROTOCOL));
        assert_eq!(ask(""), Err(NO_PROTOCOL));
        let page = "GET / HTTP/1.1\r\nHost: localhost:8765\r\n\r\n";
        assert_eq!(asked(page, &["localhost".into()]), Err(NO_VIEWER));
    }

    #[test]
    fn viewers_are_answered_and_other_pages_are_not() {
        let of = |origin: &str| {
            ask(&format!(
                "Origin: {origin}\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n"
            ))
            .is_ok()
        };
        for origin in [
            "http://localhost:8080",
            "http://127.0.0.1",
            "http://[::1]:8080",
            "http://mine:8080",
            "https://app.foxglove.dev",
            "file://",
            "foxglove://app",
        ] {
            assert!(of(origin), "{origin}");
        }
        for origin in [
            "null",
            "",
            "http://evil.example",
            "http://93.184.216.34",
            "https://evilfoxglove.dev",
            "http://app.foxglove.dev",
            "https://foxglove.dev.evil.example",
            "https://localhost.evil.example",
        ] {
            assert!(!of(origin), "{origin}");
        }
        // By the number of this machine, from a page that it serves.
        assert!(is_viewer("http://192.168.1.7:8080", "192.168.1.7:8765", &[]));
        assert!(!is_viewer("http://192.168.1.8:8080", "192.168.1.7:8765", &[]));
    }
}
