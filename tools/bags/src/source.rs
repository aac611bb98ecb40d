//! What every bag gives: connections and messages.

use std::collections::BTreeSet;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use realo_logs::cdr::CdrReader;
use realo_schemas::Nanos;

use crate::BagError;

/// How the messages of a connection are serialised.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Encoding {
    /// CDR of ROS 2, of either byte order.
    Cdr,
    /// The serialisation of ROS 1.
    Ros1,
    /// Another one, by its name.
    Other(String),
}

impl Encoding {
    pub(crate) fn named(name: &str) -> Self {
        match name {
            "cdr" => Encoding::Cdr,
            "ros1" => Encoding::Ros1,
            other => Encoding::Other(other.into()),
        }
    }

    /// Its name.
    pub fn as_str(&self) -> &str {
        match self {
            Encoding::Cdr => "cdr",
            Encoding::Ros1 => "ros1",
            Encoding::Other(name) => name,
        }
    }
}

/// A topic of a bag.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Connection {
    /// Its topic.
    pub topic: String,
    /// Type of its messages, as `sensor_msgs/PointCloud2`, in ROS 2 too.
    pub kind: String,
    /// How they are serialised.
    pub encoding: Encoding,
    /// How many there are.
    pub messages: u64,
}

impl Connection {
    /// Starts to read a message of this connection.
    ///
    /// # Errors
    /// A serialisation that is not known; why there is nothing to read.
    pub fn reader_of<'a>(&self, message: &'a Message) -> Result<CdrReader<'a>, String> {
        match message.fault() {
            Some(fault) => Err(fault.into()),
            None => self.reader(message.data()),
        }
    }

    /// Starts to read the bytes of a message.
    ///
    /// # Errors
    /// A serialisation that is not known.
    pub fn reader<'a>(&self, data: &'a [u8]) -> Result<CdrReader<'a>, String> {
        match &self.encoding {
            Encoding::Cdr => CdrReader::any_cdr(data),
            Encoding::Ros1 => Ok(CdrReader::ros1(data)),
            Encoding::Other(name) => Err(format!(
                "expected the serialisation cdr or ros1, found `{}`; convert the bag (`ros2 bag convert` with \
                 `output_serialization_format: cdr`)",
                name.escape_debug()
            )),
        }
    }
}

/// A type as both versions of ROS call it: `sensor_msgs/msg/Imu` is `sensor_msgs/Imu`.
pub(crate) fn plain_kind(kind: &str) -> String {
    kind.replacen("/msg/", "/", 1)
}

/// The latest time that is believed, ns; so differences of times do not overflow.
const LATEST: Nanos = 5_000_000_000_000_000_000;

/// A log time as far as it is believed.
pub(crate) fn believed(log_time: Nanos) -> Nanos {
    log_time.clamp(0, LATEST)
}

/// A message of a bag.
#[derive(Clone, Debug)]
pub struct Message {
    /// Place of its connection among those of the bag.
    pub connection: usize,
    /// When it was recorded, by the clock of the recorder, ns.
    pub log_time: Nanos,
    bytes: Arc<Vec<u8>>,
    body: Range<usize>,
    fault: Option<String>,
}

impl Message {
    pub(crate) fn new(connection: usize, log_time: Nanos, bytes: Arc<Vec<u8>>, body: Range<usize>) -> Self {
        Message {
            connection,
            log_time: believed(log_time),
            bytes,
            body,
            fault: None,
        }
    }

    /// What stands for a cloud that could not be decoded, with why.
    pub(crate) fn faulty(connection: usize, log_time: Nanos, fault: String) -> Self {
        Message {
            fault: Some(fault),
            ..Message::owned(connection, log_time, Vec::new())
        }
    }

    /// Why it holds nothing, where it was to be decoded of packets.
    pub fn fault(&self) -> Option<&str> {
        self.fault.as_deref()
    }

    pub(crate) fn owned(connection: usize, log_time: Nanos, bytes: Vec<u8>) -> Self {
        let body = 0..bytes.len();
        Message::new(connection, log_time, Arc::new(bytes), body)
    }

    /// Its bytes.
    pub fn data(&self) -> &[u8] {
        &self.bytes[self.body.clone()]
    }
}

/// From the first to the last time of spans, ns; `None` without any.
pub(crate) fn span_over(spans: impl Iterator<Item = [Nanos; 2]>) -> Option<[Nanos; 2]> {
    spans.reduce(|[first, last], [from, until]| [first.min(from), last.max(until)])
}

/// A recording of topics.
pub trait Bag {
    /// The file or folder.
    fn path(&self) -> &Path;

    /// What it is, in words.
    fn format(&self) -> &'static str;

    /// Its topics.
    fn connections(&self) -> &[Connection];

    /// First and last log time, ns; `None` without messages.
    fn span(&self) -> Option<[Nanos; 2]>;

    /// What is missing of it or strange about it, a line each.
    fn notes(&self) -> &[String];

    /// Topics that are decoded from others, a line each.
    fn decoded(&self) -> &[String] {
        &[]
    }

    /// Messages of some connections in the order of log time.
    ///
    /// # Errors
    /// A file that cannot be opened again.
    fn messages(&self, wanted: &BTreeSet<usize>) -> Result<Box<dyn Messages + '_>, BagError>;
}

/// Messages in the order of log time.
pub trait Messages {
    /// The next message; `None` after the last.
    ///
    /// # Errors
    /// Bytes that contradict the format, with their place.
    fn next(&mut self) -> Result<Option<Message>, BagError>;
}
