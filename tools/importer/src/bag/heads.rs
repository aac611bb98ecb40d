//! How the clouds of a topic are read, by the first of them.

use std::collections::BTreeSet;

use realo_bags::map_file::StampClock;
use realo_logs::cloud::{CloudReader, Look, Reading, TimeRule};
use realo_logs::{bare, intensity_scale};
use realo_schemas::{Nanos, PointCloud};

use super::Import;
use super::agents::{Agent, Topic};
use crate::ImportError;
use crate::clouds::LOOKED_AT;

/// Clouds in which the ground is looked for.
pub const GROUNDS: usize = 3;

/// How the clouds of a topic are read.
pub struct Heads {
    /// What intensities are multiplied by.
    pub scale: f32,
    /// How times are read.
    pub times: Option<TimeRule>,
    /// Whether times count from the stamps of headers although log times are the stamps, as of a LiDAR whose clock is another one.
    pub by_header: bool,
    /// The field of times, in words.
    pub time_words: String,
    /// How intensities became bytes.
    pub intensity_words: String,
    /// From a stamp to the last point of a sweep, ns; 0 without times.
    pub lasts: Nanos,
    /// Stamp and log time of the first clouds.
    pub stamps: Vec<[Nanos; 2]>,
    /// First clouds, in their own frames.
    pub first: Vec<(Nanos, String, PointCloud)>,
}

/// The stamp that counts.
pub fn stamp_of(clock: StampClock, header: Nanos, log_time: Nanos) -> Nanos {
    match clock {
        StampClock::Header if header != 0 => header,
        _ => log_time,
    }
}

/// Looks at the first clouds of a topic.
pub fn heads(import: &Import, agent: &Agent, topic: &Topic) -> Result<Heads, ImportError> {
    let bag = &import.joined.bags[agent.bag];
    let connection = &bag.connections()[topic.connection];
    let mut messages = bag.messages(&BTreeSet::from([topic.connection]))?;
    let mut looked = Vec::new();
    while looked.len() < LOOKED_AT
        && let Some(message) = messages.next()?
    {
        looked.push(message);
    }
    let wrong = |reason: String| ImportError::content(bag.path(), format!("topic `{}`: {reason}", topic.name));
    if looked.is_empty() {
        return Err(wrong(
            "expected clouds, found no message; name another topic in the map file".into(),
        ));
    }
    let (mut readers, mut stamps, mut headers, mut reason) = (Vec::new(), Vec::new(), Vec::new(), None);
    for message in &looked {
        let read = connection
            .reader_of(message)
            .and_then(|mut input| CloudReader::read(&mut input));
        match read {
            Ok(mut reader) => {
                headers.push(reader.stamp);
                reader.stamp = stamp_of(import.map.clock, reader.stamp, message.log_time);
                stamps.push([reader.stamp, message.log_time]);
                readers.push(reader);
            }
            Err(error) => reason = Some(error),
        }
    }
    if readers.is_empty() {
        let reason = reason.unwrap_or_default();
        return Err(wrong(format!("its first clouds cannot be read: {reason}")));
    }
    let by_stamps = Heads::of(&readers, stamps.clone());
    let by_header = by_stamps.is_err() && import.map.clock == StampClock::Log;
    if by_header {
        let readers = readers.iter_mut().zip(&headers);
        readers.for_each(|(reader, header)| reader.stamp = *header);
    }
    let mut heads = match by_header {
        true => Heads::of(&readers, stamps).map(Heads::of_headers),
        false => by_stamps,
    }
    .map_err(wrong)?;
    let reading = Reading {
        scale: heads.scale,
        times: heads.times,
        to: None,
    };
    for (place, reader) in readers.iter().take(GROUNDS).enumerate() {
        let (cloud, _) = reader.cloud(&reading).map_err(wrong)?;
        let last = cloud.time.iter().copied().max().unwrap_or(0);
        heads.lasts = heads.lasts.max(last.into());
        heads
            .first
            .push((heads.stamps[place][0], bare(reader.frame).into(), cloud));
    }
    Ok(heads)
}

impl Heads {
    /// The same, of times that count from the stamps of headers.
    fn of_headers(mut self) -> Heads {
        self.by_header = true;
        self.time_words += ", from the stamps of headers";
        self
    }

    /// By the fields of the first cloud and the values of all; yet without clouds. At least one reader.
    fn of(readers: &[CloudReader], stamps: Vec<[Nanos; 2]>) -> Result<Heads, String> {
        let looks: Vec<Look> = readers.iter().flat_map(CloudReader::look).collect();
        let brightest = readers.iter().filter_map(CloudReader::brightest).fold(0.0, f32::max);
        let first = &readers[0];
        let times = first.time_rule(&looks)?;
        let kind = first.intensity().unwrap_or_default();
        let scale = intensity_scale(kind, brightest);
        Ok(Heads {
            scale,
            times,
            time_words: match (first.time(), times) {
                (Some((field, kind)), Some(rule)) => format!("`{field}` ({kind}), {rule}"),
                _ => "none: all points of a sweep are at its stamp".into(),
            },
            intensity_words: match kind {
                "" => {
                    let fields: Vec<String> = first.field_names().map(|(name, _)| crate::shown(name)).collect();
                    format!(
                        "NONE, all are 0: the clouds have {}, and no field that is read as intensity",
                        fields.join(", ")
                    )
                }
                kind => {
                    let field = first.intensity_name().filter(|name| *name != "intensity");
                    let field = field.map_or(String::new(), |name| format!("of the field `{name}`: "));
                    format!("{field}{kind}, times {scale}")
                }
            },
            by_header: false,
            lasts: 0,
            stamps,
            first: Vec::new(),
        })
    }
}
