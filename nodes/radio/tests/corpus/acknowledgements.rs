//! Acknowledgements of cav1's points.

use realo_radio::protocol::{Acknowledgement, Frame};
use realo_radio::station::Topic;
use realo_schemas::{Kind, Nanos};

use super::{MALFORMED, OWN_SESSION, POINTS, Seed};

pub(super) fn seeds() -> Vec<Seed> {
    let taken = [of_parts(), of_others(), dated()].concat();
    let seed = |(case, ack)| Seed::open(Topic::Ack, case, None, bytes(ack));
    let mut seeds: Vec<Seed> = taken.into_iter().map(seed).collect();
    let ack = bytes(first());
    let odd = [
        ("longer", [&ack[..], &[0]].concat()),
        ("shorter", ack[..43].to_vec()),
        ("flags", [&ack[..3], &[1], &ack[4..]].concat()),
    ];
    seeds.extend(odd.map(|(case, bytes)| Seed::open(Topic::Ack, case, MALFORMED, bytes)));
    seeds
}

fn bytes(ack: Acknowledgement) -> Vec<u8> {
    Frame::Acknowledgement(ack).to_bytes().to_vec()
}

/// Of the first part of a message that is under way.
fn first() -> Acknowledgement {
    Acknowledgement {
        kind: Kind::Points,
        session: OWN_SESSION,
        seq: POINTS,
        index: 0,
        before: 0,
        sent: 0,
        received: 9,
    }
}

fn of_parts() -> Vec<(&'static str, Acknowledgement)> {
    let ack = |index, before| Acknowledgement {
        index,
        before,
        ..first()
    };
    vec![
        ("first_part", ack(0, 0)),
        ("all_parts", ack(2, 3)),
        ("before_first", ack(0, u32::MAX)),
        ("behind_last", ack(32, u32::MAX)),
        ("index_max", ack(u32::MAX, u32::MAX)),
    ]
}

fn of_others() -> Vec<(&'static str, Acknowledgement)> {
    let number = Acknowledgement {
        seq: u64::MAX,
        ..first()
    };
    let session = Acknowledgement {
        session: u64::MAX,
        ..first()
    };
    vec![("number_max", number), ("session_max", session)]
}

fn dated() -> Vec<(&'static str, Acknowledgement)> {
    let sent = |sent| Acknowledgement { sent, ..first() };
    let received = |received| Acknowledgement { received, ..first() };
    vec![
        ("sent_min", sent(Nanos::MIN)),
        ("sent_max", sent(Nanos::MAX)),
        ("received_min", received(Nanos::MIN)),
        ("received_max", received(Nanos::MAX)),
    ]
}
