//! Parts of messages, large and small.

use bytes::Bytes;
use realo_radio::protocol::{Frame, Head};
use realo_radio::refusal::Refusal;
use realo_radio::station::Topic;
use realo_schemas::Nanos;

use super::{LARGEST, MALFORMED, OVERSIZED, REPLAYED, SESSION, Seed, boxes, part, whole};

/// Parts of the largest message.
const MOST: u32 = (LARGEST / 1024) as u32;

/// What a part is called, what becomes of it, its head and its bytes.
type Part = (&'static str, Option<Refusal>, Head, usize);

pub(super) fn seeds() -> Vec<Seed> {
    let bulk = [sound(), too_large(), contradicting()].concat();
    let bulk = bulk.into_iter().map(|(case, expected, head, bytes)| {
        let frame = Frame::Part(head, vec![2; bytes].into()).to_bytes();
        Seed::open(Topic::Bulk, case, expected, frame.to_vec())
    });
    bulk.chain(small()).chain(damaged()).collect()
}

fn sound() -> Vec<Part> {
    let head = part(1, 3);
    let next = Head { seq: 10, ..head };
    let dated = |date| Head {
        sent: date,
        stamp: date,
        ..next
    };
    let session = |session| Head { session, ..head };
    vec![
        ("second_part", None, head, 1024),
        ("first_part_again", None, part(0, 3), 1024),
        ("session_max", None, session(u64::MAX), 10),
        ("session_before", REPLAYED, session(SESSION - 1), 10),
        ("session_0", REPLAYED, session(0), 10),
        ("number_max", None, Head { seq: u64::MAX, ..head }, 10),
        ("number_0", None, Head { seq: 0, ..head }, 10),
        ("date_min", None, dated(Nanos::MIN), 10),
        ("date_max", None, dated(Nanos::MAX), 10),
    ]
}

fn too_large() -> Vec<Part> {
    let next = |index, count| Head {
        seq: 10,
        ..part(index, count)
    };
    vec![
        ("most_parts", None, next(MOST - 1, MOST), 10),
        ("parts_above", OVERSIZED, next(0, MOST + 1), 10),
        ("parts_max", OVERSIZED, next(u32::MAX - 1, u32::MAX), 10),
        ("part_too_large", OVERSIZED, part(1, 3), LARGEST - 1023),
        ("message_too_large", OVERSIZED, next(0, 1), LARGEST + 1),
    ]
}

fn contradicting() -> Vec<Part> {
    let stamp = Head {
        stamp: 31,
        ..part(1, 3)
    };
    vec![
        ("contradicts_count", MALFORMED, part(1, 4), 10),
        ("contradicts_count_far", MALFORMED, part(MOST - 1, MOST), 10),
        ("contradicts_as_whole", MALFORMED, part(0, 1), 10),
        ("contradicts_stamp", MALFORMED, stamp, 10),
        ("no_bytes", MALFORMED, part(1, 3), 0),
    ]
}

/// Messages of one frame, empty.
fn small() -> Vec<Seed> {
    let boxes = boxes();
    let session = |session| Head { session, ..boxes };
    let date = Head {
        stamp: Nanos::MAX,
        ..boxes
    };
    let heads = [
        ("empty", None, boxes),
        ("number_max", None, Head { seq: u64::MAX, ..boxes }),
        ("session_max", None, session(u64::MAX)),
        ("session_before", REPLAYED, session(SESSION - 1)),
        ("date_max", None, date),
    ];
    let seed = |(case, expected, head)| {
        let frame = Frame::Part(head, Bytes::new()).to_bytes();
        Seed::open(Topic::Small, case, expected, frame.to_vec())
    };
    heads.map(seed).into()
}

/// A sound frame of which a byte is another, or bytes are missing.
fn damaged() -> Vec<Seed> {
    let whole = whole();
    let bytes = [
        ("version_0", 0, 0),
        ("version_2", 0, 2),
        ("what_2", 1, 2),
        ("what_255", 1, 255),
        ("kind_4", 2, 4),
        ("flags_2", 3, 2),
        ("no_parts", 24, 0),
        ("index_max", 23, 255),
    ];
    let mut seeds: Vec<Seed> = Vec::new();
    for (case, at, value) in bytes {
        let mut bytes = whole.clone();
        bytes[at] = value;
        seeds.push(Seed::open(Topic::Small, case, MALFORMED, bytes));
    }
    seeds.push(Seed::open(Topic::Small, "cut", MALFORMED, whole[..43].to_vec()));
    seeds.push(Seed::open(Topic::Small, "nothing", MALFORMED, Vec::new()));
    seeds
}
