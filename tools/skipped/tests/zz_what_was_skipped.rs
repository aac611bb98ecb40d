//! The last of all tests lists those that were left out.

use std::io::Write;

fn main() {
    let summary = skipped::summary(&skipped::take(&skipped::list()));
    let _ = std::io::stderr().write_all(summary.as_bytes());
}
