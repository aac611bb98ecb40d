//! From the processes of a graph to the one that started them, over a local socket.

use std::io::{self, Read, Write};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener, UnixStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use arrow::array::{RecordBatch, StructArray};
use arrow::ipc::reader::StreamReader;
use arrow::ipc::writer::StreamWriter;
use realo_schemas::{Message, wire};
use serde::{Deserialize, Serialize};

use super::{Seen, Sweeps, Tap};

/// Tells processes who watches.
pub const TAP_VARIABLE: &str = "REALO_TAP";
/// Largest thing that is seen, bytes.
const LARGEST: u32 = 64 << 20;
/// A process that connects says who it is within this time.
const TO_GREET: Duration = Duration::from_secs(2);

/// After the end of the processes, what they sent is read so long at most.
const TO_DRAIN: Duration = Duration::from_millis(500);
/// Between two tries to take a connection.
const TO_RETRY: Duration = Duration::from_millis(50);

const MESSAGE: u8 = 1;
const FATES: u8 = 2;

/// What [`TAP_VARIABLE`] holds.
#[derive(Serialize, Deserialize)]
struct Told {
    /// Name of the socket.
    socket: String,
    /// What only processes of this user can know.
    token: String,
    /// Stage and output.
    outputs: Vec<(String, String)>,
    /// One of so many tenths of a second is seen.
    one_of: u32,
}

/// Where the processes of a run bring what is seen of it, until this is dropped.
pub struct Inlet {
    told: Told,
    closed: Arc<AtomicBool>,
    /// Shared with the threads that read.
    reading: Arc<()>,
}

impl Inlet {
    /// Opens one for the outputs (stage, output) of a graph; `give` gets what its processes see.
    ///
    /// # Errors
    /// A system that has no sockets, random numbers or threads.
    pub fn open(
        outputs: Vec<(String, String)>,
        one_of: u32,
        give: impl Fn(Seen) + Send + Sync + 'static,
    ) -> io::Result<Self> {
        let random = || std::fs::read_to_string("/proc/sys/kernel/random/uuid").map(|text| text.trim().to_string());
        let (name, token) = (random()?, random()?);
        let socket = format!("realo-tap-{name}");
        let listener = UnixListener::bind_addr(&SocketAddr::from_abstract_name(&socket)?)?;
        let closed = Arc::new(AtomicBool::new(false));
        let reading = Arc::new(());
        let (known, is_closed, give, read) = (token.clone(), closed.clone(), Arc::new(give), reading.clone());
        std::thread::Builder::new().spawn(move || {
            for stream in listener.incoming() {
                if is_closed.load(Ordering::Relaxed) {
                    return;
                }
                let Ok(stream) = stream else {
                    // No file is left for a connection; later there may be one.
                    std::thread::sleep(TO_RETRY);
                    continue;
                };
                let (known, is_closed, give, reads) = (known.clone(), is_closed.clone(), give.clone(), read.clone());
                // Where no thread can be had, this process is not seen.
                let _ = std::thread::Builder::new().spawn(move || {
                    let read = read_all(stream, &known, &is_closed, &*give);
                    if let Err(error) = read.or_else(is_end) {
                        eprintln!("realo: the view lacks what one process sends: {error}");
                    }
                    drop(reads);
                });
            }
        })?;
        Ok(Inlet {
            told: Told {
                socket,
                token,
                outputs,
                one_of,
            },
            closed,
            reading,
        })
    }

    /// The value of [`TAP_VARIABLE`] for the processes of the run.
    ///
    /// # Errors
    /// Names that JSON cannot hold.
    pub fn told(&self) -> io::Result<String> {
        Ok(serde_json::to_string(&self.told)?)
    }
}

impl Drop for Inlet {
    fn drop(&mut self) {
        // What processes sent before they ended is read; this thread, and the one that listens, share it as well.
        let begun = Instant::now();
        while Arc::strong_count(&self.reading) > 2 && begun.elapsed() < TO_DRAIN {
            std::thread::sleep(Duration::from_millis(5));
        }
        self.closed.store(true, Ordering::Relaxed);
        // Wakes the thread that listens, which then ends.
        let _ = SocketAddr::from_abstract_name(&self.told.socket).and_then(|at| UnixStream::connect_addr(&at));
    }
}

/// A process that has ended says no more.
fn is_end(error: io::Error) -> io::Result<()> {
    match error.kind() {
        io::ErrorKind::UnexpectedEof | io::ErrorKind::ConnectionReset => Ok(()),
        _ => Err(error),
    }
}

fn read_all(mut stream: UnixStream, token: &str, is_closed: &AtomicBool, give: &dyn Fn(Seen)) -> io::Result<()> {
    stream.set_read_timeout(Some(TO_GREET))?;
    let mut greeting = vec![0; token.len()];
    stream.read_exact(&mut greeting)?;
    if greeting != token.as_bytes() {
        return Ok(());
    }
    stream.set_read_timeout(None)?;
    while !is_closed.load(Ordering::Relaxed) {
        let mut head = [0; 5];
        stream.read_exact(&mut head)?;
        let [kind, length @ ..] = head;
        let length = u32::from_le_bytes(length);
        if length > LARGEST {
            return Err(io::Error::other(format!("{length} bytes, expected at most {LARGEST}")));
        }
        let mut bytes = vec![0; length as usize];
        stream.read_exact(&mut bytes)?;
        give(decoded(kind, &bytes)?);
    }
    Ok(())
}

fn decoded(kind: u8, bytes: &[u8]) -> io::Result<Seen> {
    if kind == FATES {
        return Ok(Seen::Fates(serde_json::from_slice(bytes)?));
    }
    let (output, row) = bytes.split_first_chunk().ok_or(io::ErrorKind::UnexpectedEof)?;
    let output = u32::from_le_bytes(*output);
    let mut reader = StreamReader::try_new(row, None).map_err(io::Error::other)?;
    let batch = reader.next().ok_or(io::ErrorKind::UnexpectedEof)?;
    let row = StructArray::from(batch.map_err(io::Error::other)?);
    wire::from_arrow(&row)
        .map(|message| Seen::Message(output, Box::new(message)))
        .map_err(io::Error::other)
}

fn encoded(seen: &Seen) -> io::Result<(u8, Vec<u8>)> {
    match seen {
        Seen::Fates(fates) => Ok((FATES, serde_json::to_vec(fates)?)),
        Seen::Message(output, message) => Ok((MESSAGE, row(*output, message)?)),
    }
}

/// The number of an output, and its message as a row of Arrow.
fn row(output: u32, message: &Message) -> io::Result<Vec<u8>> {
    let batch = RecordBatch::from(wire::to_arrow(message));
    let mut bytes = output.to_le_bytes().to_vec();
    let mut write = || {
        let mut writer = StreamWriter::try_new(&mut bytes, &batch.schema())?;
        writer.write(&batch)?;
        writer.finish()
    };
    write().map_err(io::Error::other)?;
    Ok(bytes)
}

/// The tap of this process, if somebody watches the run. Where who watches cannot be reached any more, nothing is seen.
pub(crate) fn tap_of_this_process() -> Option<Tap> {
    let told: Told = serde_json::from_str(&std::env::var(TAP_VARIABLE).ok()?).ok()?;
    let at = SocketAddr::from_abstract_name(&told.socket).ok()?;
    let mut stream = UnixStream::connect_addr(&at).ok()?;
    stream.write_all(told.token.as_bytes()).ok()?;
    let give = move |seen| write_to(&mut stream, &seen).is_ok();
    Tap::new(told.outputs, Sweeps::OneOf(told.one_of), give).ok()
}

fn write_to(stream: &mut UnixStream, seen: &Seen) -> io::Result<()> {
    let (kind, bytes) = encoded(seen)?;
    let length = u32::try_from(bytes.len()).ok().filter(|length| *length <= LARGEST);
    // What is too large to be seen is left out.
    let Some(length) = length else { return Ok(()) };
    let [a, b, c, d] = length.to_le_bytes();
    stream.write_all(&[kind, a, b, c, d])?;
    stream.write_all(&bytes)
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;
    use std::sync::mpsc::channel;

    use realo_schemas::report::{Crossing, Fate, Fated, Use};
    use realo_schemas::{Boxes, Header, Kind};

    use super::*;

    fn things() -> [Seen; 2] {
        let header = Header::origin(&"run".into(), &"cav1".into(), Kind::Boxes, 3, 10, 20);
        let fated = Fated {
            message: Crossing {
                from: "rsu1".into(),
                to: "cav1".into(),
                kind: Kind::Points,
                seq: 2,
            },
            fate: Fate::Used,
            r#use: Some(Use { query: 3, age_ns: 5 }),
            entry: None,
        };
        [
            Seen::Message(3, Box::new(Message::new(header, Boxes::default()))),
            Seen::Fates(vec![fated]),
        ]
    }

    #[test]
    fn what_a_process_sees_arrives_and_strangers_are_not_heard() {
        let (sender, given) = channel();
        let sender = Mutex::new(sender);
        let inlet = Inlet::open(Vec::new(), 1, move |seen| sender.lock().unwrap().send(seen).unwrap()).unwrap();
        let at = SocketAddr::from_abstract_name(&inlet.told.socket).unwrap();
        let mut stranger = UnixStream::connect_addr(&at).unwrap();
        let junk = "x".repeat(inlet.told.token.len());
        stranger.write_all(junk.as_bytes()).unwrap();
        assert_eq!(stranger.read(&mut [0; 1]).unwrap(), 0, "it is shut out");
        let mut process = UnixStream::connect_addr(&at).unwrap();
        process.write_all(inlet.told.token.as_bytes()).unwrap();
        for seen in things() {
            write_to(&mut process, &seen).unwrap();
            assert_eq!(given.recv().unwrap(), seen);
        }
    }

    #[test]
    fn junk_is_an_error() {
        assert!(
            decoded(MESSAGE, b"junk").is_err() && decoded(FATES, b"junk").is_err() && decoded(MESSAGE, b"").is_err()
        );
    }
}
