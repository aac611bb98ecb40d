//! Signed frames: the open ones, each with a sound seal, and boxes whose seal is odd.

use realo_radio::refusal::Refusal;
use realo_radio::seal::{SEAL_BYTES, WINDOW};
use realo_radio::station::Topic;
use realo_schemas::Nanos;

use super::{MALFORMED, REPLAYED, Seed, WALL, seal, whole};

const FORGED: Option<Refusal> = Some(Refusal::Forged);
const UNSIGNED: Option<Refusal> = Some(Refusal::Unsigned);
const FUTURE: Option<Refusal> = Some(Refusal::Future);
/// Order of the group of Ed25519, little endian.
const ORDER: [u8; 32] = [
    0xed, 0xd3, 0xf5, 0x5c, 0x1a, 0x63, 0x12, 0x58, 0xd6, 0x9c, 0xf7, 0xa2, 0xde, 0xf9, 0xde, 0x14, 0, 0, 0, 0, 0, 0,
    0, 0, 0, 0, 0, 0, 0, 0, 0, 0x10,
];

type Case = (&'static str, Option<Refusal>, Vec<u8>);

pub(super) fn seeds(open: &[Seed]) -> Vec<Seed> {
    let odd: Vec<Case> = [dates(), of_others(), changed(), cut()].concat();
    let small = |case: &str, expected, bytes| Seed {
        is_sealed: true,
        ..Seed::open(Topic::Small, case, expected, bytes)
    };
    let is_odd = |seed: &Seed| seed.topic == Some(Topic::Small) && odd.iter().any(|(case, ..)| *case == seed.case);
    let sound = open.iter().filter(|seed| seed.bytes.len() < 2_000 && !is_odd(seed));
    let mut seeds: Vec<Seed> = sound.filter_map(sealed).collect();
    seeds.extend(
        odd.into_iter()
            .map(|(case, expected, bytes)| small(case, expected, bytes)),
    );
    seeds
}

/// The same frame with a seal; bodies have none.
fn sealed(seed: &Seed) -> Option<Seed> {
    let bytes = seal("rsu1").close("cav1", seed.topic?, &seed.bytes, WALL);
    Some(Seed {
        is_sealed: true,
        bytes: bytes.to_vec(),
        ..seed.clone()
    })
}

fn close(from: &str, to: &str, topic: Topic, date: Nanos) -> Vec<u8> {
    seal(from).close(to, topic, &whole(), date).to_vec()
}

fn sound() -> Vec<u8> {
    close("rsu1", "cav1", Topic::Small, WALL)
}

fn dates() -> Vec<Case> {
    let dated = |date| close("rsu1", "cav1", Topic::Small, date);
    vec![
        ("date_oldest", None, dated(WALL - WINDOW)),
        ("date_before", REPLAYED, dated(WALL - WINDOW - 1)),
        ("date_latest", None, dated(WALL + WINDOW)),
        ("date_after", FUTURE, dated(WALL + WINDOW + 1)),
        ("date_end", FUTURE, dated(Nanos::MAX)),
        ("date_begin", REPLAYED, dated(Nanos::MIN)),
    ]
}

/// Seals of something else.
fn of_others() -> Vec<Case> {
    vec![
        ("other_topic", FORGED, close("rsu1", "cav1", Topic::Bulk, WALL)),
        ("other_receiver", FORGED, close("rsu1", "rsu1", Topic::Small, WALL)),
        ("other_sender", FORGED, close("cav1", "cav1", Topic::Small, WALL)),
        ("other_key", FORGED, close("mallory", "cav1", Topic::Small, WALL)),
    ]
}

/// Bytes that were changed after they were signed.
fn changed() -> Vec<Case> {
    let sound = sound();
    let at = |place: usize, bytes: &[u8]| {
        let mut changed = sound.clone();
        changed[place..place + bytes.len()].copy_from_slice(bytes);
        changed
    };
    let date = whole().len();
    let signature = date + 8;
    let half = signature + 32;
    vec![
        ("other_date", FORGED, at(date, &[1])),
        ("other_frame", FORGED, at(4, &[0xff])),
        ("signature_0", FORGED, at(signature, &[0; 64])),
        (
            "signature_again",
            FORGED,
            at(half, &plus_order(&sound[half..half + 32])),
        ),
        ("algorithm_2", UNSIGNED, at(sound.len() - 1, &[2])),
    ]
}

/// Another number for which the equation of a signature holds too.
fn plus_order(scalar: &[u8]) -> Vec<u8> {
    let mut carry = 0;
    let add = |(byte, order): (&u8, u8)| {
        carry += u16::from(*byte) + u16::from(order);
        let low = carry as u8;
        carry >>= 8;
        low
    };
    scalar.iter().zip(ORDER).map(add).collect()
}

fn cut() -> Vec<Case> {
    let alone = seal("rsu1").close("cav1", Topic::Small, &[], WALL);
    vec![
        ("not_signed", UNSIGNED, whole()),
        ("seal_cut", UNSIGNED, sound()[..SEAL_BYTES - 1].to_vec()),
        ("seal_alone", MALFORMED, alone.to_vec()),
    ]
}
