use realo_operator::PortId;
use realo_schemas::report::to_report;
use realo_schemas::{DType, FeatureMap, Kind, Nanos, Pose};

use super::*;

const MS: Nanos = 1_000_000;
const NAMES: [&str; 2] = ["cav2", "rsu1"];

fn header(agent: &str, kind: Kind, seq: u64) -> Header {
    let at = 100 * seq as Nanos * MS;
    Header {
        pose: Some(Pose::exact(nalgebra::Isometry3::identity())),
        ..Header::origin(&"run".into(), &agent.into(), kind, seq, at, at)
    }
}

/// A map of 40 by 40 cells, whose confidence falls from cell to cell and whose numbers do not compress.
fn map(agent: &str, seq: u64) -> Message {
    let cells = 1600;
    let numbers = (0..cells * 16).scan(seq as u32 + 1, |state, _| {
        *state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        Some((*state >> 8) as f32 / 1e7)
    });
    let map = FeatureMap {
        rows: 40,
        columns: 40,
        channels: 16,
        cell: 0.8,
        origin: [-16.0, -16.0],
        dtype: DType::F32,
        data: numbers.flat_map(f32::to_le_bytes).collect::<Vec<u8>>().into(),
        model: "m".into(),
        confidence: Some(
            (0..cells)
                .map(|cell| 1.0 / (cell + 2) as f32)
                .collect::<Vec<f32>>()
                .into(),
        ),
    };
    Message::new(header(agent, Kind::Features, seq), map)
}

fn boxes(agent: &str, seq: u64, count: usize) -> Message {
    let object = Box3 {
        center: [3.0, -4.0, 0.0],
        length: 4.5,
        width: 1.9,
        height: 1.6,
        yaw: 0.3,
        velocity: None,
        class: "vehicle".into(),
        score: 0.9,
        track: None,
        covariance: None,
    };
    Message::new(header(agent, Kind::Boxes, seq), Boxes(vec![object; count]))
}

fn word(agent: &str, seq: u64, word: OnAir) -> Message {
    Message::new(header(agent, Kind::Report, seq), to_report(ON_AIR, &word))
}

struct Watched {
    stage: TransmissionEncoder,
    counts: realo_operator::Counts,
}

impl Watched {
    fn new(settings: Settings) -> Self {
        Watched {
            stage: TransmissionEncoder::new(settings).unwrap(),
            counts: realo_operator::Counts::default(),
        }
    }

    /// Kinds, numbers and bytes of the packets that a message makes go out.
    fn take(&mut self, port: PortId, message: Message) -> Vec<(Kind, u64, usize)> {
        let mut out = Outputs::at(message.header.ready);
        self.stage.on_message(port, message, &mut out).unwrap();
        let made = out.into_made();
        self.counts.extend(made.counts);
        let packets = made.sent.into_iter().map(|(_, message)| match message.payload {
            Payload::Packet(packet) => (message.header.kind, message.header.seq, packet.bytes.len()),
            other => panic!("{other:?}"),
        });
        packets.collect()
    }

    fn counted(&self, counter: &'static Counter) -> u64 {
        self.counts.get(counter.name)
    }
}

fn hybrid() -> Settings {
    Settings {
        budget_bytes: Some(6_000),
        detected: true,
        ..Settings::default()
    }
}

#[test]
fn boxes_cross_before_the_map_of_their_sweep_and_on_its_budget_in_whatever_order_they_come() {
    let mut stage = Watched::new(hybrid());
    for (seq, boxes_first) in [(0, true), (1, false), (2, true)] {
        for agent in NAMES {
            let both = [
                (Input::DETECTED, boxes(agent, seq, 40)),
                (Input::MESSAGES, map(agent, seq)),
            ];
            let mut both = Vec::from(both);
            if !boxes_first {
                both.reverse();
            }
            let sent: Vec<_> = both
                .into_iter()
                .flat_map(|(port, message)| stage.take(port, message))
                .collect();
            let [(Kind::Boxes, first, of_boxes), (Kind::Features, second, of_map)] = sent[..] else {
                panic!("{sent:?}");
            };
            assert_eq!([first, second], [seq, seq]);
            assert!(
                (5_000..=6_000).contains(&(of_boxes + of_map)),
                "{of_boxes} and {of_map}"
            );
        }
    }
}

#[test]
fn boxes_cross_even_if_they_leave_no_room_for_a_map_or_there_is_none() {
    let mut stage = Watched::new(hybrid());
    assert_eq!(stage.take(Input::MESSAGES, map("cav2", 0)), []);
    let sent = stage.take(Input::DETECTED, boxes("cav2", 0, 400));
    assert!(matches!(sent[..], [(Kind::Boxes, 0, 6_000..)]), "{sent:?}");
    assert_eq!(stage.counted(&UNSENT_MAPS), 1);
    // A map whose boxes never come gives way to the next.
    assert_eq!(stage.take(Input::MESSAGES, map("cav2", 1)), []);
    assert_eq!(stage.take(Input::MESSAGES, map("cav2", 2)), []);
    assert_eq!(stage.take(Input::DETECTED, boxes("cav2", 2, 1)).len(), 2);
    assert_eq!(stage.counted(&UNPAIRED_MAPS), 1);
    assert_eq!(stage.take(Input::DETECTED, boxes("cav2", 3, 1)).len(), 1);
}

#[test]
fn bytes_follow_what_the_link_says_from_low_to_the_max_and_are_counted() {
    let settings = Settings {
        budget_bytes: Some(20_000),
        follow: true,
        ..Settings::default()
    };
    let mut stage = Watched::new(settings);
    let [(.., first)] = stage.take(Input::MESSAGES, map("cav2", 0))[..] else {
        panic!("a map")
    };
    assert!(first <= 2_000, "{first}");
    let at_once = OnAir {
        bytes: first as u64,
        ..OnAir::default()
    };
    assert_eq!(stage.take(Input::ON_AIR, word("cav2", 0, at_once)), []);
    let [(.., second)] = stage.take(Input::MESSAGES, map("cav2", 1))[..] else {
        panic!("a map")
    };
    assert!((17_000..=20_000).contains(&second), "{second}");
    let [(.., other)] = stage.take(Input::MESSAGES, map("rsu1", 1))[..] else {
        panic!("a map")
    };
    assert!(other <= 2_000, "another sender has heard nothing: {other}");
    let dropped = OnAir {
        dropped: true,
        ..OnAir::default()
    };
    stage.take(Input::ON_AIR, word("cav2", 1, dropped));
    let counts = [&BUDGETS, &BUDGET_BYTES, &DROPPED_PACKETS].map(|counter| stage.counted(counter));
    assert_eq!(counts, [3, 24_000, 1]);
}

#[test]
fn a_budget_that_follows_needs_a_max_and_hears_nothing_but_words_about_packets() {
    let settings = Settings {
        follow: true,
        ..Settings::default()
    };
    let error = TransmissionEncoder::new(settings).err().unwrap().to_string();
    assert!(error.contains("`budget_bytes`, the max of a budget"), "{error}");
    let mut stage = TransmissionEncoder::new(hybrid()).unwrap();
    let other = Message::new(header("cav2", Kind::Report, 0), to_report("peers", &[0]));
    let error = stage
        .on_message(Input::ON_AIR, other, &mut Outputs::at(0))
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("expected a report of topic `on_air`, found `peers`"),
        "{error}"
    );
    let broken = Report {
        topic: ON_AIR.into(),
        json: "{}".into(),
    };
    let broken = Message::new(header("cav2", Kind::Report, 0), broken);
    let error = stage
        .on_message(Input::ON_AIR, broken, &mut Outputs::at(0))
        .unwrap_err()
        .to_string();
    assert!(error.contains("report `on_air`: missing field `bytes`"), "{error}");
}
