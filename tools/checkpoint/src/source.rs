//! Where the numbers of a checkpoint lie: a zip archive, or a file of the format before.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};

use zip::ZipArchive;
use zip::result::ZipError;

use crate::checkpoint::Problem;
use crate::legacy;
use crate::pickle::{self, Pickle};
use crate::view::Storage;

/// An open checkpoint.
pub(crate) enum Source {
    /// Of PyTorch 1.6 and later: entries below a folder, each storage one.
    Zip {
        archive: ZipArchive<BufReader<File>>,
        folder: String,
        big_endian: bool,
    },
    /// Of the time before: storages one after another.
    Legacy {
        file: BufReader<File>,
        places: legacy::Places,
    },
}

/// Bytes that show what a file is.
const HEAD: u64 = 64;

/// What a file is by its first bytes, and what helps.
fn what(begin: &[u8]) -> &'static str {
    let is = |head: &[u8]| begin.starts_with(head);
    let text = begin.trim_ascii_start().to_ascii_lowercase();
    match begin {
        [] => "empty; copy the file again",
        _ if is(b"version https://git-lfs") => "a pointer of Git LFS; fetch the file with `git lfs pull`",
        _ if text.starts_with(b"<!doctype") || text.starts_with(b"<html") => "a web page; download the file itself",
        // The header of safetensors: its length, then JSON.
        [_, _, _, _, 0, 0, 0, 0, b'{', ..] => {
            "safetensors; name such a file as weights in a model file (docs/reference/networks.md)"
        }
        [0x80, 3..=5, ..] => "a pickle of something else; save a state dict: torch.save(model.state_dict(), FILE)",
        [0x1f, 0x8b, ..] => "compressed by gzip; unpack it first",
        _ => "something else; see whether it is the right file",
    }
}

impl Source {
    /// Opens a checkpoint and parses its pickle.
    pub fn open(file: File) -> Result<(Source, Pickle), Problem> {
        let mut file = BufReader::new(file);
        let mut begin = Vec::new();
        file.by_ref().take(HEAD).read_to_end(&mut begin)?;
        file.rewind()?;
        match begin[..] {
            [b'P', b'K', 3, 4, ..] => zip(file),
            [0x80, 2, ..] => {
                let (pickle, places) = legacy::read(&mut file)?;
                Ok((Source::Legacy { file, places }, pickle))
            }
            _ => Err(Problem::Unknown(what(&begin))),
        }
    }

    /// Whether the highest byte of a number comes first.
    pub fn big_endian(&self) -> bool {
        matches!(self, Source::Zip { big_endian: true, .. })
    }

    /// The bytes of a storage: as many as it says.
    pub fn read(&mut self, storage: &Storage) -> Result<Vec<u8>, Problem> {
        let expected = (storage.count as u64).saturating_mul(storage.dtype.size() as u64);
        match self {
            Source::Zip { archive, folder, .. } => {
                let name = format!("{folder}/data/{}", storage.key);
                entry(archive, &name, expected)?.filter(|bytes| bytes.len() as u64 == expected)
            }
            Source::Legacy { file, places } => match places.get(&*storage.key) {
                Some(place) => {
                    file.seek(SeekFrom::Start(*place))?;
                    let mut bytes = Vec::new();
                    file.take(expected).read_to_end(&mut bytes)?;
                    Some(bytes).filter(|bytes| bytes.len() as u64 == expected)
                }
                None => None,
            },
        }
        .ok_or_else(|| Problem::Storage {
            key: storage.key.to_string(),
            expected,
        })
    }
}

fn zip(file: BufReader<File>) -> Result<(Source, Pickle), Problem> {
    let mut archive = ZipArchive::new(file)?;
    let pickles = archive.file_names().filter_map(|name| {
        let name = name.ok()?;
        let folder = name.strip_suffix("/data.pkl")?;
        (!folder.contains('/')).then(|| folder.to_string())
    });
    let folders: Vec<String> = pickles.take(2).collect();
    let [folder] = &folders[..] else {
        return Err(Problem::NoPickle);
    };
    let folder = folder.clone();
    let text = entry(&mut archive, &format!("{folder}/data.pkl"), pickle::MOST_BYTES)?.ok_or(Problem::NoPickle)?;
    let pickle = Pickle::parse(&text[..])?;
    let order = entry(&mut archive, &format!("{folder}/byteorder"), 16)?;
    let big_endian = match order.as_deref() {
        None | Some(b"little") => false,
        Some(b"big") => true,
        Some(_) => return Err(Problem::ByteOrder),
    };
    let source = Source::Zip {
        archive,
        folder,
        big_endian,
    };
    Ok((source, pickle))
}

/// The bytes of an entry, if it is there and has at most so many.
fn entry(archive: &mut ZipArchive<BufReader<File>>, name: &str, most: u64) -> Result<Option<Vec<u8>>, Problem> {
    let mut entry = match archive.by_name(name) {
        Ok(entry) => entry,
        Err(ZipError::FileNotFound) => return Ok(None),
        Err(error) => return Err(error.into()),
    };
    // What it says of its size is not believed: memory is taken for what comes.
    let mut bytes = Vec::new();
    entry.by_ref().take(most.saturating_add(1)).read_to_end(&mut bytes)?;
    Ok(Some(bytes).filter(|bytes| bytes.len() as u64 <= most))
}
