//! Frames on a pipe: their bytes, or where the other side finds them in shared memory.

use std::io::{ErrorKind, Read, Write};

use arrow_buffer::Buffer;

use super::memory::{FrameAt, LENT_AT_MOST, Memory};

/// Bytes of a frame, at most.
pub const FRAME_LIMIT: usize = 256 << 20;
/// Frames of more bytes go through shared memory where both sides have it.
pub const SHARED_FROM: usize = 64 << 10;
/// Stands for the length of a frame that lies in shared memory.
const SHARED: u32 = u32::MAX;

/// Why there is no frame.
#[derive(Debug, thiserror::Error)]
pub enum FrameError {
    /// Text in place of a frame.
    #[error(
        "it printed to standard output, which belongs to the protocol: expected a frame, found text that begins with {text:?}; \
         print to standard error, in Python by print(…, file=sys.stderr)"
    )]
    Text {
        /// The first four bytes.
        text: String,
    },
    /// A length beyond the limit.
    #[error(
        "expected a frame of 1 to {FRAME_LIMIT} bytes, found a length of {0}; standard output belongs to the protocol"
    )]
    Length(usize),
    /// A frame that is none, or too long for one.
    #[error("expected a frame of 1 to {FRAME_LIMIT} bytes, found one of {0}; send less in one message")]
    Size(usize),
    /// The stream ended within a frame.
    #[error("expected a frame of {expected} bytes, found the end of the stream after {found}")]
    Cut {
        /// Bytes of the frame.
        expected: usize,
        /// Bytes that came.
        found: usize,
    },
    /// Shared memory that could not be had.
    #[error("expected a frame in shared memory: {0}")]
    Memory(String),
    /// The pipe failed.
    #[error("the pipe: {0}")]
    Pipe(#[from] std::io::Error),
}

/// Writes the first frame of a program, which gives nothing back: programs of any version say hello alike.
///
/// # Errors
/// As [`write`].
pub fn write_first(to: &mut impl Write, parts: &[Buffer]) -> Result<(), FrameError> {
    let length = parts.iter().map(Buffer::len).sum();
    check(length)?;
    put(to, &[length as u32], parts)
}

/// Reads the first frame of a program.
///
/// # Errors
/// As [`read`].
pub fn read_first(from: &mut impl Read) -> Result<Option<Buffer>, FrameError> {
    let Some(length) = prefix(from)? else {
        return Ok(None);
    };
    check_prefix(length)?;
    Ok(Some(Buffer::from_vec(exactly(from, length as usize)?)))
}

/// Writes a frame of these parts and flushes; with `shared` a big one goes through memory.
///
/// # Errors
/// [`FrameError::Size`] for one beyond the limit, [`FrameError::Memory`] if none can be had.
pub fn write(to: &mut impl Write, parts: &[Buffer], memory: &Memory, shared: bool) -> Result<(), FrameError> {
    let length = parts.iter().map(Buffer::len).sum();
    check(length)?;
    let place = match shared && length > SHARED_FROM {
        true => memory.lend(parts).map_err(in_memory)?,
        false => None,
    };
    let read = memory.give_back();
    let mut numbers = vec![place.map_or(length as u32, |_| SHARED), read.len() as u32];
    numbers.extend(read);
    numbers.extend(place.iter().flat_map(|place| [place.pid, place.fd, place.length]));
    put(to, &numbers, if place.is_some() { &[] } else { parts })
}

/// Reads a frame; `None` where the stream ends between two.
///
/// # Errors
/// [`FrameError`]; room is taken as bytes come, not as the length says.
pub fn read(from: &mut impl Read, memory: &Memory) -> Result<Option<Buffer>, FrameError> {
    let Some(length) = prefix(from)? else {
        return Ok(None);
    };
    if length != SHARED {
        check_prefix(length)?;
    }
    let returned = numbers(from, 1)?[0] as usize;
    if returned > LENT_AT_MOST {
        let reason = format!("{returned} files given back, of at most {LENT_AT_MOST}");
        return Err(FrameError::Memory(reason));
    }
    memory.take_back(&numbers(from, returned)?).map_err(in_memory)?;
    if length != SHARED {
        return Ok(Some(Buffer::from_vec(exactly(from, length as usize)?)));
    }
    let words = numbers(from, 3)?;
    let (pid, fd, length) = (words[0], words[1], words[2]);
    check(length as usize)?;
    memory.borrow(FrameAt { pid, fd, length }).map(Some).map_err(in_memory)
}

fn put(to: &mut impl Write, numbers: &[u32], parts: &[Buffer]) -> Result<(), FrameError> {
    for number in numbers {
        to.write_all(&number.to_le_bytes())?;
    }
    for part in parts {
        to.write_all(part)?;
    }
    Ok(to.flush()?)
}

/// The four bytes that every frame begins with.
fn prefix(from: &mut impl Read) -> Result<Option<u32>, FrameError> {
    let bytes = up_to(from, 4)?;
    match <[u8; 4]>::try_from(bytes.as_slice()) {
        Ok(length) => Ok(Some(u32::from_le_bytes(length))),
        Err(_) if bytes.is_empty() => Ok(None),
        Err(_) => Err(FrameError::Cut {
            expected: 4,
            found: bytes.len(),
        }),
    }
}

/// A length that cannot be is most likely text.
fn check_prefix(length: u32) -> Result<(), FrameError> {
    let bytes = length.to_le_bytes();
    check(length as usize).map_err(|_| match is_text(&bytes) {
        true => FrameError::Text {
            text: String::from_utf8_lossy(&bytes).into(),
        },
        false => FrameError::Length(length as usize),
    })
}

/// Whether bytes may begin a text in UTF-8; a character may be cut at their end.
fn is_text(bytes: &[u8]) -> bool {
    let printed = |byte: &u8| !byte.is_ascii_control() || byte.is_ascii_whitespace();
    let is_utf8 = std::str::from_utf8(bytes).map_or_else(|error| error.error_len().is_none(), |_| true);
    is_utf8 && bytes.iter().all(printed)
}

fn in_memory(error: std::io::Error) -> FrameError {
    FrameError::Memory(error.to_string())
}

fn numbers(from: &mut impl Read, n: usize) -> Result<Vec<u32>, FrameError> {
    let bytes = exactly(from, 4 * n)?;
    let (words, _) = bytes.as_chunks::<4>();
    Ok(words.iter().map(|word| u32::from_le_bytes(*word)).collect())
}

fn check(length: usize) -> Result<(), FrameError> {
    match (1..=FRAME_LIMIT).contains(&length) {
        true => Ok(()),
        false => Err(FrameError::Size(length)),
    }
}

fn exactly(from: &mut impl Read, expected: usize) -> Result<Vec<u8>, FrameError> {
    let bytes = up_to(from, expected)?;
    match bytes.len() {
        found if found < expected => Err(FrameError::Cut { expected, found }),
        _ => Ok(bytes),
    }
}

fn up_to(from: &mut impl Read, length: usize) -> Result<Vec<u8>, FrameError> {
    let mut bytes = Vec::new();
    match from.take(length as u64).read_to_end(&mut bytes) {
        Ok(_) => Ok(bytes),
        // A reset pipe is one whose other end is gone.
        Err(error) if matches!(error.kind(), ErrorKind::ConnectionReset | ErrorKind::BrokenPipe) => Ok(bytes),
        Err(error) => Err(error.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::super::memory;
    use super::*;

    fn first(bytes: &[u8]) -> Result<Option<Buffer>, FrameError> {
        read(&mut &bytes[..], &Memory::default())
    }

    fn parts(parts: &[&[u8]]) -> Vec<Buffer> {
        parts.iter().map(|part| Buffer::from(*part)).collect()
    }

    #[test]
    fn frames_come_back_one_by_one() {
        for shared in [false, memory::works()] {
            let (writer, reader) = (Memory::default(), Memory::default());
            let mut stream = Vec::new();
            write(&mut stream, &parts(&[b"on", b"e"]), &writer, shared).unwrap();
            assert!(writer.take_back(&[3]).is_err(), "a small frame lies in the pipe");
            write(&mut stream, &parts(&[&[7; 40_000], &[8; 30_000]]), &writer, shared).unwrap();
            assert_eq!(stream.len() < 100, shared);
            let mut rest = stream.as_slice();
            assert_eq!(read(&mut rest, &reader).unwrap().unwrap().as_slice(), b"one");
            let back = read(&mut rest, &reader).unwrap().unwrap();
            assert_eq!((back[0], back[39_999], back[40_000], back.len()), (7, 7, 8, 70_000));
            assert!(read(&mut rest, &reader).unwrap().is_none());

            drop(back);
            let mut answer = Vec::new();
            write(&mut answer, &parts(&[b"read"]), &reader, shared).unwrap();
            assert_eq!(answer.len(), if shared { 16 } else { 12 });
            assert!(read(&mut answer.as_slice(), &writer).unwrap().is_some());
            assert_eq!(
                read(&mut answer.as_slice(), &writer).is_err(),
                shared,
                "given back twice"
            );
        }
    }

    #[test]
    fn says_what_came_instead_of_a_frame() {
        let error = first(b"hello, world\n").unwrap_err().to_string();
        assert!(
            error.contains("\"hell\"") && error.contains("standard error"),
            "{error}"
        );
        for text in ["ab\r c", "Größe", "…..."] {
            assert!(matches!(first(text.as_bytes()), Err(FrameError::Text { .. })), "{text}");
        }
        assert!(matches!(first(&[0; 4]), Err(FrameError::Length(0))));
        assert!(matches!(first(&[1, 2, 0, 64]), Err(FrameError::Length(_))));
        assert!(matches!(first(&[9, 0]), Err(FrameError::Cut { expected: 4, found: 2 })));
        assert!(matches!(
            first(&[9, 0, 0, 0, 0, 0, 0, 0, 1]),
            Err(FrameError::Cut { expected: 9, found: 1 })
        ));
        let shared = [&[255; 4][..], &[0, 0, 0, 0, 1, 0, 0, 0]].concat();
        assert!(matches!(
            first(&shared),
            Err(FrameError::Cut { expected: 12, found: 4 })
        ));
        for returned in [1, 65] {
            let given = [9, returned, 3].map(u32::to_le_bytes).concat();
            let error = first(&given).unwrap_err().to_string();
            assert!(error.contains("given back"), "{error}");
        }
        assert!(write(&mut Vec::new(), &[], &Memory::default(), false).is_err());
    }

    #[test]
    fn a_first_frame_is_its_length_and_its_bytes() {
        let mut stream = Vec::new();
        write_first(&mut stream, &parts(&[b"he", b"llo"])).unwrap();
        assert_eq!(stream, b"\x05\0\0\0hello");
        assert_eq!(
            read_first(&mut stream.as_slice()).unwrap().unwrap().as_slice(),
            b"hello"
        );
        assert!(read_first(&mut &[][..]).unwrap().is_none());
        assert!(matches!(
            read_first(&mut &stream[..6]),
            Err(FrameError::Cut { expected: 5, found: 2 })
        ));
        let text = read_first(&mut &b"hello, world\n"[..]).unwrap_err().to_string();
        assert!(text.contains("\"hell\""), "{text}");
        assert!(matches!(write_first(&mut Vec::new(), &[]), Err(FrameError::Size(0))));
    }
}
