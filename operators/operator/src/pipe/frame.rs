//! Length-prefixed frames.

use std::io::{ErrorKind, Read, Write};

/// Bytes of a frame, at most.
pub const FRAME_LIMIT: usize = 256 << 20;

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
    /// The pipe failed.
    #[error("the pipe: {0}")]
    Pipe(#[from] std::io::Error),
}

/// Writes a frame and flushes.
///
/// # Errors
/// [`FrameError::Length`] for one beyond the limit.
pub fn write(to: &mut impl Write, bytes: &[u8]) -> Result<(), FrameError> {
    check(bytes.len(), "")?;
    to.write_all(&(bytes.len() as u32).to_le_bytes())?;
    to.write_all(bytes)?;
    Ok(to.flush()?)
}

/// Reads a frame; `None` where the stream ends between two.
///
/// # Errors
/// [`FrameError`]; memory is taken as bytes come, not as the length says.
pub fn read(from: &mut impl Read) -> Result<Option<Vec<u8>>, FrameError> {
    let mut prefix = Vec::with_capacity(4);
    up_to(from, 4, &mut prefix)?;
    let Ok(length) = <[u8; 4]>::try_from(prefix.as_slice()) else {
        return match prefix.len() {
            0 => Ok(None),
            found => Err(FrameError::Cut { expected: 4, found }),
        };
    };
    let expected = u32::from_le_bytes(length) as usize;
    check(expected, &String::from_utf8_lossy(&prefix))?;
    let mut bytes = Vec::new();
    up_to(from, expected, &mut bytes)?;
    match bytes.len() {
        found if found < expected => Err(FrameError::Cut { expected, found }),
        _ => Ok(Some(bytes)),
    }
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

fn up_to(from: &mut impl Read, length: usize, bytes: &mut Vec<u8>) -> Result<(), FrameError> {
    match from.take(length as u64).read_to_end(bytes) {
        Ok(_) => Ok(()),
        // A reset pipe is one whose other end is gone.
        Err(error) if matches!(error.kind(), ErrorKind::ConnectionReset | ErrorKind::BrokenPipe) => Ok(()),
        Err(error) => Err(error.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn first(bytes: &[u8]) -> Result<Option<Vec<u8>>, FrameError> {
        read(&mut &bytes[..])
    }

    #[test]
    fn frames_come_back_one_by_one() {
        let mut stream = Vec::new();
        write(&mut stream, b"one").unwrap();
        write(&mut stream, &[7; 70_000]).unwrap();
        let mut rest = stream.as_slice();
        assert_eq!(read(&mut rest).unwrap().unwrap(), b"one");
        assert_eq!(read(&mut rest).unwrap().unwrap(), [7; 70_000]);
        assert!(read(&mut rest).unwrap().is_none());
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
        assert!(write(&mut Vec::new(), &[]).is_err());
    }
}
