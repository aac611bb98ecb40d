use realo_operator::{Outputs, PortId};
use realo_schemas::report::Fate;
use realo_schemas::{Boxes, Header, Kind, Message, Nanos, Payload, PointCloud, Selection};

use super::*;

const MS: Nanos = 1_000_000;

fn message(agent: &str, seq: u64, stamp: Nanos, ready: Nanos) -> Message {
    let mut header = Header::origin(&"run".into(), &agent.into(), Kind::Boxes, seq, stamp * MS, ready * MS);
    header.to = Some("cav1".into());
    Message::new(header, Boxes::default())
}

fn bank(offline: bool) -> FeatureBank {
    FeatureBank::new(Settings {
        offline,
        ..Settings::default()
    })
    .unwrap()
}

/// A Selection: its header, its query, and agent and seq of its entries.
type Answered = (Header, u64, Vec<String>);

/// Selections, and what was said of messages.
fn outcome(out: &mut Outputs<Output>) -> (Vec<Answered>, Vec<(u64, Fate)>) {
    let mut selections = Vec::new();
    for (port, message) in out.take_sent() {
        match message.payload {
            Payload::Selection(Selection { query, entries }) if port == Output::SELECTIONS => {
                let entries = entries
                    .iter()
                    .map(|e| format!("{}:{}", e.header.agent, e.header.seq))
                    .collect();
                selections.push((message.header, query, entries));
            }
            other => panic!("{other:?} on {port:?}"),
        }
    }
    let fates = out.take_fates().into_iter();
    (selections, fates.map(|fated| (fated.message.seq, fated.fate)).collect())
}

#[test]
fn what_cannot_be_fused_with_the_query_is_rejected_before_and_after_it_is_known() {
    for offline in [false, true] {
        let mut bank = bank(offline);
        let mut out = Outputs::at(140 * MS);
        let cloud = |seq: u64, stamp| Message {
            payload: PointCloud::empty().into(),
            ..message("rsu1", seq, stamp, stamp + 1)
        };
        bank.on_message(Input::OTHERS, cloud(4, 95), &mut out).unwrap();
        bank.on_message(Input::OTHERS, message("rsu1", 3, 90, 92), &mut out)
            .unwrap();
        bank.on_message(Input::EGO, message("cav1", 7, 100, 140), &mut out)
            .unwrap();
        let error = bank
            .on_message(Input::OTHERS, cloud(5, 100), &mut out)
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("expected Boxes") && error.contains("found PointCloud"),
            "{error}"
        );
        bank.on_end(&mut out).unwrap();
        let (selections, fates) = outcome(&mut out);
        assert_eq!(selections[0].2, ["rsu1:3"], "offline {offline}");
        assert_eq!(fates, [(4, Fate::Rejected)], "offline {offline}");
    }
}

#[test]
fn answers_each_query_at_once_with_the_querys_header() {
    let mut bank = bank(false);
    let mut out = Outputs::at(140 * MS);
    bank.on_message(Input::OTHERS, message("rsu1", 4, 90, 130), &mut out)
        .unwrap();
    bank.on_message(Input::OTHERS, message("rsu1", 4, 90, 131), &mut out)
        .unwrap();
    let query = message("cav1", 7, 100, 140);
    bank.on_message(Input::EGO, query.clone(), &mut out).unwrap();
    let (selections, fates) = outcome(&mut out);
    assert_eq!(selections, [(query.header.clone(), 7, vec!["rsu1:4".to_string()])]);
    assert_eq!((fates, out.counted("repeated")), (vec![], 1));
    bank.on_end(&mut out).unwrap();
    assert_eq!(outcome(&mut out), (vec![], vec![]), "the fusion says what became of it");
}

#[test]
fn who_is_in_the_egos_message_already_is_skipped_by_its_query() {
    for offline in [false, true] {
        let mut bank = bank(offline);
        let mut out = Outputs::at(140 * MS);
        bank.on_message(Input::OTHERS, message("rsu1", 4, 95, 110), &mut out)
            .unwrap();
        bank.on_message(Input::OTHERS, message("cav2", 2, 95, 110), &mut out)
            .unwrap();
        let query = message("cav1", 7, 100, 140);
        let entries = vec![message("rsu1", 4, 95, 100)];
        let fused = Message::new(query.header.clone(), Selection { query: 7, entries });
        bank.on_message(Input::FUSED, fused, &mut out).unwrap();
        bank.on_message(Input::EGO, query, &mut out).unwrap();
        bank.on_end(&mut out).unwrap();
        let (selections, fates) = outcome(&mut out);
        assert_eq!(selections[0].2, ["cav2:2"], "offline {offline}");
        assert_eq!(fates, [(4, Fate::Superseded)], "offline {offline}");
    }
}

#[test]
fn who_was_in_an_earlier_message_of_the_ego_is_selected_again() {
    let mut bank = bank(false);
    let mut out = Outputs::at(140 * MS);
    let query = |seq| message("cav1", seq, 100, 140);
    let entries = vec![message("rsu1", 4, 95, 100)];
    let fused = Message::new(query(7).header, Selection { query: 7, entries });
    bank.on_message(Input::OTHERS, message("rsu1", 4, 95, 110), &mut out)
        .unwrap();
    bank.on_message(Input::FUSED, fused, &mut out).unwrap();
    bank.on_message(Input::EGO, query(7), &mut out).unwrap();
    bank.on_message(Input::EGO, query(8), &mut out).unwrap();
    bank.on_end(&mut out).unwrap();
    let (selections, fates) = outcome(&mut out);
    assert_eq!(
        [&selections[0].2[..], &selections[1].2[..]],
        [&[][..], &["rsu1:4".to_string()][..]]
    );
    assert_eq!(fates, [], "the fusion says what became of it");
}

#[test]
fn offline_answers_fifty_milliseconds_after_the_stamp() {
    let mut bank = bank(true);
    let mut out = Outputs::at(100 * MS);
    bank.on_message(Input::EGO, message("cav1", 0, 100, 100), &mut out)
        .unwrap();
    assert_eq!(outcome(&mut out).0, []);
    assert_eq!(out.take_wakes().into_iter().collect::<Vec<_>>(), [150 * MS]);
    bank.on_message(Input::OTHERS, message("rsu1", 0, 140, 140), &mut out)
        .unwrap();
    bank.on_wake(149 * MS, &mut out).unwrap();
    assert_eq!(outcome(&mut out).0, []);
    let mut out = Outputs::at(150 * MS);
    bank.on_wake(150 * MS, &mut out).unwrap();
    let (selections, _) = outcome(&mut out);
    assert_eq!(selections[0].2, ["rsu1:0"]);
    assert_eq!(selections[0].0.ready, 150 * MS);
    bank.on_wake(150 * MS, &mut out).unwrap();
    assert_eq!(outcome(&mut out).0, [], "once only");
}

#[test]
fn queries_of_one_stamp_are_answered_each_in_order_of_arrival() {
    let mut bank = bank(true);
    let mut out = Outputs::at(100 * MS);
    for seq in [4, 3, 5] {
        bank.on_message(Input::EGO, message("cav1", seq, 100, 100), &mut out)
            .unwrap();
    }
    bank.on_wake(150 * MS, &mut out).unwrap();
    let answered: Vec<u64> = outcome(&mut out).0.iter().map(|(_, query, _)| *query).collect();
    assert_eq!(answered, [4, 3, 5]);
}

#[test]
fn answers_what_is_pending_at_the_end() {
    let mut bank = bank(true);
    let mut out = Outputs::at(100 * MS);
    bank.on_message(Input::EGO, message("cav1", 0, 100, 100), &mut out)
        .unwrap();
    bank.on_end(&mut out).unwrap();
    assert_eq!(outcome(&mut out).0.len(), 1);
}

#[test]
fn closes_its_books_without_a_query_and_is_silent_without_a_message() {
    let mut out = Outputs::at(100 * MS);
    bank(false).on_end(&mut out).unwrap();
    assert_eq!(out.take_sent(), []);
    let mut bank = bank(false);
    bank.on_message(Input::OTHERS, message("rsu1", 0, 90, 100), &mut out)
        .unwrap();
    bank.on_end(&mut out).unwrap();
    assert_eq!(outcome(&mut out), (vec![], vec![(0, Fate::InFlight)]));
}

#[test]
fn says_what_became_of_what_it_will_not_select() {
    let mut bank = bank(false);
    let mut out = Outputs::at(140 * MS);
    bank.on_message(Input::OTHERS, message("rsu1", 3, 0, 100), &mut out)
        .unwrap();
    bank.on_message(Input::OTHERS, message("rsu1", 4, 90, 130), &mut out)
        .unwrap();
    bank.on_message(Input::EGO, message("cav1", 7, 100, 140), &mut out)
        .unwrap();
    assert_eq!(outcome(&mut out).1, [(3, Fate::Superseded)]);
}

#[test]
fn refuses_settings_that_cannot_work() {
    let error = |config| FeatureBank::new(config).err().expect("refused").to_string();
    assert!(
        error(Settings {
            max_agents: 0,
            ..Settings::default()
        })
        .contains("`max_agents`")
    );
    assert!(
        error(Settings {
            forget_ms: 10,
            ..Settings::default()
        })
        .contains("`forget_ms`")
    );
}

/// A bank that waits at most 30 ms.
fn patient() -> FeatureBank {
    FeatureBank::new(Settings {
        patience_ms: 30,
        ..Settings::default()
    })
    .unwrap()
}

/// Gives a message at a time; what was answered, and the wakes that were asked for, in ms.
fn give(bank: &mut FeatureBank, port: PortId, message: Message) -> (Vec<Answered>, Vec<Nanos>) {
    let mut out = Outputs::at(message.header.ready);
    bank.on_message(port, message, &mut out).unwrap();
    let wakes = out.take_wakes().into_iter().map(|time| time / MS).collect();
    (outcome(&mut out).0, wakes)
}

/// Messages 0 and 1 of `agent`, 100 ms apart, ready 60 ms after their stamps.
fn two_of(bank: &mut FeatureBank, agent: &str) {
    for seq in [0, 1] {
        let stamp = 100 * seq as Nanos;
        assert_eq!(
            give(bank, Input::OTHERS, message(agent, seq, stamp, stamp + 60)),
            (vec![], vec![])
        );
    }
}

#[test]
fn patient_queries_go_on_as_soon_as_all_that_is_expected_has_come() {
    let mut bank = patient();
    two_of(&mut bank, "rsu1");
    two_of(&mut bank, "rsu2");
    // Both are due at 260.
    assert_eq!(
        give(&mut bank, Input::EGO, message("cav1", 2, 200, 250)),
        (vec![], vec![280])
    );
    assert_eq!(
        give(&mut bank, Input::OTHERS, message("rsu1", 2, 200, 262)),
        (vec![], vec![])
    );
    let (answered, _) = give(&mut bank, Input::OTHERS, message("rsu2", 2, 200, 270));
    assert_eq!(answered[0].2, ["rsu1:2", "rsu2:2"]);
    assert_eq!(answered[0].0.ready, 270 * MS);
    let mut out = Outputs::at(280 * MS);
    bank.on_wake(280 * MS, &mut out).unwrap();
    assert_eq!(outcome(&mut out), (vec![], vec![]), "once only");
}

#[test]
fn patience_ends_with_what_is_there() {
    let mut bank = patient();
    two_of(&mut bank, "rsu1");
    assert_eq!(
        give(&mut bank, Input::EGO, message("cav1", 2, 200, 250)),
        (vec![], vec![280])
    );
    for (now, answers) in [(279, vec![]), (280, vec!["rsu1:1".to_string()])] {
        let mut out = Outputs::at(now * MS);
        bank.on_wake(now * MS, &mut out).unwrap();
        let entries: Vec<String> = outcome(&mut out)
            .0
            .into_iter()
            .flat_map(|answered| answered.2)
            .collect();
        assert_eq!(entries, answers, "{now}");
    }
    let (answered, wakes) = give(&mut bank, Input::OTHERS, message("rsu1", 2, 200, 281));
    assert_eq!((answered, wakes), (vec![], vec![]), "too late for the query");
}

#[test]
fn nobody_waits_for_what_is_not_expected_within_the_patience() {
    // When the ego asks; the messages of rsu1, whose next is due 100 ms after the last; whether the ego waits.
    let last_at = |ready| vec![message("rsu1", 0, 0, ready - 100), message("rsu1", 1, 100, ready)];
    let late = || {
        let newest = message("rsu1", 2, 200, 260);
        vec![message("rsu1", 0, 0, 60), newest, message("rsu1", 1, 110, 265)]
    };
    let afresh = || vec![message("rsu1", 500, 0, 60), message("rsu1", 0, 100, 160)];
    let cases = [
        (250, last_at(180), true),
        (250, last_at(181), false),
        (250, last_at(120), true),
        (250, last_at(119), false),
        // A message was lost: the one after it is expected all the same.
        (350, last_at(160), true),
        // Where one is missing between two messages the period is half of what lies between their stamps.
        (210, last_at(160), false),
        (210, vec![message("rsu1", 0, 0, 60), message("rsu1", 2, 100, 160)], true),
        // One message has no rhythm, and what is older than the window no future.
        (250, vec![message("rsu1", 1, 100, 160)], false),
        (500, last_at(190), true),
        (501, last_at(190), false),
        // It is there already.
        (250, last_at(249), false),
        // What comes late, or is no newer, changes no rhythm.
        (330, late(), true),
        (329, late(), false),
        (250, [last_at(160), vec![message("rsu1", 2, 100, 170)]].concat(), true),
        // The newest difference of stamps counts, were it the smallest.
        (
            430,
            [(0, 0), (1, 200), (2, 300)]
                .map(|(seq, stamp)| message("rsu1", seq, stamp, stamp + 60))
                .to_vec(),
            true,
        ),
        // A sender that starts afresh keeps its rhythm.
        (250, afresh(), true),
        (210, afresh(), false),
    ];
    for (at, messages, waits) in cases {
        let mut bank = patient();
        let reported = format!(
            "{at}: {:?}",
            messages.iter().map(|m| m.header.ready / MS).collect::<Vec<_>>()
        );
        for message in messages {
            give(&mut bank, Input::OTHERS, message);
        }
        let (answered, wakes) = give(&mut bank, Input::EGO, message("cav1", 2, 200, at));
        assert_eq!((answered.is_empty(), !wakes.is_empty()), (waits, waits), "{reported}");
    }
}

#[test]
fn a_query_waits_no_longer_than_until_the_next_one() {
    let mut bank = patient();
    two_of(&mut bank, "rsu1");
    assert_eq!(give(&mut bank, Input::EGO, message("cav1", 2, 200, 250)).0, []);
    let (answered, wakes) = give(&mut bank, Input::EGO, message("cav1", 3, 210, 260));
    assert_eq!(answered.iter().map(|answered| answered.1).collect::<Vec<_>>(), [2]);
    assert_eq!(wakes, [290]);
    let mut out = Outputs::at(265 * MS);
    bank.on_end(&mut out).unwrap();
    assert_eq!(outcome(&mut out).0[0].1, 3);
}

#[test]
fn a_query_that_had_to_wait_for_its_turn_takes_what_came_meanwhile_if_it_is_patient() {
    for (patience_ms, taken) in [(0, "rsu1:0"), (30, "rsu1:1")] {
        let mut bank = FeatureBank::new(Settings {
            patience_ms,
            ..Settings::default()
        })
        .unwrap();
        give(&mut bank, Input::OTHERS, message("rsu1", 0, 100, 160));
        give(&mut bank, Input::OTHERS, message("rsu1", 1, 200, 255));
        let mut out = Outputs::at(257 * MS);
        bank.on_message(Input::EGO, message("cav1", 2, 200, 250), &mut out)
            .unwrap();
        assert_eq!(outcome(&mut out).0[0].2, [taken]);
    }
}

#[test]
fn a_patient_query_that_is_asked_early_takes_what_is_ready_when_it_is() {
    let mut bank = patient();
    give(&mut bank, Input::OTHERS, message("rsu1", 0, 100, 245));
    let mut out = Outputs::at(240 * MS);
    bank.on_message(Input::EGO, message("cav1", 2, 200, 250), &mut out)
        .unwrap();
    assert_eq!(outcome(&mut out).0[0].2, ["rsu1:0"]);
}

#[test]
fn without_patience_nobody_waits_even_for_what_is_due_when_the_query_is_ready() {
    let mut bank = bank(false);
    two_of(&mut bank, "rsu1");
    let mut out = Outputs::at(240 * MS);
    bank.on_message(Input::EGO, message("cav1", 2, 200, 260), &mut out)
        .unwrap();
    assert_eq!(outcome(&mut out).0.len(), 1);
}

#[test]
fn a_query_whose_patience_is_over_when_its_turn_comes_is_answered_at_once() {
    // When its turn comes; the wakes that it asks for.
    for (turn, wakes) in [(279, vec![280]), (280, vec![]), (300, vec![])] {
        let mut bank = patient();
        two_of(&mut bank, "rsu1");
        let mut out = Outputs::at(turn * MS);
        bank.on_message(Input::EGO, message("cav1", 2, 200, 250), &mut out)
            .unwrap();
        let asked: Vec<Nanos> = out.take_wakes().into_iter().map(|time| time / MS).collect();
        let answered = outcome(&mut out).0;
        assert_eq!((answered.is_empty(), asked), (!wakes.is_empty(), wakes), "{turn}");
    }
}

#[test]
fn the_ego_does_not_wait_for_itself() {
    let mut bank = patient();
    two_of(&mut bank, "cav1");
    assert_eq!(give(&mut bank, Input::EGO, message("cav1", 2, 200, 250)).0.len(), 1);
}

#[test]
fn waiting_for_one_sender_makes_no_other_stale() {
    let mut bank = patient();
    two_of(&mut bank, "rsu1");
    // 380 ms old when the ego asks, and 405 when it goes on.
    give(&mut bank, Input::OTHERS, message("cav2", 0, -130, 10));
    assert_eq!(give(&mut bank, Input::EGO, message("cav1", 2, 200, 250)).0, []);
    let (answered, _) = give(&mut bank, Input::OTHERS, message("rsu1", 2, 200, 275));
    assert_eq!(answered[0].2, ["cav2:0", "rsu1:2"]);
}

#[test]
fn a_late_older_message_ends_no_wait() {
    let mut bank = patient();
    for (seq, stamp) in [(0, 0), (2, 200)] {
        give(&mut bank, Input::OTHERS, message("rsu1", seq, stamp, stamp + 60));
    }
    assert_eq!(give(&mut bank, Input::EGO, message("cav1", 3, 300, 350)).0, []);
    assert_eq!(give(&mut bank, Input::OTHERS, message("rsu1", 1, 100, 355)).0, []);
    assert_eq!(
        give(&mut bank, Input::OTHERS, message("rsu1", 2, 200, 356)).0,
        [],
        "a copy"
    );
    let (answered, _) = give(&mut bank, Input::OTHERS, message("rsu1", 3, 300, 362));
    assert_eq!(answered[0].2, ["rsu1:3"]);
}
