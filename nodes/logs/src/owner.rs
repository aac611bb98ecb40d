//! Who wrote a file, so that nothing is replaced that is not realo's.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Read};
use std::os::unix::fs::FileTypeExt;
use std::path::Path;

use crate::info::LOG_RECORD;
use crate::mcap_file::MAGIC;
use crate::{LogError, RECORDING_RECORD};

/// Opcode and length of an MCAP record.
const HEAD: usize = 9;
const HEADER: u8 = 0x01;
const METADATA: u8 = 0x0c;
/// The metadata record of realo lies within so many bytes of a file that realo wrote.
const HEAD_OF_FILE: u64 = 1 << 20;

/// What is at a path, by its first records; a file that was cut is known all the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Owner {
    /// No file, or one without a byte.
    Nobody,
    /// A log that realo wrote.
    Log,
    /// A log that another program wrote, such as one with `realo_log.py`.
    OtherLog,
    /// A recording of a run.
    Recording,
    /// An MCAP file of another program.
    OtherMcap,
    /// A pipe or a socket.
    Pipe,
    /// Anything else.
    Other,
}

impl Owner {
    /// Reads the first records of a file.
    ///
    /// # Errors
    /// A file that is there and cannot be read.
    pub fn of(path: &Path) -> io::Result<Owner> {
        let kind = match fs::metadata(path) {
            Ok(found) => found.file_type(),
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Owner::Nobody),
            Err(error) => return Err(error),
        };
        // Whoever opens a pipe waits for its other end.
        if kind.is_fifo() || kind.is_socket() {
            return Ok(Owner::Pipe);
        }
        // What is written to a device takes nobody's place.
        if !kind.is_file() {
            return Ok(Owner::Nobody);
        }
        let file = File::open(path)?;
        let mut head = Vec::new();
        file.take(HEAD_OF_FILE).read_to_end(&mut head)?;
        Ok(of_head(&head))
    }
}

fn of_head(head: &[u8]) -> Owner {
    if head.is_empty() {
        return Owner::Nobody;
    }
    let Some(mut rest) = head.strip_prefix(&MAGIC) else {
        return Owner::Other;
    };
    while let Some((opcode, body, behind)) = record(rest) {
        match opcode {
            HEADER => {}
            METADATA if is_named(body, LOG_RECORD) => {
                let is_ours = program_of(&body[4 + LOG_RECORD.len()..]).is_none_or(|name| name.starts_with("realo "));
                return if is_ours { Owner::Log } else { Owner::OtherLog };
            }
            METADATA if is_named(body, RECORDING_RECORD) => return Owner::Recording,
            METADATA => {}
            _ => break,
        }
        rest = behind;
    }
    Owner::OtherMcap
}

/// The opcode of a record, what is left of its body, and what follows.
fn record(bytes: &[u8]) -> Option<(u8, &[u8], &[u8])> {
    let (head, rest) = bytes.split_at_checked(HEAD)?;
    let length = u64::from_le_bytes(head[1..].try_into().ok()?);
    let length = usize::try_from(length).unwrap_or(usize::MAX);
    let (body, behind) = rest.split_at(length.min(rest.len()));
    Some((head[0], body, behind))
}

fn is_named(metadata: &[u8], name: &str) -> bool {
    let length = (name.len() as u32).to_le_bytes();
    metadata
        .strip_prefix(&length)
        .is_some_and(|rest| rest.starts_with(name.as_bytes()))
}

/// The program of a log, by the entries of its record: `None` of a file that is cut within them.
fn program_of(entries: &[u8]) -> Option<&str> {
    let mut rest = entries.get(4..)?;
    let mut text = || {
        let (length, behind) = rest.split_at_checked(4)?;
        let length = u32::from_le_bytes(length.try_into().ok()?) as usize;
        let (text, behind) = behind.split_at_checked(length)?;
        rest = behind;
        std::str::from_utf8(text).ok()
    };
    loop {
        let (key, value) = (text()?, text()?);
        if key == "program" {
            return Some(value);
        }
    }
}

/// Refuses to write a log or a recording over a file that realo did not write.
///
/// # Errors
/// [`LogError::Foreign`]; a file that cannot be read.
pub fn refuse_foreign(path: &Path) -> Result<(), LogError> {
    let found = match Owner::of(path).map_err(LogError::io(path, "look at"))? {
        Owner::Nobody | Owner::Log | Owner::Recording => return Ok(()),
        Owner::OtherLog => "a log that another program wrote, which nothing here could write again",
        Owner::OtherMcap => "an MCAP file of another program",
        Owner::Pipe => "a pipe or a socket",
        Owner::Other => "a file that is not an MCAP file",
    };
    Err(LogError::Foreign {
        path: path.into(),
        found,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{AgentInfo, AgentKind, LogInfo, LogWriter};

    #[test]
    fn only_what_realo_wrote_may_be_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str, bytes: &[u8]| {
            let path = folder.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            path
        };
        assert_eq!(Owner::of(&folder.path().join("none")).unwrap(), Owner::Nobody);
        assert_eq!(Owner::of(&at("empty", b"")).unwrap(), Owner::Nobody);
        let log = folder.path().join("log.mcap");
        let agent = AgentInfo {
            name: "cav1".into(),
            kind: AgentKind::Vehicle,
            footprint: None,
            sensor: String::new(),
            sensor_position: None,
        };
        LogWriter::create(&log, &LogInfo::new("a test", vec![agent.clone()]))
            .unwrap()
            .finish()
            .unwrap();
        assert_eq!(Owner::of(&log).unwrap(), Owner::Log);
        let mut info = LogInfo::new("our car", vec![agent]);
        info.program = "realo_log.py".into();
        let other = folder.path().join("other.mcap");
        LogWriter::create(&other, &info).unwrap().finish().unwrap();
        assert_eq!(Owner::of(&other).unwrap(), Owner::OtherLog);
        let said = refuse_foreign(&other).unwrap_err().to_string();
        assert!(said.contains("a log that another program wrote"), "{said}");
        let bytes = std::fs::read(&log).unwrap();
        assert_eq!(Owner::of(&at("cut", &bytes[..bytes.len() / 2])).unwrap(), Owner::Log);
        refuse_foreign(&log).unwrap();
        for (name, head, expected) in [
            ("text", &b"my notes"[..], "not an MCAP file"),
            ("magic", &MAGIC, "of another program"),
            (
                "huge",
                &[&MAGIC[..], &[METADATA], &u64::MAX.to_le_bytes()].concat(),
                "of another program",
            ),
        ] {
            let said = refuse_foreign(&at(name, head)).unwrap_err().to_string();
            assert!(said.contains(expected) && said.contains(name), "{said}");
        }
    }
}
