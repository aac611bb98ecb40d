//! WebSocket (RFC 6455): the handshake, frames to a client, and those that a client sends.

use std::io::{self, Read, Write};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use sha1::{Digest, Sha1};

/// What the standard puts behind a client's key.
const BEHIND_KEY: &str = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11";

/// The standard's largest frame that may ask for an answer.
const LARGEST_CONTROL: usize = 125;

/// What a frame to a client is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Kind {
    Text = 1,
    Binary = 2,
    Close = 8,
    Ping = 9,
    Pong = 10,
}

/// What a client sent.
#[derive(Debug, PartialEq)]
pub enum Received {
    /// It wants an answer with the same content.
    Ping(Vec<u8>),
    /// It is still there.
    Pong,
    /// It says something.
    Text(String),
    /// It sends something.
    Binary,
}

/// The server's half of the handshake.
pub fn accept(key: &str) -> String {
    STANDARD.encode(Sha1::digest(format!("{key}{BEHIND_KEY}")))
}

/// Writes one frame.
///
/// # Errors
/// A client that is gone, or does not read.
pub fn write(to: &mut impl Write, kind: Kind, content: &[u8]) -> io::Result<()> {
    write_parts(to, kind, &[], content)
}

/// Writes one frame whose content begins with some bytes and goes on with others.
///
/// # Errors
/// As [`write`].
pub fn write_parts(to: &mut impl Write, kind: Kind, begin: &[u8], content: &[u8]) -> io::Result<()> {
    let mut head = vec![0x80 | kind as u8];
    match begin.len() + content.len() {
        short @ 0..=125 => head.push(short as u8),
        middle @ 126..=0xffff => {
            head.push(126);
            head.extend((middle as u16).to_be_bytes());
        }
        long => {
            head.push(127);
            head.extend((long as u64).to_be_bytes());
        }
    }
    head.extend(begin);
    to.write_all(&head)?;
    to.write_all(content)
}

/// One frame of a client.
struct Frame {
    /// Whether nothing of the message follows.
    is_last: bool,
    kind: u8,
    content: Vec<u8>,
}

/// Reads a frame of at most so many bytes; `None` where it is larger, or no frame of a client.
fn read_frame(from: &mut impl Read, largest: usize) -> io::Result<Option<Frame>> {
    let mut head = [0; 2];
    from.read_exact(&mut head)?;
    let (is_last, kind) = (head[0] & 0x80 != 0, head[0] & 0x0f);
    let is_control = kind >= 8;
    let is_too_long = is_control && usize::from(head[1] & 0x7f) > LARGEST_CONTROL;
    // Without extensions, and masked, as the standard wants it of clients.
    if head[0] & 0x70 != 0 || head[1] & 0x80 == 0 || is_too_long {
        return Ok(None);
    }
    let length = match head[1] & 0x7f {
        126 => {
            let mut length = [0; 2];
            from.read_exact(&mut length)?;
            u64::from(u16::from_be_bytes(length))
        }
        127 => {
            let mut length = [0; 8];
            from.read_exact(&mut length)?;
            u64::from_be_bytes(length)
        }
        short => u64::from(short),
    };
    let largest = if is_control { LARGEST_CONTROL } else { largest };
    let fits = usize::try_from(length).ok().filter(|length| *length <= largest);
    let Some(length) = fits.filter(|_| is_last || !is_control) else {
        return Ok(None);
    };
    let mut mask = [0; 4];
    from.read_exact(&mut mask)?;
    let mut content = vec![0; length];
    from.read_exact(&mut content)?;
    content
        .iter_mut()
        .zip(mask.iter().cycle())
        .for_each(|(byte, mask)| *byte ^= mask);
    Ok(Some(Frame { is_last, kind, content }))
}

/// Reads one frame of a client, which has nothing to say but whether it is there; `None` when it leaves or says anything else.
///
/// # Errors
/// A client that is gone.
pub fn read(from: &mut impl Read) -> io::Result<Option<Received>> {
    Ok(read_frame(from, 0)?.and_then(|Frame { kind, content, .. }| match kind {
        9 => Some(Received::Ping(content)),
        10 => Some(Received::Pong),
        _ => None,
    }))
}

/// Reads what a client says, which may come in several frames: of so many bytes at most.
pub struct Reader {
    largest: usize,
    /// What has come of a text.
    begun: Option<Vec<u8>>,
}

impl Reader {
    /// Reads texts of so many bytes at most.
    pub fn new(largest: usize) -> Self {
        Reader { largest, begun: None }
    }

    /// The next thing that a client says; `None` when it leaves, or says what no client may.
    ///
    /// # Errors
    /// A client that is gone.
    pub fn read(&mut self, from: &mut impl Read) -> io::Result<Option<Received>> {
        loop {
            let left = self.largest - self.begun.as_ref().map_or(0, Vec::len);
            let Some(Frame { is_last, kind, content }) = read_frame(from, left)? else {
                return Ok(None);
            };
            let text = match (kind, self.begun.take()) {
                (1, None) => content,
                (0, Some(mut begun)) => {
                    begun.extend(content);
                    begun
                }
                (2, None) if is_last => return Ok(Some(Received::Binary)),
                (9, begun) => {
                    self.begun = begun;
                    return Ok(Some(Received::Ping(content)));
                }
                (10, begun) => {
                    self.begun = begun;
                    return Ok(Some(Received::Pong));
                }
                _ => return Ok(None),
            };
            match is_last {
                true => return Ok(String::from_utf8(text).ok().map(Received::Text)),
                false => self.begun = Some(text),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_handshake_is_that_of_the_standard() {
        // RFC 6455, section 1.3.
        assert_eq!(accept("dGhlIHNhbXBsZSBub25jZQ=="), "s3pPLMBiTxaQ9kYGzzhZRbK+xOo=");
    }

    #[test]
    fn frames_of_all_lengths_are_written() {
        let head = |length: usize| {
            let mut frame = Vec::new();
            write(&mut frame, Kind::Binary, &vec![7; length]).unwrap();
            frame.truncate(frame.len() - length);
            frame
        };
        assert_eq!(head(5), [0x82, 5]);
        assert_eq!(head(126), [0x82, 126, 0, 126]);
        assert_eq!(head(65_536), [0x82, 127, 0, 0, 0, 0, 0, 1, 0, 0]);
        let mut hello = Vec::new();
        write(&mut hello, Kind::Text, b"Hello").unwrap();
        assert_eq!(hello, [0x81, 5, b'H', b'e', b'l', b'l', b'o']);
    }

    #[test]
    fn a_client_may_ask_whether_somebody_is_there_and_nothing_else() {
        // RFC 6455, section 5.7: a masked "Hello".
        let masked = |kind: u8| [0x80 | kind, 0x85, 0x37, 0xfa, 0x21, 0x3d, 0x7f, 0x9f, 0x4d, 0x51, 0x58];
        let got = |bytes: &[u8]| read(&mut &bytes[..]).unwrap();
        assert_eq!(got(&masked(9)), Some(Received::Ping(b"Hello".into())));
        assert_eq!(got(&masked(10)), Some(Received::Pong));
        for kind in [0, 1, 2, 3, 8, 11] {
            assert_eq!(got(&masked(kind)), None, "{kind}");
        }
        assert_eq!(got(&[0x89, 0x05]), None, "not masked");
        assert_eq!(got(&[0x09, 0x80]), None, "a part of a frame");
        assert_eq!(got(&[0xc9, 0x80]), None, "an extension");
        assert_eq!(got(&[0x89, 0xff]), None, "too long");
        assert!(read(&mut &[0x89u8][..]).is_err());
    }

    /// A frame of a client, masked.
    fn framed(head: u8, content: &[u8]) -> Vec<u8> {
        let mut frame = vec![head];
        match content.len() {
            short @ 0..=125 => frame.push(0x80 | short as u8),
            middle => {
                frame.push(0x80 | 126);
                frame.extend((middle as u16).to_be_bytes());
            }
        }
        frame.extend([1, 2, 3, 4]);
        frame.extend(
            content
                .iter()
                .zip([1, 2, 3, 4].iter().cycle())
                .map(|(byte, mask)| byte ^ mask),
        );
        frame
    }

    #[test]
    fn texts_come_whole_or_in_parts_with_pings_between() {
        let long = "x".repeat(300);
        let bytes = [
            framed(0x81, b"one"),
            framed(0x01, b"tw"),
            framed(0x89, b"?"),
            framed(0x00, b"o"),
            framed(0x80, b"!"),
            framed(0x81, long.as_bytes()),
            framed(0x82, b"bytes"),
            framed(0x88, b""),
        ]
        .concat();
        let (mut reader, mut from) = (Reader::new(300), &bytes[..]);
        let mut next = || reader.read(&mut from).unwrap();
        assert_eq!(next(), Some(Received::Text("one".into())));
        assert_eq!(next(), Some(Received::Ping(b"?".into())));
        assert_eq!(next(), Some(Received::Text("two!".into())));
        assert_eq!(next(), Some(Received::Text(long)));
        assert_eq!(next(), Some(Received::Binary));
        assert_eq!(next(), None, "it leaves");
    }

    #[test]
    fn texts_that_no_client_may_send_end_the_conversation() {
        let got = |frames: &[Vec<u8>]| {
            let bytes = frames.concat();
            Reader::new(300).read(&mut &bytes[..]).unwrap()
        };
        assert_eq!(got(&[framed(0x81, &[b'x'; 301])]), None, "too long");
        assert_eq!(
            got(&[framed(0x01, &[b'x'; 200]), framed(0x80, &[b'x'; 200])]),
            None,
            "too long in parts"
        );
        assert_eq!(got(&[framed(0x80, b"x")]), None, "goes on with nothing");
        assert_eq!(
            got(&[framed(0x01, b"x"), framed(0x81, b"y")]),
            None,
            "begins within another"
        );
        assert_eq!(got(&[framed(0x81, b"\xff")]), None, "not a text");
        assert_eq!(got(&[framed(0x09, b"?")]), None, "a ping in parts");
        assert_eq!(got(&[framed(0xc1, b"x")]), None, "an extension");
    }
}
