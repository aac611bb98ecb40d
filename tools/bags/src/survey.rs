//! What is in a bag, by the first messages of each topic.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::PathBuf;

use realo_logs::cloud::CloudReader;
use realo_logs::{Frames, bare};
use realo_schemas::{Nanos, to_millis, to_seconds};
use serde::Serialize;

use crate::messages::{Kind, header, pose, transforms};
use crate::{Bag, BagError, Connection, Message};

/// Messages of a topic that are looked at.
const LOOKED_AT: u64 = 30;
/// Messages of transforms that are looked at: they hold many frames.
const TRANSFORMS: u64 = 300;
/// Names of frames that are kept of a topic.
const FRAMES: usize = 8;

/// What is in a bag.
#[derive(Debug, Serialize)]
pub struct Survey {
    /// The file or folder.
    pub path: PathBuf,
    /// What it is, in words.
    pub format: &'static str,
    /// First and last log time, ns.
    pub span: Option<[Nanos; 2]>,
    /// What is missing or strange.
    pub notes: Vec<String>,
    /// Topics that are decoded from others.
    pub decoded: Vec<String>,
    /// Its topics, by type and name.
    pub topics: Vec<TopicSurvey>,
    /// How frames lie in each other.
    #[serde(skip)]
    pub frames: Frames,
}

/// What is known of a topic.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct TopicSurvey {
    /// Its name.
    pub topic: String,
    /// Type of its messages, as `sensor_msgs/PointCloud2`.
    #[serde(rename = "type")]
    pub kind: String,
    /// How they are serialised.
    pub encoding: String,
    /// How many there are.
    pub messages: u64,
    /// Messages a second among those that were looked at, by their log times.
    pub rate_hz: Option<f64>,
    /// Frames of their headers.
    pub frames: BTreeSet<String>,
    /// Frames that they place.
    pub children: BTreeSet<String>,
    /// The first stamp in a header, ns.
    pub first_stamp: Option<Nanos>,
    /// Max stamp in the headers that were looked at, ns.
    pub last_stamp: Option<Nanos>,
    /// Log time less stamp, the smallest, ns.
    pub behind: Option<Nanos>,
    /// Points of the largest cloud, with directions without a return.
    pub points: usize,
    /// Fields of clouds, with their types.
    pub fields: String,
    /// Why the first of its messages cannot be read.
    pub problem: Option<String>,
}

/// Looks into a bag.
///
/// # Errors
/// Bytes that contradict the format.
pub fn survey(bag: &dyn Bag) -> Result<Survey, BagError> {
    let mut found = Survey {
        path: bag.path().into(),
        format: bag.format(),
        span: bag.span(),
        notes: bag.notes().to_vec(),
        decoded: bag.decoded().to_vec(),
        topics: Vec::new(),
        frames: Frames::default(),
    };
    for (place, connection) in bag.connections().iter().enumerate() {
        let mut topic = TopicSurvey {
            topic: connection.topic.clone(),
            kind: connection.kind.clone(),
            encoding: connection.encoding.as_str().into(),
            messages: connection.messages,
            ..TopicSurvey::default()
        };
        if let Some(kind) = Kind::named(&connection.kind) {
            let most = if kind == Kind::Transforms {
                TRANSFORMS
            } else {
                LOOKED_AT
            };
            let mut messages = bag.messages(&BTreeSet::from([place]))?;
            let mut times = Vec::new();
            for _ in 0..most {
                // Damage further on is reported where the bag is imported.
                let message = match messages.next() {
                    Ok(Some(message)) => message,
                    Ok(None) => break,
                    Err(error) => {
                        topic.problem.get_or_insert(error.to_string());
                        break;
                    }
                };
                if message.fault().is_some() {
                    continue;
                }
                times.push(message.log_time);
                let looked = look(kind, connection, &message, &mut topic, &mut found.frames);
                if let Err(reason) = looked {
                    topic.problem.get_or_insert(reason);
                }
            }
            if let [first, .., last] = times[..]
                && last > first
            {
                topic.rate_hz = Some((times.len() - 1) as f64 / to_seconds(last - first));
            }
        }
        found.topics.push(topic);
    }
    found
        .topics
        .sort_by(|a, b| (&a.kind, &a.topic).cmp(&(&b.kind, &b.topic)));
    Ok(found)
}

fn look(
    kind: Kind,
    connection: &Connection,
    message: &Message,
    topic: &mut TopicSurvey,
    frames: &mut Frames,
) -> Result<(), String> {
    let begin = || connection.reader(message.data());
    if let Some((stamp, frame)) = header(kind, &mut begin()?)? {
        if topic.frames.len() < FRAMES {
            topic.frames.insert(bare(&frame).into());
        }
        topic.first_stamp.get_or_insert(stamp);
        topic.last_stamp = topic.last_stamp.max(Some(stamp));
        let behind = message.log_time.saturating_sub(stamp);
        topic.behind = Some(topic.behind.map_or(behind, |known| known.min(behind)));
    }
    match kind {
        Kind::Transforms => {
            let is_static = is_static(&connection.topic);
            for t in transforms(&mut begin()?)?.0 {
                if topic.children.len() < FRAMES {
                    topic.children.insert(bare(&t.child).into());
                }
                frames.insert(is_static, t.stamp, &t.parent, &t.child, t.parent_from_child);
            }
        }
        Kind::Odometry => {
            let child = pose(kind, &mut begin()?)?.child;
            topic.children.extend(child.map(|child| bare(&child).to_string()));
        }
        Kind::PointCloud2 => {
            let cloud = CloudReader::read(&mut begin()?)?;
            topic.points = topic.points.max(cloud.points());
            if topic.fields.is_empty() {
                let fields = cloud.field_names().take(2 * FRAMES);
                let fields: Vec<String> = fields.map(|(name, kind)| format!("{name} {kind}")).collect();
                topic.fields = fields.join(", ");
            }
        }
        _ => {}
    }
    Ok(())
}

/// Whether transforms of a topic hold for all times.
pub fn is_static(topic: &str) -> bool {
    topic.rsplit('/').next() == Some("tf_static")
}

/// A text without letters that a terminal does not show as they are: those are escaped.
pub fn printable(text: &str) -> String {
    let shown = |letter: char| match is_shown(letter) {
        true => letter.to_string(),
        false => letter.escape_debug().to_string(),
    };
    text.chars().map(shown).collect()
}

/// Whether a letter is shown as it is.
pub(crate) fn is_shown(letter: char) -> bool {
    "'\"\\".contains(letter) || letter.escape_debug().count() == 1
}

impl Survey {
    /// Topics of a type.
    pub fn of_kind(&self, kind: Kind) -> impl Iterator<Item = &TopicSurvey> {
        self.topics
            .iter()
            .filter(move |topic| Kind::named(&topic.kind) == Some(kind))
    }

    /// The frame to which a frame is fixed, and which is fixed to no other.
    pub fn base_of(&self, frame: &str) -> String {
        self.climb(frame, true)
    }

    /// The frame in which a frame is, directly or not, and which is in no other.
    pub fn root_of(&self, frame: &str) -> String {
        self.climb(frame, false)
    }

    fn climb(&self, frame: &str, only_static: bool) -> String {
        let parents: BTreeMap<&str, (&str, bool)> = self
            .frames
            .parents()
            .map(|(child, parent, fixed)| (child, (parent, fixed)))
            .collect();
        let mut at = frame;
        for _ in 0..parents.len() {
            match parents.get(at) {
                Some((parent, fixed)) if *fixed || !only_static => at = parent,
                _ => break,
            }
        }
        at.to_string()
    }
}

impl fmt::Display for Survey {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let messages: u64 = self.topics.iter().map(|topic| topic.messages).sum();
        write!(
            f,
            "{}: {}, {messages} messages on {} topics",
            printable(&self.path.display().to_string()),
            self.format,
            self.topics.len()
        )?;
        if let Some([first, last]) = self.span {
            write!(
                f,
                ", {:.3} s from {:.3} s on",
                to_seconds(last.saturating_sub(first)),
                to_seconds(first)
            )?;
        }
        for note in &self.notes {
            write!(f, "\n  note: {}", printable(note))?;
        }
        for line in &self.decoded {
            write!(f, "\n  {}", printable(line))?;
        }
        let mut kind = None;
        for topic in &self.topics {
            if kind.replace(&topic.kind) != Some(&topic.kind) {
                let name = if topic.kind.is_empty() { "no type" } else { &topic.kind };
                let read = if Kind::named(&topic.kind).is_some() {
                    ""
                } else {
                    " (not read)"
                };
                write!(f, "\n  {}{read}", name.escape_debug())?;
            }
            write!(f, "\n    {topic}")?;
        }
        let edges: Vec<String> = self
            .frames
            .parents()
            .take(40)
            .map(|(child, parent, fixed)| {
                let arrow = if fixed { "=" } else { "->" };
                format!("{} {arrow} {}", parent.escape_debug(), child.escape_debug())
            })
            .collect();
        match edges.is_empty() {
            true => Ok(()),
            false => write!(f, "\n  frames (= fixed, -> moving): {}", edges.join(", ")),
        }
    }
}

impl fmt::Display for TopicSurvey {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}  {} messages", self.topic.escape_debug(), self.messages)?;
        if !matches!(self.encoding.as_str(), "cdr" | "ros1") {
            write!(f, ", serialised as `{}`", self.encoding.escape_debug())?;
        }
        if let Some(rate) = self.rate_hz {
            write!(f, ", {rate:.1} Hz")?;
        }
        let list = |names: &BTreeSet<String>| {
            let names = names.iter().map(|name| name.escape_debug().to_string());
            names.collect::<Vec<_>>().join(" ")
        };
        if !self.frames.is_empty() {
            write!(f, ", frame {}", list(&self.frames))?;
        }
        if !self.children.is_empty() {
            write!(f, " of {}", list(&self.children))?;
        }
        if let (Some(first), Some(behind)) = (self.first_stamp, self.behind) {
            write!(
                f,
                ", stamps from {:.3} s on, {:.1} ms before log time at least",
                to_seconds(first),
                to_millis(behind)
            )?;
        }
        if self.points > 0 {
            write!(f, ", {} points: {}", self.points, printable(&self.fields))?;
        }
        match &self.problem {
            Some(problem) => write!(f, "; CANNOT BE READ: {}", printable(problem)),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_do_not_reach_the_terminal_raw() {
        let survey = TopicSurvey {
            topic: "/a\u{1b}[2J".into(),
            frames: BTreeSet::from(["map\u{7}".into()]),
            fields: "x\u{9b} f32".into(),
            points: 1,
            problem: Some("no \u{1b}c, but `Höhe`".into()),
            ..TopicSurvey::default()
        };
        let said = survey.to_string();
        assert!(!said.contains(char::is_control), "{said:?}");
        assert!(said.contains("/a\\u{1b}[2J") && said.contains("`Höhe`"), "{said:?}");
    }
}
