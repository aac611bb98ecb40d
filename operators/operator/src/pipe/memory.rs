//! Shared memory: whoever writes a frame makes a sealed memory file, whoever reads it maps it through `/proc`.
//!
//! A sealed file can neither change nor shrink, so that a mapping of it is as good as bytes of one's own.

use std::fmt;
use std::fs::File;
use std::io::{self, Write};
use std::str::FromStr;
use std::sync::OnceLock;

use arrow_buffer::Buffer;

/// Where a frame lies: an open file of a process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameAt {
    /// The process.
    pub pid: u32,
    /// The file's number there.
    pub fd: u32,
    /// Bytes of the file.
    pub length: u32,
}

impl fmt::Display for FrameAt {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{} {} {}", self.pid, self.fd, self.length)
    }
}

impl FromStr for FrameAt {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("expected the numbers of a process, a file and its bytes, found `{text}`");
        let numbers: Vec<u32> = text.split(' ').filter_map(|number| number.parse().ok()).collect();
        let [pid, fd, length] = numbers[..].try_into().map_err(|_| wrong())?;
        Ok(FrameAt { pid, fd, length })
    }
}

/// A frame that the other side may read as long as this lives.
#[derive(Debug)]
pub struct Lent {
    #[allow(dead_code, reason = "is kept open for the other side")]
    file: File,
    place: FrameAt,
}

impl Lent {
    /// Where the other side finds it.
    pub fn place(&self) -> FrameAt {
        self.place
    }
}

/// What a host lends to a program to try whether it can read the host's memory; `None` where there is none to share.
pub fn probe() -> Option<FrameAt> {
    static PROBE: OnceLock<Option<Lent>> = OnceLock::new();
    let probe = PROBE.get_or_init(|| lend(&[Buffer::from(b"realo")]).ok());
    probe.as_ref().map(Lent::place)
}

/// Whether this process can lend and read memory.
pub fn works() -> bool {
    probe().is_some_and(|place| open(place).is_ok())
}

/// Whether this process can read what a host lent it to try, and can lend memory itself.
pub fn reaches(probe: &str) -> bool {
    probe.parse().is_ok_and(|place: FrameAt| open(place).is_ok()) && works()
}

/// Writes a frame to a file in memory and seals it.
///
/// # Errors
/// What the system says against it.
#[cfg(target_os = "linux")]
pub fn lend(parts: &[Buffer]) -> io::Result<Lent> {
    use std::os::fd::AsRawFd;

    use rustix::fs::{MemfdFlags, fcntl_add_seals, memfd_create};

    let flags = MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING;
    let mut file = File::from(memfd_create("realo", flags)?);
    let length: usize = parts.iter().map(Buffer::len).sum();
    file.set_len(length as u64)?;
    for part in parts {
        file.write_all(part)?;
    }
    fcntl_add_seals(&file, seals())?;
    let wide = |_| io::Error::from(io::ErrorKind::FileTooLarge);
    let place = FrameAt {
        pid: std::process::id(),
        fd: file.as_raw_fd().unsigned_abs(),
        length: length.try_into().map_err(wide)?,
    };
    Ok(Lent { file, place })
}

/// Maps a frame that another process lent; the mapping lives as long as the buffer and what is made of it.
///
/// # Errors
/// A file that is not there, not sealed, or of another length.
#[cfg(target_os = "linux")]
pub fn open(place: FrameAt) -> io::Result<Buffer> {
    use rustix::fs::{Mode, OFlags, fcntl_get_seals};

    let FrameAt { pid, fd, length } = place;
    // Whatever the other side names, opening it must not wait.
    let flags = OFlags::RDONLY | OFlags::CLOEXEC | OFlags::NONBLOCK | OFlags::NOCTTY;
    let file = File::from(rustix::fs::open(format!("/proc/{pid}/fd/{fd}"), flags, Mode::empty())?);
    let wrong = |reason: String| io::Error::new(io::ErrorKind::InvalidData, reason);
    let sealed = fcntl_get_seals(&file).is_ok_and(|found| found.contains(seals()));
    if !sealed {
        return Err(wrong("the file that was named is not sealed".into()));
    }
    let found = file.metadata()?.len();
    if found != u64::from(length) || length == 0 {
        return Err(wrong(format!("expected a file of {length} bytes, found {found}")));
    }
    #[allow(unsafe_code)]
    // SAFETY: the seals keep the file's bytes and its length as they are for as long as it exists.
    let mapping = unsafe { memmap2::MmapOptions::new().len(length as usize).populate().map(&file)? };
    Ok(Buffer::from(bytes::Bytes::from_owner(mapping)))
}

#[cfg(target_os = "linux")]
fn seals() -> rustix::fs::SealFlags {
    use rustix::fs::SealFlags;

    SealFlags::SEAL | SealFlags::SHRINK | SealFlags::GROW | SealFlags::WRITE
}

/// Says that there is none on this system.
///
/// # Errors
/// Always.
#[cfg(not(target_os = "linux"))]
pub fn lend(_: &[Buffer]) -> io::Result<Lent> {
    Err(io::ErrorKind::Unsupported.into())
}

/// Says that there is none on this system.
///
/// # Errors
/// Always.
#[cfg(not(target_os = "linux"))]
pub fn open(_: FrameAt) -> io::Result<Buffer> {
    Err(io::ErrorKind::Unsupported.into())
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::os::fd::AsRawFd;

    use super::*;

    #[test]
    fn a_place_survives_as_text() {
        let place = FrameAt {
            pid: 1,
            fd: 2,
            length: u32::MAX,
        };
        assert_eq!(place.to_string().parse(), Ok(place));
        assert!("1 2".parse::<FrameAt>().is_err() && "1 2 -3".parse::<FrameAt>().is_err());
        assert!(works() && reaches(&probe().unwrap().to_string()));
        assert!(!reaches("") && !reaches("1 2 3"));
    }

    #[test]
    fn a_mapping_outlives_the_file() {
        let lent = lend(&[Buffer::from(&[1; 5000]), Buffer::from(&[2; 10])]).unwrap();
        let found = open(lent.place()).unwrap();
        drop(lent);
        let part = found.slice(4999);
        drop(found);
        assert_eq!(part.as_slice(), [1, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2]);
    }

    #[test]
    fn refuses_what_could_still_change() {
        let open_at = |file: &File, length| {
            open(FrameAt {
                pid: std::process::id(),
                fd: file.as_raw_fd().unsigned_abs(),
                length,
            })
        };
        let plain = tempfile::tempfile().unwrap();
        plain.set_len(10).unwrap();
        assert!(open_at(&plain, 10).unwrap_err().to_string().contains("not sealed"));
        let flags = rustix::fs::MemfdFlags::ALLOW_SEALING;
        let open_memory = File::from(rustix::fs::memfd_create("test", flags).unwrap());
        open_memory.set_len(10).unwrap();
        assert!(
            open_at(&open_memory, 10)
                .unwrap_err()
                .to_string()
                .contains("not sealed")
        );
        let lent = lend(&[Buffer::from(&[1; 10])]).unwrap();
        let error = open(FrameAt {
            length: 11,
            ..lent.place()
        });
        assert!(error.unwrap_err().to_string().contains("expected a file of 11"));
        let gone = lent.place();
        drop(lent);
        assert!(open(gone).is_err());
    }
}
