//! All messages but the clouds, and how the first clouds are to be read.

mod content;

use std::cell::Cell;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::hash::{DefaultHasher, Hash, Hasher};

use realo_bags::map_file::StampClock;
use realo_bags::messages::{self, Attitude, Fix, Kind, Measured, Objects, Pose};
use realo_bags::{Bag, Connection, Message, is_static};
use realo_logs::Frames;
use realo_logs::motion::{FixReading, ImuReading, WheelReading};
use realo_schemas::Nanos;

use super::agents::{Agent, Topic};
use super::heads::{Heads, heads, stamp_of};
use super::{Counted, Import};
use crate::ImportError;

/// Longer messages are not compared from bag to bag.
const COMPARED: usize = 4096;
/// So many messages are compared.
const MOST_COMPARED: usize = 20_000;

/// A message with when it was recorded.
pub struct At<T> {
    /// By the recorder's clock, ns.
    pub log_time: Nanos,
    /// What it says.
    pub said: T,
}

/// By topic and source: reference clock less the clock of the stamps, and the time of the reference, ns.
pub type References = BTreeMap<[String; 2], Vec<[Nanos; 2]>>;
/// Log times of messages by a hash of topic and content; `None` of content that is there twice. The content is the bytes, or what they
/// say where bags differ in how they serialise the topic.
pub type Seen = HashMap<u64, Option<Nanos>>;

/// What a bag says besides clouds.
#[derive(Default)]
pub struct BagSmall {
    /// How frames lie in each other.
    pub frames: Frames,
    /// Stamps of transforms that move.
    pub moving: BTreeMap<Nanos, Nanos>,
    /// Time references, by topic and source.
    pub references: References,
    /// Messages that may be in other bags too.
    pub seen: Seen,
    /// Topics that another bag has in the serialisation of the other version of ROS, and whose type is not read.
    pub uncompared: Vec<String>,
    /// Connections that another bag has in another serialisation.
    mixed: BTreeSet<usize>,
}

/// What motion sensors of an agent measured.
#[derive(Default)]
pub struct Motion {
    /// Its inertial unit.
    pub imu: Vec<At<Measured<ImuReading>>>,
    /// Its satellite receiver.
    pub fixes: Vec<At<Measured<FixReading>>>,
    /// Its wheels.
    pub wheels: Vec<At<Measured<WheelReading>>>,
}

impl Motion {
    /// Takes what a message measured, if its topic is one of the agent's sensors.
    fn take(
        &mut self,
        agent: &Agent,
        connection: &Connection,
        message: &Message,
        kind: Kind,
        stamped: &impl Fn(Nanos) -> Nanos,
    ) -> Result<(), String> {
        let begin = || connection.reader(message.data());
        let is = |topic: Option<&Topic>| topic.is_some_and(|topic| topic.connection == message.connection);
        let log_time = message.log_time;
        if is(agent.imu.as_ref())
            && let Some(mut said) = messages::inertial(&mut begin()?)?
        {
            said.stamp = stamped(said.stamp);
            self.imu.push(At { log_time, said });
        }
        if is(agent.receiver()) {
            let fix = messages::fix(&mut begin()?)?;
            let reading = FixReading {
                quality: fix.quality,
                geodetic: fix.geodetic.unwrap_or([f64::NAN; 3]),
                covariance: fix.covariance,
            };
            let said = Measured {
                stamp: stamped(fix.stamp),
                frame: fix.frame,
                reading,
            };
            self.fixes.push(At { log_time, said });
        }
        if is(agent.wheels.as_ref()) {
            let mut said = messages::speed(kind, &mut begin()?)?;
            said.stamp = stamped(said.stamp);
            self.wheels.push(At { log_time, said });
        }
        Ok(())
    }
}

/// What an agent's topics say besides clouds.
#[derive(Default)]
pub struct AgentSmall {
    /// Poses.
    pub poses: Vec<At<Pose>>,
    /// Positions.
    pub fixes: Vec<At<Fix>>,
    /// Attitudes.
    pub attitudes: Vec<Attitude>,
    /// What its inertial unit, its receiver and its wheels measured.
    pub motion: Motion,
    /// All objects.
    pub truth: Vec<At<Objects>>,
    /// Recorded detections.
    pub detections: Vec<At<Objects>>,
    /// How the first clouds of each topic are read.
    pub heads: Vec<Heads>,
}

/// What all bags say besides clouds.
pub struct Small {
    /// By bag.
    pub bags: Vec<BagSmall>,
    /// By agent.
    pub agents: Vec<AgentSmall>,
    /// Messages that cannot be read.
    pub faults: Counted,
    /// Messages without a stamp, by topic, where stamps of headers count.
    pub unstamped: BTreeMap<String, u64>,
}

/// Reads all bags once, without their clouds but the first.
pub fn read(import: &Import, report: &mut dyn FnMut(&'static str, u64, u64)) -> Result<Small, ImportError> {
    let mut small = Small {
        bags: Vec::new(),
        agents: import.agents.iter().map(|_| AgentSmall::default()).collect(),
        faults: Counted::default(),
        unstamped: BTreeMap::new(),
    };
    let all = (0..import.joined.bags.len()).flat_map(|bag| wanted(import, bag));
    let all: u64 = all.map(|(_, count)| count).sum();
    let mut done = 0;
    for (place, bag) in import.joined.bags.iter().enumerate() {
        small.bags.push(BagSmall::of(import, place));
        let wanted: BTreeSet<usize> = wanted(import, place).map(|(connection, _)| connection).collect();
        let mut messages = bag.messages(&wanted)?;
        while let Some(message) = messages.next()? {
            done += 1;
            if done % 1000 == 0 {
                report("reading", done, all);
            }
            let connection = &bag.connections()[message.connection];
            if let Err(reason) = small.take(import, place, connection, &message) {
                small.faults.add(&connection.topic, reason);
            }
        }
    }
    for (place, agent) in import.agents.iter().enumerate() {
        for topic in &agent.clouds {
            small.agents[place].heads.push(heads(import, agent, topic)?);
        }
    }
    Ok(small)
}

/// Connections that are read whole, with how many messages each has.
fn wanted(import: &Import, bag: usize) -> impl Iterator<Item = (usize, u64)> {
    let agents = move || import.agents.iter().filter(move |agent| agent.bag == bag);
    let connections = import.joined.bags[bag].connections().iter().enumerate();
    connections.filter_map(move |(place, connection)| {
        let is_small = match Kind::named(&connection.kind) {
            Some(Kind::PointCloud2) => false,
            Some(Kind::Transforms | Kind::TimeReference) => true,
            _ => {
                let is_used = agents().flat_map(Agent::small).any(|topic| topic.connection == place);
                // Whatever both bags recorded compares their clocks.
                is_used || (import.joined.bags.len() > 1 && is_in_all(import, connection))
            }
        };
        is_small.then_some((place, connection.messages))
    })
}

fn is_in_all(import: &Import, connection: &Connection) -> bool {
    let is_image = ["Image", "Cloud", "Scan", "Packet", "payload"]
        .iter()
        .any(|word| connection.kind.contains(word));
    let has = |bag: &dyn Bag| {
        bag.connections()
            .iter()
            .any(|other| other.topic == connection.topic && other.kind == connection.kind)
    };
    !is_image && import.joined.bags.iter().all(|bag| has(bag.as_ref()))
}

/// Whether another bag serialises a topic otherwise.
fn is_mixed(import: &Import, connection: &Connection) -> bool {
    let is_other = |other: &Connection| other.topic == connection.topic && other.encoding != connection.encoding;
    let mut bags = import.joined.bags.iter();
    bags.any(|bag| bag.connections().iter().any(is_other))
}

impl Small {
    fn take(&mut self, import: &Import, bag: usize, connection: &Connection, message: &Message) -> Result<(), String> {
        let known = &mut self.bags[bag];
        // Each recorder writes static transforms when it starts, so their log times say nothing of clocks.
        // What a file says that two bags share says nothing of their clocks either.
        let is_shared = import.joined.shared[bag].contains(&message.connection);
        if import.joined.bags.len() > 1 && !is_shared && !is_static(&connection.topic) {
            known.see(connection, message);
        }
        let Some(kind) = Kind::named(&connection.kind) else {
            return Ok(());
        };
        let clock = import.map.clock;
        let is_unstamped = Cell::new(false);
        let stamped = |stamp: Nanos| {
            is_unstamped.set(is_unstamped.get() || stamp == 0);
            stamp_of(clock, stamp, message.log_time)
        };
        let taken = self.take_stamped(import, bag, connection, message, kind, &stamped);
        // What holds for all times needs no stamp.
        if is_unstamped.get() && clock == StampClock::Header && !is_static(&connection.topic) {
            *self.unstamped.entry(connection.topic.clone()).or_default() += 1;
        }
        taken
    }

    fn take_stamped(
        &mut self,
        import: &Import,
        bag: usize,
        connection: &Connection,
        message: &Message,
        kind: Kind,
        stamped: &impl Fn(Nanos) -> Nanos,
    ) -> Result<(), String> {
        let known = &mut self.bags[bag];
        match kind {
            Kind::Transforms => return known.take_transforms(connection, message, stamped),
            Kind::TimeReference => return known.take_reference(connection, message, stamped),
            _ => {}
        }
        let agents = import.agents.iter().zip(&mut self.agents);
        for (agent, small) in agents.filter(|(agent, _)| agent.bag == bag) {
            small.take(agent, connection, message, kind, stamped)?;
        }
        Ok(())
    }
}

impl BagSmall {
    /// Of a bag before it is read.
    fn of(import: &Import, bag: usize) -> Self {
        let connections = import.joined.bags[bag].connections().iter().enumerate();
        let mixed = connections.filter(|(_, connection)| is_in_all(import, connection) && is_mixed(import, connection));
        let (mut places, mut uncompared) = (BTreeSet::new(), Vec::new());
        for (place, connection) in mixed {
            places.insert(place);
            if bag == 0 && Kind::named(&connection.kind).is_none() {
                uncompared.push(format!("`{}` ({})", connection.topic, connection.kind));
            }
        }
        BagSmall {
            uncompared,
            mixed: places,
            ..BagSmall::default()
        }
    }

    /// Remembers a message that other bags may have, too.
    fn see(&mut self, connection: &Connection, message: &Message) {
        let data = message.data();
        if data.len() > COMPARED || self.seen.len() >= MOST_COMPARED {
            return;
        }
        let hash = match self.mixed.contains(&message.connection) {
            false => Some(hash(&connection.topic, data)),
            true => content::said(connection, data).map(|said| hash(&connection.topic, said.as_bytes())),
        };
        if let Some(hash) = hash {
            let seen = self.seen.entry(hash);
            seen.and_modify(|seen| *seen = None).or_insert(Some(message.log_time));
        }
    }

    fn take_transforms(
        &mut self,
        connection: &Connection,
        message: &Message,
        stamped: &impl Fn(Nanos) -> Nanos,
    ) -> Result<(), String> {
        let fixed = is_static(&connection.topic);
        let (transforms, wrong) = messages::transforms(&mut connection.reader(message.data())?)?;
        for t in transforms {
            let stamp = stamped(t.stamp);
            self.frames
                .insert(fixed, stamp, &t.parent, &t.child, t.parent_from_child);
            if !fixed {
                self.moving.entry(stamp).or_insert(message.log_time);
            }
        }
        match wrong {
            0 => Ok(()),
            _ => Err("a transform that is not finite, or whose quaternion is not of length 1".into()),
        }
    }

    fn take_reference(
        &mut self,
        connection: &Connection,
        message: &Message,
        stamped: &impl Fn(Nanos) -> Nanos,
    ) -> Result<(), String> {
        let ([stamp, reference], source) = messages::time_reference(&mut connection.reader(message.data())?)?;
        let offset = reference.saturating_sub(stamped(stamp));
        let of_source = self.references.entry([connection.topic.clone(), source]);
        of_source.or_default().push([offset, reference]);
        Ok(())
    }
}

impl AgentSmall {
    /// Takes what a message says, by the agent's topics that it is of.
    fn take(
        &mut self,
        agent: &Agent,
        connection: &Connection,
        message: &Message,
        kind: Kind,
        stamped: &impl Fn(Nanos) -> Nanos,
    ) -> Result<(), String> {
        let begin = || connection.reader(message.data());
        let log_time = message.log_time;
        let is = |topic: &Option<Topic>| {
            let topic = topic.as_ref();
            topic.is_some_and(|topic| topic.connection == message.connection)
        };
        if is(&agent.pose) && kind == Kind::NavSatFix {
            let mut said = messages::fix(&mut begin()?)?;
            said.stamp = stamped(said.stamp);
            self.fixes.push(At { log_time, said });
        } else if is(&agent.pose) {
            let mut said = messages::pose(kind, &mut begin()?)?;
            said.stamp = stamped(said.stamp);
            self.poses.push(At { log_time, said });
        }
        if is(&agent.imu) {
            let mut said = messages::attitude(&mut begin()?)?;
            said.stamp = stamped(said.stamp);
            self.attitudes.push(said);
        }
        self.motion.take(agent, connection, message, kind, stamped)?;
        let objects = || -> Result<At<Objects>, String> {
            let mut said = match kind {
                Kind::MarkerArray => messages::markers(begin)?,
                _ => messages::detections(begin)?,
            };
            // An array of no markers has no stamp.
            let is_empty =
                kind == Kind::MarkerArray && said.stamp == 0 && said.objects.is_empty() && said.others.is_empty();
            said.stamp = if is_empty { log_time } else { stamped(said.stamp) };
            Ok(At { log_time, said })
        };
        if is(&agent.truth) {
            self.truth.push(objects()?);
        }
        if is(&agent.detections) {
            self.detections.push(objects()?);
        }
        Ok(())
    }
}

fn hash(topic: &str, data: &[u8]) -> u64 {
    let mut hasher = DefaultHasher::new();
    (topic, data).hash(&mut hasher);
    hasher.finish()
}
