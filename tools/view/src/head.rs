//! The head of a request, and whether it is answered.

use std::io::{self, Read};
use std::net::{IpAddr, TcpStream};
use std::time::{Duration, Instant};

/// Largest head, bytes.
const LARGEST: usize = 8 << 10;
/// A client has so long to send its head.
const PATIENCE: Duration = Duration::from_secs(3);

/// What a client asks for.
#[derive(Debug, PartialEq)]
pub enum Asked {
    /// The page, for the host (name or number, and port) by which the client knows this server.
    Page(String),
    /// Pictures: the client's key of the handshake.
    Pictures(String),
}

/// Why a request is not answered: the status line, and what to do.
pub type Refusal = (&'static str, &'static str);

const BAD: Refusal = ("400 Bad Request", "This is not a request of a browser.");
const STRANGER: Refusal = (
    "403 Forbidden",
    "This server answers its own page alone. Open it by an address that `realo run --view` printed, or by the machine's IP address.",
);
const NOTHING: Refusal = ("404 Not Found", "There is only one page here, at /.");
const METHOD: Refusal = ("405 Method Not Allowed", "Only GET is answered.");

/// Reads a head; `None` where the client sends too much, too slowly or not at all.
pub fn read(stream: &mut TcpStream) -> Option<String> {
    let begun = Instant::now();
    let mut head = Vec::new();
    let mut part = [0; 1024];
    while !head.ends_with(b"\r\n\r\n") {
        let left = PATIENCE.checked_sub(begun.elapsed()).filter(|left| !left.is_zero())?;
        stream.set_read_timeout(Some(left)).ok()?;
        let count = match stream.read(&mut part) {
            Ok(0) => return None,
            Ok(count) => count,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(_) => return None,
        };
        head.extend(&part[..count]);
        if head.len() > LARGEST {
            return None;
        }
    }
    String::from_utf8(head).ok()
}

/// A request for something that this machine serves.
pub struct Request<'a> {
    path: &'a str,
    /// The host (name or number, and port) by which the client knows this server.
    pub host: &'a str,
    fields: Vec<(&'a str, &'a str)>,
}

impl<'a> Request<'a> {
    /// Takes a head apart. `here`: names of this machine.
    ///
    /// # Errors
    /// What is not a GET of a browser that means this machine.
    pub fn read(head: &'a str, here: &[String]) -> Result<Self, Refusal> {
        let mut lines = head.split("\r\n");
        let mut words = lines.next().unwrap_or_default().split(' ');
        let (Some(method), Some(path), Some("HTTP/1.1"), None) =
            (words.next(), words.next(), words.next(), words.next())
        else {
            return Err(BAD);
        };
        let fields: Vec<(&str, &str)> = lines
            .take_while(|line| !line.is_empty())
            .map(|line| line.split_once(':').map(|(name, value)| (name, value.trim())))
            .collect::<Option<_>>()
            .ok_or(BAD)?;
        let host = one(&fields, "host")?.ok_or(BAD)?;
        if !is_here(host, here) {
            return Err(STRANGER);
        }
        if method != "GET" {
            return Err(METHOD);
        }
        Ok(Request { path, host, fields })
    }

    /// Of which page the script is that asks: a browser says it.
    ///
    /// # Errors
    /// Several.
    pub fn origin(&self) -> Result<Option<&'a str>, Refusal> {
        one(&self.fields, "origin")
    }

    /// Whether it asks for a WebSocket.
    pub fn upgrades(&self) -> Result<bool, Refusal> {
        let is = |name, expected: &str| -> Result<bool, Refusal> {
            let value = one(&self.fields, name)?.unwrap_or_default();
            Ok(value.split(',').any(|word| word.trim().eq_ignore_ascii_case(expected)))
        };
        Ok(is("upgrade", "websocket")? && is("connection", "upgrade")?)
    }

    /// The client's key of the handshake of a WebSocket.
    ///
    /// # Errors
    /// A request that is no such handshake.
    pub fn key(&self) -> Result<&'a str, Refusal> {
        let key = one(&self.fields, "sec-websocket-key")?.filter(|key| key.len() == 24);
        let fits = self.upgrades()? && one(&self.fields, "sec-websocket-version") == Ok(Some("13"));
        key.filter(|_| fits).ok_or(BAD)
    }

    /// The protocols that the client speaks over a WebSocket, the ones it likes best first.
    pub fn protocols(&self) -> impl Iterator<Item = &'a str> {
        let named = self
            .fields
            .iter()
            .filter(|(name, _)| name.eq_ignore_ascii_case("sec-websocket-protocol"));
        named.flat_map(|(_, value)| value.split(',').map(str::trim))
    }
}

/// What a head asks for. `here`: names of this machine.
pub fn asked(head: &str, here: &[String]) -> Result<Asked, Refusal> {
    let request = Request::read(head, here)?;
    match request.path {
        "/" => Ok(Asked::Page(request.host.into())),
        "/pictures" => {
            // Nobody else's page may look.
            if request.origin()?.and_then(|origin| origin.strip_prefix("http://")) != Some(request.host) {
                return Err(STRANGER);
            }
            Ok(Asked::Pictures(request.key()?.into()))
        }
        _ => Err(NOTHING),
    }
}

/// A field that may be there once.
fn one<'a>(fields: &[(&str, &'a str)], name: &str) -> Result<Option<&'a str>, Refusal> {
    let mut values = fields.iter().filter(|(known, _)| known.eq_ignore_ascii_case(name));
    match (values.next(), values.next()) {
        (_, Some(_)) => Err(BAD),
        (value, None) => Ok(value.map(|(_, value)| *value)),
    }
}

/// Whether a host is this machine: a number, which no page elsewhere can take as its name, or a name of it. The port may be another,
/// where somebody passes it on (`ssh -L`).
fn is_here(host: &str, here: &[String]) -> bool {
    name_of(host).is_some_and(|name| name.parse::<IpAddr>().is_ok() || is_name(name, here))
}

/// Whether this is a name of this machine.
pub fn is_name(name: &str, here: &[String]) -> bool {
    here.iter().any(|known| known.eq_ignore_ascii_case(name))
}

/// The name or number of a host that may have a port behind it.
pub fn name_of(host: &str) -> Option<&str> {
    let (name, port) = match host.strip_prefix('[') {
        Some(rest) => rest.split_once(']')?,
        None => host.split_at(host.find(':').unwrap_or(host.len())),
    };
    let is_port = port.is_empty() || port.strip_prefix(':').is_some_and(|port| port.parse::<u16>().is_ok());
    is_port.then_some(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pictures(host: &str, more: &str) -> String {
        format!(
            "GET /pictures HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: keep-alive, Upgrade\r\n\
             Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n{more}\r\n"
        )
    }

    fn ask(head: &str) -> Result<Asked, Refusal> {
        asked(head, &["localhost".into(), "mine".into()])
    }

    #[test]
    fn the_own_page_is_answered() {
        for host in [
            "127.0.0.1:8800",
            "localhost:9000",
            "[::1]:8800",
            "192.168.1.7:8800",
            "MINE:8800",
        ] {
            assert_eq!(
                ask(&format!("GET / HTTP/1.1\r\nHost: {host}\r\n\r\n")),
                Ok(Asked::Page(host.into()))
            );
            let asked = ask(&pictures(host, &format!("origin: http://{host}\r\n")));
            assert_eq!(asked, Ok(Asked::Pictures("dGhlIHNhbXBsZSBub25jZQ==".into())), "{host}");
        }
    }

    #[test]
    fn strangers_are_not_answered() {
        for host in [
            "evil.example",
            "127.0.0.1.evil.example:8800",
            "[::1",
            "localhost:8800:1",
            "",
            "localhost:x",
        ] {
            assert_eq!(
                ask(&format!("GET / HTTP/1.1\r\nHost: {host}\r\n\r\n")),
                Err(STRANGER),
                "{host}"
            );
        }
        for origin in [
            "",
            "Origin: http://evil.example\r\n",
            "Origin: null\r\n",
            "Origin: http://localhost:9000\r\n",
            "Origin: https://localhost:8800\r\n",
        ] {
            assert_eq!(ask(&pictures("localhost:8800", origin)), Err(STRANGER), "{origin}");
        }
    }

    #[test]
    fn what_is_no_request_is_refused() {
        for head in [
            "",
            "\r\n\r\n",
            "GET /\r\n\r\n",
            "GET / HTTP/1.0\r\nHost: localhost\r\n\r\n",
            "GET / HTTP/1.1\r\n\r\n",
            "GET / HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n\r\n",
            "GET / HTTP/1.1\r\njunk\r\n\r\n",
            "GET / x HTTP/1.1\r\nHost: localhost\r\n\r\n",
        ] {
            assert_eq!(ask(head), Err(BAD), "{head:?}");
        }
        assert_eq!(ask("POST / HTTP/1.1\r\nHost: localhost\r\n\r\n"), Err(METHOD));
        assert_eq!(ask("GET /x HTTP/1.1\r\nHost: localhost\r\n\r\n"), Err(NOTHING));
        let origin = "Origin: http://localhost\r\n";
        for (from, to) in [
            ("websocket", "h2c"),
            ("13", "8"),
            ("dGhl", ""),
            ("keep-alive, Upgrade", "close"),
        ] {
            let head = pictures("localhost", origin).replace(from, to);
            assert_eq!(ask(&head), Err(BAD), "{from}");
        }
    }
}
