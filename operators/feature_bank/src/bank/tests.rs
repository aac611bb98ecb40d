use std::collections::BTreeSet;

use proptest::prelude::*;
use realo_schemas::report::Fate;
use realo_schemas::{Boxes, Kind};

use super::*;

const MS: Nanos = 1_000_000;

fn header(agent: &str, seq: u64, stamp: Nanos, ready: Nanos) -> Header {
    Header::origin(&"run".into(), &agent.into(), Kind::Boxes, seq, stamp * MS, ready * MS)
}

fn message(agent: &str, seq: u64, stamp: Nanos, ready: Nanos) -> Message {
    Message::new(header(agent, seq, stamp, ready), Boxes::default())
}

fn online() -> Bank {
    Bank::new(400 * MS, false, 1000 * MS, 256, 60_000 * MS)
}

fn offline() -> Bank {
    Bank {
        offline: true,
        ..online()
    }
}

/// A query that is answered at once.
fn ask(bank: &mut Bank, query: &Header) -> Answer {
    bank.answer(query, query.ready, &BTreeSet::new())
}

fn seqs(entries: &[Message]) -> Vec<(&str, u64)> {
    entries
        .iter()
        .map(|entry| (&*entry.header.agent, entry.header.seq))
        .collect()
}

fn fates(departed: &Departed) -> Vec<(&str, u64, Fate)> {
    departed
        .iter()
        .map(|(header, fate)| (&*header.agent, header.seq, *fate))
        .collect()
}

#[test]
fn takes_the_newest_stamp_of_each_sender_in_the_window() {
    let mut bank = online();
    for message in [
        message("b", 0, 0, 20),
        message("b", 2, 200, 210),
        message("b", 1, 100, 230),
        message("a", 9, 150, 240),
    ] {
        assert!(matches!(bank.insert(message), Ok(Taken::Held { .. })));
    }
    let answer = ask(&mut bank, &header("ego", 3, 200, 250));
    assert_eq!(seqs(&answer.entries), [("a", 9), ("b", 2)]);
    assert_eq!(
        fates(&answer.departed),
        [("b", 0, Fate::Superseded), ("b", 1, Fate::Superseded)]
    );
    assert_eq!(fates(&bank.close()), []);
}

#[test]
fn window_is_inclusive_and_what_is_older_is_stale() {
    let mut bank = online();
    bank.insert(message("a", 0, 100, 110)).unwrap();
    assert_eq!(seqs(&ask(&mut bank, &header("ego", 0, 480, 500)).entries), [("a", 0)]);
    let late = Header {
        ready: 500 * MS + 1,
        ..header("ego", 1, 480, 500)
    };
    assert_eq!(ask(&mut bank, &late).entries, []);
    bank.insert(message("b", 0, 10, 20)).unwrap();
    assert_eq!(ask(&mut bank, &header("ego", 2, 600, 700)).entries, []);
    assert_eq!(
        fates(&bank.close()),
        [("b", 0, Fate::Stale)],
        "of what was selected the fusion says what became"
    );
}

#[test]
fn a_query_that_waited_does_not_see_what_came_after_it() {
    let mut bank = online();
    bank.insert(message("a", 0, 0, 10)).unwrap();
    bank.insert(message("a", 1, 100, 110)).unwrap();
    let answer = ask(&mut bank, &header("ego", 0, 90, 109));
    assert_eq!(seqs(&answer.entries), [("a", 0)]);
    assert_eq!(fates(&answer.departed), []);
    let answer = ask(&mut bank, &header("ego", 1, 90, 110));
    assert_eq!(seqs(&answer.entries), [("a", 1)]);
    assert_eq!(fates(&answer.departed), []);
}

#[test]
fn copies_and_the_egos_own_messages_are_not_held() {
    let mut bank = online();
    bank.insert(message("a", 5, 100, 110)).unwrap();
    bank.insert(message("ego", 5, 100, 110)).unwrap();
    assert_eq!(bank.insert(message("a", 5, 100, 130)), Ok(Taken::Repeated));
    assert_eq!(seqs(&ask(&mut bank, &header("ego", 0, 100, 140)).entries), [("a", 5)]);
    assert_eq!(bank.insert(message("ego", 6, 100, 150)), Ok(Taken::FromEgo));
    assert_eq!(
        bank.insert(message("a", 5, 100, 150)),
        Ok(Taken::Repeated),
        "after it was selected, too"
    );
    assert_eq!(fates(&bank.close()), []);
}

#[test]
fn a_restarted_peer_is_heard_and_one_from_the_future_is_not() {
    let mut bank = online();
    bank.insert(message("a", 500, 1000, 1010)).unwrap();
    bank.insert(message("a", 0, 1500, 1510)).unwrap();
    let error = bank.insert(message("a", 1, 9000, 1600)).unwrap_err().to_string();
    assert!(
        error.contains("`ahead_ms`") && error.contains("boxes of a, seq 1"),
        "{error}"
    );
    assert_eq!(seqs(&ask(&mut bank, &header("ego", 0, 1500, 1610)).entries), [("a", 0)]);
    // The peer's clock jumps back: its messages are too old, and it is heard again when the clock is right.
    bank.insert(message("a", 2, 100, 1700)).unwrap();
    bank.insert(message("a", 3, 2000, 2010)).unwrap();
    assert_eq!(seqs(&ask(&mut bank, &header("ego", 1, 2000, 2010)).entries), [("a", 3)]);
}

#[test]
fn a_stamp_may_lie_as_far_ahead_as_allowed_and_no_further() {
    let mut bank = online();
    let ahead = |seq, by| {
        let header = Header {
            stamp: 10 * MS + by,
            ..header("a", seq, 10, 10)
        };
        Message::new(header, Boxes::default())
    };
    assert_eq!(bank.insert(ahead(0, 1000 * MS)), Ok(Taken::Held { newest: true }));
    let error = bank.insert(ahead(1, 1000 * MS + 1)).unwrap_err();
    assert!(matches!(error, BankError::Ahead { limit_ms: 1000.0, .. }), "{error}");
}

#[test]
fn copies_are_known_among_the_last_sixty_four_messages_of_their_sender() {
    let mut bank = online();
    for seq in 0..64 {
        bank.insert(message("a", seq, 0, 10)).unwrap();
    }
    assert_eq!(bank.insert(message("a", 0, 0, 11)), Ok(Taken::Repeated));
    assert_eq!(bank.insert(message("a", 64, 0, 11)), Ok(Taken::Held { newest: false }));
    assert_eq!(bank.insert(message("a", 1, 0, 12)), Ok(Taken::Repeated));
    let again = bank.insert(message("a", 0, 0, 12));
    assert_eq!(again, Ok(Taken::Held { newest: false }), "65 messages ago");
}

#[test]
fn sixteen_messages_of_a_sender_are_held_for_queries_that_wait() {
    let fed = |count: u64| {
        let mut bank = online();
        for seq in 0..count {
            let at = 10 * seq as Nanos;
            bank.insert(message("a", seq, at, at)).unwrap();
        }
        bank
    };
    let query = header("ego", 0, 0, 0);
    let answer = ask(&mut fed(16), &query);
    assert_eq!(
        (seqs(&answer.entries), fates(&answer.departed)),
        (vec![("a", 0)], vec![])
    );
    let answer = ask(&mut fed(17), &query);
    assert_eq!(
        (seqs(&answer.entries), fates(&answer.departed)),
        (vec![], vec![("a", 0, Fate::Superseded)])
    );
}

#[test]
fn what_came_after_a_query_departs_with_a_later_one() {
    let mut bank = online();
    for message in [
        message("a", 0, 0, 40),
        message("a", 1, 100, 110),
        message("a", 2, 50, 120),
    ] {
        bank.insert(message).unwrap();
    }
    assert_eq!(bank.agents(), 1);
    let departed = |bank: &mut Bank, ready| {
        let answer = ask(bank, &header("ego", 0, 90, ready));
        assert_eq!(seqs(&answer.entries), [("a", 1)]);
        let departed = fates(&answer.departed).into_iter().map(|(_, seq, fate)| (seq, fate));
        departed.collect::<Vec<_>>()
    };
    assert_eq!(departed(&mut bank, 119), [(0, Fate::Superseded)]);
    assert_eq!(departed(&mut bank, 120), [(2, Fate::Superseded)]);
    assert_eq!(departed(&mut bank, 121), []);
}

#[test]
fn extreme_stamps_do_no_harm() {
    for mut bank in [online(), offline()] {
        for (seq, stamp) in [Nanos::MIN, Nanos::MAX, 0, -1].into_iter().enumerate() {
            let header = Header {
                stamp,
                ready: 0,
                ..header("a", seq as u64, 0, 0)
            };
            let taken = bank.insert(Message::new(header, Boxes::default()));
            assert_eq!(taken.is_err(), stamp == Nanos::MAX);
        }
        for (seq, stamp) in [Nanos::MIN, -1, Nanos::MAX].into_iter().enumerate() {
            ask(
                &mut bank,
                &Header {
                    stamp,
                    ready: stamp,
                    ..header("ego", seq as u64, 0, 0)
                },
            );
        }
        bank.close();
    }
}

#[test]
fn holds_ten_thousand_agents_and_forgets_them() {
    let mut bank = Bank {
        max_agents: 10_000,
        ..online()
    };
    for round in 0..3 {
        for agent in 0..10_000 {
            bank.insert(message(
                &format!("a{agent:05}"),
                round,
                100 * round as Nanos,
                100 * round as Nanos + 5,
            ))
            .unwrap();
        }
    }
    let error = bank.insert(message("one-more", 0, 200, 205)).unwrap_err().to_string();
    assert!(error.contains("10000") && error.contains("`max_agents`"), "{error}");
    let answer = ask(&mut bank, &header("ego", 0, 200, 210));
    assert_eq!((answer.entries.len(), answer.departed.len()), (10_000, 20_000));
    assert!(answer.entries.is_sorted_by_key(|entry| &entry.header.agent));
    let answer = ask(&mut bank, &header("ego", 1, 60_300, 60_300));
    assert_eq!(
        (answer.entries.len(), answer.departed.len(), bank.agents()),
        (0, 0, 0),
        "forgotten, and all of it was selected before"
    );
    let held = bank.insert(message("one-more", 1, 60_300, 60_301));
    assert_eq!(held, Ok(Taken::Held { newest: true }));
}

#[test]
fn a_sender_that_nobody_asks_takes_bounded_memory() {
    for mut bank in [online(), offline()] {
        for seq in 0..10_000 {
            bank.insert(message("a", seq, 100 * seq as Nanos, 100 * seq as Nanos))
                .unwrap();
        }
        let departed = bank.close();
        assert_eq!(departed.len(), 10_000);
        let in_flight = departed.iter().filter(|(_, fate)| *fate == Fate::InFlight).count();
        assert_eq!(
            in_flight,
            if bank.offline { 10_000 } else { 1 },
            "offline no query superseded any"
        );
    }
}

#[test]
fn offline_takes_the_nearest_stamp_within_fifty_milliseconds() {
    struct Case {
        stamps: &'static [Nanos],
        selected: Option<Nanos>,
    }
    let cases = [
        Case {
            stamps: &[960, 1030],
            selected: Some(1030),
        },
        Case {
            stamps: &[970, 1030],
            selected: Some(970),
        },
        Case {
            stamps: &[950],
            selected: Some(950),
        },
        Case {
            stamps: &[1050],
            selected: Some(1050),
        },
        Case {
            stamps: &[949, 1051],
            selected: None,
        },
        Case {
            stamps: &[1000, 1000],
            selected: Some(1000),
        },
    ];
    for case in cases {
        let mut bank = offline();
        for (seq, stamp) in case.stamps.iter().enumerate() {
            bank.insert(message("a", seq as u64, *stamp, *stamp)).unwrap();
        }
        let answer = ask(&mut bank, &header("ego", 0, 1000, 1000));
        let found = answer.entries.first().map(|entry| entry.header.stamp / MS);
        assert_eq!(found, case.selected, "{:?}", case.stamps);
        assert!(
            answer
                .entries
                .first()
                .is_none_or(|entry| entry.header.seq == 0 || case.stamps[0] == 960)
        );
    }
}

#[test]
fn offline_what_came_while_nobody_asked_is_stale_for_the_next_query() {
    let mut bank = offline();
    for seq in 0..40 {
        bank.insert(message("a", seq, 100 * seq as Nanos, 100 * seq as Nanos))
            .unwrap();
    }
    let answer = ask(&mut bank, &header("ego", 0, 2000, 2050));
    assert_eq!(answer.entries.len(), 0, "only the last 16 are held");
    assert_eq!(fates(&answer.departed).len(), 20);
    assert!(fates(&answer.departed).iter().all(|(.., fate)| *fate == Fate::Stale));
    assert_eq!(
        seqs(&ask(&mut bank, &header("ego", 1, 3900, 3950)).entries),
        [("a", 39)]
    );
}

#[test]
fn offline_fates() {
    let mut bank = offline();
    for (seq, stamp) in [(0, 0), (1, 80), (2, 110), (3, 160), (4, 260)] {
        bank.insert(message("a", seq, stamp, stamp)).unwrap();
    }
    assert_eq!(
        fates(&ask(&mut bank, &header("ego", 0, 100, 100)).departed),
        [("a", 0, Fate::Stale)]
    );
    let answer = ask(&mut bank, &header("ego", 1, 220, 220));
    assert_eq!(seqs(&answer.entries), [("a", 4)]);
    assert_eq!(
        fates(&answer.departed),
        [("a", 1, Fate::Superseded), ("a", 3, Fate::Stale)]
    );
    bank.insert(message("a", 5, 300, 300)).unwrap();
    assert_eq!(fates(&bank.close()), [("a", 5, Fate::InFlight)]);
}

/// What happens to a bank, in the order in which it happens; times in ms.
#[derive(Clone, Debug)]
enum Event {
    Message(Sent),
    Query { stamp: Nanos, ready: Nanos },
}

#[derive(Clone, Debug, PartialEq)]
struct Sent {
    agent: u8,
    seq: u64,
    stamp: Nanos,
    ready: Nanos,
}

/// A message that came in, and what happened to it.
struct Came {
    sent: Sent,
    selected: bool,
    stale: bool,
    skipped: bool,
}

/// The rules as they are written in the design, over everything that ever came in.
struct Naive {
    offline: bool,
    came: Vec<Came>,
}

impl Naive {
    fn insert(&mut self, sent: &Sent) {
        let id = |sent: &Sent| (sent.agent, sent.seq, sent.stamp);
        if self.came.iter().all(|came| id(&came.sent) != id(sent)) {
            let (sent, selected, stale, skipped) = (sent.clone(), false, false, false);
            self.came.push(Came {
                sent,
                selected,
                stale,
                skipped,
            });
        }
    }

    fn query(&mut self, stamp: Nanos, ready: Nanos) -> Vec<(u8, u64)> {
        let agents: BTreeSet<u8> = self.came.iter().map(|came| came.sent.agent).collect();
        let mut selected = Vec::new();
        for agent in agents {
            let at = if self.offline {
                self.nearest(agent, stamp)
            } else {
                self.newest(agent, ready)
            };
            selected.extend(at.map(|at| (agent, self.came[at].sent.seq)));
        }
        selected
    }

    fn newest(&mut self, agent: u8, ready: Nanos) -> Option<usize> {
        let mine = self
            .came
            .iter()
            .enumerate()
            .filter(|(_, c)| c.sent.agent == agent && c.sent.ready <= ready);
        let newest = mine.max_by_key(|(at, c)| (c.sent.stamp, *at)).map(|(at, _)| at)?;
        let came = &mut self.came[newest];
        let in_time = ready - came.sent.stamp <= 400;
        came.selected |= in_time;
        came.stale |= !in_time;
        in_time.then_some(newest)
    }

    fn nearest(&mut self, agent: u8, stamp: Nanos) -> Option<usize> {
        let distance = |c: &Came| (c.sent.stamp - stamp).abs();
        let mine = self
            .came
            .iter()
            .enumerate()
            .filter(|(_, c)| c.sent.agent == agent && distance(c) <= 50);
        let nearest = mine
            .min_by_key(|(at, c)| (distance(c), c.sent.stamp, *at))
            .map(|(at, _)| at);
        for (at, came) in self.came.iter_mut().enumerate().filter(|(_, c)| c.sent.agent == agent) {
            came.selected |= nearest == Some(at);
            came.skipped |= nearest != Some(at) && distance(came) <= 50;
            came.stale |= came.sent.stamp < stamp - 50;
        }
        nearest
    }

    fn fates(&self) -> Vec<(u8, u64, Fate)> {
        let all = self.came.iter().enumerate().filter(|(_, came)| !came.selected);
        all.map(|(at, came)| (came.sent.agent, came.sent.seq, self.fate(at, came)))
            .collect()
    }

    fn fate(&self, at: usize, came: &Came) -> Fate {
        let order = |at: usize, came: &Came| (came.sent.stamp, at);
        let newer = |(i, c): (usize, &Came)| c.sent.agent == came.sent.agent && order(i, c) > order(at, came);
        match came {
            Came { skipped: true, .. } => Fate::Superseded,
            Came { stale: true, .. } => Fate::Stale,
            _ if !self.offline && self.came.iter().enumerate().any(newer) => Fate::Superseded,
            _ => Fate::InFlight,
        }
    }
}

/// A run of a few agents with delays (hence reordering), copies, gaps, jumps of clocks and restarts.
fn events(offline: bool) -> impl Strategy<Value = Vec<Event>> {
    let step = (0u8..4, 0i64..300, 0u8..20, -700i64..700, 0u8..30);
    let messages = prop::collection::vec(step, 0..120);
    let queries = prop::collection::vec((1i64..180, 0i64..60, 0i64..40), 0..40);
    (messages, queries).prop_map(move |(messages, queries)| {
        // (processed, class, event)
        let mut all: Vec<(Nanos, u8, Event)> = Vec::new();
        let (mut clock, mut seq, mut jump) = ([1000i64; 4], [0u64; 4], [0i64; 4]);
        for (agent, delay, copies, by, special) in messages {
            let a = agent as usize;
            clock[a] += if special == 7 { 900 } else { 90 };
            match special {
                1 => jump[a] = by,
                2 => jump[a] = 0,
                3 => seq[a] = 0,
                4 => seq[a] += 5,
                _ => {}
            }
            let stamp = clock[a] + if offline { 0 } else { jump[a] };
            let delay = if offline { 0 } else { delay };
            let ready = clock[a].max(stamp) + delay;
            for copy in 0..=i64::from(copies == 1) {
                let ready = ready + 13 * copy;
                all.push((
                    ready,
                    0,
                    Event::Message(Sent {
                        agent,
                        seq: seq[a],
                        stamp,
                        ready,
                    }),
                ));
            }
            seq[a] += 1;
        }
        let (mut stamp, mut last) = (1000, (0, 0));
        for (step, compute, wait) in queries {
            stamp += step;
            // Queries are ready and answered in order.
            let ready = (stamp + compute).max(last.0);
            last = (ready, (ready + wait).max(last.1));
            let (ready, processed) = if offline { (stamp, stamp + 50) } else { last };
            all.push((processed, 1, Event::Query { stamp, ready }));
        }
        all.sort_by_key(|(processed, class, _)| (*processed, *class));
        all.into_iter().map(|(_, _, event)| event).collect()
    })
}

fn agrees(offline: bool, events: &[Event]) -> Result<(), TestCaseError> {
    let mut bank = if offline { self::offline() } else { online() };
    bank.ahead = 10_000 * MS;
    bank.forget = 1_000_000 * MS;
    bank.held = usize::MAX;
    let mut naive = Naive {
        offline,
        came: Vec::new(),
    };
    let mut departed = Vec::new();
    let agent = |name: &str| name.trim_start_matches('a').parse::<u8>().unwrap();
    let mut leave = |left: Departed| {
        departed.extend(
            left.iter()
                .map(|(header, fate)| (agent(&header.agent), header.seq, *fate)),
        );
    };
    for event in events {
        match event {
            Event::Message(sent) => {
                let Sent {
                    agent,
                    seq,
                    stamp,
                    ready,
                } = sent;
                bank.insert(message(&format!("a{agent}"), *seq, *stamp, *ready))
                    .unwrap();
                naive.insert(sent);
            }
            Event::Query { stamp, ready } => {
                let answer = ask(&mut bank, &header("ego", 0, *stamp, *ready));
                let found: Vec<_> = seqs(&answer.entries)
                    .iter()
                    .map(|(name, seq)| (agent(name), *seq))
                    .collect();
                prop_assert_eq!(
                    found,
                    naive.query(*stamp, *ready),
                    "query at {}, ready {}",
                    stamp,
                    ready
                );
                leave(answer.departed);
            }
        }
    }
    leave(bank.close());
    departed.sort();
    let mut expected = naive.fates();
    expected.sort();
    prop_assert_eq!(departed, expected);
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1500))]

    #[test]
    fn agrees_online_with_a_naive_model(events in events(false)) {
        agrees(false, &events)?;
    }

    #[test]
    fn agrees_offline_with_a_naive_model(events in events(true)) {
        agrees(true, &events)?;
    }
}
