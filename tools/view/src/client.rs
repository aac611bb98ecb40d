//! One browser.

use std::io::{self, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::frames::{self, Kind, Received};
use crate::head::{self, Asked, Refusal};
use crate::ring::{Next, Place, Ring, Shown};
use crate::server::Shared;

/// A client that takes nothing for so long is gone.
pub const TO_READ: Duration = Duration::from_secs(5);
/// A client is asked so often whether it is there.
pub const PING: Duration = Duration::from_secs(2);
/// A client that says nothing for so long, though it is asked, is gone.
pub const TO_ANSWER: Duration = Duration::from_secs(20);

/// Answers one connection.
pub fn serve(mut stream: TcpStream, shared: &Shared) {
    // What comes of a client that is gone concerns nobody.
    let _ = stream.set_write_timeout(Some(TO_READ));
    let Some(head) = head::read(&mut stream) else {
        return;
    };
    let _ = match head::asked(&head, &shared.names) {
        Ok(Asked::Page(host)) => answer(&mut stream, "200 OK", "text/html; charset=utf-8", &(shared.page)(&host)),
        Ok(Asked::Pictures(key)) => show(stream, &key, shared),
        Err(refusal) => refuse(&mut stream, refusal),
    };
}

/// Tells a client that it is one too many.
pub fn turn_away(mut stream: TcpStream) {
    let _ = stream.set_write_timeout(Some(Duration::from_millis(100)));
    let _ = refuse(
        &mut stream,
        (
            "503 Service Unavailable",
            "As many browsers as may look do so already: close one.",
        ),
    );
}

pub fn refuse(stream: &mut TcpStream, (status, words): Refusal) -> io::Result<()> {
    answer(stream, status, "text/plain; charset=utf-8", &format!("{words}\n"))
}

fn answer(stream: &mut TcpStream, status: &str, kind: &str, body: &str) -> io::Result<()> {
    let length = body.len();
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\nConnection: close\r\nCache-Control: no-store\r\n\
         X-Content-Type-Options: nosniff\r\nX-Frame-Options: DENY\r\nCross-Origin-Resource-Policy: same-origin\r\n\
         Cross-Origin-Opener-Policy: same-origin\r\nReferrer-Policy: no-referrer\r\n\r\n"
    );
    stream.write_all(head.as_bytes())?;
    stream.write_all(body.as_bytes())?;
    stream.shutdown(Shutdown::Write)
}

/// Ends the handshake: what follows is WebSocket, and of the protocol that both speak.
pub fn greet(stream: &mut TcpStream, key: &str, protocol: Option<&str>) -> io::Result<()> {
    let accepted = frames::accept(key);
    let protocol = protocol.map(|protocol| format!("Sec-WebSocket-Protocol: {protocol}\r\n"));
    let head = format!(
        "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: {accepted}\r\n{}\r\n",
        protocol.unwrap_or_default()
    );
    stream.write_all(head.as_bytes())
}

/// Shows pictures to a client until it leaves.
fn show(mut stream: TcpStream, key: &str, shared: &Shared) -> io::Result<()> {
    stream.set_nodelay(true)?;
    greet(&mut stream, key, None)?;
    let heard = Arc::new(Heard::default());
    let listening = listen(stream.try_clone()?, heard.clone(), shared.ring.clone())?;
    let shown = send_all(&mut stream, &heard, &shared.ring);
    // Ends the thread that listens.
    let _ = stream.shutdown(Shutdown::Both);
    let _ = listening.join();
    shown
}

/// What a client has said since the last look.
#[derive(Default)]
struct Heard(Mutex<(Option<Vec<u8>>, bool)>);

impl Heard {
    /// The newest question whether somebody is there, and whether the client has left.
    fn take(&self) -> (Option<Vec<u8>>, bool) {
        let mut heard = self.0.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        (heard.0.take(), heard.1)
    }

    fn set(&self, ping: Option<Vec<u8>>, left: bool) {
        let mut heard = self.0.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        heard.0 = ping.or(heard.0.take());
        heard.1 |= left;
    }
}

fn listen(mut stream: TcpStream, heard: Arc<Heard>, ring: Arc<Ring>) -> io::Result<std::thread::JoinHandle<()>> {
    stream.set_read_timeout(Some(TO_ANSWER))?;
    std::thread::Builder::new().spawn(move || {
        while let Ok(Some(received)) = frames::read(&mut stream) {
            if let Received::Ping(content) = received {
                heard.set(Some(content), false);
            }
        }
        heard.set(None, true);
        ring.wake();
    })
}

fn send_all(stream: &mut TcpStream, heard: &Heard, ring: &Ring) -> io::Result<()> {
    let (mut place, mut pinged) = (Place::default(), Instant::now());
    loop {
        let next = ring.next(&mut place, PING);
        // Also where a picture follows the other: who only looks says nothing unasked.
        if pinged.elapsed() >= PING {
            frames::write(stream, Kind::Ping, b"")?;
            pinged = Instant::now();
        }
        let (ping, left) = heard.take();
        if let Some(content) = ping {
            frames::write(stream, Kind::Pong, &content)?;
        }
        if left {
            return Ok(());
        }
        match next {
            Next::Shown(Shown::Text(text)) => frames::write(stream, Kind::Text, text.as_bytes())?,
            Next::Shown(Shown::Picture(bytes)) => frames::write(stream, Kind::Binary, &bytes)?,
            Next::Wait => {}
            // 1001: the server goes away.
            Next::Closed => return frames::write(stream, Kind::Close, &1001u16.to_be_bytes()),
        }
    }
}
