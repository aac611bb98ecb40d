//! Frames that an agent, cav1, may get from rsu1: sound ones, odd ones and forged ones, each with what becomes of it.

mod acknowledgements;
mod bodies;
mod books;
mod clock;
mod parts;
mod sealed;
mod sent;

use bytes::Bytes;
use ed25519_dalek::SigningKey;
use realo_radio::keys::{Own, Trusted};
use realo_radio::protocol::{Frame, Head, Offer, Settings};
use realo_radio::refusal::Refusal;
use realo_radio::seal::Seal;
use realo_radio::station::{Moment, Station, Topic};
use realo_schemas::{Kind, Name, Nanos};

pub const MS: Nanos = 1_000_000;
pub const WALL: Nanos = 1_700_000_000_000_000_000;
/// Bytes of a message at most: 16 parts.
pub const LARGEST: usize = 16 << 10;
/// Session of the peer, of which a message has begun to come in.
pub const SESSION: u64 = 5;
/// Messages of the agent itself, which cross.
const OWN_SESSION: u64 = 7;
pub const POINTS: u64 = 3;

const MALFORMED: Option<Refusal> = Some(Refusal::Malformed);
const OVERSIZED: Option<Refusal> = Some(Refusal::Oversized);
const REPLAYED: Option<Refusal> = Some(Refusal::Replayed);

/// A frame of the corpus.
#[derive(Clone)]
pub struct Seed {
    /// `None`: a body, which is what a whole message has.
    pub topic: Option<Topic>,
    pub is_sealed: bool,
    pub case: String,
    /// `None`: it is taken.
    pub expected: Option<Refusal>,
    pub bytes: Vec<u8>,
}

impl Seed {
    fn open(topic: impl Into<Option<Topic>>, case: &str, expected: Option<Refusal>, bytes: Vec<u8>) -> Seed {
        Seed {
            topic: topic.into(),
            is_sealed: false,
            case: case.into(),
            expected,
            bytes,
        }
    }

    /// Topic and seal.
    pub fn group(&self) -> String {
        let topic = self.topic.map_or("body", Topic::as_str);
        let seal = if self.is_sealed { "sealed" } else { "open" };
        format!("{topic}.{seal}")
    }

    pub fn name(&self) -> String {
        format!("{}.{}", self.group(), self.case)
    }
}

/// All frames, ordered by name.
pub fn corpus() -> Vec<Seed> {
    let open = [
        sent::seeds(),
        clock::seeds(),
        parts::seeds(),
        acknowledgements::seeds(),
        books::seeds(),
        bodies::seeds(),
    ];
    let mut seeds = open.concat();
    seeds.extend(sealed::seeds(&seeds));
    seeds.sort_by_key(Seed::name);
    seeds
}

/// Seal of an agent that cav1 and rsu1 trust if it is one of them.
pub fn seal(agent: &str) -> Seal {
    let own = |name: &str| Own {
        agent: name.into(),
        key: SigningKey::from_bytes(&[name.len() as u8 + name.as_bytes()[0]; 32]),
    };
    let mut trusted = Trusted::default();
    trusted
        .0
        .extend(["cav1", "rsu1"].map(|name| own(name).public().0).into_iter().flatten());
    Seal::new("site", own(agent), trusted)
}

pub fn moment(after: Nanos) -> Moment {
    Moment {
        steady: after,
        log: Some(after),
        wall: WALL + after,
        wall_error: Some(MS),
    }
}

pub fn offer(kind: Kind, seq: u64, bytes: usize) -> Offer {
    Offer {
        kind,
        seq,
        stamp: 0,
        born: 0,
        bytes: vec![7; bytes].into(),
    }
}

fn station(name: &str, session: u64, is_sealed: bool) -> Station {
    let settings = Settings {
        part: 1024,
        ..Settings::default()
    };
    Station::new(name.into(), settings, LARGEST, session, is_sealed.then(|| seal(name)))
}

/// What an agent sends now.
pub fn sends(station: &mut Station, now: Moment) -> Vec<(Topic, Bytes)> {
    let outgoing = std::iter::from_fn(|| station.next(now)).map(|outgoing| (outgoing.topic, outgoing.bytes));
    let outgoing: Vec<_> = outgoing.take(10_000).collect();
    assert!(outgoing.len() < 10_000, "what goes out comes to an end");
    outgoing
}

/// cav1, which has begun to send points and to ask for the time, and has the first of three parts of rsu1's features.
pub fn cav1(is_sealed: bool) -> Station {
    let mut station = station("cav1", OWN_SESSION, is_sealed);
    let rsu1 = Name::from("rsu1");
    station.up(&rsu1, moment(0));
    station.offer(&offer(Kind::Points, POINTS, 3_000));
    sends(&mut station, moment(0));
    let first = Frame::Part(part(0, 3), vec![1; 1024].into()).to_bytes();
    let first = if is_sealed {
        seal("rsu1").close("cav1", Topic::Bulk, &first, WALL)
    } else {
        first
    };
    station.take(&rsu1, Topic::Bulk, &first, moment(0));
    station.take_events(moment(0));
    assert!(station.refused().is_empty());
    station
}

/// Of rsu1's features of which cav1 has the first part.
fn part(index: u32, count: u32) -> Head {
    Head {
        kind: Kind::Features,
        asks: true,
        waits: false,
        session: SESSION,
        seq: 9,
        index,
        count,
        sent: 40,
        stamp: 30,
    }
}

/// Boxes of rsu1 in one frame.
fn boxes() -> Head {
    Head {
        kind: Kind::Boxes,
        asks: false,
        ..part(0, 1)
    }
}

/// The frame of such boxes.
fn whole() -> Vec<u8> {
    Frame::Part(boxes(), vec![2; 30].into()).to_bytes().to_vec()
}

fn words<const N: usize>(values: [Nanos; N]) -> Vec<u8> {
    values.map(Nanos::to_le_bytes).concat()
}
