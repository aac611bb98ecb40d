//! Folders of ROS 2: `metadata.yaml` and its parts, in SQLite or MCAP, compressed or not.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use realo_schemas::Nanos;
use serde::Deserialize;
use tempfile::NamedTempFile;

use crate::open::{open_file, unpacked};
use crate::pack::{ZSTD, unpack_message};
use crate::source::span_over;
use crate::{Bag, BagError, Connection, Encoding, Message, Messages};

/// What a folder of ROS 2 has beside its parts.
pub(crate) const METADATA: &str = "metadata.yaml";

/// The part of `metadata.yaml` that says where the messages are.
#[derive(Deserialize)]
struct Document {
    rosbag2_bagfile_information: Information,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct Information {
    relative_file_paths: Vec<String>,
    compression_format: Option<String>,
    message_count: u64,
    topics_with_message_count: Vec<Topic>,
}

#[derive(Deserialize)]
struct Topic {
    topic_metadata: TopicMetadata,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct TopicMetadata {
    name: String,
    serialization_format: String,
}

/// An open folder of ROS 2.
pub(crate) struct Rosbag2 {
    path: PathBuf,
    /// In the order of their first messages.
    parts: Vec<Part>,
    connections: Vec<Connection>,
    notes: Vec<String>,
}

struct Part {
    bag: Box<dyn Bag>,
    /// Connections of the part, as places in the folder's.
    places: Vec<usize>,
    /// What the part was unpacked to.
    _unpacked: Option<NamedTempFile>,
}

impl Rosbag2 {
    pub fn open(dir: &Path) -> Result<Self, BagError> {
        let mut notes = Vec::new();
        let metadata = dir.join(METADATA);
        let information = match metadata.is_file() {
            true => Some(read(&metadata)?),
            false => None,
        };
        let files = match &information {
            Some(information) => named(dir, &metadata, information)?,
            None => {
                notes.push(format!(
                    "there is no {METADATA}, so nothing says whether a part is missing"
                ));
                found(dir)?
            }
        };
        if files.is_empty() {
            let reason = format!(
                "expected the folder of a bag of ROS 2 ({METADATA} and parts `.db3` or `.mcap`), found no part"
            );
            return Err(BagError::content(dir, reason));
        }
        let (mut parts, mut connections) = (Vec::new(), Vec::<Connection>::new());
        for file in &files {
            let part = part(file, &mut connections, &mut notes)?;
            parts.push(part);
        }
        // Files say `cdr` whatever the recorder wrote.
        let topics = information
            .iter()
            .flat_map(|information| &information.topics_with_message_count);
        for TopicMetadata {
            name,
            serialization_format,
        } in topics.map(|topic| &topic.topic_metadata)
        {
            let of_topic = connections.iter_mut().filter(|connection| connection.topic == *name);
            of_topic
                .filter(|_| !serialization_format.is_empty())
                .for_each(|connection| {
                    connection.encoding = Encoding::named(serialization_format);
                });
        }
        let counted: u64 = connections.iter().map(|connection| connection.messages).sum();
        if let Some(information) = information
            && information.message_count != counted
        {
            notes.push(format!(
                "{METADATA} says {} messages, {counted} are there",
                information.message_count
            ));
        }
        parts.sort_by_key(|part: &Part| part.bag.span().map_or(Nanos::MAX, |[first, _]| first));
        Ok(Rosbag2 {
            path: dir.into(),
            parts,
            connections,
            notes,
        })
    }

    /// A file by itself.
    pub fn of_file(path: &Path, bag: Box<dyn Bag>, unpacked: Option<NamedTempFile>, notes: Vec<String>) -> Self {
        let connections = bag.connections().to_vec();
        let places = (0..connections.len()).collect();
        let notes = bag.notes().iter().cloned().chain(notes).collect();
        Rosbag2 {
            path: path.into(),
            parts: vec![Part {
                bag,
                places,
                _unpacked: unpacked,
            }],
            connections,
            notes,
        }
    }
}

fn part(file: &Path, connections: &mut Vec<Connection>, notes: &mut Vec<String>) -> Result<Part, BagError> {
    let (unpacked, lost) = unpacked(file)?;
    let name = file.file_name().unwrap_or_default().to_string_lossy();
    notes.extend(lost.map(|lost| format!("`{name}`: {lost}")));
    let bag = match &unpacked {
        None => open_file(file)?,
        Some(unpacked) => open_file(unpacked.path())
            .map_err(|error| BagError::content(file, format!("what it was unpacked to cannot be read: {error}")))?,
    };
    notes.extend(bag.notes().iter().map(|note| format!("`{name}`: {note}")));
    let place = |connection: &Connection| {
        let is = |other: &Connection| {
            (&other.topic, &other.kind, &other.encoding) == (&connection.topic, &connection.kind, &connection.encoding)
        };
        let place = connections.iter().position(is).unwrap_or_else(|| {
            connections.push(Connection {
                messages: 0,
                ..connection.clone()
            });
            connections.len() - 1
        });
        connections[place].messages += connection.messages;
        place
    };
    let places = bag.connections().iter().map(place).collect();
    Ok(Part {
        bag,
        places,
        _unpacked: unpacked,
    })
}

fn read(metadata: &Path) -> Result<Information, BagError> {
    let text = realo_documents::read(metadata).map_err(BagError::io(metadata))?;
    let document: Document = realo_documents::yaml(&text).map_err(|reason| {
        BagError::content(
            metadata,
            format!("expected the metadata of a bag of ROS 2: {reason}; `ros2 bag reindex` writes it anew"),
        )
    })?;
    let information = document.rosbag2_bagfile_information;
    match information.compression_format.as_deref() {
        None | Some("" | "zstd") => Ok(information),
        Some(other) => Err(BagError::content(
            metadata,
            format!(
                "compression_format: expected `zstd` or none, found `{}`; convert the bag (`ros2 bag convert`)",
                other.escape_debug()
            ),
        )),
    }
}

/// The parts that the metadata name; older versions put the name of the folder before them, and leave out how they are compressed.
fn named(dir: &Path, metadata: &Path, information: &Information) -> Result<Vec<PathBuf>, BagError> {
    let mut missing = Vec::new();
    let mut files = Vec::new();
    for listed in &information.relative_file_paths {
        let name = listed.rsplit(['/', '\\']).next().unwrap_or_default();
        let candidates = [dir.join(name), dir.join(format!("{name}.zstd"))];
        let bare = name
            .strip_suffix(".zstd")
            .filter(|bare| !bare.is_empty())
            .map(|bare| dir.join(bare));
        match candidates.into_iter().chain(bare).find(|file| file.is_file()) {
            Some(file) => files.push(file),
            None => missing.push(format!("`{}`", listed.escape_debug())),
        }
    }
    if files.is_empty() && missing.is_empty() {
        return found(dir);
    }
    match missing.is_empty() {
        true => Ok(files),
        false => Err(BagError::content(
            metadata,
            format!(
                "relative_file_paths: {} of {} parts are missing: {}; fetch them, or remove them from the list to read the rest",
                missing.len(),
                information.relative_file_paths.len(),
                missing.join(", ")
            ),
        )),
    }
}

/// Parts without metadata, by the numbers in their names.
fn found(dir: &Path) -> Result<Vec<PathBuf>, BagError> {
    let mut files = Vec::new();
    for entry in fs::read_dir(dir).map_err(BagError::io(dir))? {
        let path = entry.map_err(BagError::io(dir))?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let bare = name.strip_suffix(".zstd").unwrap_or(&name);
        if bare.ends_with(".db3") || bare.ends_with(".mcap") {
            files.push(path);
        }
    }
    files.sort_by_cached_key(|path| {
        let name = path.to_string_lossy().into_owned();
        (name.len(), name)
    });
    Ok(files)
}

impl Bag for Rosbag2 {
    fn path(&self) -> &Path {
        &self.path
    }

    fn format(&self) -> &'static str {
        match &self.parts[..] {
            [part] => part.bag.format(),
            _ => "split bag of ROS 2",
        }
    }

    fn connections(&self) -> &[Connection] {
        &self.connections
    }

    fn span(&self) -> Option<[Nanos; 2]> {
        span_over(self.parts.iter().filter_map(|part| part.bag.span()))
    }

    fn notes(&self) -> &[String] {
        &self.notes
    }

    fn messages(&self, wanted: &BTreeSet<usize>) -> Result<Box<dyn Messages + '_>, BagError> {
        Ok(Box::new(Merged {
            folder: self,
            wanted: wanted.clone(),
            next: 0,
            open: Vec::new(),
        }))
    }
}

/// Parts that overlap in time are read together.
struct Merged<'a> {
    folder: &'a Rosbag2,
    wanted: BTreeSet<usize>,
    next: usize,
    open: Vec<(Message, usize, Box<dyn Messages + 'a>)>,
}

impl Merged<'_> {
    /// Opens the next part, if it begins before what is open goes on.
    fn open_until(&mut self) -> Result<(), BagError> {
        while let Some(part) = self.folder.parts.get(self.next) {
            let first = part.bag.span().map_or(Nanos::MAX, |[first, _]| first);
            if self.open.iter().any(|(message, ..)| message.log_time < first) {
                break;
            }
            let place = self.next;
            self.next += 1;
            let wanted = part
                .places
                .iter()
                .enumerate()
                .filter(|(_, place)| self.wanted.contains(place));
            let mut messages = part.bag.messages(&wanted.map(|(own, _)| own).collect())?;
            if let Some(message) = messages.next()? {
                self.open.push((message, place, messages));
            }
        }
        Ok(())
    }
}

impl Messages for Merged<'_> {
    fn next(&mut self) -> Result<Option<Message>, BagError> {
        self.open_until()?;
        let soonest = self
            .open
            .iter()
            .enumerate()
            .min_by_key(|(_, (message, place, _))| (message.log_time, *place));
        let Some((place, _)) = soonest else { return Ok(None) };
        let (message, part, messages) = &mut self.open[place];
        let part = &self.folder.parts[*part];
        let next = messages.next()?;
        let mut taken = match next {
            Some(next) => std::mem::replace(message, next),
            None => self.open.swap_remove(place).0,
        };
        let connection = part.places[taken.connection];
        taken.connection = connection;
        let is_packed =
            self.folder.connections[connection].encoding == Encoding::Cdr && taken.data().starts_with(&ZSTD);
        match is_packed {
            false => Ok(Some(taken)),
            true => {
                let data = unpack_message(taken.data()).map_err(|reason| {
                    let topic = &self.folder.connections[connection].topic;
                    let reason = format!(
                        "a message on `{topic}` at {} ns: {reason}; fetch the file anew",
                        taken.log_time
                    );
                    BagError::content(&self.folder.path, reason)
                })?;
                Ok(Some(Message::owned(connection, taken.log_time, data)))
            }
        }
    }
}
