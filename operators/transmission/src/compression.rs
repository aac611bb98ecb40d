//! zstd, with lengths that are known beforehand.

use zstd::bulk::{Compressor, Decompressor};

use crate::error::{DecodeError, EncodeError};

/// Compresses bytes into a frame, in place of what was there.
pub(crate) fn compress(zstd: &mut Compressor, bytes: &[u8], into: &mut Vec<u8>) -> Result<(), EncodeError> {
    into.clear();
    into.reserve(zstd::compress_bound(bytes.len()));
    let done = zstd.compress_to_buffer(bytes, into);
    done.map_err(|error| EncodeError::Zstd(error.to_string()))?;
    Ok(())
}

/// Gets exactly so many bytes out of a frame, in place of what was there.
pub(crate) fn decompress(
    zstd: &mut Decompressor,
    compressed: &[u8],
    length: usize,
    field: &'static str,
    into: &mut Vec<u8>,
) -> Result<(), DecodeError> {
    // Its capacity bounds what is written.
    into.clear();
    into.reserve_exact(length);
    let written = zstd.decompress_to_buffer(compressed, into);
    let found = match written {
        Ok(written) if written == length => return Ok(()),
        Ok(written) => format!("{written} bytes"),
        Err(error) => error.to_string(),
    };
    Err(DecodeError::Zstd { field, length, found })
}
