//! Bodies of whole messages.

use realo_radio::body;
use realo_schemas::{Nanos, Packet};

use super::{MALFORMED, Seed, words};

pub(super) fn seeds() -> Vec<Seed> {
    let taken = [
        ("codecs", body(&["int8", "zstd"], 5)),
        ("no_codecs", body(&[], 5)),
        ("most_codecs", body(&[""; 255], 5)),
        ("long_codec", body(&[&"x".repeat(255)], 5)),
        ("date_max", body(&["zstd"], Nanos::MAX)),
        ("date_min", body(&["zstd"], Nanos::MIN)),
    ];
    let date = words([5]);
    let odd = [
        ("date_alone", vec![0; 8]),
        ("nothing", Vec::new()),
        ("codecs_missing", [&date[..], &[255]].concat()),
        ("codec_cut", [&date[..], &[1, 255, b'x']].concat()),
        ("codec_no_text", [&date[..], &[1, 2, 0xc3, 0x28]].concat()),
    ];
    let taken = taken.map(|(case, bytes)| Seed::open(None, case, None, bytes));
    let odd = odd.map(|(case, bytes)| Seed::open(None, case, MALFORMED, bytes));
    taken.into_iter().chain(odd).collect()
}

fn body(codec: &[&str], given: Nanos) -> Vec<u8> {
    let packet = Packet {
        codec: codec.iter().map(|name| name.to_string()).collect(),
        bytes: vec![3u8; 40].into(),
    };
    body::to_bytes(&packet, given).unwrap().to_vec()
}
