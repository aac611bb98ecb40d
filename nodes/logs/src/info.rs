use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::Path;

use realo_schemas::Nanos;
use serde::{Deserialize, Serialize};

use crate::geodesy::MapOrigin;
use crate::{LogError, Precomputed};

/// Name of the metadata record of a log.
pub const LOG_RECORD: &str = "realo";
/// Name of the metadata record that a finished log ends with.
pub const END_RECORD: &str = "realo_end";
/// Key of [`END_RECORD`]: how far the clocks of other agents lie from the log's.
pub const CLOCKS: &str = "clocks";
/// Key of [`END_RECORD`]: how the body frames of agents were levelled.
pub const LEVELLED: &str = "levelled";
/// Key of the record that says what was computed beforehand.
const PRECOMPUTED: &str = "precomputed";
/// Key of the record that says where the map is on the Earth.
const MAP_ORIGIN: &str = "map_origin";
/// Key of the record that says how wrong the clocks of agents are, where that is known.
const CLOCK_ERRORS: &str = "clock_errors";
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

/// How an agent's body frame was levelled when its log was made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Levelled {
    /// By what: `pose`, `ground`, or `none`.
    pub by: String,
    /// The smallest and the largest tilt that was taken out of a sweep, degrees.
    pub degrees: [f64; 2],
}

impl Levelled {
    /// [`Levelled::by`] of frames that are level by their poses.
    pub const BY_POSE: &str = "pose";
    /// [`Levelled::by`] of frames that lie along the ground.
    pub const BY_GROUND: &str = "ground";
    /// [`Levelled::by`] of frames that are as the sensor is mounted.
    pub const BY_NOTHING: &str = "none";
}

impl fmt::Display for Levelled {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let [min, most] = self.degrees;
        match self.by.as_str() {
            Self::BY_NOTHING => f.write_str("not levelled"),
            by => write!(f, "levelled by {by}, by {min:.2}° to {most:.2}°"),
        }
    }
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
    /// Log time of the last message, ns, where known beforehand; a cut log is recognised by it.
    pub end: Option<Nanos>,
    /// What of it was computed beforehand.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub precomputed: Option<Precomputed>,
    /// Where the map's origin is on WGS 84: latitude and longitude, degrees, and height over the ellipsoid, m; where known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub map_origin: Option<[f64; 3]>,
    /// How wrong the clocks of agents are, by agent, where that is known, as in a simulated log.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub clock_errors: BTreeMap<String, ClockError>,
}

/// What the stamps of an agent are wrong by: `offset + drift · t`, and `step` more from `step_at` on, t from the log's beginning.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ClockError {
    /// At the beginning, ns; above 0 the clock is ahead.
    pub offset: Nanos,
    /// What the clock gains, s/s.
    pub drift: f64,
    /// What the clock jumps by, ns.
    pub step: Nanos,
    /// When it jumps, ns from the beginning.
    pub step_at: Nanos,
}

impl ClockError {
    /// What a stamp is wrong by, ns, `since` the log's beginning.
    pub fn at(&self, since: Nanos) -> Nanos {
        let step = if since >= self.step_at { self.step } else { 0 };
        self.offset + (self.drift * since as f64).round() as Nanos + step
    }
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
            precomputed: None,
            map_origin: None,
            clock_errors: BTreeMap::new(),
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
        if let Some(precomputed) = &self.precomputed {
            let text = serde_json::to_string(precomputed).expect("texts are plain data");
            record.insert(PRECOMPUTED.into(), text);
        }
        if let Some(origin) = &self.map_origin {
            let text = serde_json::to_string(origin).expect("numbers are plain data");
            record.insert(MAP_ORIGIN.into(), text);
        }
        if !self.clock_errors.is_empty() {
            let text = serde_json::to_string(&self.clock_errors).expect("numbers are plain data");
            record.insert(CLOCK_ERRORS.into(), text);
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
        let precomputed = record.get(PRECOMPUTED).map(|text| serde_json::from_str(text));
        let precomputed = precomputed.transpose();
        let map_origin = record.get(MAP_ORIGIN).map(|text| {
            let read: [f64; 3] = serde_json::from_str(text).map_err(|error| error.to_string())?;
            MapOrigin::new(read).map(|_| read)
        });
        let map_origin = map_origin.transpose().map_err(|reason| bad(MAP_ORIGIN, reason))?;
        let clock_errors = record.get(CLOCK_ERRORS).map(|text| serde_json::from_str(text));
        let clock_errors = clock_errors
            .transpose()
            .map_err(|error| bad(CLOCK_ERRORS, error.to_string()))?;
        Ok(LogInfo {
            program: get("program")?,
            source: get("source")?,
            agents,
            map_frame: get("map_frame")?,
            protocol: get("protocol")?,
            key_frames: get("key_frames")?,
            start: time("start")?,
            end: time("end")?,
            precomputed: precomputed.map_err(|error| bad(PRECOMPUTED, error.to_string()))?,
            map_origin,
            clock_errors: clock_errors.unwrap_or_default(),
        })
    }
}

/// This program with its version.
pub fn program() -> String {
    concat!("realo ", env!("CARGO_PKG_VERSION")).into()
}

/// No vehicle reaches further from the origin of its body frame, m.
const FARTHEST_OUTLINE: f64 = 30.0;

/// Whether names can be parts of topics and of paths, and differ; whether outlines are outlines.
pub(crate) fn check_agents(agents: &[AgentInfo]) -> Result<(), String> {
    let mut names = BTreeSet::new();
    for agent in agents {
        check_name(&agent.name)?;
        if !names.insert(agent.name.to_ascii_lowercase()) {
            return Err(format!(
                "two agents are named `{}` (case does not tell them apart); every agent needs a name of its own",
                agent.name
            ));
        }
        if let Some(outline @ [x0, x1, y0, y1]) = agent.footprint
            && !(outline.iter().all(|v| v.abs() <= FARTHEST_OUTLINE) && x0 < x1 && y0 < y1)
        {
            return Err(format!(
                "`footprint` of `{}`: expected [x min, x max, y min, y max] in metres, within ±{FARTHEST_OUTLINE} m and with min below \
                 max, found {outline:?}: correct it where the log is made",
                agent.name
            ));
        }
    }
    Ok(())
}

/// Names are parts of topics, folders and frames, and stand in arguments.
const LONGEST_NAME: usize = 64;

/// Whether a name can be an agent's.
///
/// # Errors
/// What was expected and found.
pub fn check_name(name: &str) -> Result<(), String> {
    let inside = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
    let starts = name.starts_with(|c: char| c.is_ascii_alphanumeric() || c == '_');
    let taken = ["tf", "tf_static"].contains(&name);
    match starts && name.chars().all(inside) && !name.ends_with('.') && name.len() <= LONGEST_NAME && !taken {
        true => Ok(()),
        false => Err(format!(
            "`{}` cannot name an agent: expected 1 to {LONGEST_NAME} letters, digits, `_`, `-` or `.`, first a letter, \
             a digit or `_`, no `.` at the end, and neither `tf` nor `tf_static`; rename it where the log is made",
            name.chars().take(LONGEST_NAME).collect::<String>().escape_debug()
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_can_be_folders_topics_and_arguments() {
        let longest = "x".repeat(LONGEST_NAME);
        for name in ["a", "cav1", "RSU-2", "_x", "7", "a.b", "tf2", &longest] {
            assert_eq!(check_name(name), Ok(()), "{name}");
        }
        let long = "x".repeat(LONGEST_NAME + 1);
        let bad = [
            "", ".", "..", "...", ".a", "a.", "-a", "a/b", "/", "../a", "a b", "a\n", "a\0", "é", "a\\b", "a:b",
        ];
        for name in bad.into_iter().chain(["tf", "tf_static", &long]) {
            let error = check_name(name).unwrap_err();
            let shown = name.chars().take(LONGEST_NAME).collect::<String>();
            assert!(
                error.contains(&format!("`{}` cannot name", shown.escape_debug())),
                "{error}"
            );
        }
    }

    #[test]
    fn what_is_precomputed_is_read_back_or_refused() {
        let mut info = LogInfo::new("a test", vec![]);
        assert!(!info.to_record().contains_key(PRECOMPUTED));
        info.precomputed = Some(Precomputed {
            graph: "attfuse".into(),
            agents: vec!["rsu1".into()],
            compute: "measured".into(),
            lane: vec![],
        });
        let mut record = info.to_record();
        let read = |record: &BTreeMap<String, String>| LogInfo::from_record(Path::new("a.mcap"), record);
        assert_eq!(read(&record).unwrap(), info);
        for wrong in ["", "[]", "{\"graph\": 3}", "{\"graph\": \"a\", \"agents\": []}"] {
            record.insert(PRECOMPUTED.into(), wrong.into());
            let error = read(&record).unwrap_err().to_string();
            assert!(
                error.contains("a.mcap") && error.contains("metadata `precomputed`"),
                "{wrong}: {error}"
            );
        }
    }

    #[test]
    fn where_the_map_is_and_how_clocks_err_is_read_back_or_refused() {
        let mut info = LogInfo::new("a test", vec![]);
        info.map_origin = Some([48.1, 11.6, 519.25]);
        let error = ClockError {
            offset: 37_000_000,
            drift: 2e-5,
            step: -1_000_000,
            step_at: 5_000_000_000,
        };
        info.clock_errors.insert("cav2".into(), error);
        let mut record = info.to_record();
        let read = |record: &BTreeMap<String, String>| LogInfo::from_record(Path::new("a.mcap"), record);
        assert_eq!(read(&record).unwrap(), info);
        for wrong in ["", "[1, 2]", "[91, 0, 0]", "{}"] {
            record.insert(MAP_ORIGIN.into(), wrong.into());
            let error = read(&record).unwrap_err().to_string();
            assert!(error.contains("metadata `map_origin`"), "{wrong}: {error}");
        }
        assert_eq!(
            [0, 5_000_000_000].map(|since| error.at(since)),
            [37_000_000, 36_100_000]
        );
    }

    #[test]
    fn agents_differ_and_have_outlines() {
        let agent = |name: &str, footprint| AgentInfo {
            name: name.into(),
            kind: AgentKind::Vehicle,
            footprint,
            sensor: String::new(),
            sensor_position: None,
        };
        let outline = |outline| check_agents(&[agent("a", Some(outline))]);
        assert_eq!(outline([-1.0, 3.0, -1.0, 1.0]), Ok(()));
        for wrong in [
            [1.0, 1.0, -1.0, 1.0],
            [-1.0, 1.0, 2.0, 1.0],
            [-1.0, f64::INFINITY, -1.0, 1.0],
            [f64::NAN, 1.0, -1.0, 1.0],
            [-150.0, 330.0, -90.0, 90.0],
        ] {
            assert!(outline(wrong).unwrap_err().contains("`footprint` of `a`"), "{wrong:?}");
        }
        assert_eq!(check_agents(&[agent("a", None), agent("b", None)]), Ok(()));
        let error = check_agents(&[agent("Bus", None), agent("bus", None)]).unwrap_err();
        assert!(error.contains("two agents are named `bus`"), "{error}");
    }
}
