//! Captures of packets of UDP (`.pcap`): a topic for each port that packets are sent to.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use realo_schemas::Nanos;

use crate::packets::UDP;
use crate::source::believed;
use crate::{Bag, BagError, Connection, Encoding, Message, Messages};

/// How captures begin, with stamps in µs or ns, of either byte order; and those of a newer form.
pub(crate) const MAGICS: [[u8; 4]; 4] = [
    [0xd4, 0xc3, 0xb2, 0xa1],
    [0x4d, 0x3c, 0xb2, 0xa1],
    [0xa1, 0xb2, 0xc3, 0xd4],
    [0xa1, 0xb2, 0x3c, 0x4d],
];
pub(crate) const NEWER: [u8; 4] = [0x0a, 0x0d, 0x0d, 0x0a];
/// No packet is longer.
const LONGEST: u32 = 1 << 18;

/// A payload in the file.
struct Payload {
    log_time: Nanos,
    connection: usize,
    at: u64,
    bytes: usize,
}

/// An open capture.
pub(crate) struct Pcap {
    path: PathBuf,
    connections: Vec<Connection>,
    payloads: Vec<Payload>,
    notes: Vec<String>,
}

/// How numbers of the file are read.
#[derive(Clone, Copy)]
struct Form {
    is_big: bool,
    is_nanos: bool,
    link: u32,
}

impl Form {
    fn u32(self, bytes: &[u8]) -> u32 {
        let four = bytes.try_into().unwrap_or_default();
        if self.is_big {
            u32::from_be_bytes(four)
        } else {
            u32::from_le_bytes(four)
        }
    }

    fn of(head: &[u8; 24]) -> Option<Self> {
        let index = MAGICS.iter().position(|magic| head.starts_with(magic))?;
        let form = Form {
            is_big: index >= 2,
            is_nanos: index % 2 == 1,
            link: 0,
        };
        Some(Form {
            link: form.u32(&head[20..]) & 0x0fff_ffff,
            ..form
        })
    }

    /// Bytes before a packet of IP, by the bytes of the link.
    fn link_bytes(self, frame: &[u8]) -> Option<usize> {
        let is_ip = |at: usize| frame.get(at..at + 2) == Some(&[0x08, 0x00]);
        match self.link {
            1 if is_ip(12) => Some(14),
            // A tag of a virtual network.
            1 if frame.get(12..14) == Some(&[0x81, 0x00]) && is_ip(16) => Some(18),
            113 if is_ip(14) => Some(16),
            276 if is_ip(0) => Some(20),
            12 | 14 | 101 | 228 => Some(0),
            _ => None,
        }
    }
}

/// A payload of UDP in a packet of IPv4: the port that it is sent to, and where it lies.
enum Found {
    Udp(u16, usize, usize),
    Fragment,
    Other,
}

fn udp(frame: &[u8], ip: usize) -> Found {
    let Some(head) = frame.get(ip..ip + 20).filter(|head| head[0] >> 4 == 4 && head[9] == 17) else {
        return Found::Other;
    };
    // More fragments follow, or it is not the first.
    if (u16::from_be_bytes([head[6], head[7]]) & 0x3fff) != 0 {
        return Found::Fragment;
    }
    let udp = ip + 4 * usize::from(head[0] & 0x0f);
    let Some(head) = frame.get(udp..udp + 8) else {
        return Found::Other;
    };
    let [port, length] = [[head[2], head[3]], [head[4], head[5]]].map(u16::from_be_bytes);
    let bytes = usize::from(length).saturating_sub(8);
    match frame.len() >= udp + 8 + bytes {
        true => Found::Udp(port, udp + 8, bytes),
        false => Found::Other,
    }
}

impl Pcap {
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let file = File::open(path).map_err(BagError::io(path))?;
        let mut input = BufReader::with_capacity(1 << 20, file);
        let mut head = [0; 24];
        input.read_exact(&mut head).map_err(BagError::io(path))?;
        let form =
            Form::of(&head).ok_or_else(|| BagError::content(path, "expected a capture, found another beginning"))?;
        if ![1, 12, 14, 101, 113, 228, 276].contains(&form.link) {
            let reason = format!(
                "expected a capture of Ethernet, of IP or of `any`, found the link type {}; convert it by `editcap -T ether`",
                form.link
            );
            return Err(BagError::content(path, reason));
        }
        let mut pcap = Pcap {
            path: path.into(),
            connections: Vec::new(),
            payloads: Vec::new(),
            notes: Vec::new(),
        };
        pcap.scan(&mut input, form).map_err(BagError::io(path))?;
        pcap.payloads.sort_by_key(|payload| payload.log_time);
        Ok(pcap)
    }

    /// A topic for a port.
    fn connection(&mut self, port: u16) -> usize {
        self.connections.push(Connection {
            topic: format!("/udp/{port}"),
            kind: UDP.into(),
            encoding: Encoding::Other("udp".into()),
            messages: 0,
        });
        self.connections.len() - 1
    }

    fn scan(&mut self, input: &mut impl Read, form: Form) -> std::io::Result<()> {
        let (mut at, mut ports, mut fragments, mut others) = (24_u64, BTreeMap::<u16, usize>::new(), 0_u64, 0_u64);
        let mut frame = Vec::new();
        loop {
            let mut head = [0; 16];
            match read_all(input, &mut head)? {
                0 => break,
                16 => {}
                _ => {
                    self.notes.push(format!(
                        "the capture was cut at byte {at}: all packets before it are read"
                    ));
                    break;
                }
            }
            let [seconds, part, kept] = [0, 4, 8].map(|byte| form.u32(&head[byte..byte + 4]));
            if kept > LONGEST {
                self.notes.push(format!(
                    "a packet of {kept} bytes at byte {at} is none: what follows is not read"
                ));
                break;
            }
            frame.resize(kept as usize, 0);
            if read_all(input, &mut frame)? < frame.len() {
                self.notes.push(format!(
                    "the capture was cut at byte {at}: all packets before it are read"
                ));
                break;
            }
            let part = if form.is_nanos { part } else { part.saturating_mul(1000) };
            let log_time = believed(i64::from(seconds) * 1_000_000_000 + i64::from(part));
            match form.link_bytes(&frame).map_or(Found::Other, |ip| udp(&frame, ip)) {
                Found::Udp(port, begin, bytes) => {
                    let connection = *ports.entry(port).or_insert_with(|| self.connection(port));
                    self.connections[connection].messages += 1;
                    self.payloads.push(Payload {
                        log_time,
                        connection,
                        at: at + 16 + begin as u64,
                        bytes,
                    });
                }
                Found::Fragment => fragments += 1,
                Found::Other => others += 1,
            }
            at += 16 + u64::from(kept);
        }
        if fragments > 0 {
            self.notes.push(format!(
                "{fragments} fragments of packets are left out: capture with jumbo frames"
            ));
        }
        if others > 0 {
            self.notes
                .push(format!("{others} packets are no UDP over IPv4, and are left out"));
        }
        Ok(())
    }
}

/// Reads as much as there is.
fn read_all(input: &mut impl Read, into: &mut [u8]) -> std::io::Result<usize> {
    let mut read = 0;
    while read < into.len() {
        match input.read(&mut into[read..])? {
            0 => break,
            bytes => read += bytes,
        }
    }
    Ok(read)
}

impl Bag for Pcap {
    fn path(&self) -> &Path {
        &self.path
    }

    fn format(&self) -> &'static str {
        "capture of packets"
    }

    fn connections(&self) -> &[Connection] {
        &self.connections
    }

    fn span(&self) -> Option<[Nanos; 2]> {
        Some([self.payloads.first()?.log_time, self.payloads.last()?.log_time])
    }

    fn notes(&self) -> &[String] {
        &self.notes
    }

    fn messages(&self, wanted: &BTreeSet<usize>) -> Result<Box<dyn Messages + '_>, BagError> {
        let file = File::open(&self.path).map_err(BagError::io(&self.path))?;
        Ok(Box::new(InOrder {
            pcap: self,
            file: BufReader::with_capacity(1 << 17, file),
            wanted: wanted.clone(),
            next: 0,
        }))
    }
}

struct InOrder<'a> {
    pcap: &'a Pcap,
    file: BufReader<File>,
    wanted: BTreeSet<usize>,
    next: usize,
}

impl Messages for InOrder<'_> {
    fn next(&mut self) -> Result<Option<Message>, BagError> {
        while let Some(payload) = self.pcap.payloads.get(self.next) {
            self.next += 1;
            if !self.wanted.contains(&payload.connection) {
                continue;
            }
            let mut bytes = vec![0; payload.bytes];
            let read = self
                .file
                .seek(SeekFrom::Start(payload.at))
                .and_then(|_| self.file.read_exact(&mut bytes));
            read.map_err(BagError::io(&self.pcap.path))?;
            return Ok(Some(Message::owned(payload.connection, payload.log_time, bytes)));
        }
        Ok(None)
    }
}
