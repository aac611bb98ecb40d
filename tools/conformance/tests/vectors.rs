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
fn boxes_iou_nms_and_evaluation_pass() {
    let Some(dir) = shared("conformance") else { return };
    let results = run(&dir);
    let of_folder = |folder: &str| -> Vec<&CaseResult> {
        results
            .iter()
            .filter(|result| result.file.starts_with(&format!("{folder}/")))
            .collect()
    };
    let mut failed = Vec::new();
    for (folder, count) in [("boxes", 8), ("iou_nms", 6), ("evaluation", 6)] {
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
