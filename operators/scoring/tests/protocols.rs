//! Protocols that somebody damaged, by accident or on purpose: a protocol that can be used, or an error that names it.

use damage::{Draw, cases, damaged_yaml};
use realo_scoring::Protocol;

const SOUND: &str = include_str!("../protocols/default.yml");
const WORDS: &[&str] = &[
    "name",
    "region",
    "rule",
    "classes",
    "raw",
    "ignore_case",
    "ious",
    "min_points",
    "seen_points",
    "range_edges",
    "x",
    "y",
    "center",
    "all_bottom_corners",
    "Van",
    "vehicle",
    "Vehicle",
    "",
];

#[test]
fn damaged_protocols_are_protocols_or_errors() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("mine.yml");
    let name = file.to_str().unwrap();
    let (mut taken, mut refused) = (0, 0);
    for case in 0..cases(10_000) {
        let mut draw = Draw::new(case);
        std::fs::write(&file, damaged_yaml(SOUND, &mut draw, WORDS)).unwrap();
        match Protocol::load(name) {
            Ok(protocol) => {
                assert!(protocol.ious.iter().all(|iou| *iou > 0.0 && *iou <= 1.0), "case {case}");
                assert!(protocol.range_edges.iter().all(|edge| edge.is_finite()), "case {case}");
                assert!(
                    protocol
                        .class_of("Van")
                        .is_none_or(|class| usize::from(class) < protocol.classes.len())
                );
                taken += 1;
            }
            Err(error) => {
                let error = error.to_string();
                assert!(error.contains("mine.yml") && error.len() < 2000, "case {case}: {error}");
                refused += 1;
            }
        }
    }
    assert!(
        taken > refused / 50 && refused > taken / 50,
        "{taken} taken, {refused} refused"
    );
}
