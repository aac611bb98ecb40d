use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use realo_schemas::Nanos;
use serde::{Deserialize, Serialize};

use crate::LogError;

/// Name of the metadata record of a log.
pub const LOG_RECORD: &str = "realo";
/// Name of the metadata record that a finished log ends with.
pub const END_RECORD: &str = "realo_end";
/// Version of the layout.
pub const FORMAT: &str = "1";

/// What an agent is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AgentKind {
    /// It drives.
    Vehicle,
    /// It stands beside the road.
    Roadside,
}

impl AgentKind {
    /// `vehicle` or `roadside`.
    pub fn as_str(self) -> &'static str {
        match self {
            AgentKind::Vehicle => "vehicle",
            AgentKind::Roadside => "roadside",
        }
    }
}

/// An agent of a log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AgentInfo {
    /// Name; the first part of its topics.
    pub name: String,
    /// What it is.
    pub kind: AgentKind,
    /// Its outline in its body frame, [x min, x max, y min, y max], m, where it has one.
    #[serde(default)]
    pub footprint: Option<[f64; 4]>,
    /// Its LiDAR, in words.
    #[serde(default)]
    pub sensor: String,
    /// Where the LiDAR sits in the body frame, m, where known.
    #[serde(default)]
    pub sensor_position: Option<[f64; 3]>,
}

/// What a log says of itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LogInfo {
    /// What wrote it, with version.
    pub program: String,
    /// Where its data come from, in words.
    pub source: String,
    /// Its agents; their order is kept.
    pub agents: Vec<AgentInfo>,
    /// Name of the frame that poses are given in.
    pub map_frame: String,
    /// The evaluation protocol that fits its classes.
    pub protocol: String,
    /// Which frames are scored, in words; every frame's own flag decides.
    pub key_frames: String,
    /// Log time of the first message, ns, where known beforehand.
    pub start: Option<Nanos>,
    /// Log time of the last message, ns, where known beforehand; a cut log is told by it.
    pub end: Option<Nanos>,
}

impl LogInfo {
    /// A log of this program with map frame `map` and protocol `default`.
    pub fn new(source: impl Into<String>, agents: Vec<AgentInfo>) -> Self {
        LogInfo {
            program: program(),
            source: source.into(),
            agents,
            map_frame: "map".into(),
            protocol: "default".into(),
            key_frames: "every sweep with ground truth".into(),
            start: None,
            end: None,
        }
    }

    /// An agent by its name.
    pub fn agent(&self, name: &str) -> Option<&AgentInfo> {
        self.agents.iter().find(|agent| agent.name == name)
    }

    pub(crate) fn to_record(&self) -> BTreeMap<String, String> {
        let agents = serde_json::to_string(&self.agents).expect("agents are plain data");
        let mut record = BTreeMap::from(
            [
                ("format", FORMAT),
                ("program", &self.program),
                ("source", &self.source),
                ("agents", &agents),
                ("map_frame", &self.map_frame),
                ("protocol", &self.protocol),
                ("key_frames", &self.key_frames),
            ]
            .map(|(key, value)| (key.to_string(), value.to_string())),
        );
        for (key, time) in [("start", self.start), ("end", self.end)] {
            if let Some(time) = time {
                record.insert(key.into(), time.to_string());
            }
        }
        record
    }

    pub(crate) fn from_record(path: &Path, record: &BTreeMap<String, String>) -> Result<Self, LogError> {
        let bad = |field: &'static str, reason: String| LogError::Metadata {
            path: path.into(),
            field,
            reason,
        };
        let get = |field: &'static str| {
            record
                .get(field)
                .cloned()
                .ok_or_else(|| bad(field, "expected this key, found none".into()))
        };
        let format = get("format")?;
        if format != FORMAT {
            return Err(bad(
                "format",
                format!("expected {FORMAT}, found {format}; another version of realo wrote it"),
            ));
        }
        let time = |field: &'static str| match record.get(field) {
            None => Ok(None),
            Some(text) => text
                .parse()
                .map(Some)
                .map_err(|_| bad(field, format!("expected ns, found `{text}`"))),
        };
        let agents: Vec<AgentInfo> =
            serde_json::from_str(&get("agents")?).map_err(|error| bad("agents", error.to_string()))?;
        check_agents(&agents).map_err(|reason| bad("agents", reason))?;
        Ok(LogInfo {
            program: get("program")?,
            source: get("source")?,
            agents,
            map_frame: get("map_frame")?,
            protocol: get("protocol")?,
            key_frames: get("key_frames")?,
            start: time("start")?,
            end: time("end")?,
        })
    }
}

/// This program with its version.
pub fn program() -> String {
    concat!("realo ", env!("CARGO_PKG_VERSION")).into()
}

/// Whether names can be parts of topics and differ.
pub(crate) fn check_agents(agents: &[AgentInfo]) -> Result<(), String> {
    let mut names = BTreeSet::new();
    for agent in agents {
        check_name(&agent.name)?;
        if !names.insert(&agent.name) {
            return Err(format!(
                "two agents are named `{}`; every agent needs a name of its own",
                agent.name
            ));
        }
    }
    Ok(())
}

pub(crate) fn check_name(name: &str) -> Result<(), String> {
    let fits = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
    match !name.is_empty() && name.chars().all(fits) && name != "tf" {
        true => Ok(()),
        false => Err(format!(
            "`{name}` cannot name an agent: expected letters, digits, `_`, `-` or `.`"
        )),
    }
}
