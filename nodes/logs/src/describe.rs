use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use realo_schemas::{Nanos, to_seconds};
use serde::Serialize;

use crate::{ChannelInfo, Log, LogError, LogInfo, Truncation};

/// What `realo info` says of a log.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Description {
    /// The file.
    pub path: PathBuf,
    /// Its length.
    pub bytes: u64,
    /// What it says of itself.
    #[serde(flatten)]
    pub info: LogInfo,
    /// First log time, ns.
    pub first: Option<Nanos>,
    /// Last log time, ns.
    pub last: Option<Nanos>,
    /// Time between them, s.
    pub duration_s: f64,
    /// Its topics.
    pub topics: BTreeMap<String, ChannelInfo>,
    /// Scored frames per agent, in a finished log.
    pub scored_frames: Option<BTreeMap<String, usize>>,
    /// Where it was cut, if it was.
    pub truncated: Option<Truncation>,
}

/// Describes a log.
///
/// # Errors
/// As [`Log::open`].
pub fn describe(path: impl AsRef<Path>) -> Result<Description, LogError> {
    let log = Log::open(path)?;
    let bytes = std::fs::metadata(log.path())
        .map_err(LogError::io(log.path(), "read"))?
        .len();
    let span = log.span();
    let count = |frames: BTreeMap<String, Vec<Nanos>>| frames.into_iter().map(|(k, v)| (k, v.len())).collect();
    Ok(Description {
        path: log.path().into(),
        bytes,
        info: log.info().clone(),
        first: span.map(|(first, _)| first),
        last: span.map(|(_, last)| last),
        duration_s: span.map_or(0.0, |(first, last)| to_seconds(last - first)),
        topics: log.topics(),
        scored_frames: log.key_frames().map(count),
        truncated: log.truncation().cloned(),
    })
}

impl fmt::Display for Description {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "{}  ({:.1} MB)", self.path.display(), self.bytes as f64 / 1e6)?;
        if let Some(cut) = &self.truncated {
            writeln!(f, "  TRUNCATED: {cut}")?;
        }
        writeln!(f, "  source    {}", self.info.source)?;
        writeln!(f, "  program   {}", self.info.program)?;
        writeln!(f, "  protocol  {}", self.info.protocol)?;
        let first = self.first.map(to_seconds).unwrap_or_default();
        writeln!(f, "  time      {:.3} s from {first:.3} s", self.duration_s)?;
        write!(f, "  scored    {}", self.info.key_frames)?;
        for (agent, frames) in self.scored_frames.iter().flatten() {
            write!(f, "; {agent} {frames}")?;
        }
        writeln!(f, "\n  agents (poses in frame `{}`)", self.info.map_frame)?;
        for agent in &self.info.agents {
            writeln!(f, "    {:<12} {:<9} {}", agent.name, agent.kind.as_str(), agent.sensor)?;
        }
        writeln!(f, "  topics")?;
        for (topic, channel) in &self.topics {
            let rate = match self.duration_s > 0.0 {
                true => format!("{:6.1} Hz", channel.messages.saturating_sub(1) as f64 / self.duration_s),
                false => String::new(),
            };
            writeln!(
                f,
                "    {topic:<32} {:>7}  {rate:>9}  {}",
                channel.messages, channel.schema
            )?;
        }
        Ok(())
    }
}
