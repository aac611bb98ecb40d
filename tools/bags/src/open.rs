//! Which sort of bag a path is.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use realo_logs::shell;
use tempfile::NamedTempFile;

use crate::db3::Db3;
use crate::mcap::Mcap;
use crate::pack::{ZSTD, unpack_file};
use crate::pcap::{self, Pcap};
use crate::rosbag1::Rosbag1;
use crate::rosbag2::{METADATA, Rosbag2};
use crate::{Bag, BagError, rosbag1, sqlite};

/// How an MCAP file begins.
const MCAP: &[u8] = b"\x89MCAP0\r\n";
const LFS: &[u8] = b"version https://git-lfs";
/// Bytes that tell what a file is.
const LOOKED_AT: u64 = 32;
const SORTS: &str = "a bag of ROS 1 (`.bag`), the folder of a bag of ROS 2, or one of its files (`.db3`, `.mcap`), \
                     or a capture of packets (`.pcap`)";

/// Opens a bag: a file of ROS 1, a folder of ROS 2 or one of its files, or an MCAP file of anybody.
///
/// # Errors
/// Something else; a part that is missing; a file that is damaged where nothing can be read.
pub fn open(path: &Path) -> Result<Box<dyn Bag>, BagError> {
    if path.is_dir() {
        return Ok(Box::new(Rosbag2::open(path)?));
    }
    if path.file_name().is_some_and(|name| name == METADATA) {
        let dir = path.parent().filter(|dir| !dir.as_os_str().is_empty());
        return Ok(Box::new(Rosbag2::open(dir.unwrap_or(Path::new(".")))?));
    }
    let begin = head(path)?;
    if begin.starts_with(rosbag1::MAGIC) || pcap::MAGICS.iter().any(|magic| begin.starts_with(magic)) {
        return open_file(path);
    }
    let (unpacked, lost) = unpacked(path)?;
    let bag = match &unpacked {
        None => open_file(path)?,
        Some(unpacked) => open_file(unpacked.path())
            .map_err(|error| BagError::content(path, format!("what it was unpacked to cannot be read: {error}")))?,
    };
    Ok(Box::new(Rosbag2::of_file(
        path,
        bag,
        unpacked,
        lost.into_iter().collect(),
    )))
}

/// Why a path is a bag, by its first bytes alone.
///
/// # Errors
/// Why it is not.
pub fn recognise(path: &Path) -> Result<&'static str, String> {
    if path.is_dir() {
        return match realo_documents::read(&path.join(METADATA)) {
            Ok(text) if text.contains("rosbag2_bagfile_information") => Ok("there is `metadata.yaml` of a bag"),
            _ => Err(format!("there is no `{METADATA}` of a bag")),
        };
    }
    let head = head(path).map_err(|error| error.to_string())?;
    match &head[..] {
        head if head.starts_with(rosbag1::MAGIC) => Ok("it begins with `#ROSBAG V`"),
        head if head.starts_with(sqlite::MAGIC) => Ok("it is an SQLite file"),
        head if head.starts_with(MCAP) => match Mcap::open(path) {
            Ok(file) if file.is_ours() => Err("it is a log or a recording of realo already".into()),
            Ok(_) => Ok("it is an MCAP file"),
            Err(error) => Err(error.to_string()),
        },
        head if head.starts_with(&ZSTD) => Ok("it is compressed by zstd"),
        head if pcap::MAGICS.iter().any(|magic| head.starts_with(magic)) => Ok("it is a capture of packets"),
        _ => Err(format!("it does not begin as {SORTS}")),
    }
}

fn head(path: &Path) -> Result<Vec<u8>, BagError> {
    // To open a pipe would wait for whoever writes into it.
    if !path.metadata().map_err(BagError::io(path))?.is_file() {
        return Err(BagError::content(
            path,
            format!("expected {SORTS}, found a device or the like"),
        ));
    }
    let mut head = Vec::new();
    let file = File::open(path).map_err(BagError::io(path))?;
    file.take(LOOKED_AT)
        .read_to_end(&mut head)
        .map_err(BagError::io(path))?;
    Ok(head)
}

/// What a file that is compressed as a whole unpacks to, and why that ends early; nothing of another.
pub(crate) fn unpacked(path: &Path) -> Result<(Option<NamedTempFile>, Option<String>), BagError> {
    match head(path)?.starts_with(&ZSTD) {
        false => Ok((None, None)),
        true => {
            let (file, lost) = unpack_file(path)?;
            Ok((Some(file), lost))
        }
    }
}

/// Opens a file that is not compressed as a whole.
pub(crate) fn open_file(path: &Path) -> Result<Box<dyn Bag>, BagError> {
    let head = head(path)?;
    match &head[..] {
        head if head.starts_with(rosbag1::MAGIC) => Ok(Box::new(Rosbag1::open(path)?)),
        head if head.starts_with(sqlite::MAGIC) => Ok(Box::new(Db3::open(path)?)),
        head if head.starts_with(MCAP) => Ok(Box::new(Mcap::open(path)?)),
        head if pcap::MAGICS.iter().any(|magic| head.starts_with(magic)) => Ok(Box::new(Pcap::open(path)?)),
        head => Err(BagError::content(
            path,
            format!("expected {SORTS}, found {}", what(path, head)),
        )),
    }
}

/// What a pickle is called, and why nothing is read from it.
pub const PICKLE: &str = "a pickle of Python, which is never loaded, as loading one runs what is in it";

/// Whether a file begins as a pickle of protocol 2 or later does. The older protocols begin as any text may.
pub fn is_pickle(head: &[u8]) -> bool {
    matches!(head, [0x80, 2..=5, ..])
}

/// What a file is instead, and what helps.
fn what(path: &Path, head: &[u8]) -> String {
    let name = shell::word(path);
    let unpack = |what: &str, program: &str| {
        format!("a file that is compressed by {what}; unpack it first (`{program} {name}`)")
    };
    match head {
        [] => "an empty file; the recorder ended before its first message, or the copy failed".into(),
        head if head.starts_with(&pcap::NEWER) => {
            format!("a capture of the newer form; convert it by `editcap -F pcap {name} packets.pcap`")
        }
        head if head.starts_with(LFS) => "a pointer of Git LFS; run `git lfs pull` in its folder".into(),
        head if head.starts_with(b"\x1f\x8b") => unpack("gzip", "gunzip -k"),
        head if head.starts_with(b"BZh") => unpack("bzip2", "bunzip2 -k"),
        head if head.starts_with(b"\x04\x22\x4d\x18") => unpack("lz4", "lz4 -d"),
        head if head.starts_with(b"PK\x03\x04") => unpack("zip", "unzip"),
        head if head.starts_with(&ZSTD) => unpack("zstd twice", "zstd -d"),
        head if is_pickle(head) => {
            format!("{PICKLE}; save its arrays as `.npz` (numpy.savez) for `import numpy`, or record a bag")
        }
        head if head.starts_with(b"ply\n") || head.starts_with(b"ply\r") => {
            "a cloud of PLY; `import opv2v` and `import v2x-real` read such clouds beside their labels".into()
        }
        head => format!(
            "a file that begins with {:02x?}; the copy may have failed",
            &head[..head.len().min(5)]
        ),
    }
}
