//! HOTA against TrackEval, by results that it gave (`data/hota.py`).

use realo_scoring::hota::{Hota, THRESHOLDS, Tally, TrackedFrame, add, tallies};
use serde_json::Value;

fn numbers<T>(value: &Value, of: impl Fn(&Value) -> Option<T>) -> Vec<T> {
    value
        .as_array()
        .expect("a list")
        .iter()
        .map(|one| of(one).expect("a number"))
        .collect()
}

fn frame(frame: &Value) -> TrackedFrame {
    let ids = |key: &str| numbers(&frame[key], |id| Some(id.as_u64()? as usize));
    TrackedFrame {
        truths: ids("truths"),
        detections: ids("detections"),
        overlaps: numbers(&frame["overlaps"], Value::as_f64),
    }
}

fn check(found: Hota, expected: &Value, what: &str) {
    let parts = [
        ("HOTA", found.hota),
        ("DetA", found.detection),
        ("AssA", found.association),
        ("LocA", found.localization),
    ];
    for (name, found) in parts {
        let expected = expected[name].as_f64().expect("a number");
        assert!(
            (found - expected).abs() < 1e-9,
            "{what}: {name} is {found}, TrackEval says {expected}"
        );
    }
}

#[test]
fn hota_is_what_trackeval_says() {
    let document: Value = serde_json::from_str(include_str!("data/hota.json")).expect("JSON");
    let mut together = [Tally::default(); THRESHOLDS];
    let sequences = document["sequences"].as_array().expect("sequences");
    assert!(sequences.len() >= 6);
    for (number, sequence) in sequences.iter().enumerate() {
        let frames: Vec<TrackedFrame> = sequence["frames"]
            .as_array()
            .expect("frames")
            .iter()
            .map(frame)
            .collect();
        let (found, _) = tallies(&frames);
        check(Hota::of(&found), sequence, &format!("sequence {number}"));
        add(&mut together, &found);
    }
    check(Hota::of(&together), &document["together"], "all together");
}
