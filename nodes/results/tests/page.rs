//! What `docs/reference/results.md` says is so.

use realo_results::{Run, RunResult, Samples, Settings, Timing};
use realo_scoring::{Detection, Outline, Truth};

const PAGE: &str = include_str!("../../../docs/reference/results.md");

#[test]
fn the_page_shows_the_units_of_outlines() {
    let outline = Outline::new([10.0, -2.5], 4.5, 1.9, 0.5);
    let truth = Truth {
        class: 0,
        outline,
        points: Some([30, 12]),
    };
    let detection = Detection {
        class: 0,
        score: 0.75,
        outline,
    };
    for row in [
        serde_json::to_string(&truth).unwrap(),
        serde_json::to_string(&detection).unwrap(),
    ] {
        assert!(PAGE.contains(&row), "{row}");
    }
    assert!(PAGE.contains("4.5 m × 1.9 m at (10, -2.5) m, turned by 0.5 rad"));
    assert!(PAGE.contains("micrometres") && PAGE.contains("10⁻⁸ rad"));
}

#[test]
fn the_page_names_every_field() {
    let run = Run {
        result: RunResult::new(Settings::default()),
        timing: Timing::default(),
        samples: Samples::default(),
    };
    let documents = [
        serde_json::to_value(&run.result).unwrap(),
        serde_json::to_value(&run.timing).unwrap(),
        serde_json::to_value(&run.samples).unwrap(),
    ];
    for document in documents {
        for field in document.as_object().unwrap().keys() {
            let named = [format!("`{field}`"), format!("`{field}.")]
                .iter()
                .any(|name| PAGE.contains(name));
            assert!(named, "`{field}` is not explained");
        }
    }
}
