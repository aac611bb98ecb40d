use realo_schemas::report::Fate;
use realo_schemas::{Boxes, Kind, Payload, PointCloud};

use super::*;

const MS: Nanos = 1_000_000;

fn message(agent: &str, seq: u64, stamp: Nanos, ready: Nanos) -> Message {
    let mut header = Header::origin(&"run".into(), &agent.into(), Kind::Boxes, seq, stamp * MS, ready * MS);
    header.to = Some("cav1".into());
    Message::new(header, Boxes::default())
}

fn bank(offline: bool) -> FeatureBank {
    FeatureBank::new(BankConfig {
        offline,
        ..BankConfig::default()
    })
    .unwrap()
}

/// A Selection: its header, its query, and agent and seq of its entries.
type Answered = (Header, u64, Vec<String>);

/// Selections, and what was said of messages.
fn outcome(out: &mut Outputs) -> (Vec<Answered>, Vec<(u64, Fate)>) {
    let mut selections = Vec::new();
    for (port, message) in out.take_sent() {
        match message.payload {
            Payload::Selection(Selection { query, entries }) if port == SELECTIONS => {
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
        bank.on_input(OTHERS, cloud(4, 95), &mut out).unwrap();
        bank.on_input(OTHERS, message("rsu1", 3, 90, 92), &mut out).unwrap();
        bank.on_input(EGO, message("cav1", 7, 100, 140), &mut out).unwrap();
        let error = bank.on_input(OTHERS, cloud(5, 100), &mut out).unwrap_err().to_string();
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
    bank.on_input(OTHERS, message("rsu1", 4, 90, 130), &mut out).unwrap();
    bank.on_input(OTHERS, message("rsu1", 4, 90, 131), &mut out).unwrap();
    let query = message("cav1", 7, 100, 140);
    bank.on_input(EGO, query.clone(), &mut out).unwrap();
    let (selections, fates) = outcome(&mut out);
    assert_eq!(selections, [(query.header.clone(), 7, vec!["rsu1:4".to_string()])]);
    assert_eq!((fates, out.counted("repeated")), (vec![], 1));
    bank.on_end(&mut out).unwrap();
    assert_eq!(outcome(&mut out), (vec![], vec![]), "the fusion says what became of it");
}

#[test]
fn offline_answers_fifty_milliseconds_after_the_stamp() {
    let mut bank = bank(true);
    let mut out = Outputs::at(100 * MS);
    bank.on_input(EGO, message("cav1", 0, 100, 100), &mut out).unwrap();
    assert_eq!(outcome(&mut out).0, []);
    assert_eq!(out.take_wakes().into_iter().collect::<Vec<_>>(), [150 * MS]);
    bank.on_input(OTHERS, message("rsu1", 0, 140, 140), &mut out).unwrap();
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
        bank.on_input(EGO, message("cav1", seq, 100, 100), &mut out).unwrap();
    }
    bank.on_wake(150 * MS, &mut out).unwrap();
    let answered: Vec<u64> = outcome(&mut out).0.iter().map(|(_, query, _)| *query).collect();
    assert_eq!(answered, [4, 3, 5]);
}

#[test]
fn answers_what_is_pending_at_the_end() {
    let mut bank = bank(true);
    let mut out = Outputs::at(100 * MS);
    bank.on_input(EGO, message("cav1", 0, 100, 100), &mut out).unwrap();
    bank.on_end(&mut out).unwrap();
    assert_eq!(outcome(&mut out).0.len(), 1);
}

#[test]
fn closes_its_books_without_a_query_and_is_silent_without_a_message() {
    let mut out = Outputs::at(100 * MS);
    bank(false).on_end(&mut out).unwrap();
    assert_eq!(out.take_sent(), []);
    let mut bank = bank(false);
    bank.on_input(OTHERS, message("rsu1", 0, 90, 100), &mut out).unwrap();
    bank.on_end(&mut out).unwrap();
    assert_eq!(outcome(&mut out), (vec![], vec![(0, Fate::InFlight)]));
}

#[test]
fn says_what_became_of_what_it_will_not_select() {
    let mut bank = bank(false);
    let mut out = Outputs::at(140 * MS);
    bank.on_input(OTHERS, message("rsu1", 3, 0, 100), &mut out).unwrap();
    bank.on_input(OTHERS, message("rsu1", 4, 90, 130), &mut out).unwrap();
    bank.on_input(EGO, message("cav1", 7, 100, 140), &mut out).unwrap();
    assert_eq!(outcome(&mut out).1, [(3, Fate::Superseded)]);
}

#[test]
fn refuses_settings_that_cannot_work() {
    let error = |config| FeatureBank::new(config).err().expect("refused").to_string();
    assert!(
        error(BankConfig {
            max_agents: 0,
            ..BankConfig::default()
        })
        .contains("`max_agents`")
    );
    assert!(
        error(BankConfig {
            forget_ms: 10,
            ..BankConfig::default()
        })
        .contains("`forget_ms`")
    );
}

#[test]
fn arguments_are_the_keys_of_the_configuration() {
    let keys: Vec<String> = realo_operator::config::defaults::<BankConfig>()
        .keys()
        .cloned()
        .collect();
    assert_eq!(
        keys,
        FeatureBank::ARGUMENTS
            .iter()
            .map(|argument| argument.name)
            .collect::<Vec<_>>()
    );
}
