//! The logic of the page's scripts, by the test runner of Node.js.

use std::path::Path;
use std::process::Command;

/// The first release of Node.js with a test runner that shows what failed.
const OLDEST: u32 = 20;

/// The version of the Node.js that is installed.
fn version() -> Option<u32> {
    let said = Command::new("node").arg("--version").output().ok()?;
    let said = String::from_utf8(said.stdout).ok()?;
    said.trim().strip_prefix('v')?.split('.').next()?.parse().ok()
}

#[test]
fn the_scripts_of_the_page_pass_their_own_tests() {
    if version().is_none_or(|version| version < OLDEST) {
        skipped::skip(&format!(
            "install Node.js {OLDEST} or newer, for example by `apt-get install nodejs`"
        ));
        return;
    }
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/scripts");
    let entries = std::fs::read_dir(&folder).expect("it can be listed");
    let files = entries.map(|entry| entry.expect("an entry").path());
    let mut tests: Vec<_> = files
        .filter(|file| file.to_string_lossy().ends_with(".test.mjs"))
        .collect();
    tests.sort();
    assert!(tests.len() >= 3, "{tests:?}");
    let output = Command::new("node")
        .args(["--test", "--test-reporter=tap"])
        .args(&tests)
        .output()
        .expect("it was there before");
    let said = String::from_utf8_lossy(&output.stdout);
    let passed = said.lines().find_map(|line| line.strip_prefix("# pass "));
    let passed: Option<u32> = passed.and_then(|count| count.parse().ok());
    assert!(
        output.status.success() && passed >= Some(40),
        "{said}\n{}",
        String::from_utf8_lossy(&output.stderr)
    );
}
