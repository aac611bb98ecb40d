//! Frames on a pipe: their bytes, or where the other side finds them in shared memory.

use std::io::{ErrorKind, Read, Write};

use arrow_buffer::Buffer;

use super::memory::{self, FrameAt, Lent};

/// Bytes of a frame, at most.
pub const FRAME_LIMIT: usize = 256 << 20;
/// Frames of more bytes go through shared memory where both sides have it.
pub const SHARED_FROM: usize = 64 << 10;
/// Stands for the length of a frame that lies in shared memory.
const SHARED: u32 = u32::MAX;

/// Why there is no frame.
#[derive(Debug, thiserror::Error)]
pub enum FrameError {
    /// A length beyond the limit: most likely text.
    #[error(
        "expected a frame of 1 to {FRAME_LIMIT} bytes, found a length of {length} (as text: {text:?}); \
         print to standard error, standard output belongs to the protocol"
    )]
    Length {
        /// The length that the first four bytes give.
        length: usize,
        /// The four bytes as text.
        text: String,
    },
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

/// Writes a frame of these parts and flushes. With `shared` a big one goes through memory, to be kept until the other side
/// has answered.
///
/// # Errors
/// [`FrameError::Length`] for one beyond the limit, [`FrameError::Memory`] if none can be had.
pub fn write(to: &mut impl Write, parts: &[Buffer], shared: bool) -> Result<Option<Lent>, FrameError> {
    let length = parts.iter().map(Buffer::len).sum();
    check(length, "")?;
    if shared && length > SHARED_FROM {
        let lent = memory::lend(parts).map_err(|error| FrameError::Memory(error.to_string()))?;
        let FrameAt { pid, fd, length } = lent.place();
        for number in [SHARED, pid, fd, length] {
            to.write_all(&number.to_le_bytes())?;
        }
        to.flush()?;
        return Ok(Some(lent));
    }
    to.write_all(&(length as u32).to_le_bytes())?;
    for part in parts {
        to.write_all(part)?;
    }
    to.flush()?;
    Ok(None)
}

/// Reads a frame; `None` where the stream ends between two.
///
/// # Errors
/// [`FrameError`]; memory is taken as bytes come, not as the length says.
pub fn read(from: &mut impl Read) -> Result<Option<Buffer>, FrameError> {
    let prefix = up_to(from, 4)?;
    let Ok(length) = <[u8; 4]>::try_from(prefix.as_slice()) else {
        return match prefix.len() {
            0 => Ok(None),
            found => Err(FrameError::Cut { expected: 4, found }),
        };
    };
    let length = u32::from_le_bytes(length);
    if length == SHARED {
        return read_shared(from).map(Some);
    }
    let expected = length as usize;
    check(expected, &String::from_utf8_lossy(&prefix))?;
    Ok(Some(Buffer::from_vec(exactly(from, expected)?)))
}

fn read_shared(from: &mut impl Read) -> Result<Buffer, FrameError> {
    let words = exactly(from, 12)?;
    let word = |at: usize| {
        words[at..at + 4]
            .iter()
            .rev()
            .fold(0, |word, byte| word << 8 | u32::from(*byte))
    };
    let place = FrameAt {
        pid: word(0),
        fd: word(4),
        length: word(8),
    };
    check(place.length as usize, "")?;
    memory::open(place).map_err(|error| FrameError::Memory(error.to_string()))
}

fn check(length: usize, text: &str) -> Result<(), FrameError> {
    if (1..=FRAME_LIMIT).contains(&length) {
        return Ok(());
    }
    Err(FrameError::Length {
        length,
        text: text.into(),
    })
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
    use super::*;

    fn first(bytes: &[u8]) -> Result<Option<Buffer>, FrameError> {
        read(&mut &bytes[..])
    }

    fn parts(parts: &[&[u8]]) -> Vec<Buffer> {
        parts.iter().map(|part| Buffer::from(*part)).collect()
    }

    #[test]
    fn frames_come_back_one_by_one() {
        for shared in [false, memory::works()] {
            let mut stream = Vec::new();
            let small = write(&mut stream, &parts(&[b"on", b"e"]), shared).unwrap();
            assert!(small.is_none(), "a small frame lies in the pipe");
            let big = write(&mut stream, &parts(&[&[7; 40_000], &[8; 30_000]]), shared).unwrap();
            assert_eq!((big.is_some(), stream.len() < 100), (shared, shared));
            let mut rest = stream.as_slice();
            assert_eq!(read(&mut rest).unwrap().unwrap().as_slice(), b"one");
            let back = read(&mut rest).unwrap().unwrap();
            assert_eq!((back[0], back[39_999], back[40_000], back.len()), (7, 7, 8, 70_000));
            assert!(read(&mut rest).unwrap().is_none());
        }
    }

    #[test]
    fn says_what_came_instead_of_a_frame() {
        let error = first(b"hello, world\n").unwrap_err().to_string();
        assert!(
            error.contains("\"hell\"") && error.contains("standard error"),
            "{error}"
        );
        assert!(matches!(first(&[0; 4]), Err(FrameError::Length { length: 0, .. })));
        assert!(matches!(first(&[9, 0]), Err(FrameError::Cut { expected: 4, found: 2 })));
        assert!(matches!(
            first(&[9, 0, 0, 0, 1]),
            Err(FrameError::Cut { expected: 9, found: 1 })
        ));
        let shared = [&[255; 4][..], &[1, 0, 0, 0]].concat();
        assert!(matches!(
            first(&shared),
            Err(FrameError::Cut { expected: 12, found: 4 })
        ));
        assert!(write(&mut Vec::new(), &[], false).is_err());
    }
}
