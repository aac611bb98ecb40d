//! WebSocket (RFC 6455): the handshake, frames to a browser, and the few that a browser sends.

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
    let mut head = vec![0x80 | kind as u8];
    match content.len() {
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
    to.write_all(&head)?;
    to.write_all(content)
}

/// Reads one frame of a client, which has nothing to say but whether it is there; `None` when it leaves or says anything else.
///
/// # Errors
/// A client that is gone.
pub fn read(from: &mut impl Read) -> io::Result<Option<Received>> {
    let mut head = [0; 2];
    from.read_exact(&mut head)?;
    let length = usize::from(head[1] & 0x7f);
    // Whole, without extensions, and masked, as the standard wants it of clients.
    let is_control = head[0] & 0xf8 == 0x88 && head[1] & 0x80 != 0 && length <= LARGEST_CONTROL;
    if !is_control {
        return Ok(None);
    }
    let mut mask = [0; 4];
    from.read_exact(&mut mask)?;
    let mut content = vec![0; length];
    from.read_exact(&mut content)?;
    content
        .iter_mut()
        .zip(mask.iter().cycle())
        .for_each(|(byte, mask)| *byte ^= mask);
    Ok(match head[0] & 0x0f {
        9 => Some(Received::Ping(content)),
        10 => Some(Received::Pong),
        _ => None,
    })
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
}
