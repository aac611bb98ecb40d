use arrow::buffer::Buffer;
use nalgebra::Isometry3;
use realo_operator::{Error, NodeBooks, Outputs, PortId};
use realo_schemas::report::from_report;
use realo_schemas::{AgentState, Header, Kind, Message, Nanos, Packet, PoseStatus};

use super::*;

const MS: Nanos = 1_000_000;

fn header(agent: &str, kind: Kind, seq: u64, at: Nanos) -> Header {
    Header::origin(&"run".into(), &agent.into(), kind, seq, at, at)
}

fn packet(agent: &str, kind: Kind, seq: u64, at: Nanos, bytes: usize) -> Message {
    let packet = Packet {
        codec: vec!["plain".into()],
        bytes: Buffer::from(vec![0u8; bytes]),
    };
    Message::new(header(agent, kind, seq, at), packet)
}

fn state(agent: &str, at: Nanos, x: f64, y: f64) -> Message {
    let state = AgentState {
        map_from_body: Isometry3::translation(x, y, 900.0),
        covariance: None,
        velocity: None,
        angular_rate: None,
        status: PoseStatus::Recorded,
    };
    Message::new(header(agent, Kind::AgentState, 0, at), state)
}

/// A link, and what it said of its channels.
struct Watched {
    link: Link,
    books: NodeBooks,
    lost: u64,
    /// What senders were told: when, who, and what.
    words: Vec<(Nanos, String, OnAir)>,
    /// Sender and number of each packet that entered a channel.
    entries: Vec<(String, u64, Entry)>,
}

/// What is known of a channel.
struct Seen {
    from: String,
    to: String,
    kind: Kind,
    sent: u64,
    bytes: u64,
    lost: u64,
    duplicated: u64,
    out_of_range: u64,
}

impl Watched {
    fn new(config: Settings) -> Result<Self, Error> {
        Ok(Watched {
            link: Link::new(config)?,
            books: NodeBooks::default(),
            lost: 0,
            words: Vec::new(),
            entries: Vec::new(),
        })
    }

    fn on_message(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        let mut own = Outputs::at(out.now());
        let done = self.link.on_message(port, message, &mut own);
        self.watch(own, out);
        done
    }

    fn watch(&mut self, own: Outputs<Output>, out: &mut Outputs) {
        let mut made = own.into_made();
        made.traffic.drain(..).for_each(|channel| self.books.carried(channel));
        self.lost += made.fates.iter().filter(|fated| fated.fate == Fate::Lost).count() as u64;
        self.entries.extend(made.fates.iter().filter_map(|fated| {
            let entry = fated.entry?;
            assert_eq!(fated.fate, Fate::InFlight, "nothing has become of it");
            Some((fated.message.from.clone(), fated.message.seq, entry))
        }));
        for (_, message) in made.sent.extract_if(.., |(port, _)| *port == Output::ON_AIR) {
            let (header, report): (Header, Report) = message.into_parts().unwrap();
            let word = from_report(&report).unwrap();
            self.words.push((header.ready, header.agent.to_string(), word));
        }
        out.take_over(made);
    }
}

fn link(profile: &str) -> Watched {
    Watched::new(Settings {
        profile: profile.into(),
        ego: "cav1".into(),
        ..Settings::default()
    })
    .unwrap()
}

/// A link that knows all agents to stand at one place.
fn placed(mut link: Watched) -> Watched {
    let out = &mut Outputs::at(0);
    link.on_message(Input::EGO_STATE, state("cav1", 0, 0.0, 0.0), out)
        .unwrap();
    for other in ["rsu1", "cav2"] {
        link.on_message(Input::STATES, state(other, 0, 0.0, 0.0), out).unwrap();
    }
    link
}

/// The channels at the end, in order; what is lost counts for the first.
fn report(link: &mut Watched) -> Vec<Seen> {
    let mut own = Outputs::at(99 * MS);
    link.link.on_end(&mut own).unwrap();
    link.watch(own, &mut Outputs::at(99 * MS));
    let mut channels = link.books.channels.clone();
    channels.sort_by_key(|channel| (channel.from.clone(), channel.to.clone(), channel.kind));
    let seen = channels.into_iter().map(|channel| Seen {
        from: channel.from,
        to: channel.to,
        kind: channel.kind,
        sent: channel.traffic.sent,
        bytes: channel.traffic.bytes,
        lost: std::mem::take(&mut link.lost),
        duplicated: channel.traffic.duplicated,
        out_of_range: channel.traffic.out_of_range,
    });
    seen.collect()
}

#[test]
fn paper_delays_by_kind_from_the_time_of_sending() {
    let mut link = placed(link("paper"));
    let kinds = [
        (Kind::Boxes, 10_000_000),
        (Kind::Points, 144_200_000),
        (Kind::Features, 41_700_000),
        (Kind::AgentState, 10_000_000),
    ];
    for (kind, delay) in kinds {
        let mut out = Outputs::at(17);
        link.on_message(Input::OTHERS, packet("rsu1", kind, 3, 12, 100), &mut out)
            .unwrap();
        let sent = out.take_sent();
        assert_eq!(sent.len(), 1);
        let (port, message) = &sent[0];
        assert_eq!((*port, message.header.to.as_deref()), (Output::TO_EGO, Some("cav1")));
        assert_eq!(
            (message.header.ready, message.header.stamp, message.header.seq),
            (17 + delay, 12, 3)
        );
    }
    let channels = report(&mut link);
    assert_eq!(
        channels.iter().map(|c| c.kind).collect::<Vec<_>>(),
        [Kind::Points, Kind::Features, Kind::Boxes, Kind::AgentState]
    );
    assert!(channels.iter().all(|c| (c.sent, c.bytes, c.lost) == (1, 100, 0)));
}

#[test]
fn range_gate_is_inclusive_and_uses_the_newest_positions() {
    let mut link = link("perfect");
    let mut out = Outputs::at(MS);
    let mut delivered = |link: &mut Watched, states: &[(&str, Nanos, f64, f64)]| {
        for (agent, at, x, y) in states {
            let port = if *agent == "cav1" {
                Input::EGO_STATE
            } else {
                Input::STATES
            };
            link.on_message(port, state(agent, *at, *x, *y), &mut out).unwrap();
        }
        link.on_message(Input::OTHERS, packet("rsu1", Kind::Boxes, 0, MS, 10), &mut out)
            .unwrap();
        out.take_sent().len()
    };
    let near = [("cav1", 0, 1e6, 1e6), ("rsu1", 0, 1e6 + 42.0, 1e6 + 56.0)];
    assert_eq!(delivered(&mut link, &near), 1, "70 m");
    assert_eq!(delivered(&mut link, &[("rsu1", 5, 1e6 + 42.1, 1e6 + 56.0)]), 0);
    assert_eq!(
        delivered(&mut link, &[("rsu1", 4, 1e6, 1e6)]),
        0,
        "an older state does not count"
    );
    assert_eq!(delivered(&mut link, &[("cav1", 6, 1e6 + 10.0, 1e6)]), 1);
    assert_eq!(out.counted("unplaced"), 0);
    let channels = report(&mut link);
    assert_eq!(
        (channels[0].sent, channels[0].out_of_range, channels[0].bytes),
        (2, 2, 20)
    );
}

#[test]
fn packets_wait_for_the_first_position_of_their_sender_and_offline_of_the_ego() {
    let hear = |link: &mut Watched, at: Nanos, seqs: std::ops::Range<u64>| {
        let mut out = Outputs::at(at);
        for seq in seqs {
            link.on_message(Input::OTHERS, packet("rsu1", Kind::Boxes, seq, 0, 10), &mut out)
                .unwrap();
        }
        assert_eq!(out.take_sent(), []);
        out.counted("unplaced")
    };
    let mut at_start = 0;
    let mut place = |link: &mut Watched, agent: &str, at: Nanos| -> Vec<(u64, Nanos)> {
        let mut out = Outputs::at(at);
        let port = if agent == "cav1" {
            Input::EGO_STATE
        } else {
            Input::STATES
        };
        link.on_message(port, state(agent, 0, 20.0, 0.0), &mut out).unwrap();
        let sent = out.take_sent();
        assert_eq!(out.counted("unplaced"), 0);
        at_start += out.counted("before_start");
        sent.iter().map(|(_, m)| (m.header.seq, m.header.ready)).collect()
    };
    let most = EARLY as u64 + 2;
    for offline in [false, true] {
        let mut link = Watched::new(Settings {
            profile: "paper".into(),
            ego: "cav1".into(),
            offline,
            ..Settings::default()
        })
        .unwrap();
        let delay = if offline { 0 } else { 10 * MS };
        let (first, second) = if offline { ("rsu1", "cav1") } else { ("cav1", "rsu1") };
        assert_eq!(hear(&mut link, 0, 0..3), 0);
        assert_eq!(place(&mut link, first, 0), []);
        assert_eq!(
            hear(&mut link, 15 * MS, 3..most),
            0,
            "the oldest leave, which is a start so far"
        );
        // Sent at 0 and 15 ms.
        let ready = |seq: u64| (delay + if seq < 3 { 0 } else { 15 * MS }).max(17 * MS);
        let expected: Vec<_> = (2..most).map(|seq| (seq, ready(seq))).collect();
        assert_eq!(place(&mut link, second, 17 * MS), expected, "the wait is no delay");
        assert_eq!(report(&mut link)[0].out_of_range, 2);
    }

    let mut link = link("paper");
    assert_eq!(place(&mut link, "rsu1", 0), []);
    assert_eq!(hear(&mut link, 0, 0..1), 0, "online, nobody waits for the ego");
    link.on_message(
        Input::OTHERS,
        packet("cav2", Kind::Boxes, 0, 0, 10),
        &mut Outputs::at(MS),
    )
    .unwrap();
    assert_eq!(at_start, 4, "of whom positions came");
    let (mut own, mut out) = (Outputs::at(2 * MS), Outputs::at(2 * MS));
    link.link.on_end(&mut own).unwrap();
    link.watch(own, &mut out);
    assert_eq!(
        (out.counted("unplaced"), out.counted("before_start")),
        (2, 0),
        "of whom none came"
    );
    let channels = report(&mut link);
    let reported: Vec<_> = channels.iter().map(|c| (&*c.from, c.sent, c.out_of_range)).collect();
    assert_eq!(
        reported,
        [("cav2", 0, 1), ("rsu1", 0, 1)],
        "who never reported a position is out of range"
    );
}

#[test]
fn the_egos_packets_go_to_every_other_agent() {
    let mut link = link("paper");
    let mut out = Outputs::at(0);
    link.on_message(Input::EGO_STATE, state("cav1", 0, 0.0, 0.0), &mut out)
        .unwrap();
    link.on_message(Input::STATES, state("cav2", 0, 0.0, 20.0), &mut out)
        .unwrap();
    link.on_message(Input::STATES, state("rsu2", 0, 10.0, 0.0), &mut out)
        .unwrap();
    link.on_message(Input::OTHERS, packet("cav2", Kind::AgentState, 0, 0, 10), &mut out)
        .unwrap();
    out.take_sent();
    link.on_message(Input::EGO, packet("cav1", Kind::AgentState, 0, 0, 20), &mut out)
        .unwrap();
    let sent: Vec<_> = out
        .take_sent()
        .into_iter()
        .map(|(port, m)| (port, m.header.to.unwrap().to_string()))
        .collect();
    assert_eq!(
        sent,
        [
            (Output::TO_OTHERS, "cav2".to_string()),
            (Output::TO_OTHERS, "rsu2".to_string())
        ]
    );
    let channels: Vec<_> = report(&mut link).into_iter().map(|c| (c.from, c.to, c.bytes)).collect();
    let expected = [("cav1", "cav2", 20), ("cav1", "rsu2", 20), ("cav2", "cav1", 10)];
    assert_eq!(
        channels,
        expected.map(|(from, to, bytes)| (from.to_string(), to.to_string(), bytes))
    );
}

fn lossy(folder: &tempfile::TempDir) -> String {
    let path = folder.path().join("lossy.toml");
    std::fs::write(
        &path,
        "[default]\nfixed_ms = 5\nloss = 0.3\nduplicate = 0.2\njitter = { gaussian_ms = 3 }",
    )
    .unwrap();
    path.to_str().unwrap().to_string()
}

/// (seq, ready) of what 200 packets, sent in the given order, become.
fn delivered(link: &mut Watched, order: impl Iterator<Item = u64>) -> BTreeSet<(u64, Nanos)> {
    let mut all = BTreeSet::new();
    for seq in order {
        let mut out = Outputs::at(100 * MS * seq as Nanos);
        link.on_message(Input::OTHERS, packet("rsu1", Kind::Boxes, seq, 0, 10), &mut out)
            .unwrap();
        all.extend(
            out.take_sent()
                .into_iter()
                .map(|(_, message)| (message.header.seq, message.header.ready)),
        );
    }
    all
}

#[test]
fn draws_do_not_depend_on_the_order_of_events() {
    let folder = tempfile::tempdir().unwrap();
    let profile = lossy(&folder);
    let (mut forth, mut back) = (placed(link(&profile)), placed(link(&profile)));
    let all = delivered(&mut forth, 0..200);
    assert_eq!(all, delivered(&mut back, (0..200).rev()));
    let channel = report(&mut forth).remove(0);
    assert_eq!(all.len() as u64, channel.sent - channel.lost + channel.duplicated);
    assert!(channel.lost > 30 && channel.duplicated > 10);
    let other = Settings {
        profile,
        ego: "cav1".into(),
        seed: 1,
        ..Settings::default()
    };
    assert_ne!(all, delivered(&mut placed(Watched::new(other).unwrap()), 0..200));
}

#[test]
fn offline_keeps_the_gate_and_the_counts_only() {
    let folder = tempfile::tempdir().unwrap();
    let config = Settings {
        profile: lossy(&folder),
        ego: "cav1".into(),
        offline: true,
        ..Settings::default()
    };
    let mut link = placed(Watched::new(config).unwrap());
    let all = delivered(&mut link, 0..200);
    assert_eq!(all, (0..200).map(|seq| (seq, 100 * MS * seq as Nanos)).collect());
    let mut out = Outputs::at(0);
    link.on_message(Input::EGO_STATE, state("cav1", 0, 0.0, 0.0), &mut out)
        .unwrap();
    link.on_message(Input::STATES, state("rsu1", 0, 71.0, 0.0), &mut out)
        .unwrap();
    assert_eq!(delivered(&mut link, 200..210), BTreeSet::new());
    let channel = report(&mut link).remove(0);
    assert_eq!(
        (channel.sent, channel.bytes, channel.lost, channel.out_of_range),
        (200, 2000, 0, 10)
    );
    let entered = |seq: u64| Entry {
        bytes: 10,
        at_ns: 100 * MS * seq as Nanos,
    };
    let expected = (0..200).map(|seq| ("rsu1".to_string(), seq, entered(seq)));
    assert!(
        link.entries.iter().cloned().eq(expected),
        "what is out of range enters no channel"
    );
}

#[test]
fn learns_the_ego_and_refuses_what_is_wired_wrongly() {
    let mut link = Watched::new(Settings::default()).unwrap();
    let mut out = Outputs::at(0);
    link.on_message(Input::STATES, state("rsu1", 0, 0.0, 0.0), &mut out)
        .unwrap();
    link.on_message(Input::OTHERS, packet("rsu1", Kind::Boxes, 0, 0, 1), &mut out)
        .unwrap();
    assert_eq!((out.take_sent().len(), out.counted("no_receiver")), (0, 0));
    let mut refuse =
        |link: &mut Watched, port, message| link.on_message(port, message, &mut out).unwrap_err().to_string();
    link.on_message(Input::EGO_STATE, state("cav1", 0, 0.0, 0.0), &mut Outputs::at(0))
        .unwrap();
    assert!(refuse(&mut link, Input::OTHERS, packet("cav1", Kind::Boxes, 0, 0, 1)).contains("others' lane"));
    assert!(refuse(&mut link, Input::EGO, packet("cav2", Kind::Boxes, 0, 0, 1)).contains("ego's lane"));
    assert!(refuse(&mut link, Input::STATES, state("rsu1", 0, f64::NAN, 0.0)).contains("not finite"));
    let refuse = |config| Link::new(config).err().expect("refused").to_string();
    assert!(
        refuse(Settings {
            range_m: -1.0,
            ..Settings::default()
        })
        .contains("`range_m`")
    );
    assert!(
        refuse(Settings {
            profile: "pape".into(),
            ..Settings::default()
        })
        .contains("`paper`")
    );
}

#[test]
fn senders_are_told_when_their_packets_left_and_how_busy_the_channel_was() {
    // 8 ms a packet of 1000 bytes.
    let mut link = placed(link(
        "channel.bits_per_second=1e6,channel.half_duplex=true,channel.queue_ms=20",
    ));
    for (seq, at) in [(0, 0), (1, 100)] {
        for sender in ["rsu1", "cav2"] {
            let packet = packet(sender, Kind::Boxes, seq, at * MS, 1000);
            link.on_message(Input::OTHERS, packet, &mut Outputs::at(at * MS))
                .unwrap();
        }
    }
    for seq in 2..5 {
        let packet = packet("rsu1", Kind::Features, seq, 100 * MS, 1000);
        link.on_message(Input::OTHERS, packet, &mut Outputs::at(100 * MS))
            .unwrap();
    }
    let told = |ready: Nanos, agent: &str, [air, span, busy]: [Nanos; 3]| {
        let word = OnAir {
            bytes: 1000,
            dropped: air == 0,
            air_ns: air * MS,
            span_ns: span * MS,
            busy_ns: busy * MS,
        };
        (ready * MS, agent.to_string(), word)
    };
    let expected = [
        told(8, "rsu1", [8, 0, 0]),
        told(16, "cav2", [8, 0, 0]),
        told(108, "rsu1", [8, 100, 16]),
        told(116, "cav2", [8, 100, 16]),
        told(124, "rsu1", [8, 16, 16]),
        told(100, "rsu1", [0, 0, 0]),
        told(100, "rsu1", [0, 0, 0]),
    ];
    assert_eq!(link.words, expected);
}

#[test]
fn bytes_take_no_time_without_a_channel_and_the_ego_is_told_nothing() {
    let mut link = placed(link("paper"));
    let other = packet("rsu1", Kind::Features, 0, MS, 1000);
    link.on_message(Input::OTHERS, other, &mut Outputs::at(MS)).unwrap();
    let own = packet("cav1", Kind::Boxes, 0, MS, 1000);
    link.on_message(Input::EGO, own, &mut Outputs::at(MS)).unwrap();
    let word = OnAir {
        bytes: 1000,
        ..OnAir::default()
    };
    assert_eq!(link.words, [(MS, "rsu1".to_string(), word)]);
}
