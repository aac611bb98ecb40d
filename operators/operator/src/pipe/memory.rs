//! Shared memory: whoever writes frames keeps files in memory for them, whoever reads them maps these through `/proc` and
//! gives each back once nothing of its frame is needed any more. Then it is written again: to make and to map the pages of
//! a sweep costs more than to copy it.

use std::collections::BTreeMap;
use std::fmt;
use std::fs::File;
use std::io;
use std::str::FromStr;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};

use arrow_buffer::Buffer;

/// Files that one side lends at most; a frame for which there is none goes through the pipe.
pub const LENT_AT_MOST: usize = 64;

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

/// The shared memory of one side of a pipe: what it lends, and what it borrows from the other.
#[derive(Debug, Default)]
pub struct Memory {
    own: Mutex<Own>,
    mapped: Mutex<BTreeMap<u32, Arc<Mapping>>>,
    read: Arc<Mutex<Vec<u32>>>,
}

#[derive(Debug, Default)]
struct Own {
    free: Vec<File>,
    lent: BTreeMap<u32, File>,
}

/// A borrowed frame; its file is given back when the last array of it is gone.
struct Borrowed {
    mapping: Arc<Mapping>,
    place: FrameAt,
    read: Arc<Mutex<Vec<u32>>>,
}

impl AsRef<[u8]> for Borrowed {
    fn as_ref(&self) -> &[u8] {
        &self.mapping[..self.place.length as usize]
    }
}

impl Drop for Borrowed {
    fn drop(&mut self) {
        locked(&self.read).push(self.place.fd);
    }
}

impl Memory {
    /// Writes a frame to a file that the other side may read until it gives it back; `None` if it holds
    /// [`LENT_AT_MOST`].
    ///
    /// # Errors
    /// What the system says against it.
    pub fn lend(&self, parts: &[Buffer]) -> io::Result<Option<FrameAt>> {
        let mut own = locked(&self.own);
        if own.lent.len() == LENT_AT_MOST {
            return Ok(None);
        }
        let file = own.free.pop().map_or_else(system::create, Ok)?;
        let mut length = 0;
        for part in parts {
            system::write_at(&file, part, length)?;
            length += part.len() as u64;
        }
        let place = FrameAt {
            pid: std::process::id(),
            fd: system::number(&file),
            length: length
                .try_into()
                .map_err(|_| io::Error::from(io::ErrorKind::FileTooLarge))?,
        };
        own.lent.insert(place.fd, file);
        Ok(Some(place))
    }

    /// Takes back what the other side has read.
    ///
    /// # Errors
    /// A number that was not lent.
    pub fn take_back(&self, numbers: &[u32]) -> io::Result<()> {
        let mut own = locked(&self.own);
        for number in numbers {
            let file = own.lent.remove(number).ok_or_else(|| {
                let held: Vec<_> = own.lent.keys().collect();
                wrong(format!("file {number} was given back, lent are {held:?}"))
            })?;
            own.free.push(file);
        }
        Ok(())
    }

    /// The frame that the other side lent.
    ///
    /// # Errors
    /// A file that is not there, could be cut, or is shorter; more of them than one side lends.
    pub fn borrow(&self, place: FrameAt) -> io::Result<Buffer> {
        let mut mapped = locked(&self.mapped);
        let known = mapped.get(&place.fd);
        if known.is_none() && mapped.len() == LENT_AT_MOST {
            let fd = place.fd;
            return Err(wrong(format!(
                "expected at most {LENT_AT_MOST} files, file {fd} is one more"
            )));
        }
        let mapping = match known.filter(|known| known.len() >= place.length as usize) {
            Some(known) => known.clone(),
            None => {
                let mapping = Arc::new(system::map(place)?);
                mapped.insert(place.fd, mapping.clone());
                mapping
            }
        };
        let read = self.read.clone();
        Ok(Buffer::from(bytes::Bytes::from_owner(Borrowed {
            mapping,
            place,
            read,
        })))
    }

    /// What was borrowed and is needed no more since this was last asked.
    pub fn give_back(&self) -> Vec<u32> {
        std::mem::take(&mut locked(&self.read))
    }
}

/// What a host lends to a program to try whether it can read the host's memory; `None` where there is none to share.
pub fn probe() -> Option<FrameAt> {
    static PROBE: OnceLock<(Memory, Option<FrameAt>)> = OnceLock::new();
    let (_, place) = PROBE.get_or_init(|| {
        let memory = Memory::default();
        let place = memory.lend(&[Buffer::from(b"realo")]).ok().flatten();
        (memory, place)
    });
    *place
}

/// Whether this process can lend and read memory.
pub fn works() -> bool {
    probe().is_some_and(|place| system::map(place).is_ok())
}

/// Whether this process can read what a host lent it to try, and can lend memory itself.
pub fn reaches(probe: &str) -> bool {
    probe.parse().is_ok_and(|place: FrameAt| system::map(place).is_ok()) && works()
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

fn wrong(reason: String) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, reason)
}

#[cfg(target_os = "linux")]
use memmap2::Mmap as Mapping;
#[cfg(not(target_os = "linux"))]
type Mapping = Vec<u8>;

#[cfg(target_os = "linux")]
mod system {
    use std::fs::File;
    use std::io;
    use std::os::fd::AsRawFd;
    use std::os::unix::fs::FileExt;

    use rustix::fs::{MemfdFlags, Mode, OFlags, SealFlags, fcntl_add_seals, fcntl_get_seals, memfd_create};

    use super::{FrameAt, Mapping, wrong};

    /// A new file in memory that can grow but not shrink: behind the end of one that does, a mapping is no memory.
    pub fn create() -> io::Result<File> {
        let file = File::from(memfd_create("realo", MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING)?);
        fcntl_add_seals(&file, SealFlags::SHRINK)?;
        Ok(file)
    }

    pub fn write_at(file: &File, bytes: &[u8], at: u64) -> io::Result<()> {
        file.write_all_at(bytes, at)
    }

    pub fn number(file: &File) -> u32 {
        file.as_raw_fd().unsigned_abs()
    }

    /// Maps as much of a file of another process as its frame is long.
    pub fn map(FrameAt { pid, fd, length }: FrameAt) -> io::Result<Mapping> {
        // Whatever the other side names, opening it must not wait.
        let flags = OFlags::RDONLY | OFlags::CLOEXEC | OFlags::NONBLOCK | OFlags::NOCTTY;
        let file = File::from(rustix::fs::open(format!("/proc/{pid}/fd/{fd}"), flags, Mode::empty())?);
        if !fcntl_get_seals(&file).is_ok_and(|seals| seals.contains(SealFlags::SHRINK)) {
            return Err(wrong("the file that was named is not sealed against shrinking".into()));
        }
        let found = file.metadata()?.len();
        if found < u64::from(length) || length == 0 {
            return Err(wrong(format!(
                "expected a file of {length} bytes or more, found {found}"
            )));
        }
        #[allow(unsafe_code)]
        // SAFETY: the seal keeps the file as long as the mapping is. Its owner writes to it again once it was given back,
        // after the last look at it; were it to do so earlier, numbers would be wrong, but lengths, offsets and texts are
        // no longer read from it then.
        unsafe {
            memmap2::MmapOptions::new().len(length as usize).populate().map(&file)
        }
    }
}

#[cfg(not(target_os = "linux"))]
mod system {
    use std::fs::File;
    use std::io;

    use super::{FrameAt, Mapping};

    pub fn create() -> io::Result<File> {
        Err(io::ErrorKind::Unsupported.into())
    }

    pub fn write_at(_: &File, _: &[u8], _: u64) -> io::Result<()> {
        Err(io::ErrorKind::Unsupported.into())
    }

    pub fn number(_: &File) -> u32 {
        0
    }

    pub fn map(_: FrameAt) -> io::Result<Mapping> {
        Err(io::ErrorKind::Unsupported.into())
    }
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
    fn a_file_is_written_again_only_when_all_of_its_frame_is_gone() {
        let (writer, reader) = (Memory::default(), Memory::default());
        let lend = |bytes: &[u8]| {
            writer
                .lend(&[Buffer::from(bytes), Buffer::from(b"!")])
                .unwrap()
                .unwrap()
        };
        let first = lend(&[1; 5000]);
        let found = reader.borrow(first).unwrap();
        let part = found.slice(4999);
        drop(found);
        assert!(reader.give_back().is_empty());
        let second = lend(&[2; 10]);
        assert_ne!(second.fd, first.fd);
        assert_eq!(part.as_slice(), [1, b'!']);

        drop(part);
        assert_eq!(reader.give_back(), [first.fd]);
        assert!(reader.give_back().is_empty());
        writer.take_back(&[first.fd]).unwrap();
        assert!(
            writer
                .take_back(&[first.fd])
                .unwrap_err()
                .to_string()
                .contains("was given back")
        );
        for bytes in [vec![3; 4000], vec![4; 9000]] {
            let again = lend(&bytes);
            assert_eq!(again.fd, first.fd);
            assert_eq!(reader.borrow(again).unwrap().as_slice(), [&bytes[..], b"!"].concat());
            writer.take_back(&reader.give_back()).unwrap();
        }
    }

    #[test]
    fn what_is_never_given_back_is_bounded() {
        let (writer, reader) = (Memory::default(), Memory::default());
        for _ in 0..LENT_AT_MOST {
            reader
                .borrow(writer.lend(&[Buffer::from(b"kept")]).unwrap().unwrap())
                .unwrap();
        }
        assert_eq!(writer.lend(&[Buffer::from(b"kept")]).unwrap(), None);
        let more = Memory::default().lend(&[Buffer::from(b"more")]).unwrap();
        assert!(more.is_some_and(|more| reader.borrow(more).is_err()));
    }

    #[test]
    fn refuses_what_could_be_cut() {
        let open_at = |file: &File, length| {
            let place = FrameAt {
                pid: std::process::id(),
                fd: file.as_raw_fd().unsigned_abs(),
                length,
            };
            Memory::default().borrow(place).map(|_| ())
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
        rustix::fs::fcntl_add_seals(&open_memory, rustix::fs::SealFlags::SHRINK).unwrap();
        assert!(open_at(&open_memory, 10).is_ok());
        assert!(
            open_at(&open_memory, 11)
                .unwrap_err()
                .to_string()
                .contains("expected a file of 11")
        );
        assert!(open_at(&open_memory, 0).is_err());
    }
}
