//! A node of ROS 2 over DDS.

use std::net::{IpAddr, Ipv4Addr};
use std::sync::mpsc::{Sender, channel};
use std::time::Instant;

use futures::StreamExt;
use futures::executor::block_on;
use realo_logs::cdr::CdrWriter;
use realo_schemas::Nanos;
use rustdds::policy::{Durability, History, Reliability};
use rustdds::{
    DomainParticipant, DomainParticipantBuilder, Duration, Publisher, QosPolicies, QosPolicyBuilder, Subscriber,
    Timestamp, TopicKind, no_key,
};
use serde::{Deserialize, Serialize};

use crate::names;
use crate::queue::{Heard, Queue};
use crate::wire::Raw;

/// The largest domain whose ports exist.
pub const MOST_DOMAIN: u16 = 232;
/// Names the domain where no setting does, as every tool of ROS takes it.
const DOMAIN_VARIABLE: &str = "ROS_DOMAIN_ID";
/// Where participants say which nodes of ROS they are.
const NODES: (&str, &str) = ("ros_discovery_info", "rmw_dds_common/ParticipantEntitiesInfo");
/// So long a reliable writer waits for room at most.
const BLOCKING: Duration = Duration::from_millis(100);

/// Whether what is lost on the way is sent again.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Delivery {
    /// Never, as drivers of sensors publish; hears every publisher.
    #[default]
    BestEffort,
    /// Yes; a best-effort publisher is not heard, and a best-effort subscriber is served all the same.
    Reliable,
}

/// How a topic is published or read.
#[derive(Clone, Copy, Debug)]
pub struct Quality {
    /// Whether what is lost is sent again.
    pub delivery: Delivery,
    /// Messages that are kept.
    pub depth: i32,
    /// Whether who comes late gets what was sent before.
    pub latched: bool,
}

impl Quality {
    fn to_dds(self) -> QosPolicies {
        let reliability = match self.delivery {
            Delivery::BestEffort => Reliability::BestEffort,
            Delivery::Reliable => Reliability::Reliable {
                max_blocking_time: BLOCKING,
            },
        };
        let durability = match self.latched {
            true => Durability::TransientLocal,
            false => Durability::Volatile,
        };
        QosPolicyBuilder::new()
            .reliability(reliability)
            .durability(durability)
            .history(History::KeepLast { depth: self.depth })
            .build()
    }
}

/// Why ROS could not be reached.
#[derive(Debug, thiserror::Error)]
#[error("ROS 2, {what}: {reason}")]
pub struct RosError {
    what: String,
    reason: String,
}

fn failed<E: std::fmt::Debug>(what: impl Into<String>) -> impl FnOnce(E) -> RosError {
    let what = what.into();
    move |error| RosError {
        what,
        reason: format!("{error:?}"),
    }
}

/// The domain of a setting, of the environment, or 0.
///
/// # Errors
/// A number that is no domain.
pub fn domain(given: Option<u16>) -> Result<u16, String> {
    let named = std::env::var(DOMAIN_VARIABLE).ok().filter(|text| !text.is_empty());
    let (domain, whence) = match (given, named) {
        (Some(given), _) => (given.to_string(), "setting `domain`"),
        (None, Some(named)) => (named, DOMAIN_VARIABLE),
        (None, None) => return Ok(0),
    };
    let number = domain.parse().ok().filter(|number| *number <= MOST_DOMAIN);
    number.ok_or_else(|| {
        format!(
            "{whence}: expected 0 to {MOST_DOMAIN}, found `{}`",
            domain.escape_debug()
        )
    })
}

/// A publisher that others have announced.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Found {
    /// Its topic, as `/points`.
    pub topic: String,
    /// Its type, as `sensor_msgs/PointCloud2`.
    pub kind: String,
    /// Whether it sends again what is lost.
    pub is_reliable: bool,
}

/// Bytes of a participant's number in announcements of nodes: until Humble, and later.
const GID_BYTES: [usize; 2] = [24, 16];
/// What publishers say of their types since Iron.
const TYPE_HASH: &[u8] = b"typehash=";
/// A topic that every node of ROS publishes.
const LOG_TOPIC: &str = "rt/rosout";
/// Between two looks at what others are.
const LOOK: std::time::Duration = std::time::Duration::from_secs(1);

/// A node of ROS.
pub struct Ros {
    participant: DomainParticipant,
    publisher: Publisher,
    subscriber: Subscriber,
    node: String,
    nodes: no_key::DataWriter<Vec<u8>, Raw>,
    readers: Vec<[u8; 16]>,
    writers: Vec<[u8; 16]>,
    /// The form of the announcement that holds, by the bytes of a number.
    announced: Option<usize>,
    looked: Option<Instant>,
}

/// Publishes payloads on a topic.
pub struct Writer(no_key::DataWriter<Vec<u8>, Raw>);

impl Writer {
    /// Publishes CDR with its head.
    ///
    /// # Errors
    /// What DDS does not take.
    pub fn write(&self, payload: Vec<u8>) -> Result<(), RosError> {
        let written = self.0.write(payload, Some(Timestamp::now()));
        written.map_err(|error| RosError {
            what: format!("topic `{}`", rustdds::TopicDescription::name(self.0.topic())),
            reason: error.to_string(),
        })
    }
}

impl Ros {
    /// Joins a domain as a node; `localhost`: on this machine alone.
    ///
    /// # Errors
    /// What keeps it from the network.
    pub fn join(domain: u16, localhost: bool, node: &str) -> Result<Ros, RosError> {
        let mut builder = DomainParticipantBuilder::new(domain);
        if localhost {
            builder = builder.with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)]);
        }
        let participant = builder.build().map_err(failed(format!("domain {domain}")))?;
        let qos = QosPolicyBuilder::new().build();
        let publisher = participant.create_publisher(&qos).map_err(failed("publisher"))?;
        let subscriber = participant.create_subscriber(&qos).map_err(failed("subscriber"))?;
        let latched = Quality {
            delivery: Delivery::Reliable,
            depth: 1,
            latched: true,
        };
        let nodes = writer(&participant, &publisher, NODES.0, NODES.1, latched)?;
        Ok(Ros {
            participant,
            publisher,
            subscriber,
            node: node.into(),
            nodes,
            readers: Vec::new(),
            writers: Vec::new(),
            announced: None,
            looked: None,
        })
    }

    /// Reads a topic into a queue from now on, on a thread of its own.
    ///
    /// # Errors
    /// What DDS does not take.
    pub fn read(
        &mut self,
        topic: &str,
        kind: &str,
        quality: Quality,
        (queue, number): (Queue, usize),
    ) -> Result<(), RosError> {
        let qos = quality.to_dds();
        let wrong = || failed(format!("topic `{topic}`"));
        let (name, kind) = (names::dds_topic(topic), names::dds_type(kind));
        let known = self.participant.create_topic(name, kind, &qos, TopicKind::NoKey);
        let known = known.map_err(wrong())?;
        let (ready, is_ready) = channel();
        let subscriber = self.subscriber.clone();
        std::thread::spawn(move || {
            let reader = subscriber.create_simple_datareader_no_key::<Vec<u8>, Raw>(&known, Some(qos));
            listen(reader, &ready, &queue, number);
        });
        let guid = is_ready.recv().map_err(failed(format!("topic `{topic}`")))?;
        self.readers.push(guid.map_err(|reason| RosError {
            what: format!("topic `{topic}`"),
            reason,
        })?);
        self.announced = None;
        Ok(())
    }

    /// Publishes a topic.
    ///
    /// # Errors
    /// What DDS does not take.
    pub fn write(&mut self, topic: &str, kind: &str, quality: Quality) -> Result<Writer, RosError> {
        let name = names::dds_topic(topic);
        let writer = writer(&self.participant, &self.publisher, &name, kind, quality)?;
        self.writers.push(rustdds::RTPSEntity::guid(&writer).to_bytes());
        self.announced = None;
        Ok(Writer(writer))
    }

    /// The publishers of topics of ROS that are known by now.
    pub fn found(&self) -> Vec<Found> {
        let own = self.participant.discovered_writers();
        let mut found: Vec<Found> = own
            .iter()
            .filter_map(|writer| {
                let data = &writer.publication_topic_data;
                Some(Found {
                    topic: names::ros_topic(&data.topic_name)?.into(),
                    kind: names::ros_type(&data.type_name)?,
                    is_reliable: matches!(data.reliability, Some(Reliability::Reliable { .. })),
                })
            })
            .collect();
        found.sort();
        found
    }

    /// Says which node this is and what it reads and publishes, as `ros2 node list` and `ros2 topic info` show it; is called again and
    /// again. Nothing is said before a node of ROS is known, because distributions differ in the form.
    ///
    /// # Errors
    /// What DDS does not take.
    pub fn announce(&mut self) -> Result<(), RosError> {
        if self.looked.is_some_and(|looked| looked.elapsed() < LOOK) {
            return Ok(());
        }
        self.looked = Some(Instant::now());
        let (mut has_hash, mut is_ros) = (false, false);
        for writer in self.participant.discovered_writers() {
            has_hash |= writer.user_data.windows(TYPE_HASH.len()).any(|part| part == TYPE_HASH);
            is_ros |= writer.publication_topic_data.topic_name == LOG_TOPIC;
        }
        let form = (has_hash || is_ros).then(|| GID_BYTES[usize::from(has_hash)]);
        match form.filter(|form| self.announced != Some(*form)) {
            Some(form) => {
                self.announced = Some(form);
                self.publish_announcement(form)
            }
            None => Ok(()),
        }
    }

    fn publish_announcement(&self, gid_bytes: usize) -> Result<(), RosError> {
        let mut payload = Vec::new();
        let mut out = CdrWriter::new(&mut payload);
        let put = |out: &mut CdrWriter, guid: &[u8; 16]| {
            guid.iter().for_each(|byte| out.u8(*byte));
            (guid.len()..gid_bytes).for_each(|_| out.u8(0));
        };
        put(&mut out, &rustdds::RTPSEntity::guid(&self.participant).to_bytes());
        out.length(1);
        out.string("/");
        out.string(&self.node);
        for guids in [&self.readers, &self.writers] {
            out.length(guids.len());
            guids.iter().for_each(|guid| put(&mut out, guid));
        }
        let written = self.nodes.write(payload, Some(Timestamp::now()));
        written.map_err(|error| RosError {
            what: "the announcement of the node".into(),
            reason: error.to_string(),
        })
    }
}

fn writer(
    participant: &DomainParticipant,
    publisher: &Publisher,
    topic: &str,
    kind: &str,
    quality: Quality,
) -> Result<no_key::DataWriter<Vec<u8>, Raw>, RosError> {
    let qos = quality.to_dds();
    let wrong = || failed(format!("topic `{topic}`"));
    let (name, kind) = (topic.to_string(), names::dds_type(kind));
    let known = participant.create_topic(name, kind, &qos, TopicKind::NoKey);
    let known = known.map_err(wrong())?;
    let written = publisher.create_datawriter_no_key::<Vec<u8>, Raw>(&known, Some(qos));
    written.map_err(failed(format!("topic `{topic}`")))
}

type Reader = no_key::SimpleDataReader<Vec<u8>, Raw>;

/// Reads until the process ends.
fn listen(
    reader: rustdds::dds::CreateResult<Reader>,
    ready: &Sender<Result<[u8; 16], String>>,
    queue: &Queue,
    topic: usize,
) {
    let reader = match reader {
        Ok(reader) => reader,
        Err(error) => {
            // Who asked has gone only if the process ends.
            let _ = ready.send(Err(format!("{error:?}")));
            return;
        }
    };
    let _ = ready.send(Ok(reader.guid().to_bytes()));
    block_on(async {
        let mut stream = std::pin::pin!(reader.as_async_stream());
        while let Some(next) = stream.next().await {
            match next {
                Ok(sample) => {
                    let number = i64::from(sample.sequence_number);
                    let writer = sample.writer_guid.to_bytes();
                    let at: Nanos = realo_clock::wall();
                    let payload = sample.into_value();
                    queue.put(Heard { topic, payload, at }, writer, number);
                }
                Err(error) => queue.refuse(topic, error.to_string()),
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_domain_is_in_range() {
        assert_eq!(domain(Some(7)), Ok(7));
        assert_eq!(domain(Some(MOST_DOMAIN)), Ok(MOST_DOMAIN));
        assert!(domain(Some(MOST_DOMAIN + 1)).unwrap_err().contains("found `233`"));
    }
}
