//! Files of bounded length.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

/// Why a file was not read.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The system says so.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// It is longer than any such file.
    #[error("expected at most {most} bytes, found more")]
    TooLong {
        /// Bytes that such a file has at most.
        most: u64,
    },
}

/// The bytes of a file, unless there are more than `most`.
pub fn read_bounded(path: &Path, most: u64) -> Result<Vec<u8>, ReadError> {
    let mut bytes = Vec::new();
    File::open(path)?.take(most + 1).read_to_end(&mut bytes)?;
    match bytes.len() as u64 > most {
        true => Err(ReadError::TooLong { most }),
        false => Ok(bytes),
    }
}
