use realo_schemas::report::{Fate, from_report};
use realo_schemas::{Boxes, Payload, PointCloud, Report};

use super::*;

const MS: Nanos = 1_000_000;

fn message(agent: &str, seq: u64, stamp: Nanos, ready: Nanos) -> Message {
    let header = Header::origin(&"run".into(), &agent.into(), Kind::Boxes, seq, stamp * MS, ready * MS);
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

/// Selections and reports.
fn outcome(out: &mut Outputs) -> (Vec<Answered>, Vec<BankReport>) {
    let (mut selections, mut reports) = (Vec::new(), Vec::new());
    for (port, message) in out.take_sent() {
        match message.payload {
            Payload::Selection(Selection { query, entries }) if port == SELECTIONS => {
                let entries = entries
                    .iter()
                    .map(|e| format!("{}:{}", e.header.agent, e.header.seq))
                    .collect();
                selections.push((message.header, query, entries));
            }
            Payload::Report(report) if port == REPORT => {
                assert_eq!((message.header.kind, &*report.topic), (Kind::Report, "bank"));
                reports.push(from_report(&report).unwrap());
            }
            other => panic!("{other:?} on {port:?}"),
        }
    }
    (selections, reports)
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
        let (selections, reports) = outcome(&mut out);
        assert_eq!(selections[0].2, ["rsu1:3"], "offline {offline}");
        let fates: Vec<_> = reports
            .iter()
            .flat_map(|report| &report.departed)
            .map(|departed| (departed.message.seq, departed.fate))
            .collect();
        assert_eq!(fates, [(4, Fate::Rejected), (3, Fate::Unused)], "offline {offline}");
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
    let (selections, reports) = outcome(&mut out);
    assert_eq!(selections, [(query.header.clone(), 7, vec!["rsu1:4".to_string()])]);
    assert_eq!(reports.len(), 1);
    assert_eq!((reports[0].query, reports[0].agent.as_str()), (Some(7), "cav1"));
    assert_eq!(reports[0].selected[0].age_ns, 50 * MS);
    assert_eq!(out.counted("repeated"), 1);
    bank.on_end(&mut out).unwrap();
    let (selections, reports) = outcome(&mut out);
    assert!(selections.is_empty());
    assert_eq!((reports[0].query, reports[0].departed[0].fate), (None, Fate::Unused));
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
    let (selections, reports) = outcome(&mut out);
    assert_eq!(selections[0].2, ["rsu1:0"]);
    assert_eq!(selections[0].0.ready, 150 * MS);
    assert_eq!(reports[0].selected[0].age_ns, -40 * MS);
    bank.on_wake(150 * MS, &mut out).unwrap();
    assert_eq!(outcome(&mut out).0, [], "once only");
}

#[test]
fn answers_what_is_pending_at_the_end() {
    let mut bank = bank(true);
    let mut out = Outputs::at(100 * MS);
    bank.on_input(EGO, message("cav1", 0, 100, 100), &mut out).unwrap();
    bank.on_end(&mut out).unwrap();
    let (selections, reports) = outcome(&mut out);
    assert_eq!((selections.len(), reports.len()), (1, 2));
}

#[test]
fn closes_its_books_without_a_query_and_is_silent_without_a_message() {
    let mut out = Outputs::at(100 * MS);
    bank(false).on_end(&mut out).unwrap();
    assert_eq!(out.take_sent(), []);
    let mut bank = bank(false);
    bank.on_input(OTHERS, message("rsu1", 0, 90, 100), &mut out).unwrap();
    bank.on_end(&mut out).unwrap();
    let (_, reports) = outcome(&mut out);
    assert_eq!(
        (reports[0].agent.as_str(), reports[0].departed[0].fate),
        ("", Fate::InFlight)
    );
}

#[test]
fn reports_are_written_as_documented() {
    let mut bank = bank(false);
    let mut out = Outputs::at(140 * MS);
    bank.on_input(OTHERS, message("rsu1", 3, 0, 100), &mut out).unwrap();
    bank.on_input(OTHERS, message("rsu1", 4, 90, 130), &mut out).unwrap();
    bank.on_input(EGO, message("cav1", 7, 100, 140), &mut out).unwrap();
    let report = out.take_sent().into_iter().find(|(port, _)| *port == REPORT).unwrap().1;
    let (_, report): (Header, Report) = report.into_parts().unwrap();
    let expected = concat!(
        r#"{"query":7,"agent":"cav1","selected":[{"agent":"rsu1","kind":"boxes","seq":4,"age_ns":50000000}],"#,
        r#""departed":[{"agent":"rsu1","kind":"boxes","seq":3,"fate":"superseded"}]}"#
    );
    assert_eq!(report.json, expected);
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
