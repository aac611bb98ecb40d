//! What `docs/results.md` says is so.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use realo_results::{Run, RunResult, Samples, Settings, Timing};
use realo_scoring::{Detection, Outline, Truth};

const PAGE: &str = include_str!("../../../docs/results.md");

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

/// Every name that an operator or node of this repository counts under.
fn counters(folder: &Path, found: &mut BTreeSet<String>) {
    let mut entries: Vec<PathBuf> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    entries.sort();
    for path in entries {
        if path.is_dir() {
            counters(&path, found);
            continue;
        }
        if path.extension().is_none_or(|ending| ending != "rs") || path.ends_with("tests.rs") {
            continue;
        }
        let text = fs::read_to_string(&path).unwrap();
        let text = text.split("#[cfg(test)]").next().unwrap_or_default();
        for call in ["out.count(", "script.count(", "count(&counters,", "count(counters,"] {
            for (at, _) in text.match_indices(call) {
                let rest = &text[at + call.len()..];
                let arguments = &rest[..rest.find(';').unwrap_or(rest.len())];
                // Quoted words of the first statement: there may be two to choose from.
                found.extend(arguments.split('"').skip(1).step_by(2).map(String::from));
            }
        }
    }
}

#[test]
fn the_page_explains_every_counter() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let mut found = BTreeSet::new();
    for folder in fs::read_dir(root.join("operators")).unwrap() {
        counters(&folder.unwrap().path().join("src"), &mut found);
    }
    counters(&root.join("nodes/player/src"), &mut found);
    for known in [
        "over_points",
        "out_of_order",
        "unplaced",
        "log_truncated",
        "poses_unusable",
        "tilted_poses",
    ] {
        assert!(found.contains(known), "{known} in {found:?}");
    }
    let missing: Vec<&String> = found
        .iter()
        .filter(|name| !PAGE.contains(&format!("`{name}`")))
        .collect();
    assert!(missing.is_empty(), "not explained: {missing:?}");
}
