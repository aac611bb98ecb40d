//! How a data set is imported: one table of options for all kinds.

use std::path::PathBuf;

use crate::dair::RoadsideStamp;
use crate::level::Level;

/// An option of the command line.
#[derive(Clone, Copy, Debug)]
pub struct OptionInfo {
    /// Its name, without dashes.
    pub name: &'static str,
    /// What it takes, in capitals; `None` for a switch.
    pub value: Option<&'static str>,
    /// The only values that it takes; empty where any may do.
    pub choices: &'static [&'static str],
    /// What it does.
    pub help: &'static str,
}

const fn option(name: &'static str, value: &'static str, help: &'static str) -> OptionInfo {
    choice(name, value, &[], help)
}

const fn choice(
    name: &'static str,
    value: &'static str,
    choices: &'static [&'static str],
    help: &'static str,
) -> OptionInfo {
    OptionInfo {
        name,
        value: Some(value),
        choices,
        help,
    }
}

/// All options; each kind of data set takes some of them.
pub const OPTIONS: &[OptionInfo] = &[
    option(
        "map",
        "FILE",
        "Whose topics and frames are which, in YAML; `realo info BAG` prints a first draft [default: that draft]",
    ),
    option(
        "scenes",
        "NAMES",
        "Only these scenes, with commas between [default: all]",
    ),
    option(
        "without",
        "WORDS",
        "Leave out scenes whose names contain one of these, with commas between [default: none]",
    ),
    option(
        "frames",
        "FROM..TO",
        "Only frames with these numbers, the last not included; `FROM..`, `..TO` and a single number do as well [default: all]",
    ),
    option(
        "agents",
        "NAMES",
        "Only these agents, by their folders or their names in the log, with commas between [default: all]",
    ),
    option(
        "rate",
        "HZ",
        "Sweeps a second: the data set has numbers in place of times",
    ),
    choice(
        "stamp",
        "END",
        &["start", "end"],
        "Whether the time of a frame is the start or the end of its sweep",
    ),
    choice(
        "roadside-stamp",
        "END",
        &["start", "end"],
        "Whether the roadside stamp is the start or the end of its sweep: the data set does not say",
    ),
    choice(
        "level",
        "BY",
        &["pose", "ground", "none"],
        "By what the body frames of the agents are levelled: their recorded poses, a plane through the ground around the \
         sensor, or not at all",
    ),
    option(
        "height",
        "M",
        "Height of the LiDARs over the ground: metres, or `ground` for that of the ground in the first sweeps of each agent; \
         `--level ground` does not need it",
    ),
    choice(
        "handed",
        "HAND",
        &["left", "right"],
        "Whether y points to the right, as in CARLA (left-handed, mirrored once), or to the left",
    ),
    option(
        "pose-key",
        "KEY",
        "Key of the pose of the LiDAR in label files [default: `lidar_pose`, else `true_ego_pose` or `true_ego_pos`]",
    ),
    option("class", "NAME", "Class of objects whose labels name none"),
    option(
        "footprint",
        "X0,X1,Y0,Y1",
        "Outline of the vehicles about their LiDARs, m: from X0 to X1 ahead, from Y0 to Y1 to the left",
    ),
    choice(
        "box-z",
        "WHERE",
        &["middle", "bottom"],
        "What the place of a label is: the middle of its box, or the middle of its bottom",
    ),
    choice(
        "pose-direction",
        "WAY",
        &["to-parent", "from-parent"],
        "What matrices of calibrations do: bring points of the sensor to its parent, or points of the parent to the sensor",
    ),
    option(
        "label-frame",
        "SENSOR",
        "The sensor in whose frame the labels are [default: the first in the name of their folder]",
    ),
    choice(
        "times",
        "SOURCE",
        &["table", "names"],
        "Where the times of sweeps are from: the table of synchronised times, or the names of the files",
    ),
    option(
        "intensity-range",
        "MAX",
        "The largest intensity of the sensors' scale, which becomes 255; where none is given, the brightest of the first sweeps chooses it",
    ),
    choice(
        "cloud",
        "TYPE",
        &["pcd", "bin", "ply"],
        "Which clouds are read where a sweep has both",
    ),
    option(
        "columns",
        "N",
        "Numbers of a point in `.bin` clouds: x, y, z, intensity and, of 5, one that is not read",
    ),
    option("jobs", "COUNT", "Scenes at a time [default: one for each core]"),
    OptionInfo {
        name: "resume",
        value: None,
        choices: &[],
        help: "Leave logs of scenes that are there already as they are, whatever options made them: an import that ended early goes on",
    },
    OptionInfo {
        name: "skip-incomplete",
        value: None,
        choices: &[],
        help: "Leave out what is incomplete because a cloud, a label or a calibration is missing or damaged, and report how many \
               and why",
    },
];

/// An option by its name.
pub fn option_info(name: &str) -> Option<&'static OptionInfo> {
    OPTIONS.iter().find(|option| option.name == name)
}

/// What the time of a frame is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SweepStamp {
    /// The start of its sweep: the sweep is ready a duration later.
    #[default]
    Start,
    /// The end of its sweep: the sweep is ready at once.
    End,
}

impl SweepStamp {
    /// `start` or `end`.
    pub fn as_str(self) -> &'static str {
        match self {
            SweepStamp::Start => "start",
            SweepStamp::End => "end",
        }
    }
}

/// Where y of a data set's frames points to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Handed {
    /// To the right.
    Left,
    /// To the left, as in logs.
    Right,
}

/// What the place of a label is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum BoxPlace {
    /// The middle of its box.
    #[default]
    Middle,
    /// The middle of the bottom of its box.
    Bottom,
}

/// How a data set is imported.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Says whose topics and frames of a bag are which.
    pub map: Option<PathBuf>,
    /// Further bags of the same log.
    pub more: Vec<PathBuf>,
    /// Scenes that are wanted; all where empty.
    pub scenes: Vec<String>,
    /// Scenes whose names contain one of these are left out.
    pub without: Vec<String>,
    /// Agents that are wanted; all where empty.
    pub agents: Vec<String>,
    /// Numbers of frames that are wanted, the second excluded.
    pub frames: [u64; 2],
    /// Scenes at a time.
    pub jobs: usize,
    /// Leaves logs that are there as they are.
    pub resume: bool,
    /// Leaves out incomplete frames.
    pub skip_incomplete: bool,
    /// Sweeps a second.
    pub rate_hz: f64,
    /// What the time of a frame is.
    pub stamp: SweepStamp,
    /// What the time of a roadside sweep of DAIR is.
    pub roadside_stamp: RoadsideStamp,
    /// By what body frames are levelled.
    pub level: Level,
    /// Height of all LiDARs over the ground, m; by the ground where `None`.
    pub height_m: Option<f64>,
    /// Where y of the data set points to.
    pub handed: Handed,
    /// Key of the pose of the LiDAR.
    pub pose_key: Option<String>,
    /// Class of objects whose labels name none.
    pub class: String,
    /// The outline of vehicles about their LiDARs, m: [x min, x max, y min, y max].
    pub footprint: [f64; 4],
    /// What the places of labels are.
    pub box_place: BoxPlace,
    /// Whether matrices of calibrations bring points of the parent to the sensor; else those of the sensor to its parent.
    pub poses_from_parent: bool,
    /// The sensor in whose frame labels are.
    pub label_frame: Option<String>,
    /// Whether times of sweeps are those of the names of files, whatever a table says.
    pub times_of_names: bool,
    /// The largest intensity of the sensors' scale; by the brightest of the first sweeps where `None`.
    pub intensity_range: Option<f32>,
    /// How the names of clouds end that are preferred, where a sweep has several.
    pub cloud: Option<String>,
    /// Numbers of a point in `.bin` clouds.
    pub columns: usize,
}

impl Default for Options {
    fn default() -> Self {
        Options {
            map: None,
            more: Vec::new(),
            scenes: Vec::new(),
            without: Vec::new(),
            agents: Vec::new(),
            frames: [0, u64::MAX],
            jobs: std::thread::available_parallelism().map_or(1, usize::from),
            resume: false,
            skip_incomplete: false,
            rate_hz: 10.0,
            stamp: SweepStamp::Start,
            roadside_stamp: RoadsideStamp::Start,
            level: Level::Pose,
            height_m: None,
            handed: Handed::Right,
            pose_key: None,
            class: "Car".into(),
            footprint: [-2.3, 2.3, -0.95, 0.95],
            box_place: BoxPlace::Middle,
            poses_from_parent: false,
            label_frame: None,
            times_of_names: false,
            intensity_range: None,
            cloud: None,
            columns: 4,
        }
    }
}

impl Options {
    /// Sets an option from its text; a switch takes any.
    ///
    /// # Errors
    /// What was expected and what was found; an option that does not exist.
    pub fn set(&mut self, name: &str, text: &str) -> Result<(), String> {
        let text = text.trim();
        let expected = |what: &str| format!("--{name}: expected {what}, found `{}`", crate::shown(text));
        if let Some(info) = option_info(name)
            && !info.choices.is_empty()
            && !info.choices.contains(&text)
        {
            return Err(expected(&info.choices.join(" or ")));
        }
        match name {
            "map" => self.map = Some(text.into()),
            "scenes" => self.scenes = list(text),
            "without" => self.without = list(text),
            "agents" => self.agents = list(text),
            "frames" => self.frames = range(text).ok_or_else(|| expected("`FROM..TO`, as `0..50`"))?,
            "jobs" => {
                let jobs = text.parse().ok().filter(|jobs| (1..=1024).contains(jobs));
                self.jobs = jobs.ok_or_else(|| expected("1 to 1024"))?;
            }
            "resume" => self.resume = true,
            "skip-incomplete" => self.skip_incomplete = true,
            "rate" => self.rate_hz = within(text, 0.1, 1000.0).ok_or_else(|| expected("0.1 to 1000 Hz"))?,
            "stamp" if text == "start" => self.stamp = SweepStamp::Start,
            "stamp" => self.stamp = SweepStamp::End,
            "roadside-stamp" if text == "start" => self.roadside_stamp = RoadsideStamp::Start,
            "roadside-stamp" => self.roadside_stamp = RoadsideStamp::End,
            "level" => self.level = level(text),
            "height" if text == "ground" => self.height_m = None,
            "height" => {
                self.height_m = Some(within(text, 0.0, 50.0).ok_or_else(|| expected("0 to 50 m, or `ground`"))?)
            }
            "handed" if text == "left" => self.handed = Handed::Left,
            "handed" => self.handed = Handed::Right,
            "pose-key" => self.pose_key = Some(text.into()),
            "class" if text.is_empty() => return Err(expected("a name")),
            "class" => self.class = text.into(),
            "footprint" => {
                let what = "`X0,X1,Y0,Y1` in m within ±30, each pair rising";
                self.footprint = footprint(text).ok_or_else(|| expected(what))?;
            }
            "box-z" if text == "bottom" => self.box_place = BoxPlace::Bottom,
            "box-z" => self.box_place = BoxPlace::Middle,
            "pose-direction" => self.poses_from_parent = text == "from-parent",
            "label-frame" => self.label_frame = Some(text.into()),
            "times" => self.times_of_names = text == "names",
            "intensity-range" => {
                let range = within(text, 1e-3, 1e9).ok_or_else(|| expected("0.001 to 10⁹"))?;
                self.intensity_range = Some(range as f32);
            }
            "cloud" => self.cloud = Some(text.into()),
            "columns" => {
                let columns = text.parse().ok().filter(|columns| (4..=16).contains(columns));
                self.columns = columns.ok_or_else(|| expected("4 to 16"))?;
            }
            _ => return Err(format!("--{name}: no import has this option")),
        }
        Ok(())
    }

    /// Whether a frame is wanted.
    pub(crate) fn wants_frame(&self, number: u64) -> bool {
        (self.frames[0]..self.frames[1]).contains(&number)
    }
}

fn level(text: &str) -> Level {
    let known = Level::ALL.iter().find(|(_, name, _)| *name == text);
    known.map(|(level, ..)| *level).unwrap_or_default()
}

fn list(text: &str) -> Vec<String> {
    let words = text.split(',').map(str::trim).filter(|word| !word.is_empty());
    words.map(String::from).collect()
}

fn within(text: &str, min: f64, max: f64) -> Option<f64> {
    text.parse().ok().filter(|value| (min..=max).contains(value))
}

fn footprint(text: &str) -> Option<[f64; 4]> {
    let numbers = text.split(',').map(|word| within(word.trim(), -30.0, 30.0));
    let numbers: [f64; 4] = numbers.collect::<Option<Vec<f64>>>()?.try_into().ok()?;
    (numbers[0] < numbers[1] && numbers[2] < numbers[3]).then_some(numbers)
}

/// The first number, and the one behind the last.
fn range(text: &str) -> Option<[u64; 2]> {
    let Some((from, to)) = text.split_once("..") else {
        let only: u64 = text.parse().ok()?;
        return Some([only, only.saturating_add(1)]);
    };
    let number = |text: &str, none: u64| match text {
        "" => Some(none),
        text => text.parse().ok(),
    };
    let range = [number(from, 0)?, number(to, u64::MAX)?];
    (range[0] < range[1]).then_some(range)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_option_can_be_set_and_refuses_what_it_does_not_take() {
        for info in OPTIONS {
            let mut options = Options::default();
            let fine = match info.name {
                "scenes" | "without" | "agents" => "a, -1",
                "frames" => "3..9",
                "rate" | "columns" | "jobs" | "intensity-range" => "5",
                "height" => "1.9",
                "footprint" => "-2, 3,-1,1",
                _ => info.choices.first().copied().unwrap_or("name"),
            };
            options.set(info.name, fine).unwrap();
            if !info.choices.is_empty()
                || [
                    "frames",
                    "rate",
                    "columns",
                    "jobs",
                    "height",
                    "footprint",
                    "intensity-range",
                ]
                .contains(&info.name)
            {
                let error = options.set(info.name, "nonsense").unwrap_err();
                assert!(
                    error.contains(info.name) && error.contains("found `nonsense`"),
                    "{error}"
                );
            }
        }
        assert!(Options::default().set("colour", "red").is_err());
    }

    #[test]
    fn frames_are_ranges_of_numbers() {
        for (text, expected) in [
            ("3..9", Some([3, 9])),
            ("7", Some([7, 8])),
            ("..9", Some([0, 9])),
            ("3..", Some([3, u64::MAX])),
            ("9..3", None),
            ("a..b", None),
        ] {
            assert_eq!(range(text), expected, "{text}");
        }
    }
}
