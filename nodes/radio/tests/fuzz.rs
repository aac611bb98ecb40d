//! What somebody sends an agent, sound, made up or damaged, is taken or refused, and every refusal counts; nothing that was not signed
//! is taken where signatures are asked for, and memory stays within what was sent.
//!
//! Seeds are the frames of `corpus`, `TOPIC.SEAL.CASE.EXPECTED.bin`, which a test writes anew:
//! `REALO_WRITE=1 cargo test --release -p realo-radio --test fuzz`.
//! `REALO_FUZZ_CASES=1000000 cargo test --release -p realo-radio --test fuzz` runs as many cases.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use bytes::Bytes;
use damage::{Draw, cases, most_held};
use ed25519_dalek::SigningKey;
use realo_radio::body;
use realo_radio::keys::{Own, Trusted};
use realo_radio::protocol::{Acknowledgement, Frame, Head, Offer, Settings};
use realo_radio::refusal::Refusal;
use realo_radio::seal::{SEAL_BYTES, Seal, WINDOW};
use realo_radio::station::{Moment, Station, Topic};
use realo_schemas::{Kind, Name, Nanos, Packet};

const MS: Nanos = 1_000_000;
const WALL: Nanos = 1_700_000_000_000_000_000;
/// Bytes of a message at most: 16 parts.
const LARGEST: usize = 16 << 10;
/// Session of the peer, of which a message has begun to come in.
const SESSION: u64 = 5;
/// Messages of the agent itself, which cross.
const OWN_SESSION: u64 = 7;
const POINTS: u64 = 3;
/// Order of the group of Ed25519, little endian.
const ORDER: [u8; 32] = [
    0xed, 0xd3, 0xf5, 0x5c, 0x1a, 0x63, 0x12, 0x58, 0xd6, 0x9c, 0xf7, 0xa2, 0xde, 0xf9, 0xde, 0x14, 0, 0, 0, 0, 0, 0,
    0, 0, 0, 0, 0, 0, 0, 0, 0, 0x10,
];

/// A frame of the corpus.
#[derive(Clone)]
struct Seed {
    /// `None`: a body, which is what a whole message has.
    topic: Option<Topic>,
    is_sealed: bool,
    case: String,
    expected: Option<Refusal>,
    bytes: Vec<u8>,
}

impl Seed {
    fn name(&self) -> String {
        let topic = self.topic.map_or("body", Topic::as_str);
        let seal = if self.is_sealed { "sealed" } else { "open" };
        let expected = self.expected.map_or("taken", Refusal::as_str);
        format!("{topic}.{seal}.{}.{expected}.bin", self.case)
    }

    fn of_name(name: &str, bytes: Vec<u8>) -> Option<Seed> {
        let words: Vec<&str> = name.split('.').collect();
        let [topic, seal, case, expected, "bin"] = words[..] else {
            return None;
        };
        let seed = Seed {
            topic: Topic::ALL.into_iter().find(|known| known.as_str() == topic),
            is_sealed: seal == "sealed",
            case: case.into(),
            expected: Refusal::ALL.into_iter().find(|known| known.as_str() == expected),
            bytes,
        };
        (seed.name() == name).then_some(seed)
    }
}

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/corpus")
}

fn corpus() -> Vec<Seed> {
    let files = std::fs::read_dir(folder()).expect("the corpus");
    let mut files: Vec<_> = files.map(|file| file.unwrap().path()).collect();
    files.sort();
    let seed = |path: PathBuf| {
        let name = path.file_name().unwrap().to_str().unwrap();
        let seed = Seed::of_name(name, std::fs::read(&path).unwrap());
        seed.unwrap_or_else(|| panic!("{name}: expected TOPIC.SEAL.CASE.EXPECTED.bin"))
    };
    files.into_iter().map(seed).collect()
}

/// Seal of an agent that cav1 and rsu1 trust if it is one of them.
fn seal(agent: &str) -> Seal {
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

fn moment(after: Nanos) -> Moment {
    Moment {
        steady: after,
        log: Some(after),
        wall: WALL + after,
        wall_error: Some(MS),
    }
}

fn offer(kind: Kind, seq: u64, bytes: usize) -> Offer {
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
fn sends(station: &mut Station, now: Moment) -> Vec<(Topic, Bytes)> {
    let outgoing = std::iter::from_fn(|| station.next(now)).map(|outgoing| (outgoing.topic, outgoing.bytes));
    let outgoing: Vec<_> = outgoing.take(10_000).collect();
    assert!(outgoing.len() < 10_000, "what goes out comes to an end");
    outgoing
}

/// cav1, which has begun to send points and to ask for the time, and has the first of three parts of rsu1's features.
fn cav1(is_sealed: bool) -> Station {
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

/// All frames of the corpus.
fn seeds() -> Vec<Seed> {
    let mut seeds = Vec::new();
    let mut add = |topic, case: &str, expected, bytes: Vec<u8>| {
        seeds.push(Seed {
            topic,
            is_sealed: false,
            case: case.into(),
            expected,
            bytes,
        });
    };
    let (odd, large, old) = (
        Some(Refusal::Malformed),
        Some(Refusal::Oversized),
        Some(Refusal::Replayed),
    );

    let mut rsu1 = station("rsu1", SESSION, false);
    rsu1.up(&"cav1".into(), moment(0));
    rsu1.offer(&offer(Kind::Features, 8, 1_500));
    rsu1.offer(&offer(Kind::Boxes, 1, 300));
    rsu1.offer(&offer(Kind::AgentState, 1, 200));
    let mut sent = sends(&mut rsu1, moment(0));
    sent.extend(sends(&mut rsu1, moment(600 * MS)));
    for (place, (topic, bytes)) in sent.into_iter().enumerate() {
        add(Some(topic), &format!("sent_{place}"), None, bytes.to_vec());
    }
    let word = |value: Nanos| value.to_le_bytes().to_vec();
    for (case, asked, answered) in [
        ("answer", 0, 123_456 * MS),
        ("answer_max", 0, Nanos::MAX),
        ("answer_min", 0, Nanos::MIN),
        ("answer_to_nothing", Nanos::MAX, 5),
    ] {
        add(
            Some(Topic::Clock),
            case,
            None,
            [asked, answered, SESSION as Nanos].map(word).concat(),
        );
    }
    for (case, line, error) in [
        ("synchronised", 40 * MS - WALL, MS / 10),
        ("synchronised_line_max", Nanos::MAX, MS),
        ("synchronised_line_min", Nanos::MIN, 0),
        ("synchronised_error_max", 0, Nanos::MAX),
        ("synchronised_error_negative", 0, Nanos::MIN),
    ] {
        let answer = [0, 123_456 * MS, SESSION as Nanos, line, error].map(word).concat();
        add(Some(Topic::Clock), case, None, answer);
    }
    for (case, asked, session) in [
        ("question_max", Nanos::MAX, SESSION as Nanos),
        ("question_min", Nanos::MIN, SESSION as Nanos),
        ("question_of_a_later_session", 0, Nanos::MAX),
        ("question_of_the_last_session", 0, -1),
    ] {
        add(Some(Topic::Clock), case, None, [asked, session].map(word).concat());
    }
    add(
        Some(Topic::Clock),
        "question_of_an_earlier_session",
        old,
        [0, SESSION as Nanos - 1].map(word).concat(),
    );
    for bytes in [0, 7, 15, 32, 4_000] {
        add(Some(Topic::Clock), &format!("bytes_{bytes}"), odd, vec![1; bytes]);
    }

    let most = (LARGEST / 1024) as u32;
    let head = part(1, 3);
    let boxes = Head {
        kind: Kind::Boxes,
        asks: false,
        ..part(0, 1)
    };
    for (case, expected, head, bytes) in [
        ("second_part", None, head, 1024),
        ("first_part_again", None, part(0, 3), 1024),
        (
            "session_max",
            None,
            Head {
                session: u64::MAX,
                ..head
            },
            10,
        ),
        (
            "session_before",
            old,
            Head {
                session: SESSION - 1,
                ..head
            },
            10,
        ),
        ("session_0", old, Head { session: 0, ..head }, 10),
        ("number_max", None, Head { seq: u64::MAX, ..head }, 10),
        ("number_0", None, Head { seq: 0, ..head }, 10),
        (
            "most_parts",
            None,
            Head {
                seq: 10,
                ..part(most - 1, most)
            },
            10,
        ),
        (
            "parts_above",
            large,
            Head {
                seq: 10,
                ..part(0, most + 1)
            },
            10,
        ),
        (
            "parts_max",
            large,
            Head {
                seq: 10,
                ..part(u32::MAX - 1, u32::MAX)
            },
            10,
        ),
        ("contradicts_count", odd, part(1, 4), 10),
        ("contradicts_count_far", odd, part(most - 1, most), 10),
        ("contradicts_as_whole", odd, part(0, 1), 10),
        ("contradicts_stamp", odd, Head { stamp: 31, ..head }, 10),
        ("no_bytes", odd, head, 0),
        ("part_too_large", large, head, LARGEST - 1023),
        ("message_too_large", large, Head { seq: 10, ..part(0, 1) }, LARGEST + 1),
        (
            "date_min",
            None,
            Head {
                seq: 10,
                sent: Nanos::MIN,
                stamp: Nanos::MIN,
                ..head
            },
            10,
        ),
        (
            "date_max",
            None,
            Head {
                seq: 10,
                sent: Nanos::MAX,
                stamp: Nanos::MAX,
                ..head
            },
            10,
        ),
    ] {
        add(
            Some(Topic::Bulk),
            case,
            expected,
            Frame::Part(head, vec![2; bytes].into()).to_bytes().to_vec(),
        );
    }
    let whole = Frame::Part(boxes, vec![2; 30].into()).to_bytes().to_vec();
    for (case, expected, head) in [
        ("empty", None, boxes),
        ("number_max", None, Head { seq: u64::MAX, ..boxes }),
        (
            "session_max",
            None,
            Head {
                session: u64::MAX,
                ..boxes
            },
        ),
        (
            "session_before",
            old,
            Head {
                session: SESSION - 1,
                ..boxes
            },
        ),
        (
            "date_max",
            None,
            Head {
                stamp: Nanos::MAX,
                ..boxes
            },
        ),
    ] {
        add(
            Some(Topic::Small),
            case,
            expected,
            Frame::Part(head, Bytes::new()).to_bytes().to_vec(),
        );
    }
    for (case, at, value) in [
        ("version_0", 0, 0),
        ("version_2", 0, 2),
        ("what_2", 1, 2),
        ("what_255", 1, 255),
        ("kind_4", 2, 4),
        ("flags_2", 3, 2),
        ("no_parts", 24, 0),
        ("index_max", 23, 255),
    ] {
        let mut bytes = whole.clone();
        bytes[at] = value;
        add(Some(Topic::Small), case, odd, bytes);
    }
    add(Some(Topic::Small), "cut", odd, whole[..43].to_vec());
    add(Some(Topic::Small), "nothing", odd, Vec::new());

    let ack = Acknowledgement {
        kind: Kind::Points,
        session: OWN_SESSION,
        seq: POINTS,
        index: 0,
        before: 0,
        sent: 0,
        received: 9,
    };
    for (case, ack) in [
        ("first_part", ack),
        (
            "all_parts",
            Acknowledgement {
                index: 2,
                before: 3,
                ..ack
            },
        ),
        (
            "before_first",
            Acknowledgement {
                before: u32::MAX,
                ..ack
            },
        ),
        (
            "behind_last",
            Acknowledgement {
                index: 32,
                before: u32::MAX,
                ..ack
            },
        ),
        (
            "index_max",
            Acknowledgement {
                index: u32::MAX,
                before: u32::MAX,
                ..ack
            },
        ),
        ("number_max", Acknowledgement { seq: u64::MAX, ..ack }),
        (
            "session_max",
            Acknowledgement {
                session: u64::MAX,
                ..ack
            },
        ),
        (
            "sent_min",
            Acknowledgement {
                sent: Nanos::MIN,
                ..ack
            },
        ),
        (
            "sent_max",
            Acknowledgement {
                sent: Nanos::MAX,
                ..ack
            },
        ),
        (
            "received_min",
            Acknowledgement {
                received: Nanos::MIN,
                ..ack
            },
        ),
        (
            "received_max",
            Acknowledgement {
                received: Nanos::MAX,
                ..ack
            },
        ),
    ] {
        add(
            Some(Topic::Ack),
            case,
            None,
            Frame::Acknowledgement(ack).to_bytes().to_vec(),
        );
    }
    let ack = Frame::Acknowledgement(ack).to_bytes().to_vec();
    add(Some(Topic::Ack), "longer", odd, [&ack[..], &[0]].concat());
    add(Some(Topic::Ack), "shorter", odd, ack[..43].to_vec());
    add(Some(Topic::Ack), "flags", odd, [&ack[..3], &[1], &ack[4..]].concat());

    let sheet = |session: u64, number: u64, lines: &str| {
        format!(r#"{{"session":{session},"number":{number},"lines":[{lines}]}}"#)
    };
    let lines = |count: u64| {
        let lines: Vec<String> = (0..count).map(|seq| format!(r#"["boxes",{seq},9,"sent"]"#)).collect();
        lines.join(",")
    };
    let huge = u64::MAX;
    for (case, expected, text) in [
        ("empty", None, sheet(SESSION, 0, "")),
        ("session_max", None, sheet(huge, huge, &lines(2))),
        ("session_before", None, sheet(SESSION - 1, 0, &lines(2))),
        (
            "bytes_max",
            None,
            sheet(
                SESSION,
                0,
                &format!(r#"["boxes",{huge},{huge},"lost"],["boxes",0,{huge},"lost"]"#),
            ),
        ),
        ("lines_above", None, sheet(SESSION, 0, &lines(1_025))),
        (
            "reported_twice",
            None,
            sheet(
                SESSION,
                0,
                r#"["boxes",1,9,"late"],["boxes",1,9,"sent"],["boxes",1,9,"late"]"#,
            ),
        ),
        (
            "session_above",
            odd,
            sheet(SESSION, 0, "").replace(":5,", ":18446744073709551616,"),
        ),
        ("negative", odd, sheet(SESSION, 0, r#"["boxes",-1,9,"sent"]"#)),
        ("fraction", odd, sheet(SESSION, 0, r#"["boxes",1e400,9,"sent"]"#)),
        ("kind_unknown", odd, sheet(SESSION, 0, r#"["nothing",1,9,"sent"]"#)),
        ("outcome_unknown", odd, sheet(SESSION, 0, r#"["boxes",1,9,"found"]"#)),
        ("line_short", odd, sheet(SESSION, 0, r#"["boxes",1,9]"#)),
        ("line_long", odd, sheet(SESSION, 0, r#"["boxes",1,9,"sent",1]"#)),
        (
            "field_unknown",
            odd,
            sheet(SESSION, 0, "").replace("}", r#","more":1}"#),
        ),
        (
            "field_twice",
            odd,
            sheet(SESSION, 0, "").replace("}", r#","number":1}"#),
        ),
        ("followed", odd, sheet(SESSION, 0, "") + "{}"),
        ("cut", odd, sheet(SESSION, 0, &lines(3)[..40])),
        ("nested_lists", odd, sheet(SESSION, 0, &"[".repeat(8_000))),
        ("nested_alone", odd, "[".repeat(16_000)),
        ("nested_objects", odd, r#"{"lines":"#.repeat(2_000)),
        ("nested_unknown", odd, format!(r#"{{"more":{}"#, "[".repeat(8_000))),
        (
            "long_text",
            odd,
            sheet(SESSION, 0, &format!(r#"["{}",1,9,"sent"]"#, "x".repeat(8_000))),
        ),
        (
            "long_number",
            odd,
            sheet(SESSION, 0, &format!(r#"["boxes",{},9,"sent"]"#, "9".repeat(8_000))),
        ),
        ("nothing", odd, String::new()),
    ] {
        add(Some(Topic::Books), case, expected, text.into_bytes());
    }
    add(
        Some(Topic::Books),
        "no_text",
        odd,
        sheet(SESSION, 0, "")
            .into_bytes()
            .into_iter()
            .map(|byte| byte | 0x80)
            .collect(),
    );

    let packet = |codec: &[&str]| Packet {
        codec: codec.iter().map(|name| name.to_string()).collect(),
        bytes: vec![3u8; 40].into(),
    };
    let body = |codec: &[&str], given| body::to_bytes(&packet(codec), given).unwrap().to_vec();
    add(None, "codecs", None, body(&["int8", "zstd"], 5));
    add(None, "no_codecs", None, body(&[], 5));
    add(None, "most_codecs", None, body(&[""; 255], 5));
    add(None, "long_codec", None, body(&[&"x".repeat(255)], 5));
    add(None, "date_max", None, body(&["zstd"], Nanos::MAX));
    add(None, "date_min", None, body(&["zstd"], Nanos::MIN));
    add(None, "date_alone", odd, vec![0; 8]);
    add(None, "nothing", odd, Vec::new());
    add(None, "codecs_missing", odd, [&word(5)[..], &[255]].concat());
    add(None, "codec_cut", odd, [&word(5)[..], &[1, 255, b'x']].concat());
    add(None, "codec_no_text", odd, [&word(5)[..], &[1, 2, 0xc3, 0x28]].concat());

    let open = seeds.clone();
    for seed in open.iter().filter(|seed| seed.bytes.len() < 2_000) {
        let Some(topic) = seed.topic else { continue };
        seeds.push(Seed {
            is_sealed: true,
            bytes: seal("rsu1").close("cav1", topic, &seed.bytes, WALL).to_vec(),
            ..seed.clone()
        });
    }
    let (forged, unsigned, future) = (Some(Refusal::Forged), Some(Refusal::Unsigned), Some(Refusal::Future));
    let close = |from: &str, to: &str, topic, date| seal(from).close(to, topic, &whole, date).to_vec();
    let sound = close("rsu1", "cav1", Topic::Small, WALL);
    let at = |place: usize, bytes: &[u8]| {
        let mut changed = sound.clone();
        changed[place..place + bytes.len()].copy_from_slice(bytes);
        changed
    };
    let signature = whole.len() + 8;
    let half = signature + 32;
    let mut carry = 0;
    let twice: Vec<u8> = (sound[half..half + 32].iter().zip(ORDER))
        .map(|(byte, order)| {
            carry += u16::from(*byte) + u16::from(order);
            let low = carry as u8;
            carry >>= 8;
            low
        })
        .collect();
    for (case, expected, bytes) in [
        ("date_oldest", None, close("rsu1", "cav1", Topic::Small, WALL - WINDOW)),
        (
            "date_before",
            old,
            close("rsu1", "cav1", Topic::Small, WALL - WINDOW - 1),
        ),
        ("date_latest", None, close("rsu1", "cav1", Topic::Small, WALL + WINDOW)),
        (
            "date_after",
            future,
            close("rsu1", "cav1", Topic::Small, WALL + WINDOW + 1),
        ),
        ("date_end", future, close("rsu1", "cav1", Topic::Small, Nanos::MAX)),
        ("date_begin", old, close("rsu1", "cav1", Topic::Small, Nanos::MIN)),
        ("other_topic", forged, close("rsu1", "cav1", Topic::Bulk, WALL)),
        ("other_receiver", forged, close("rsu1", "rsu1", Topic::Small, WALL)),
        ("other_sender", forged, close("cav1", "cav1", Topic::Small, WALL)),
        ("other_key", forged, close("mallory", "cav1", Topic::Small, WALL)),
        ("other_date", forged, at(whole.len(), &[1])),
        ("other_frame", forged, at(4, &[0xff])),
        ("signature_0", forged, at(signature, &[0; 64])),
        ("signature_again", forged, at(half, &twice)),
        ("algorithm_2", unsigned, at(sound.len() - 1, &[2])),
        ("not_signed", unsigned, whole.clone()),
        ("seal_cut", unsigned, sound[..SEAL_BYTES - 1].to_vec()),
        (
            "seal_alone",
            odd,
            seal("rsu1").close("cav1", Topic::Small, &[], WALL).to_vec(),
        ),
    ] {
        seeds.retain(|seed| !(seed.is_sealed && seed.topic == Some(Topic::Small) && seed.case == case));
        seeds.push(Seed {
            topic: Some(Topic::Small),
            is_sealed: true,
            case: case.into(),
            expected,
            bytes,
        });
    }
    seeds
}

/// Why an agent refuses it; `None`: it is taken.
fn refusal(station: &mut Station, topic: Topic, bytes: &Bytes, now: Moment) -> Option<Refusal> {
    let before = station.refused().clone();
    station.take(&"rsu1".into(), topic, bytes, now);
    let more = station.refused().iter().filter_map(|(refusal, count)| {
        let more = count - before.get(refusal).unwrap_or(&0);
        (more > 0).then_some((*refusal, more))
    });
    match more.collect::<Vec<_>>()[..] {
        [] => None,
        [(refusal, 1)] => Some(refusal),
        ref several => panic!("refused more than once: {several:?}"),
    }
}

/// `REALO_WRITE=1` writes the corpus anew.
#[test]
fn the_corpus_is_what_is_made_here() {
    let made: BTreeMap<String, Vec<u8>> = seeds().into_iter().map(|seed| (seed.name(), seed.bytes)).collect();
    assert_eq!(made.len(), seeds().len(), "two have one name");
    if std::env::var_os("REALO_WRITE").is_some() {
        let _ = std::fs::remove_dir_all(folder());
        std::fs::create_dir_all(folder()).unwrap();
        for (name, bytes) in &made {
            std::fs::write(folder().join(name), bytes).unwrap();
        }
    }
    let kept: BTreeMap<String, Vec<u8>> = corpus().into_iter().map(|seed| (seed.name(), seed.bytes)).collect();
    let differs: Vec<&String> = made
        .keys()
        .chain(kept.keys())
        .filter(|name| made.get(*name) != kept.get(*name))
        .collect();
    assert!(differs.is_empty(), "made and kept differ: {differs:?}");
}

#[test]
fn the_corpus_gives_what_its_names_say() {
    let corpus = corpus();
    for seed in &corpus {
        let bytes = Bytes::from(seed.bytes.clone());
        let found = match seed.topic {
            Some(topic) => refusal(&mut cav1(seed.is_sealed), topic, &bytes, moment(0)),
            None => body::of_bytes(&bytes).is_none().then_some(Refusal::Malformed),
        };
        assert_eq!(found, seed.expected, "{}", seed.name());
    }
    let all: BTreeSet<_> = corpus.iter().map(|seed| (seed.topic, seed.is_sealed)).collect();
    assert_eq!(
        all.len(),
        2 * Topic::ALL.len() + 1,
        "every topic, sealed and not, and bodies"
    );
}

#[test]
fn any_two_of_the_corpus_are_taken_or_refused() {
    let corpus = corpus();
    let open = || corpus.iter().filter(|seed| !seed.is_sealed);
    for (first, second) in open().flat_map(|first| open().map(move |second| (first, second))) {
        let mut station = cav1(false);
        for (seed, now) in [(first, 10 * MS), (second, 20 * MS)] {
            if let Some(topic) = seed.topic {
                refusal(&mut station, topic, &seed.bytes.clone().into(), moment(now));
            }
            sends(&mut station, moment(now));
        }
    }
}

/// Frames to an agent one after the other, of which some are of the corpus, damaged, spliced, or signed by who may sign.
struct Attack<'a> {
    corpus: &'a [Seed],
    draw: Draw,
    is_sealed: bool,
    /// What was signed for cav1.
    signed: BTreeSet<(Topic, Vec<u8>)>,
    refused: BTreeMap<Refusal, u64>,
    taken: u64,
}

impl Attack<'_> {
    fn frame(&mut self, now: Moment) -> (Topic, Bytes) {
        let draw = &mut self.draw;
        let seed = &self.corpus[draw.below(self.corpus.len())];
        let usual = seed.topic.unwrap_or(Topic::Bulk);
        let topic = if draw.chance(8) { draw.pick(&Topic::ALL) } else { usual };
        let mut bytes = seed.bytes.clone();
        match draw.below(8) {
            0 => {
                let other = &self.corpus[draw.below(self.corpus.len())].bytes;
                let (at, from) = (draw.below(bytes.len()), draw.below(other.len()));
                bytes.truncate(at);
                bytes.extend(&other[from..]);
            }
            // A number of the head, which places and dates are.
            1..=3 if bytes.len() >= 44 => {
                let (at, width) = draw.pick(&[(4, 8), (12, 8), (20, 4), (24, 4), (28, 8), (36, 8)]);
                let mut old = [0; 8];
                old[..width].copy_from_slice(&bytes[at..at + width]);
                let new = draw.length(u64::from_le_bytes(old)).to_le_bytes();
                bytes[at..at + width].copy_from_slice(&new[..width]);
            }
            4 => {}
            _ => draw.damage(&mut bytes),
        }
        // Who is trusted may be hostile too.
        if self.is_sealed && draw.chance(2) {
            let date = now.wall + draw.pick(&[0, 0, 0, WINDOW + 1, -WINDOW - 1]);
            bytes = seal("rsu1").close("cav1", topic, &bytes, date).to_vec();
            self.signed.insert((topic, bytes.clone()));
        }
        (topic, bytes.into())
    }

    fn run(&mut self, station: &mut Station) -> usize {
        let (mut now, mut sent) = (0, 0);
        for number in 0..=self.draw.below(24) as u64 {
            let (topic, bytes) = self.frame(moment(now));
            sent += bytes.len();
            match refusal(station, topic, &bytes, moment(now)) {
                Some(refusal) => *self.refused.entry(refusal).or_default() += 1,
                None => {
                    self.taken += 1;
                    let signed = !self.is_sealed || self.signed.contains(&(topic, bytes.to_vec()));
                    assert!(signed, "taken on {topic:?} though nobody signed it: {bytes:?}");
                }
            }
            let _ = body::of_bytes(&bytes);
            if self.draw.chance(3) {
                now += self.draw.pick(&[0, MS, 50 * MS, 600 * MS, 3_000 * MS]);
                let fresh = Offer {
                    born: now,
                    ..offer(Kind::Points, POINTS + number, 3_000)
                };
                station.offer(&fresh);
            }
            sends(station, moment(now));
            let _ = (station.wakes_at(), station.clock_of("rsu1", moment(now)));
        }
        station.take_events(moment(now));
        assert_eq!(*station.refused(), self.refused, "refusals add up");
        let reported: u64 = (station.reports(moment(now)).iter())
            .flat_map(|report| report.refused.values())
            .sum();
        assert_eq!(reported, self.refused.values().sum::<u64>());
        station.end();
        sent
    }
}

/// Lists of parts, a few windows of what the agent itself sends, and of a sheet's line of 20 bytes a fate with two names, which
/// is held three times while lists grow.
fn bound(bytes: usize) -> u64 {
    (256 << 10) + 24 * bytes as u64
}

#[test]
fn forged_frames_are_taken_or_refused() {
    let corpus = corpus();
    let (mut taken, mut refused) = (0, 0);
    for case in 0..cases(4_000) {
        let is_sealed = case % 2 == 1;
        let fits = |seed: &Seed| seed.is_sealed == is_sealed || seed.topic.is_none() || case % 8 < 2;
        let corpus: Vec<Seed> = corpus.iter().filter(|seed| fits(seed)).cloned().collect();
        let signed = corpus.iter().filter(|seed| {
            let nobody = [Refusal::Forged, Refusal::Unsigned];
            seed.is_sealed && !seed.expected.is_some_and(|refusal| nobody.contains(&refusal))
        });
        let mut signed: BTreeSet<_> = signed
            .filter_map(|seed| Some((seed.topic?, seed.bytes.clone())))
            .collect();
        // It comes on the topic for which it was signed here and there.
        let other = corpus.iter().filter(|seed| seed.case == "other_topic");
        signed.extend(other.map(|seed| (Topic::Bulk, seed.bytes.clone())));
        let mut attack = Attack {
            corpus: &corpus,
            draw: Draw::new(case),
            is_sealed,
            signed,
            refused: BTreeMap::new(),
            taken: 0,
        };
        let mut station = cav1(is_sealed);
        let mut sent = 0;
        let held = most_held(|| sent = attack.run(&mut station));
        assert!(held <= bound(sent), "case {case} of {sent} bytes took {held} bytes");
        taken += attack.taken;
        refused += attack.refused.values().sum::<u64>();
    }
    assert!(
        taken > refused / 20 && refused > taken / 20,
        "{taken} taken, {refused} refused"
    );
}
