//! Packets of LiDARs as clouds: a topic of packets has a topic of `sensor_msgs/PointCloud2` beside it, which is decoded from it.

pub mod ouster;
pub mod robosense;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::{Path, PathBuf};

use realo_logs::cloud::encode;
use realo_schemas::{Nanos, PointCloud};

use self::ouster::{Decoder, Format, Frame};
use self::robosense::Angles;
use crate::{Bag, BagError, Connection, Encoding, Message, Messages};

/// The type of payloads of UDP in captures.
pub const UDP: &str = "udp/payload";
/// Types of messages that hold a packet of Ouster.
const OUSTER: [&str; 3] = ["ouster_ros/PacketMsg", "ouster_sensor_msgs/PacketMsg", UDP];
/// The type of messages that hold the packets of a turn of RoboSense.
const ROBOSENSE: &str = "robosense_msgs/RobosenseScan";
/// Who makes such sensors.
const ROBOSENSE_MAKER: &str = "RoboSense";
/// Bytes of a packet of Velodyne.
const VELODYNE_BYTES: usize = 1206;
/// The type of clouds.
const CLOUD: &str = "sensor_msgs/PointCloud2";
/// How the name of a topic of decoded clouds ends.
const DECODED: &str = "/points";
/// The frame of clouds of Ouster.
const OUSTER_FRAME: &str = "os_sensor";
/// Packets by which a sensor's clock is compared with the recorder's.
const COMPARED: usize = 640;
/// Clocks that are nearer show the same time, ns: a day.
const SAME_CLOCK: Nanos = 86_400_000_000_000;
/// Stamps of messages go no further, ns: to 2038.
const LATEST: Nanos = (i32::MAX as Nanos) * 1_000_000_000;
/// Messages in which angles of RoboSense are looked for.
const LOOKED_AT: usize = 100;

/// A topic of packets with what decodes it.
struct Source {
    /// Place of the topic of packets.
    packets: usize,
    /// Place of the topic of clouds.
    clouds: usize,
    how: How,
}

enum How {
    /// Packets one by one, and what is added to the sensor's times, ns.
    Ouster(Box<Format>, Nanos),
    /// A turn in each message.
    Robosense(Box<Angles>),
}

/// A bag with its packets as clouds.
struct Decoded {
    bag: Box<dyn Bag>,
    connections: Vec<Connection>,
    notes: Vec<String>,
    /// What is decoded from what.
    decoded: Vec<String>,
    sources: Vec<Source>,
}

/// A bag with a topic of clouds for each topic of packets that can be decoded; a note says why another cannot be.
///
/// # Errors
/// A bag that cannot be read.
pub fn decoded(bag: Box<dyn Bag>) -> Result<Box<dyn Bag>, BagError> {
    let (mut connections, mut notes) = (bag.connections().to_vec(), bag.notes().to_vec());
    let (mut sources, mut decoded) = (Vec::new(), Vec::new());
    for (packets, connection) in bag.connections().iter().enumerate() {
        let is_ouster = OUSTER.contains(&&*connection.kind) && !connection.topic.contains("imu");
        if is_ouster && is_of_imu(bag.as_ref(), connection)? {
            decoded.push(format!(
                "`{}` is the port of the inertial unit, by the metadata: its packets are not read",
                connection.topic
            ));
            continue;
        }
        let how = match (is_ouster, &*connection.kind == ROBOSENSE) {
            _ if connection.messages == 0 => continue,
            (true, _) => of_ouster(bag.as_ref(), packets)?,
            (_, true) => of_robosense(bag.as_ref(), packets)?,
            _ => continue,
        };
        let topic = format!("{}{DECODED}", connection.topic);
        match how {
            Ok((how, note)) => {
                decoded.push(format!("`{}` is decoded as `{topic}`: {note}", connection.topic));
                let messages = match &how {
                    How::Robosense(_) => connection.messages,
                    How::Ouster(format, _) => connection.messages.div_ceil(format.packets_per_frame() as u64),
                };
                sources.push(Source {
                    packets,
                    clouds: connections.len(),
                    how,
                });
                connections.push(Connection {
                    topic,
                    kind: CLOUD.into(),
                    encoding: Encoding::Cdr,
                    messages,
                });
            }
            Err(reason) => notes.push(format!("packets of `{}` are not read: {reason}", connection.topic)),
        }
    }
    if sources.is_empty() && notes.len() == bag.notes().len() {
        return Ok(bag);
    }
    Ok(Box::new(Decoded {
        bag,
        connections,
        notes,
        decoded,
        sources,
    }))
}

/// Whether a port is that of the inertial unit, by the metadata beside a capture.
fn is_of_imu(bag: &dyn Bag, connection: &Connection) -> Result<bool, BagError> {
    if connection.kind != UDP {
        return Ok(false);
    }
    let format = metadata(bag, &connection.topic)?.and_then(|(text, _)| Format::parse(&text).ok());
    let ports = format.map_or([None; 2], |format| format.ports);
    let is_port = |port: Option<u64>| port.is_some_and(|port| connection.topic == format!("/udp/{port}"));
    Ok(is_port(ports[1]) && !is_port(ports[0]))
}

type Found = Result<(How, String), String>;

/// The packet in a message.
fn payload<'a>(connection: &Connection, message: &'a Message) -> Result<&'a [u8], String> {
    match &*connection.kind {
        UDP => Ok(message.data()),
        _ => connection.reader(message.data())?.bytes(),
    }
}

fn of_ouster(bag: &dyn Bag, packets: usize) -> Result<Found, BagError> {
    let connection = &bag.connections()[packets];
    if let Some(maker) = of_others(bag, packets)? {
        return Ok(Err(format!(
            "they are of {maker}, and in captures those of Ouster alone are read; play the capture through the sensor's driver and record \
             its clouds in a bag{}",
            if maker == ROBOSENSE_MAKER {
                ", or its `robosense_msgs/RobosenseScan`, which is read of a Helios 16P"
            } else {
                ""
            }
        )));
    }
    let (text, from) = match metadata(bag, &connection.topic)? {
        Some(found) => found,
        None => {
            return Ok(Err(format!(
                "expected the sensor's metadata on a topic `metadata` beside it, or in `{}` beside the file, found none; save it there",
                named_beside(bag.path()).display()
            )));
        }
    };
    let format = match Format::parse(&text) {
        Ok(format) => format,
        Err(reason) => return Ok(Err(format!("metadata of {from}: {reason}"))),
    };
    let glance = match Glance::of(bag, packets, &format)? {
        Ok(glance) => glance,
        Err(reason) => return Ok(Err(reason)),
    };
    let behind = glance.behind;
    let (shift, clock) = match behind.abs() < SAME_CLOCK {
        true => (0, "stamps are the sensor's".to_string()),
        false => (
            behind,
            format!(
                "the sensor's clock counts from elsewhere: {behind} ns, by the quickest packet, are added to its times"
            ),
        ),
    };
    let note = format!(
        "{}, metadata of {from}, reflectivities as intensities; {clock}{}",
        format.words(),
        glance.words()
    );
    Ok(Ok((How::Ouster(Box::new(format), shift), note)))
}

/// What the first packets say.
struct Glance {
    /// Log time less the sensor's, the smallest, ns.
    behind: Nanos,
    packets: usize,
    /// Packets that came before.
    doubled: usize,
    /// Packets of another start of the sensor than the metadata.
    restarted: usize,
}

impl Glance {
    fn of(bag: &dyn Bag, packets: usize, format: &Format) -> Result<Result<Self, String>, BagError> {
        let connection = &bag.connections()[packets];
        let mut messages = bag.messages(&BTreeSet::from([packets]))?;
        let (mut seen, mut behind, mut wrong) = (BTreeSet::new(), None::<Nanos>, Vec::new());
        let (mut most, mut doubled, mut restarted, mut count) = (0, 0, 0, 0);
        for _ in 0..COMPARED {
            let Some(message) = messages.next()? else { break };
            let looked = payload(connection, &message).and_then(|packet| {
                let last = format.last(packet)?;
                Ok((last, format.is_of_other_start(packet)?))
            });
            match looked {
                Ok((None, _)) => {}
                Ok((Some((time, frame, column)), is_restarted)) => {
                    let late = message.log_time - time;
                    behind = Some(behind.map_or(late, |least| least.min(late)));
                    most = most.max(column);
                    count += 1;
                    doubled += usize::from(!seen.insert((frame, column)));
                    restarted += usize::from(is_restarted);
                }
                Err(reason) => wrong.push(reason),
            }
        }
        // A few may be others that came to the same port.
        let behind = behind.filter(|_| 3 * wrong.len() <= count);
        let Some(behind) = behind else {
            return Ok(Err(wrong
                .pop()
                .unwrap_or_else(|| "expected packets, found none".into())));
        };
        if let Some(reason) = format.too_few_columns(most, seen.len()) {
            return Ok(Err(reason));
        }
        Ok(Ok(Glance {
            behind,
            packets: count,
            doubled,
            restarted,
        }))
    }

    fn words(&self) -> String {
        let Glance {
            packets,
            doubled,
            restarted,
            ..
        } = self;
        let mut words = String::new();
        if *doubled > 0 {
            words.push_str(&format!(
                "; {doubled} of the first {packets} packets came before: each counts once"
            ));
        }
        if *restarted > 0 {
            words.push_str("; THE METADATA ARE OF ANOTHER START OF THE SENSOR (initialization_id): see whether its mode was the same");
        }
        words
    }
}

/// The maker of packets of a capture that are not Ouster's, by how the first ones begin or how long they are.
fn of_others(bag: &dyn Bag, packets: usize) -> Result<Option<&'static str>, BagError> {
    if bag.connections()[packets].kind != UDP {
        return Ok(None);
    }
    let mut messages = bag.messages(&BTreeSet::from([packets]))?;
    let Some(first) = messages.next()? else { return Ok(None) };
    let packet = first.data();
    Ok(match packet {
        _ if robosense::is_packet(packet) => Some(ROBOSENSE_MAKER),
        [0xff, 0xee, ..] if packet.len() == VELODYNE_BYTES => Some("Velodyne"),
        [0xee, 0xff, ..] => Some("Hesai"),
        _ => None,
    })
}

/// The metadata of a sensor of Ouster, and where it is from: a topic beside the packets, or a file beside the bag.
fn metadata(bag: &dyn Bag, topic: &str) -> Result<Option<(String, String)>, BagError> {
    let space = topic.rsplit_once('/').map_or("", |(space, _)| space);
    let is_beside = |connection: &&Connection| {
        connection.kind == "std_msgs/String"
            && connection.topic == format!("{space}/metadata")
            && connection.messages > 0
    };
    if let Some(place) = bag.connections().iter().position(|connection| is_beside(&connection)) {
        let mut messages = bag.messages(&BTreeSet::from([place]))?;
        if let Some(message) = messages.next()? {
            let connection = &bag.connections()[place];
            let text = connection
                .reader(message.data())
                .and_then(|mut input| input.string().map(String::from));
            return Ok(text.ok().map(|text| (text, format!("`{}`", connection.topic))));
        }
    }
    let Some(file) = file_beside(bag.path()) else {
        return Ok(None);
    };
    let text = realo_documents::read(&file).map_err(BagError::io(&file))?;
    Ok(Some((text, format!("`{}`", file.display()))))
}

fn named_beside(path: &Path) -> PathBuf {
    path.with_extension("json")
}

/// The file of JSON beside a bag with its name, or with the longest part of its beginning.
fn file_beside(path: &Path) -> Option<PathBuf> {
    let own = path.file_stem()?.to_string_lossy().into_owned();
    let folder = path
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    let files = std::fs::read_dir(folder).ok()?.flatten().map(|entry| entry.path());
    let files = files.filter(|file| file.extension().is_some_and(|end| end == "json"));
    let begins = files.filter_map(|file| {
        let stem = file.file_stem()?.to_string_lossy().into_owned();
        own.starts_with(&stem).then_some((stem.len(), file))
    });
    begins.max().map(|(_, file)| file)
}

fn of_robosense(bag: &dyn Bag, packets: usize) -> Result<Found, BagError> {
    let connection = &bag.connections()[packets];
    let mut messages = bag.messages(&BTreeSet::from([packets]))?;
    let mut wrong = None;
    for _ in 0..LOOKED_AT {
        let Some(message) = messages.next()? else { break };
        match connection
            .reader(message.data())
            .and_then(|mut input| robosense::scan(&mut input))
        {
            Ok(scan) => {
                let note = "Helios 16P, 16 channels that are shot twice a block, with the angles of its DIFOP packets";
                match scan.angles() {
                    Ok(Some(angles)) => return Ok(Ok((How::Robosense(Box::new(angles)), note.into()))),
                    Ok(None) => {}
                    Err(reason) => return Ok(Err(reason)),
                }
            }
            Err(reason) => wrong = Some(reason),
        }
    }
    Ok(Err(wrong.unwrap_or_else(|| {
        format!(
            "expected a DIFOP packet with the sensor's angles in the first {LOOKED_AT} messages, found none; record the packets of port 7788 too"
        )
    })))
}

impl Bag for Decoded {
    fn path(&self) -> &Path {
        self.bag.path()
    }

    fn format(&self) -> &'static str {
        self.bag.format()
    }

    fn connections(&self) -> &[Connection] {
        &self.connections
    }

    fn span(&self) -> Option<[Nanos; 2]> {
        self.bag.span()
    }

    fn notes(&self) -> &[String] {
        &self.notes
    }

    fn decoded(&self) -> &[String] {
        &self.decoded
    }

    fn messages(&self, wanted: &BTreeSet<usize>) -> Result<Box<dyn Messages + '_>, BagError> {
        let sources = self.sources.iter().filter(|source| wanted.contains(&source.clouds));
        let mut all: BTreeSet<usize> = wanted
            .iter()
            .copied()
            .filter(|place| *place < self.bag.connections().len())
            .collect();
        let wanted = all.clone();
        let mut decoding = BTreeMap::new();
        for source in sources {
            all.insert(source.packets);
            let state = match &source.how {
                How::Ouster(format, shift) => State::Ouster(Decoder::new(format), *shift, 0),
                How::Robosense(angles) => State::Robosense(angles),
            };
            decoding.insert(source.packets, (source.clouds, state));
        }
        Ok(Box::new(Decoding {
            connections: self.bag.connections(),
            messages: self.bag.messages(&all)?,
            wanted,
            decoding,
            ready: VecDeque::new(),
            has_ended: false,
        }))
    }
}

enum State<'a> {
    /// The decoder, what is added to its times, and the log time of its last packet.
    Ouster(Decoder<'a>, Nanos, Nanos),
    Robosense(&'a Angles),
}

struct Decoding<'a> {
    connections: &'a [Connection],
    messages: Box<dyn Messages + 'a>,
    /// Topics of the bag itself that are wanted.
    wanted: BTreeSet<usize>,
    /// By topics of packets: the topic of clouds, and what decodes them.
    decoding: BTreeMap<usize, (usize, State<'a>)>,
    ready: VecDeque<Message>,
    has_ended: bool,
}

impl Messages for Decoding<'_> {
    fn next(&mut self) -> Result<Option<Message>, BagError> {
        loop {
            if let Some(message) = self.ready.pop_front() {
                return Ok(Some(message));
            }
            if self.has_ended {
                return Ok(None);
            }
            let Some(message) = self.messages.next()? else {
                self.has_ended = true;
                self.flush();
                continue;
            };
            if let Some((clouds, state)) = self.decoding.get_mut(&message.connection) {
                let made = state.take(&self.connections[message.connection], &message);
                self.ready
                    .extend(made.map(|made| made.message(*clouds, message.log_time)));
            }
            if self.wanted.contains(&message.connection) {
                self.ready.push_back(message);
            }
        }
    }
}

impl Decoding<'_> {
    fn flush(&mut self) {
        for (clouds, state) in self.decoding.values_mut() {
            if let State::Ouster(decoder, shift, last) = state
                && let Some(frame) = decoder.finish()
            {
                self.ready.push_back(of_frame(&frame, *shift).message(*clouds, *last));
            }
        }
    }
}

/// A cloud with its stamp and frame, or why there is none.
struct Made(Result<(Nanos, String, PointCloud), String>);

impl Made {
    fn message(self, connection: usize, log_time: Nanos) -> Message {
        match self.0 {
            Ok((stamp, frame, cloud)) => {
                let mut bytes = Vec::new();
                encode(&mut bytes, stamp, &frame, &cloud);
                Message::owned(connection, log_time, bytes)
            }
            Err(reason) => Message::faulty(connection, log_time, reason),
        }
    }
}

impl State<'_> {
    fn take(&mut self, connection: &Connection, message: &Message) -> Option<Made> {
        match self {
            State::Ouster(decoder, shift, last) => {
                *last = message.log_time;
                match payload(connection, message).and_then(|packet| decoder.take(packet)) {
                    Ok(None) => None,
                    Ok(Some(frame)) => Some(of_frame(&frame, *shift)),
                    Err(reason) => Some(Made(Err(reason))),
                }
            }
            State::Robosense(angles) => {
                let scan = connection
                    .reader(message.data())
                    .and_then(|mut input| robosense::scan(&mut input));
                Some(Made(scan.and_then(|scan| {
                    Ok((scan.stamp, scan.frame.clone(), scan.cloud(angles)?))
                })))
            }
        }
    }
}

/// A sweep of Ouster; one of which less than half has come is none.
fn of_frame(frame: &Frame, shift: Nanos) -> Made {
    let (columns, all) = (frame.columns, frame.all_columns);
    if 2 * columns < all {
        return Made(Err(format!(
            "a sweep of {columns} of {all} columns, less than half: the recording begins or ends in it, or packets were lost"
        )));
    }
    let stamp = frame.first.saturating_add(shift);
    match (0..LATEST).contains(&stamp) {
        true => Made(Ok((stamp, OUSTER_FRAME.into(), frame.cloud()))),
        false => Made(Err(format!(
            "expected times from 1970 to 2038, found a sweep at {stamp} ns"
        ))),
    }
}
