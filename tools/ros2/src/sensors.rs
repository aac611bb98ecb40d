//! The stage that brings clouds and poses of ROS into a graph.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use realo_bags::map_file::{MapFile, PoseSource, StampClock};
use realo_bags::messages::{self, Kind};
use realo_logs::cdr::CdrReader;
use realo_logs::cloud::CloudReader;
use realo_logs::{Frames, Step, Stream, clock_words};
use realo_operator::{Counter, Describe, Durations, Error, NoInput, Operator, Outputs, Settings};
use realo_schemas::{AgentState, Header, Kind as Carried, Name, Nanos, PointCloud, from_seconds};
use serde::{Deserialize, Serialize};

use crate::agent::{Agent, Lack, Placed};
use crate::counters::{
    ALL, CLOUDS, INTENSITIES_LIMITED, LOST, NO_POSE, NO_WAY, OVERRUN, POSES, SILENT, STAMPS_BACK, STAMPS_OFF,
    STAMPS_ZERO, UNREADABLE, WITHOUT_TIMES,
};
use crate::names;
use crate::queue::{Heard, Queue, Traffic};
use crate::ros::{self, Delivery, Quality, Ros};
use crate::watch;

/// How long a call waits for something to come.
const PATIENCE: Duration = Duration::from_millis(50);
/// Between two looks for the type of a topic of poses, ns.
const LOOK: Nanos = 100_000_000;
/// Clouds that wait at most.
const CLOUDS_WAITING: usize = 8;
/// Other messages of a topic that wait at most.
const OTHERS_WAITING: usize = 4096;
/// Transforms are kept for so long, ns.
const TRANSFORMS: Nanos = 10_000_000_000;
/// Topics of transforms, and whether what is on them holds for all times.
const TRANSFORM_TOPICS: [(&str, bool); 2] = [("/tf", false), ("/tf_static", true)];

/// Settings of the stage.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// YAML file that says whose topics and frames are which, as for `realo-lab import bag`.
    #[setting(default = "ros2.yml")]
    pub map: PathBuf,
    /// Name of the ego in that file; empty: its only agent.
    pub ego: String,
    /// Domain of ROS, 0 to 232; null: what ROS_DOMAIN_ID says, or 0.
    pub domain: Option<u16>,
    /// Whether only programs on this machine are heard.
    pub localhost: bool,
    /// How clouds and poses are read: `best_effort` hears every publisher, `reliable` has what is lost sent again.
    pub reliability: Delivery,
    /// A topic without a message for so many seconds is reported.
    #[setting(default = 5.0, range = 0.1..=1e6)]
    pub silent_s: f64,
    /// Seconds after which the streams end; null: never.
    #[setting(range = 0.0<..=1e9)]
    pub seconds: Option<f64>,
    /// Name of the run, in every header.
    #[setting(default = "run")]
    pub run: String,
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The ego's sweeps.
    #[port(of(Ego))]
    EgoClouds(Header, PointCloud),
    /// The ego's poses.
    #[port(of(Ego))]
    EgoPoses(Header, AgentState),
    /// The sweeps of the other agents of the map file.
    #[port(of(Others))]
    Clouds(Header, PointCloud),
    /// Their poses.
    #[port(of(Others))]
    Poses(Header, AgentState),
}

/// Brings clouds and poses of ROS 2 into a graph.
#[derive(Describe)]
#[stage(name = "ros2-sensors", input = NoInput, counters = ALL)]
pub struct Sensors {
    settings: Settings,
    run: Name,
    domain: u16,
    clock: StampClock,
    /// What is added to the stamps of transforms, ns.
    offset: Nanos,
    agents: Vec<Agent>,
    frames: Frames,
    queue: Queue,
    topics: Vec<Topic>,
    /// Agents whose topic of poses has no known type yet.
    untyped: Vec<usize>,
    ros: Option<Ros>,
    began: Nanos,
    looked: Nanos,
    /// What was said once.
    said: BTreeMap<String, u64>,
}

/// What comes on a topic.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Carries {
    Clouds(usize),
    Poses(usize, Kind),
    Transforms(bool),
}

struct Topic {
    name: String,
    kind: &'static str,
    carries: Carries,
    /// What was counted already.
    counted: Traffic,
    /// Since when it is waited for, or its newest message, by the wall clock.
    waits_since: Nanos,
    /// What was said last of its silence.
    silence: String,
    /// From a cloud's stamp to its arrival.
    delays: Durations,
}

impl Operator for Sensors {
    fn build(settings: Settings) -> Result<Self, Error> {
        let domain = ros::domain(settings.domain)?;
        let map = MapFile::read(&settings.map)?;
        let ego = ego(&map, &settings.ego)?;
        let place = |reason: String| format!("{}: {reason}", settings.map.display());
        let agents = map
            .agents
            .iter()
            .map(|(name, agent)| Agent::new(name, agent, &map.world, *name == ego));
        let agents: Vec<Agent> = agents.collect::<Result<_, String>>().map_err(place)?;
        for agent in &agents {
            names::topic(&agent.map.clouds[0])
                .map_err(|reason| place(format!("agents.{}: clouds: {reason}", agent.name)))?;
            if let PoseSource::Topic(topic) = &agent.map.pose {
                names::topic(topic).map_err(|reason| place(format!("agents.{}: pose: {reason}", agent.name)))?;
            }
        }
        let offset = offset_of_transforms(&agents).map_err(place)?;
        Ok(Sensors {
            offset,
            run: settings.run.as_str().into(),
            domain,
            clock: map.clock,
            agents,
            frames: Frames::default(),
            queue: Queue::default(),
            topics: Vec::new(),
            untyped: Vec::new(),
            ros: None,
            began: 0,
            looked: 0,
            said: BTreeMap::new(),
            settings,
        })
    }

    fn on_input(&mut self, input: NoInput, _: &mut Outputs<Output>) -> Result<(), Error> {
        match input {}
    }

    fn on_wake(&mut self, _: Nanos, out: &mut Outputs<Output>) -> Result<(), Error> {
        if self.ros.is_none() {
            self.join()?;
        }
        if let Some(ros) = &mut self.ros {
            ros.announce()?;
        }
        self.look_for_types()?;
        for heard in self.queue.take(PATIENCE) {
            self.hear(heard, out);
        }
        let now = realo_clock::wall();
        self.count(now, out);
        let is_over = self
            .settings
            .seconds
            .is_some_and(|seconds| now - self.began > from_seconds(seconds));
        if !is_over {
            out.wake_at(out.now());
        }
        Ok(())
    }

    fn on_end(&mut self, _: &mut Outputs<Output>) -> Result<(), Error> {
        for (number, topic) in self.topics.iter().enumerate() {
            eprintln!("ros2-sensors: {}", topic.summary(&self.queue.traffic(number)));
        }
        Ok(())
    }
}

/// The agent that is the ego.
fn ego(map: &MapFile, given: &str) -> Result<String, String> {
    let names: Vec<&str> = map.agents.keys().map(String::as_str).collect();
    match (given, &names[..]) {
        ("", [only]) => Ok(only.to_string()),
        ("", _) => Err(format!(
            "setting `ego`: the map file has {}: name one of them",
            names.join(", ")
        )),
        (given, _) if names.contains(&given) => Ok(given.into()),
        (given, _) => Err(format!(
            "setting `ego`: expected an agent of the map file ({}), found `{}`",
            names.join(", "),
            given.escape_debug()
        )),
    }
}

impl Sensors {
    /// Joins the domain and reads all topics whose types are known.
    fn join(&mut self) -> Result<(), Error> {
        let ros = self
            .ros
            .insert(Ros::join(self.domain, self.settings.localhost, "realo_sensors")?);
        let now = realo_clock::wall();
        (self.began, self.looked) = (now, now);
        for (name, is_static) in TRANSFORM_TOPICS {
            let quality = Quality {
                delivery: Delivery::Reliable,
                depth: 100,
                latched: is_static,
            };
            let carries = Carries::Transforms(is_static);
            open(
                ros,
                &self.queue,
                &mut self.topics,
                (name, "tf2_msgs/TFMessage"),
                quality,
                carries,
            )?;
        }
        for (index, agent) in self.agents.iter().enumerate() {
            let name = names::topic(&agent.map.clouds[0])?;
            let quality = Quality {
                delivery: self.settings.reliability,
                depth: CLOUDS_WAITING as i32,
                latched: false,
            };
            let typed = (name.as_str(), "sensor_msgs/PointCloud2");
            open(
                ros,
                &self.queue,
                &mut self.topics,
                typed,
                quality,
                Carries::Clouds(index),
            )?;
            if matches!(agent.map.pose, PoseSource::Topic(_)) {
                self.untyped.push(index);
            }
            for unused in watch::unused(&agent.map) {
                eprintln!(
                    "ros2-sensors: agent `{}`: `{unused}` of the map file is for recordings, and not used",
                    agent.name
                );
            }
        }
        Ok(())
    }

    /// Reads the topics of poses whose publishers have announced a type by now.
    fn look_for_types(&mut self) -> Result<(), Error> {
        let now = realo_clock::wall();
        let Some(ros) = self
            .ros
            .as_mut()
            .filter(|_| !self.untyped.is_empty() && now - self.looked > LOOK)
        else {
            return Ok(());
        };
        self.looked = now;
        let found = ros.found();
        for index in std::mem::take(&mut self.untyped) {
            let PoseSource::Topic(topic) = &self.agents[index].map.pose else {
                continue;
            };
            let topic = names::topic(topic)?;
            let kinds = found
                .iter()
                .filter(|found| found.topic == topic)
                .map(|found| found.kind.as_str());
            let known = kinds.clone().find_map(watch::pose_type);
            let Some((kind, name)) = known else {
                let waited = now - self.began > from_seconds(self.settings.silent_s);
                let others: Vec<&str> = kinds.collect();
                let words = watch::no_poses(&topic, &others, &found);
                if waited && self.said.insert(topic, 1).is_none() {
                    eprintln!("ros2-sensors: {words}");
                }
                self.untyped.push(index);
                continue;
            };
            let quality = Quality {
                delivery: self.settings.reliability,
                depth: 100,
                latched: false,
            };
            let typed = (topic.as_str(), name);
            open(
                ros,
                &self.queue,
                &mut self.topics,
                typed,
                quality,
                Carries::Poses(index, kind),
            )?;
        }
        Ok(())
    }

    fn hear(&mut self, heard: Heard, out: &mut Outputs<Output>) {
        let Heard { topic, payload, at } = heard;
        let heard = match self.topics[topic].carries {
            Carries::Clouds(agent) => self.hear_cloud(topic, agent, &payload, at, out),
            Carries::Poses(agent, kind) => self.hear_pose(agent, kind, &payload, at, out),
            Carries::Transforms(is_static) => self.hear_transforms(is_static, &payload, at, out),
        };
        if let Err((counter, agent, words)) = heard {
            out.count_of(counter, &agent, 1, 1);
            let topic = &self.topics[topic].name;
            out.found(counter, &agent, || format!("{topic}: {words}"));
            let times = self.said.entry(format!("{topic} {}", counter.name)).or_default();
            *times += 1;
            if *times == 1 {
                eprintln!("ros2-sensors: {topic}: {words}; {}", counter.remedy);
            }
        }
    }

    fn hear_cloud(
        &mut self,
        topic: usize,
        index: usize,
        payload: &[u8],
        at: Nanos,
        out: &mut Outputs<Output>,
    ) -> Result<(), Lost> {
        let agent = &mut self.agents[index];
        let name = agent.name.clone();
        let lost = |counter: &'static Counter| {
            let name = name.to_string();
            move |words: String| (counter, name, words)
        };
        let reader = CdrReader::any_cdr(payload).and_then(|mut input| CloudReader::read(&mut input));
        let mut reader = reader.map_err(lost(&UNREADABLE))?;
        reader.stamp =
            stamp(self.clock, reader.stamp, agent.offset(), at).map_err(|(counter, words)| lost(counter)(words))?;
        self.topics[topic].delays.record(at - reader.stamp);
        if !agent.is_later_cloud(reader.stamp) {
            return Err(lost(&STAMPS_BACK)(format!(
                "a cloud of stamp {} ns came after a later one",
                reader.stamp
            )));
        }
        let (cloud, limited, pose) = agent.cloud(&self.frames, &reader).map_err(|lack| match lack {
            Lack::Pose => lost(&NO_POSE)("no pose is within a second of a cloud".into()),
            Lack::Way(words) => lost(&NO_WAY)(words),
            Lack::Content(words) => lost(&UNREADABLE)(words),
        })?;
        out.count(&WITHOUT_TIMES, &name, u64::from(reader.time().is_none()));
        out.count(&INTENSITIES_LIMITED, &name, limited);
        out.count(&CLOUDS, &name, 1);
        for counter in [&UNREADABLE, &NO_POSE, &NO_WAY, &STAMPS_BACK, &STAMPS_OFF, &STAMPS_ZERO] {
            out.count_of(counter, &name, 0, 1);
        }
        if let Some(state) = pose {
            self.send_pose(index, (reader.stamp, state), at, out);
        }
        let agent = &mut self.agents[index];
        let header = Header::origin(&self.run, &agent.name, Carried::Points, agent.next[0], reader.stamp, at);
        agent.next[0] += 1;
        out.send(match agent.is_ego {
            true => Output::EgoClouds(header, cloud),
            false => Output::Clouds(header, cloud),
        });
        Ok(())
    }

    fn hear_pose(
        &mut self,
        index: usize,
        kind: Kind,
        payload: &[u8],
        at: Nanos,
        out: &mut Outputs<Output>,
    ) -> Result<(), Lost> {
        let agent = &mut self.agents[index];
        let name = agent.name.clone();
        let lost = |counter: &'static Counter, words: String| (counter, name.to_string(), words);
        let said = CdrReader::any_cdr(payload).and_then(|mut input| messages::pose(kind, &mut input));
        let mut said = said.map_err(|words| lost(&UNREADABLE, words))?;
        said.stamp =
            stamp(self.clock, said.stamp, agent.offset(), at).map_err(|(counter, words)| lost(counter, words))?;
        let placed = agent.pose(&self.frames, said).map_err(|lack| match lack {
            Lack::Way(words) => lost(&NO_WAY, words),
            Lack::Content(words) => lost(&UNREADABLE, words),
            Lack::Pose => lost(&NO_POSE, "no pose".into()),
        })?;
        let placed = placed.ok_or_else(|| lost(&STAMPS_BACK, "a pose is not later than the one before".into()))?;
        self.send_pose(index, placed, at, out);
        Ok(())
    }

    fn hear_transforms(
        &mut self,
        is_static: bool,
        payload: &[u8],
        at: Nanos,
        out: &mut Outputs<Output>,
    ) -> Result<(), Lost> {
        let lost = |counter: &'static Counter, words: String| (counter, String::new(), words);
        let read = CdrReader::any_cdr(payload).and_then(|mut input| messages::transforms(&mut input));
        let (transforms, wrong) = read.map_err(|words| lost(&UNREADABLE, words))?;
        let mut changed = Vec::new();
        let mut left_out = (wrong > 0).then(|| lost(&UNREADABLE, format!("{wrong} transforms are not poses")));
        for transform in &transforms {
            let (parent, child) = (&transform.parent, &transform.child);
            let stamp = match is_static {
                true => Ok(transform.stamp),
                false => stamp(self.clock, transform.stamp, self.offset, at)
                    .map_err(|(counter, words)| lost(counter, format!("frame `{child}`: {words}"))),
            };
            let taken = stamp.and_then(|stamp| {
                let pose = transform.parent_from_child;
                match self.frames.insert(is_static, stamp, parent, child, pose) {
                    true => Ok(stamp),
                    false => Err(lost(&UNREADABLE, format!("frame `{child}` is one too many"))),
                }
            });
            match taken {
                Ok(stamp) => changed.push((child.as_str(), stamp)),
                Err(reason) => left_out = left_out.or(Some(reason)),
            }
        }
        self.frames.forget(at - TRANSFORMS);
        for index in 0..self.agents.len() {
            let agent = &mut self.agents[index];
            let (placed, given_up) = agent.transforms(&self.frames, &changed);
            if let Some((count, words)) = given_up {
                let name = agent.name.clone();
                // One is counted with its reason.
                out.count(&NO_WAY, &name, count - 1);
                left_out = left_out.or(Some((&NO_WAY, name.to_string(), words)));
            }
            placed
                .into_iter()
                .for_each(|placed| self.send_pose(index, placed, at, out));
        }
        left_out.map_or(Ok(()), Err)
    }

    fn send_pose(&mut self, index: usize, (stamp, state): Placed, at: Nanos, out: &mut Outputs<Output>) {
        let agent = &mut self.agents[index];
        let header = Header::origin(&self.run, &agent.name, Carried::AgentState, agent.next[1], stamp, at);
        agent.next[1] += 1;
        out.count(&POSES, &agent.name, 1);
        out.send(match agent.is_ego {
            true => Output::EgoPoses(header, state),
            false => Output::Poses(header, state),
        });
    }

    /// Counts what the queue knows, and says which topics are silent.
    fn count(&mut self, now: Nanos, out: &mut Outputs<Output>) {
        let Some(ros) = &self.ros else { return };
        let patience = from_seconds(self.settings.silent_s);
        for (number, topic) in self.topics.iter_mut().enumerate() {
            let known = self.queue.traffic(number);
            let agent = topic.carries.agent().map_or("", |agent| &*self.agents[agent].name);
            let of = known.received + known.lost - topic.counted.received - topic.counted.lost;
            out.count_of(&LOST, agent, known.lost - topic.counted.lost, of);
            out.count_of(&OVERRUN, agent, known.overrun - topic.counted.overrun, of);
            let refused = known.refused.0 - topic.counted.refused.0;
            if refused > 0 {
                out.count_of(&UNREADABLE, agent, refused, refused);
                out.found(&UNREADABLE, agent, || known.refused.1.clone());
            }
            topic.waits_since = topic.waits_since.max(known.newest.unwrap_or(0));
            topic.counted = known;
            // Transforms may be all that a run does without.
            if topic.carries.agent().is_some() && now - topic.waits_since > patience {
                topic.waits_since = now;
                out.count_of(&SILENT, agent, 1, 0);
                let words = watch::silent(&topic.name, topic.kind, self.settings.silent_s, &ros.found());
                if words != topic.silence {
                    eprintln!("ros2-sensors: {words}");
                    topic.silence = words;
                }
            }
        }
    }
}

/// A message that is left out: as what it counts, whose it is, and why.
type Lost = (&'static Counter, String, String);

/// Reads a topic from now on.
fn open(
    ros: &mut Ros,
    queue: &Queue,
    topics: &mut Vec<Topic>,
    (name, kind): (&str, &'static str),
    quality: Quality,
    carries: Carries,
) -> Result<(), Error> {
    let room = match carries {
        Carries::Clouds(_) => CLOUDS_WAITING,
        Carries::Poses(..) | Carries::Transforms(_) => OTHERS_WAITING,
    };
    let number = queue.open(room);
    topics.push(Topic {
        name: name.into(),
        kind,
        carries,
        counted: Traffic::default(),
        waits_since: realo_clock::wall(),
        silence: String::new(),
        delays: Durations::default(),
    });
    Ok(ros.read(name, kind, quality, (queue.clone(), number))?)
}

/// What is added to the stamps of transforms, ns: the offset of the agents that they place.
///
/// # Errors
/// Agents with different offsets, since nobody knows whose clock a transform has.
fn offset_of_transforms(agents: &[Agent]) -> Result<Nanos, String> {
    let mut placed = agents.iter().filter(|agent| agent.map.pose == PoseSource::Tf);
    let Some(first) = placed.next() else { return Ok(0) };
    match placed.find(|other| other.offset() != first.offset()) {
        None => Ok(first.offset()),
        Some(other) => Err(format!(
            "agents.{}: offset: expected that of `{}`, since both have `pose: tf` and a transform is of one clock, found another; give one of \
             them a topic of poses",
            other.name, first.name
        )),
    }
}

/// The stamp that counts of a message that came `at`, moved by an offset.
fn stamp(clock: StampClock, given: Nanos, offset: Nanos, at: Nanos) -> Result<Nanos, (&'static Counter, String)> {
    match (clock, given) {
        (StampClock::Log, _) => return Ok(at.saturating_add(offset)),
        (StampClock::Header, 0) => return Err((&STAMPS_ZERO, "the stamp in its header is 0".into())),
        (StampClock::Header, _) => {}
    }
    let stamp = given.saturating_add(offset);
    match Step::of(Stream::Points, stamp, at) {
        Step::Off => Err((&STAMPS_OFF, clock_words(stamp, at))),
        Step::InStep | Step::Ahead => Ok(stamp),
    }
}

impl Carries {
    fn agent(self) -> Option<usize> {
        match self {
            Carries::Clouds(agent) | Carries::Poses(agent, _) => Some(agent),
            Carries::Transforms(_) => None,
        }
    }
}

impl Topic {
    fn summary(&self, traffic: &Traffic) -> String {
        let Traffic {
            received,
            lost,
            overrun,
            ..
        } = traffic;
        let millis = |share| {
            self.delays
                .quantile(share)
                .map_or(f64::NAN, |delay| delay as f64 * 1e-6)
        };
        let delays = match self.delays.count() {
            0 => String::new(),
            _ => format!(
                "; from stamp to arrival p50 {:.1} ms, p99 {:.1} ms",
                millis(0.5),
                millis(0.99)
            ),
        };
        format!(
            "{}: {received} messages, {lost} lost, {overrun} dropped{delays}",
            self.name
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Nanos = 1_000_000_000;

    #[test]
    fn stamps_of_zero_and_of_other_clocks_are_named() {
        let at = 1_700_000_000 * SECOND;
        let header = |given, offset| stamp(StampClock::Header, given, offset, at).map_err(|(counter, _)| counter.name);
        assert_eq!(header(at - SECOND / 10, 0), Ok(at - SECOND / 10));
        assert_eq!(header(0, 0), Err("stamps_zero"));
        assert_eq!(header(at - 37 * SECOND, 0), Err("stamps_off"));
        assert_eq!(header(at - 37 * SECOND, 37 * SECOND), Ok(at));
        assert_eq!(header(at + 2 * SECOND, 0), Err("stamps_off"));
        assert_eq!(stamp(StampClock::Log, 0, 0, at).ok(), Some(at));
    }

    #[test]
    fn the_ego_is_an_agent_of_the_map_file() {
        let one = "agents:\n  car: {clouds: /a, frame: base_link, pose: tf, height: 1}\n";
        let two = format!("{one}  mast: {{clouds: /b, frame: mast, pose: [0, 0, 5, 0], height: 5}}\n");
        let ego_of = |text: &str, given: &str| ego(&MapFile::parse(text).unwrap(), given);
        assert_eq!(ego_of(one, "").as_deref(), Ok("car"));
        assert_eq!(ego_of(&two, "mast").as_deref(), Ok("mast"));
        assert!(ego_of(&two, "").unwrap_err().contains("car, mast: name one of them"));
        assert!(ego_of(&two, "van").unwrap_err().contains("found `van`"));
    }
}
