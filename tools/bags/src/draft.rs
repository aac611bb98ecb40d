//! A first draft of the map file, by what is in bags.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::{Path, PathBuf};

use realo_logs::AgentKind;

use crate::map_file::{AgentMap, Height, MapFile, PoseSource, StampClock, quoted};
use crate::messages::Kind;
use crate::packets::UDP;
use crate::recordings::{Recording, recordings};
use crate::survey::{Survey, TopicSurvey, printable};

/// A map file with why it says what it says.
pub struct Draft {
    /// The file.
    pub map: MapFile,
    /// Remarks by agent and field.
    why: BTreeMap<(String, &'static str), String>,
    /// Why the world's frame is what it is.
    world: String,
    /// Topics of markers that may be labels, by agents that have no truth.
    markers: BTreeMap<String, String>,
    /// Bags of which no agent takes anything.
    unused: Vec<PathBuf>,
}

/// Clouds that belong together.
struct Group<'a> {
    recording: &'a Recording<'a>,
    survey: &'a Survey,
    space: String,
    base: String,
    clouds: Vec<&'a TopicSurvey>,
}

impl Draft {
    /// Of bags that become one log.
    ///
    /// # Errors
    /// No clouds.
    pub fn of(surveys: &[Survey]) -> Result<Self, String> {
        let (recordings, unused) = recordings(surveys);
        let groups: Vec<Group> = recordings.iter().flat_map(groups).collect();
        if groups.is_empty() {
            let kinds: BTreeSet<&str> = surveys
                .iter()
                .flat_map(|survey| survey.topics.iter().map(|topic| topic.kind.as_str()))
                .filter(|kind| kind.contains("acket") || kind.contains("Scan") || *kind == UDP)
                .collect();
            let packets = match kinds.is_empty() {
                true => String::new(),
                false => format!(
                    "; topics of packets ({}) are not read{}",
                    printable(&kinds.into_iter().collect::<Vec<_>>().join(", ")),
                    why_not(surveys)
                ),
            };
            return Err(format!(
                "expected a topic of sensor_msgs/PointCloud2 with messages, found none{packets}"
            ));
        }
        let mut draft = Draft {
            map: MapFile {
                world: String::new(),
                clock: StampClock::Header,
                map_origin: None,
                classes: BTreeMap::new(),
                agents: BTreeMap::new(),
            },
            why: BTreeMap::new(),
            world: String::new(),
            markers: BTreeMap::new(),
            unused: unused.into_iter().map(PathBuf::from).collect(),
        };
        let spaces: BTreeSet<String> = groups.iter().map(|group| group.space.clone()).collect();
        let bags: Vec<&Path> = surveys.iter().map(|survey| survey.path.as_path()).collect();
        for group in &groups {
            draft.agent(group, &spaces, &bags, [recordings.len(), groups.len()]);
        }
        draft.remark_shared_poses();
        draft.remark_worlds();
        if draft.map.world.is_empty() {
            draft.map.world = "map".into();
            draft.world = "no pose names a frame".into();
        }
        Ok(draft)
    }

    fn agent(&mut self, group: &Group, spaces: &BTreeSet<String>, bags: &[&Path], [recordings, groups]: [usize; 2]) {
        let Group {
            recording,
            base,
            clouds,
            ..
        } = group;
        let name = self.free_name(group, recordings > 1, groups);
        let mut remark = |field, words: String| {
            self.why.insert((name.clone(), field), words);
        };
        if recording.bags.len() > 1 {
            let words = format!("read as one, of one clock, because {}", recording.why);
            remark("bag", words);
        }
        let main = clouds
            .iter()
            .max_by_key(|topic| (topic.points, topic.messages))
            .expect("a group has clouds");
        let others = clouds.iter().filter(|topic| topic.topic != main.topic);
        let others: Vec<&str> = others.map(|topic| topic.topic.as_str()).collect();
        if !others.is_empty() {
            let words = format!(
                "the most points; it has {} too, `clouds: [A, B]` takes several",
                others.join(", ")
            );
            remark("clouds", words);
        }
        let frames = main.frames.iter().cloned().collect::<Vec<_>>().join(" ");
        let words = match main.frames.iter().any(|frame| frame != base) {
            true => format!("`{frames}` is fixed to it"),
            false => "the frame of its clouds, which no transform fixes to another".into(),
        };
        remark("frame", words);
        let posed = group.pose(spaces, groups);
        remark("pose", posed.why);
        if self.map.world.is_empty() && !posed.world.is_empty() {
            self.world = format!("the frame of the poses of {name}");
            self.map.world = posed.world;
        }
        let objects = || {
            let arrays = group.topics(Kind::Detection3DArray, spaces, groups);
            arrays.chain(group.topics(Kind::MarkerArray, spaces, groups))
        };
        let truth = objects().find(|topic| is_truth(topic));
        let mut arrays = group.topics(Kind::Detection3DArray, spaces, groups);
        let detections = arrays.find(|topic| !is_truth(topic));
        if detections.is_some() && truth.is_none() {
            remark(
                "detections",
                "as `truth` instead if these are labels: without truth no run is scored".into(),
            );
        }
        let mut markers = group.topics(Kind::MarkerArray, spaces, groups);
        if let (None, Some(markers)) = (truth, markers.next()) {
            self.markers.insert(name.clone(), markers.topic.clone());
        }
        let lower = name.to_ascii_lowercase();
        let stands = ["rsu", "infra", "road", "mast"].iter().any(|word| lower.contains(word));
        let agent = AgentMap {
            kind: if stands {
                AgentKind::Roadside
            } else {
                AgentKind::Vehicle
            },
            bag: match bags {
                [_] => Vec::new(),
                _ => recording.bags.iter().map(|bag| shortest(bags, bag)).collect(),
            },
            clouds: vec![main.topic.clone()],
            frame: base.clone(),
            height: Height::Ground,
            footprint: None,
            pose: posed.source,
            imu: posed.imu.or_else(|| group.sensor(&[Kind::Imu], spaces, groups)),
            fix: None,
            wheels: group.sensor(&[Kind::TwistWithCovarianceStamped, Kind::TwistStamped], spaces, groups),
            truth: truth.map(|topic| topic.topic.clone()),
            detections: detections.map(|topic| topic.topic.clone()),
            mounts: BTreeMap::new(),
            offset: None,
        };
        self.map.agents.insert(name, agent);
    }

    /// Two agents with one topic of poses are often two LiDARs of one vehicle.
    fn remark_shared_poses(&mut self) {
        let mut seen: Vec<(&String, &AgentMap)> = Vec::new();
        for (name, agent) in &self.map.agents {
            let same = |(_, other): &&(&String, &AgentMap)| {
                matches!(&agent.pose, PoseSource::Topic(_)) && other.pose == agent.pose && other.bag == agent.bag
            };
            if let Some((other, _)) = seen.iter().find(same) {
                let words = format!(
                    "the pose of `{other}` too: if both are LiDARs of one vehicle, keep one agent, with `clouds: [A, B]` and `mounts`"
                );
                self.why.insert((name.clone(), "pose"), words);
            }
            seen.push((name, agent));
        }
    }

    /// Vehicles whose poses count from where each was switched on are in no common world.
    fn remark_worlds(&mut self) {
        let moving = self
            .map
            .agents
            .values()
            .filter(|agent| !matches!(agent.pose, PoseSource::Fixed(_)));
        if counts_from_start(&self.map.world) && moving.count() > 1 {
            self.world.push_str(
                "; ARE ALL AGENTS IN IT? Where each vehicle's begins at 0, take poses of a common frame (a map, or positions of satellites)",
            );
        }
    }

    /// A name for the agent of a group that no other has.
    fn free_name(&self, group: &Group, several: bool, groups: usize) -> String {
        let Group {
            survey, space, base, ..
        } = group;
        let stem = survey.path.file_stem().unwrap_or_default().to_string_lossy();
        let wanted = match (space.is_empty(), several, groups) {
            (false, ..) => space.clone(),
            (true, true, _) => named(&stem),
            (true, false, 1) => "ego".into(),
            (true, false, _) => named(base),
        };
        let others = (2..).map(|number| format!("{wanted}_{number}"));
        let mut names = std::iter::once(wanted.clone()).chain(others);
        names.find(|name| !self.map.agents.contains_key(name)).unwrap_or(wanted)
    }
}

/// Whether a frame, by its name, mostly begins at 0 where its vehicle was switched on.
pub fn counts_from_start(frame: &str) -> bool {
    frame
        .rsplit('/')
        .next()
        .is_some_and(|name| name.to_ascii_lowercase().contains("odom"))
}

/// What says where an agent is.
struct Posed {
    source: PoseSource,
    /// The frame of its poses; empty where nothing says it.
    world: String,
    /// Topic of the attitude, where positions alone are said.
    imu: Option<String>,
    why: String,
}

impl<'a> Group<'a> {
    /// Its topics of a kind: those of its space of names, and those of no other's.
    fn topics(
        &self,
        kind: Kind,
        spaces: &'a BTreeSet<String>,
        groups: usize,
    ) -> impl Iterator<Item = &'a TopicSurvey> + use<'a> {
        let space = self.space.clone();
        let topics = self.survey.of_kind(kind).filter(|topic| topic.messages > 0);
        topics.filter(move |topic| {
            let its = space_of(&topic.topic);
            its == space || (!spaces.contains(its) && (space.is_empty() || groups == 1))
        })
    }

    /// The topic of a motion sensor, with the most messages of the first kind that is there.
    fn sensor(&self, kinds: &[Kind], spaces: &'a BTreeSet<String>, groups: usize) -> Option<String> {
        let topics = |kind: &Kind| {
            let topics = self.topics(*kind, spaces, groups).filter(|topic| is_measured(topic));
            topics
                .max_by_key(|topic| topic.messages)
                .map(|topic| topic.topic.clone())
        };
        kinds.iter().find_map(topics)
    }

    /// What says where its agent is, the best of what there is.
    fn pose(&self, spaces: &'a BTreeSet<String>, groups: usize) -> Posed {
        let Group { survey, base, .. } = self;
        let most = |kind: Kind| {
            let topics = self.topics(kind, spaces, groups);
            topics.max_by_key(|topic| (topic.children.contains(base), topic.messages))
        };
        let posed = [Kind::Odometry, Kind::PoseStamped, Kind::PoseWithCovarianceStamped];
        let (source, world, imu, why) = if let Some(topic) = posed.into_iter().find_map(most) {
            let frame = topic.frames.iter().next().cloned().unwrap_or_default();
            let source = PoseSource::Topic(topic.topic.clone());
            let all = posed.into_iter().flat_map(|kind| self.topics(kind, spaces, groups));
            let others = all.filter(|other| other.topic != topic.topic);
            let others: Vec<&str> = others.map(|other| other.topic.as_str()).collect();
            let why = match others.is_empty() {
                true => topic.kind.clone(),
                false => format!("{}; it has {} too", topic.kind, others.join(", ")),
            };
            (source, survey.root_of(&frame), None, why)
        } else if survey.root_of(base) != *base {
            let root = survey.root_of(base);
            let why = format!("transforms from `{root}` to `{base}`");
            (PoseSource::Tf, root, None, why)
        } else if let Some(fix) = most(Kind::NavSatFix) {
            let imu = most(Kind::Imu).map(|topic| topic.topic.clone());
            let why = "positions; the first one is the map's origin where `map_origin` says no other";
            (PoseSource::Topic(fix.topic.clone()), "map".into(), imu, why.into())
        } else {
            let why = "NOTHING SAYS WHERE IT IS: name a topic, or write [x, y, z, yaw] if it stands still";
            (PoseSource::Tf, String::new(), None, why.into())
        };
        Posed {
            source,
            world,
            imu,
            why,
        }
    }
}

/// Whether a topic is measured: of speeds its name must say so, for others are commands.
fn is_measured(topic: &TopicSurvey) -> bool {
    if Kind::named(&topic.kind) == Some(Kind::Imu) {
        return true;
    }
    let lower = topic.topic.to_lowercase();
    ["wheel", "speed", "velocity_status"]
        .iter()
        .any(|word| lower.contains(word))
}

/// Why packets are not clouds: what bags note of them.
fn why_not(surveys: &[Survey]) -> String {
    let notes = surveys
        .iter()
        .flat_map(|survey| &survey.notes)
        .filter(|note| note.starts_with("packets of"));
    let notes: Vec<String> = notes.map(|note| format!("; {}", printable(note))).collect();
    match notes.is_empty() {
        true => ": play them through the sensor's driver and record its clouds".into(),
        false => notes.concat(),
    }
}

/// Whether a topic's name says that its objects are the truth.
fn is_truth(topic: &TopicSurvey) -> bool {
    let name = topic.topic.to_ascii_lowercase();
    let words = ["truth", "label", "annotation", "gt_", "_gt", "/gt"];
    words.iter().any(|word| name.contains(word))
}

/// The last parts of the path of a bag that no other of the bags ends with; the whole path where there are none.
pub fn shortest(bags: &[&Path], path: &Path) -> PathBuf {
    let parts: Vec<_> = path.components().collect();
    let ends = (0..parts.len())
        .rev()
        .map(|first| parts[first..].iter().collect::<PathBuf>());
    let mut ends = ends.filter(|end| bags.iter().filter(|bag| bag.ends_with(end)).count() == 1);
    ends.next().unwrap_or_else(|| path.into())
}

/// The first part of a topic that has several.
fn space_of(topic: &str) -> &str {
    let topic = topic.trim_start_matches('/');
    topic.split_once('/').map_or("", |(space, _)| space)
}

/// Clouds of a bag by the frame that they are fixed to, and by the space of names that they share with other topics.
fn groups<'a>(recording: &'a Recording<'a>) -> Vec<Group<'a>> {
    let survey = &recording.survey;
    let others: BTreeSet<&str> = survey
        .topics
        .iter()
        .filter(|topic| Kind::named(&topic.kind).is_some_and(|kind| kind != Kind::PointCloud2))
        .map(|topic| space_of(&topic.topic))
        .collect();
    let mut groups: Vec<Group> = Vec::new();
    for cloud in survey.of_kind(Kind::PointCloud2).filter(|topic| topic.messages > 0) {
        let frame = cloud.frames.iter().next().cloned().unwrap_or_default();
        let base = survey.base_of(&frame);
        let space = Some(space_of(&cloud.topic))
            .filter(|space| others.contains(space))
            .unwrap_or_default();
        match groups
            .iter_mut()
            .find(|group| group.base == base && group.space == space)
        {
            Some(group) => group.clouds.push(cloud),
            None => groups.push(Group {
                recording,
                survey,
                space: space.into(),
                base,
                clouds: vec![cloud],
            }),
        }
    }
    groups
}

/// A name of an agent that a text can be.
fn named(text: &str) -> String {
    let letter = |letter: char| match letter {
        letter if letter.is_ascii_alphanumeric() || "_-".contains(letter) => letter,
        _ => '_',
    };
    let name: String = text.chars().take(40).map(letter).collect();
    match name.starts_with(|first: char| first.is_ascii_alphanumeric() || first == '_') {
        true => name,
        false => format!("agent_{}", name.trim_start_matches('-')),
    }
}

impl fmt::Display for Draft {
    /// As YAML.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let MapFile {
            world, clock, agents, ..
        } = &self.map;
        writeln!(
            f,
            "# A draft: look at every line. docs/reference/importers.md has the fields."
        )?;
        for bag in &self.unused {
            writeln!(
                f,
                "# NOT TAKEN: {} has no clouds, and nothing says whose it is; `bag: [A, B]` of an agent reads it as one with its own",
                printable(&bag.to_string_lossy())
            )?;
        }
        writeln!(f, "world: {}  # {}", quoted(world), printable(&self.world))?;
        writeln!(f, "clock: {}  # or `log`: when messages were recorded", clock.as_str())?;
        writeln!(f, "agents:")?;
        for (name, agent) in agents {
            let line = |f: &mut fmt::Formatter, field: &'static str, value: &str| {
                let why = self.why.get(&(name.clone(), field));
                let why = why.map_or(String::new(), |why| format!("  # {}", printable(why)));
                writeln!(f, "    {field}: {value}{why}")
            };
            writeln!(f, "  {}:", quoted(name))?;
            line(f, "kind", agent.kind.as_str())?;
            let bags: Vec<String> = agent.bag.iter().map(|bag| quoted(&bag.to_string_lossy())).collect();
            match &bags[..] {
                [] => {}
                [bag] => line(f, "bag", bag)?,
                bags => line(f, "bag", &format!("[{}]", bags.join(", ")))?,
            }
            line(f, "clouds", &quoted(&agent.clouds[0]))?;
            line(f, "frame", &quoted(&agent.frame))?;
            writeln!(
                f,
                "    height: {}  # of the frame over the ground, m (0 if it is on it), or `ground`: found in the first sweeps, below the LiDAR, \
                 or at z = 0 of clouds that have nothing below",
                agent.height
            )?;
            line(f, "pose", &agent.pose.to_string())?;
            for (field, topic) in [
                ("imu", &agent.imu),
                ("fix", &agent.fix),
                ("wheels", &agent.wheels),
                ("truth", &agent.truth),
                ("detections", &agent.detections),
            ] {
                if let Some(topic) = topic {
                    line(f, field, &quoted(topic))?;
                }
            }
            if let Some(topic) = self.markers.get(name) {
                writeln!(
                    f,
                    "    # truth: {}  # markers: take them if these are labels, for without truth no run is scored",
                    quoted(topic)
                )?;
            }
            if agent.kind == AgentKind::Vehicle {
                writeln!(
                    f,
                    "    # footprint: [-1.0, 3.8, -0.9, 0.9]  # the outline in `frame`, m: x min, x max, y min, y max"
                )?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn draft(topics: &[(&str, &str)]) -> String {
        let topic = |(topic, kind): &(&str, &str)| TopicSurvey {
            topic: (*topic).into(),
            kind: (*kind).into(),
            messages: 10,
            frames: BTreeSet::from(["base_link".to_string()]),
            ..TopicSurvey::default()
        };
        let survey = Survey {
            path: "one.bag".into(),
            format: "a bag",
            span: None,
            notes: Vec::new(),
            decoded: Vec::new(),
            topics: topics.iter().map(topic).collect(),
            frames: Default::default(),
        };
        Draft::of(&[survey]).unwrap().to_string()
    }

    #[test]
    fn what_may_be_meant_as_well_is_named() {
        let clouds = ("/points", "sensor_msgs/PointCloud2");
        let (odom, other) = (("/odom", "nav_msgs/Odometry"), ("/gps_odom", "nav_msgs/Odometry"));
        let (markers, truth) = (
            ("/objects", "visualization_msgs/MarkerArray"),
            ("/ground_truth", "visualization_msgs/MarkerArray"),
        );
        let all = draft(&[clouds, odom, other, markers]);
        assert!(
            all.contains("; it has /odom too") || all.contains("; it has /gps_odom too"),
            "{all}"
        );
        assert!(
            all.contains("# truth: \"/objects\"  # markers") || all.contains("# truth: /objects  # markers"),
            "{all}"
        );
        let clear = draft(&[clouds, odom, markers, truth]);
        assert!(!clear.contains("too") && !clear.contains("# markers"), "{clear}");
        assert!(clear.contains("truth: ") && clear.contains("/ground_truth"), "{clear}");
    }

    #[test]
    fn the_shortest_path_that_is_unique_names_a_bag() {
        let bags = ["/x/a/one.bag", "/x/b/one.bag", "two.bag", "c/two.bag"].map(Path::new);
        for (path, expected) in [
            ("/x/a/one.bag", "a/one.bag"),
            ("/x/b/one.bag", "b/one.bag"),
            ("two.bag", "two.bag"),
            ("c/two.bag", "c/two.bag"),
        ] {
            assert_eq!(shortest(&bags, Path::new(path)), Path::new(expected));
        }
        assert_eq!(shortest(&bags[..1], bags[0]), Path::new("one.bag"));
    }
}
