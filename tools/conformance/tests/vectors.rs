//! The vectors of `$REALO_SHARED/conformance`, where they are at hand.

use std::io::Write;
use std::path::PathBuf;

use realo_conformance::{CaseResult, Status, exit_code, run};

/// The folder that holds conformance vectors and sample data, unless the variable is not set.
fn shared(folder: &str) -> Option<PathBuf> {
    let shared = std::env::var_os("REALO_SHARED").map(|shared| PathBuf::from(shared).join(folder));
    if shared.is_none() {
        // Past the capture of test output, so that nobody misses it.
        let _ = writeln!(
            std::io::stderr(),
            "SKIPPED: set REALO_SHARED to the folder that holds `{folder}` to run this test"
        );
    }
    shared
}

#[test]
fn the_vectors_of_every_supported_folder_pass() {
    let Some(dir) = shared("conformance") else { return };
    let results = run(&dir);
    let of_folder = |folder: &str| -> Vec<&CaseResult> {
        results
            .iter()
            .filter(|result| result.file.starts_with(&format!("{folder}/")))
            .collect()
    };
    let mut failed = Vec::new();
    let folders = [
        ("boxes", 8),
        ("iou_nms", 6),
        ("evaluation", 6),
        ("pillars", 7),
        ("targets", 5),
        ("loss", 2),
        ("postprocess", 3),
    ];
    for (folder, count) in folders {
        let cases = of_folder(folder);
        assert_eq!(cases.len(), count, "{folder}");
        failed.extend(
            cases
                .iter()
                .filter(|case| case.status != Status::Passed)
                .map(|case| case.to_string()),
        );
    }
    assert!(failed.is_empty(), "{}", failed.join("\n"));
    let unsupported = results
        .iter()
        .any(|case| matches!(case.status, Status::NotSupported(_)));
    assert_eq!(exit_code(&results), if unsupported { 3 } else { 0 });
}

#[test]
fn the_single_agent_network_passes() {
    let Some(dir) = shared("conformance") else { return };
    let results = run(&dir);
    for name in [
        "network/scatter",
        "network/backbone_1_1_1",
        "network/backbone_3_5_8",
        "network/shrink_k1",
        "network/shrink_k3",
        "network/head",
        "model/single",
    ] {
        let file = format!("{name}.safetensors");
        let case = results.iter().find(|case| case.file == file);
        let case = case.unwrap_or_else(|| panic!("no vector {file}"));
        assert_eq!(case.status, Status::Passed, "{case}");
    }
}
