//! What bags are compressed by, unpacked to no more than a file of its size can be believed to hold.

use std::fs::File;
use std::io::{self, BufReader, Read, Write};
use std::path::Path;

use tempfile::NamedTempFile;

use crate::BagError;

/// What bytes may unpack to, as a multiple of them, and what is free: clouds of a covered sensor are zeros.
const RATIO: u64 = 1024;
const ROOM: u64 = 16 << 20;
/// No writer makes longer chunks or messages.
const LONGEST: u64 = 1 << 30;
/// What a whole file may unpack to, as a multiple of it: it goes to the disk.
const FILE_RATIO: u64 = 256;
/// Decoders of zstd keep so much of what they unpacked, as a power of two.
const WINDOW: u32 = 27;

/// How every frame of zstd begins.
pub(crate) const ZSTD: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];

/// A way to compress.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Packing {
    Plain,
    Bz2,
    Lz4,
    Zstd,
}

impl Packing {
    pub fn of_chunk(name: &str) -> Option<Self> {
        match name {
            "none" => Some(Packing::Plain),
            "bz2" => Some(Packing::Bz2),
            "lz4" => Some(Packing::Lz4),
            "zstd" => Some(Packing::Zstd),
            _ => None,
        }
    }

    /// Unpacks to `size` bytes.
    ///
    /// # Errors
    /// A size that is not believed; bytes that unpack to another one, or not at all.
    pub fn unpack_to(self, packed: &[u8], size: u64) -> Result<Vec<u8>, String> {
        let most = most_unpacked(packed.len() as u64);
        if size > most {
            return Err(format!(
                "{} bytes are said to unpack to {size}; at most {most} are believed",
                packed.len()
            ));
        }
        let unpacked = self.unpack(packed, size)?;
        match unpacked.len() as u64 == size {
            true => Ok(unpacked),
            false => Err(format!("expected {size} unpacked bytes, found {}", unpacked.len())),
        }
    }

    /// At most one byte more than `most`.
    fn unpack(self, packed: &[u8], most: u64) -> Result<Vec<u8>, String> {
        let mut unpacked = Vec::new();
        let mut read = |from: &mut dyn Read| from.take(most.saturating_add(1)).read_to_end(&mut unpacked);
        let done = match self {
            Packing::Plain => read(&mut { packed }),
            Packing::Bz2 => read(&mut bzip2::read::MultiBzDecoder::new(packed)),
            Packing::Lz4 => lz4::Decoder::new(packed).and_then(|mut decoder| read(&mut decoder)),
            Packing::Zstd => zstd_decoder(packed).and_then(|mut decoder| read(&mut decoder)),
        };
        done.map_err(|error| format!("cannot unpack: {error}"))?;
        Ok(unpacked)
    }
}

/// A message that was compressed by itself.
pub(crate) fn unpack_message(packed: &[u8]) -> Result<Vec<u8>, String> {
    let most = most_unpacked(packed.len() as u64);
    let unpacked = Packing::Zstd.unpack(packed, most)?;
    match unpacked.len() as u64 <= most {
        true => Ok(unpacked),
        false => Err(format!(
            "a message of {} bytes unpacks to more than the {most} that are believed",
            packed.len()
        )),
    }
}

/// Most bytes that `packed` bytes may unpack to.
pub(crate) fn most_unpacked(packed: u64) -> u64 {
    RATIO.saturating_mul(packed).saturating_add(ROOM).min(LONGEST)
}

fn zstd_decoder<'a, R: Read + 'a>(packed: R) -> io::Result<zstd::Decoder<'a, BufReader<R>>> {
    let mut decoder = zstd::Decoder::new(packed)?;
    decoder.window_log_max(WINDOW)?;
    Ok(decoder)
}

/// Unpacks a file that is compressed as a whole by zstd to one that lives as long as the bag is open. A file that was cut gives what
/// it has, and why it ends.
pub(crate) fn unpack_file(path: &Path) -> Result<(NamedTempFile, Option<String>), BagError> {
    let file = File::open(path).map_err(BagError::io(path))?;
    let size = file.metadata().map_err(BagError::io(path))?.len();
    let most = size.saturating_mul(FILE_RATIO).saturating_add(ROOM);
    let mut unpacked = NamedTempFile::new().map_err(BagError::io(&std::env::temp_dir()))?;
    let mut decoder = zstd_decoder(file).map_err(BagError::io(path))?;
    let (mut written, mut buffer) = (0u64, vec![0; 1 << 16]);
    loop {
        let read = match decoder.read(&mut buffer) {
            Ok(0) => return Ok((unpacked, None)),
            Ok(read) => read,
            Err(error) if written > 0 => {
                let lost = format!("its zstd ends or is damaged behind {written} unpacked bytes: {error}");
                return Ok((unpacked, Some(lost)));
            }
            Err(error) => return Err(BagError::content(path, format!("cannot unpack its zstd: {error}"))),
        };
        written += read as u64;
        if written > most {
            let reason =
                format!("{size} bytes unpack to more than the {most} that are believed; unpack it yourself: `zstd -d`");
            return Err(BagError::content(path, reason));
        }
        let temporary = unpacked.path().to_path_buf();
        unpacked.write_all(&buffer[..read]).map_err(BagError::io(&temporary))?;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_packing_gives_the_same_and_wrong_sizes_are_refused() {
        let data: Vec<u8> = (0..100_000u32).map(|i| (i / 700) as u8).collect();
        let mut bz2 = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::fast());
        bz2.write_all(&data).unwrap();
        let mut lz4 = lz4::EncoderBuilder::new().build(Vec::new()).unwrap();
        lz4.write_all(&data).unwrap();
        for (packing, packed) in [
            (Packing::Plain, data.clone()),
            (Packing::Bz2, bz2.finish().unwrap()),
            (Packing::Lz4, lz4.finish().0),
            (Packing::Zstd, zstd::encode_all(&data[..], 1).unwrap()),
        ] {
            assert_eq!(packing.unpack_to(&packed, 100_000).unwrap(), data, "{packing:?}");
            for size in [0, 99_999, 100_001] {
                assert!(packing.unpack_to(&packed, size).is_err(), "{packing:?} {size}");
            }
            let error = packing.unpack_to(&packed, 1 << 40).unwrap_err();
            assert!(error.contains("are believed"), "{error}");
            let cut = &packed[..packed.len() / 2];
            assert!(packing.unpack_to(cut, 100_000).is_err(), "{packing:?}");
        }
    }
}
