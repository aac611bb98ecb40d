//! The file that says whose topics are which.

use std::collections::BTreeMap;
use std::fmt;
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use realo_logs::pose::isometry;
use realo_logs::{AgentKind, Frames, NoWay, bare};
use realo_schemas::Nanos;
use serde::de::{MapAccess, Visitor};
use serde::{Deserialize, Deserializer};

use crate::BagError;
use crate::survey::is_shown;

/// Which time of a message counts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StampClock {
    /// The stamp in its header.
    #[default]
    Header,
    /// When it was recorded.
    Log,
}

impl StampClock {
    /// `header` or `log`.
    pub fn as_str(self) -> &'static str {
        match self {
            StampClock::Header => "header",
            StampClock::Log => "log",
        }
    }
}

/// Where an agent's poses come from.
#[derive(Clone, Debug, PartialEq)]
pub enum PoseSource {
    /// Transforms from the world to the agent's frame.
    Tf,
    /// A topic of poses or positions.
    Topic(String),
    /// It stands still: world from the agent's frame.
    Fixed(Isometry3<f64>),
}

/// How high an agent's frame is over the ground.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Height {
    /// As the ground in its first sweeps has it.
    #[default]
    Ground,
    /// So many m.
    Meters(f64),
}

/// Which topics and frames an agent has.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AgentMap {
    /// What it is.
    #[serde(default = "vehicle")]
    pub kind: AgentKind,
    /// Its bag, where there are several: its path, or the last part of it. Several bags of one clock are read as one.
    #[serde(default, deserialize_with = "bags")]
    pub bag: Vec<PathBuf>,
    /// Topics of its clouds.
    #[serde(deserialize_with = "topics")]
    pub clouds: Vec<String>,
    /// Its own frame: x ahead, y to the left.
    pub frame: String,
    /// How high that frame is over the ground.
    #[serde(default)]
    pub height: Height,
    /// Its outline in its frame, m: [x min, x max, y min, y max].
    #[serde(default)]
    pub footprint: Option<[f64; 4]>,
    /// Where its poses come from.
    pub pose: PoseSource,
    /// A topic of its inertial unit: the attitude, where poses are only positions, and the motion that the log takes over.
    #[serde(default)]
    pub imu: Option<String>,
    /// A topic of positions that the log takes over beside the poses.
    #[serde(default)]
    pub fix: Option<String>,
    /// A topic of the speed of its wheels that the log takes over.
    #[serde(default)]
    pub wheels: Option<String>,
    /// A topic of all objects.
    #[serde(default)]
    pub truth: Option<String>,
    /// A topic of recorded detections.
    #[serde(default)]
    pub detections: Option<String>,
    /// Sensors' frames in its frame, where no transform says it: x, y, z in m, roll, pitch, yaw in rad.
    #[serde(default, deserialize_with = "mounts")]
    pub mounts: BTreeMap<String, [f64; 6]>,
    /// What is added to its stamps, s.
    #[serde(default)]
    pub offset: Option<f64>,
}

/// How bags become one log.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MapFile {
    /// The frame of all poses.
    #[serde(default = "map")]
    pub world: String,
    /// Which time counts.
    #[serde(default)]
    pub clock: StampClock,
    /// Where the world's origin is, for positions of satellites: degrees north, degrees east, m over the ellipsoid.
    #[serde(default)]
    pub map_origin: Option<[f64; 3]>,
    /// The bags' classes, with those of the log.
    #[serde(default, deserialize_with = "classes")]
    pub classes: BTreeMap<String, String>,
    /// The agents by their names in the log.
    #[serde(deserialize_with = "agents")]
    pub agents: BTreeMap<String, AgentMap>,
}

fn vehicle() -> AgentKind {
    AgentKind::Vehicle
}

fn map() -> String {
    "map".into()
}

impl MapFile {
    /// Reads a file. Tags in it are never executed.
    ///
    /// # Errors
    /// What the system says; a field that is not known, is missing or holds something else.
    pub fn read(path: &Path) -> Result<Self, BagError> {
        let text = realo_documents::read(path).map_err(BagError::io(path))?;
        Self::parse(&text).map_err(|reason| {
            BagError::content(
                path,
                format!(
                    "{reason}; `realo info BAG` prints a first draft, and docs/reference/importers.md has the fields"
                ),
            )
        })
    }

    /// Reads its text.
    ///
    /// # Errors
    /// A field that is not known, is missing or holds something else.
    pub fn parse(text: &str) -> Result<Self, String> {
        let map: MapFile = realo_documents::yaml(text)?;
        if map.agents.is_empty() {
            return Err("agents: expected at least one, found none".into());
        }
        for (name, agent) in &map.agents {
            let wrong = |what: String| Err(format!("agents.{name}: {what}"));
            if agent.clouds.is_empty() {
                return wrong("clouds: expected a topic, found none".into());
            }
            if agent
                .offset
                .is_some_and(|offset| !offset.is_finite() || offset.abs() > 4e9)
            {
                return wrong("offset: expected seconds within ±4·10⁹".into());
            }
            if let Some((frame, _)) = agent
                .mounts
                .iter()
                .find(|(_, mount)| mount.iter().any(|v| !v.is_finite()))
            {
                return wrong(format!("mounts.{frame}: expected six finite numbers"));
            }
            for (frame, [_, _, _, angles @ ..]) in &agent.mounts {
                for (name, angle) in ["roll", "pitch", "yaw"].iter().zip(angles) {
                    if let Err(reason) = realo_documents::in_radians(*angle) {
                        return wrong(format!("mounts.{frame}: {name}: {reason}"));
                    }
                }
            }
        }
        Ok(map)
    }
}

impl AgentMap {
    /// Where sensors are in its frame, by the map file alone.
    pub fn mounted(&self) -> impl Iterator<Item = (&str, Isometry3<f64>)> {
        self.mounts.iter().map(|(frame, [x, y, z, roll, pitch, yaw])| {
            let rotation = UnitQuaternion::from_euler_angles(*roll, *pitch, *yaw);
            (
                frame.as_str(),
                Isometry3::from_parts(Translation3::new(*x, *y, *z), rotation),
            )
        })
    }
}

/// Brings what lies in one frame into another, or says why nothing does.
///
/// # Errors
/// Why nothing leads there at this time, in words.
pub fn way(frames: &Frames, to: &str, from: &str, stamp: Nanos) -> Result<Isometry3<f64>, String> {
    let way = frames.way(bare(to), bare(from), stamp);
    way.map(|way| way.to_from_from).map_err(|no_way| match no_way {
        NoWay::Gap(reason) | NoWay::Never(reason) => reason,
    })
}

impl AgentMap {
    /// The agent's frame from a sensor's, by the map file or else by transforms.
    ///
    /// # Errors
    /// Why nothing leads there, and what to write.
    pub fn mount(&self, frames: &Frames, sensor: &str, stamp: Nanos) -> Result<Isometry3<f64>, String> {
        let (sensor, own) = (bare(sensor), bare(&self.frame));
        if sensor == own {
            return Ok(Isometry3::identity());
        }
        if let Some((_, pose)) = self.mounted().find(|(known, _)| bare(known) == sensor) {
            return Ok(pose);
        }
        way(frames, own, sensor, stamp).map_err(|reason| {
            format!(
                "its frame is `{sensor}`, and no transform leads to the agent's frame `{own}`: {reason}; add `mounts: {{{sensor}: [x, y, z, roll, \
                 pitch, yaw]}}` to the agent in the map file"
            )
        })
    }
}

/// A map in which each key is there once.
struct Once<T> {
    what: &'static str,
    value: PhantomData<T>,
}

impl<'de, T: Deserialize<'de>> Visitor<'de> for Once<T> {
    type Value = BTreeMap<String, T>;

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "keys and values in `{}`", self.what)
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Self::Value, A::Error> {
        use serde::de::Error;
        let mut map = BTreeMap::new();
        while let Some(key) = entries.next_key::<String>()? {
            if map.contains_key(&key) {
                let reason = format!(
                    "{}: `{}` is there twice; expected each name once",
                    self.what,
                    realo_documents::shown(&key).escape_debug()
                );
                return Err(A::Error::custom(reason));
            }
            map.insert(key, entries.next_value()?);
        }
        Ok(map)
    }
}

fn once<'de, D: Deserializer<'de>, T: Deserialize<'de>>(
    deserializer: D,
    what: &'static str,
) -> Result<BTreeMap<String, T>, D::Error> {
    let value = PhantomData;
    deserializer.deserialize_map(Once { what, value })
}

fn agents<'de, D: Deserializer<'de>>(deserializer: D) -> Result<BTreeMap<String, AgentMap>, D::Error> {
    once(deserializer, "agents")
}

fn classes<'de, D: Deserializer<'de>>(deserializer: D) -> Result<BTreeMap<String, String>, D::Error> {
    once(deserializer, "classes")
}

fn mounts<'de, D: Deserializer<'de>>(deserializer: D) -> Result<BTreeMap<String, [f64; 6]>, D::Error> {
    once(deserializer, "mounts")
}

#[derive(Deserialize)]
#[serde(untagged)]
enum OneOrMany {
    One(String),
    Many(Vec<String>),
}

fn one_or_many<'de, D: Deserializer<'de>>(deserializer: D, expected: &str) -> Result<Vec<String>, D::Error> {
    use serde::de::Error;
    let found = OneOrMany::deserialize(deserializer);
    // Serde names its own types where nothing fits.
    match found.map_err(|_| D::Error::custom(format!("{expected}, found something else")))? {
        OneOrMany::One(text) => Ok(vec![text]),
        OneOrMany::Many(texts) => Ok(texts),
    }
}

fn topics<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<String>, D::Error> {
    one_or_many(deserializer, "clouds: expected a topic or a list of topics")
}

fn bags<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<PathBuf>, D::Error> {
    let bags = one_or_many(deserializer, "bag: expected the path of a bag or a list of them")?;
    Ok(bags.into_iter().map(PathBuf::from).collect())
}

#[derive(Deserialize)]
#[serde(untagged)]
enum NumbersOrText {
    Number(f64),
    Numbers(Vec<f64>),
    Text(String),
}

impl<'de> Deserialize<'de> for PoseSource {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        use serde::de::Error;
        let expected = "pose: expected `tf`, a topic, [x, y, z, yaw] or [x, y, z, qx, qy, qz, qw]";
        let found = NumbersOrText::deserialize(deserializer);
        let found = found.map_err(|error| match error.to_string() {
            // A field that is not there is read, too.
            missing if missing.starts_with("missing field") => {
                D::Error::custom(format!("{missing}; {}", expected.trim_start_matches("pose: ")))
            }
            // Serde names its own types where nothing fits.
            _ => D::Error::custom(format!("{expected}, found something else")),
        });
        match found? {
            NumbersOrText::Text(text) if text == "tf" => Ok(PoseSource::Tf),
            NumbersOrText::Text(topic) => Ok(PoseSource::Topic(topic)),
            NumbersOrText::Numbers(numbers) => match numbers[..] {
                [x, y, z, yaw] if numbers.iter().all(|v| v.is_finite()) => {
                    let yaw = realo_documents::in_radians(yaw)
                        .map_err(|reason| D::Error::custom(format!("pose: yaw: {reason}")))?;
                    Ok(PoseSource::Fixed(Isometry3::from_parts(
                        Translation3::new(x, y, z),
                        UnitQuaternion::from_euler_angles(0.0, 0.0, yaw),
                    )))
                }
                [x, y, z, i, j, k, w] => isometry(&[x, y, z, i, j, k, w])
                    .map(PoseSource::Fixed)
                    .map_err(D::Error::custom),
                _ => Err(D::Error::custom(format!("{expected}, found {} numbers", numbers.len()))),
            },
            NumbersOrText::Number(number) => Err(D::Error::custom(format!("{expected}, found {number}"))),
        }
    }
}

impl<'de> Deserialize<'de> for Height {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        use serde::de::Error;
        let expected = "height: expected `ground`, or -5 to 50 m";
        let found = NumbersOrText::deserialize(deserializer);
        match found.map_err(|_| D::Error::custom(format!("{expected}, found something else")))? {
            NumbersOrText::Text(text) if text == "ground" => Ok(Height::Ground),
            NumbersOrText::Number(meters) if (-5.0..=50.0).contains(&meters) => Ok(Height::Meters(meters)),
            NumbersOrText::Number(found) => Err(D::Error::custom(format!("{expected}, found {found}"))),
            NumbersOrText::Text(found) => Err(D::Error::custom(format!(
                "{expected}, found `{}`",
                found.escape_debug()
            ))),
            NumbersOrText::Numbers(found) => {
                Err(D::Error::custom(format!("{expected}, found {} numbers", found.len())))
            }
        }
    }
}

impl fmt::Display for PoseSource {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            PoseSource::Tf => f.write_str("tf"),
            PoseSource::Topic(topic) => f.write_str(&quoted(topic)),
            PoseSource::Fixed(pose) => {
                let (t, q) = (&pose.translation, &pose.rotation);
                write!(f, "[{}, {}, {}, {}, {}, {}, {}]", t.x, t.y, t.z, q.i, q.j, q.k, q.w)
            }
        }
    }
}

impl fmt::Display for Height {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Height::Ground => f.write_str("ground"),
            Height::Meters(meters) => write!(f, "{meters}"),
        }
    }
}

/// A text as YAML has it, whatever is in it.
pub(crate) fn quoted(text: &str) -> String {
    let is_plain = |letter: char| letter.is_ascii_alphanumeric() || "/_-.".contains(letter);
    let is_word = text.starts_with(|first: char| first.is_ascii_alphabetic() || first == '/')
        && text.chars().all(is_plain)
        && !["true", "false", "null", "yes", "no", "on", "off", "y", "n"].contains(&text.to_ascii_lowercase().as_str());
    if is_word {
        return text.into();
    }
    if text.chars().all(is_shown) {
        return format!("'{}'", text.replace('\'', "''"));
    }
    let escaped = |letter: char| match letter {
        '"' | '\\' => format!("\\{letter}"),
        letter if is_shown(letter) => letter.to_string(),
        letter => format!("\\U{:08x}", u32::from(letter)),
    };
    format!("\"{}\"", text.chars().map(escaped).collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHORT: &str = "agents:\n  car:\n    clouds: /points\n    frame: base_link\n    pose: tf\n";

    #[test]
    fn a_short_file_is_enough() {
        let map = MapFile::parse(SHORT).unwrap();
        assert_eq!((map.world.as_str(), map.clock), ("map", StampClock::Header));
        let car = &map.agents["car"];
        assert_eq!(
            (car.kind, &car.pose, car.height),
            (AgentKind::Vehicle, &PoseSource::Tf, Height::Ground)
        );
        assert_eq!(car.clouds, ["/points"]);
        let more =
            "    kind: roadside\n    height: 5.2\n    offset: -0.01\n    mounts: {lidar: [0, 0, 2, 0, 0, 1.5]}\n";
        let map = MapFile::parse(&format!("{SHORT}{more}").replace("pose: tf", "pose: [1, 2, 0, 0.5]")).unwrap();
        let mast = &map.agents["car"];
        assert_eq!((mast.kind, mast.height), (AgentKind::Roadside, Height::Meters(5.2)));
        let PoseSource::Fixed(pose) = &mast.pose else {
            panic!("{:?}", mast.pose)
        };
        assert_eq!(pose.translation.vector.y, 2.0);
        assert_eq!(mast.mounted().next().unwrap().0, "lidar");
    }

    #[test]
    fn what_does_not_fit_is_named() {
        for (from, to, expected) in [
            ("clouds", "cloud", "cloud"),
            ("pose: tf", "pose: [1, 2]", "found 2 numbers"),
            ("pose: tf", "pose: 3", "found 3"),
            ("pose: tf", "pose: tf\n    height: high", "found `high`"),
            ("pose: tf", "pose: tf\n    offset: .inf", "offset"),
            ("clouds: /points", "clouds: []", "clouds: expected a topic"),
            ("agents:", "worlds: map\nagents:", "worlds"),
            ("    frame: base_link\n", "", "missing field `frame`"),
            (
                "    pose: tf\n",
                "",
                "missing field `pose`; expected `tf`, a topic, [x, y, z, yaw] or [x, y, z, qx, qy, qz, qw]",
            ),
            (
                "pose: tf",
                "pose: {a: 1}",
                "pose: expected `tf`, a topic, [x, y, z, yaw] or",
            ),
        ] {
            let error = MapFile::parse(&SHORT.replace(from, to)).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
        assert!(MapFile::parse("agents: {}").unwrap_err().contains("found none"));
    }

    #[test]
    fn angles_in_degrees_are_refused() {
        let refused = |text: String| MapFile::parse(&text).unwrap_err();
        let pose = refused(SHORT.replace("pose: tf", "pose: [5, 6, 0, 90]"));
        let degrees = "expected radians within ±4π, found 90, which looks like degrees: 90° are 1.5708 rad";
        assert!(pose.contains("pose: yaw: ") && pose.contains(degrees), "{pose}");
        let mount = refused(format!("{SHORT}    mounts: {{lidar: [0, 0, 2, 0, 90, 0]}}\n"));
        assert!(
            mount.contains(&format!("agents.car: mounts.lidar: pitch: {degrees}")),
            "{mount}"
        );
    }

    #[test]
    fn a_name_that_is_there_twice_is_refused() {
        let car = "  car:\n    clouds: /other\n    frame: base_link\n    pose: tf\n";
        for (text, expected) in [
            (format!("{SHORT}{car}"), "agents: `car` is there twice"),
            (
                format!("{SHORT}classes: {{a: car, b: car, a: truck}}\n"),
                "classes: `a` is there twice",
            ),
            (
                format!("{SHORT}    mounts: {{rear: [0, 0, 1, 0, 0, 0], rear: [0, 0, 2, 0, 0, 0]}}\n"),
                "mounts: `rear` is there twice",
            ),
        ] {
            let error = MapFile::parse(&text).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
        let other = car.replace("car:", "7:").replace("/other", "/others");
        assert!(
            MapFile::parse(&format!("{SHORT}{other}"))
                .unwrap()
                .agents
                .contains_key("7")
        );
    }

    #[test]
    fn any_name_is_one_line_of_yaml() {
        for name in [
            "/a\u{1b}[2J",
            "a\nb: c",
            "it's \"\\\u{85}",
            "\u{202e}x\t",
            "it's",
            "a \"b\" \\",
            "no",
        ] {
            let text = quoted(name);
            assert!(text.chars().all(is_shown), "{text:?}");
            let map = MapFile::parse(&SHORT.replace("/points", &text)).unwrap();
            assert_eq!(map.agents["car"].clouds, [name]);
        }
    }

    #[test]
    fn tags_of_python_are_no_orders() {
        let text = SHORT.replace("base_link", "!!python/object/apply:os.system ['touch /tmp/x']");
        assert!(MapFile::parse(&text).is_err());
        let text = format!("{SHORT}x: !!python/object/apply:os.system ['touch /tmp/x']\n");
        assert!(MapFile::parse(&text).unwrap_err().contains("unknown field `x`"));
    }
}
