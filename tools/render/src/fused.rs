use std::collections::BTreeSet;
use std::path::Path;

use realo_logs::LogError;
use realo_recorder::{FATES, reports_of};
use realo_schemas::Nanos;
use realo_schemas::report::{Crossing, Fated};
use serde::Deserialize;

/// Messages that a fusion used, and their ages: ns from their stamps to when the ego asked.
pub type Fused = Vec<(Crossing, Nanos)>;

/// What the ego's fusion of a sweep used; nothing where none took place.
pub fn fused(recording: &Path, ego: &str, seq: u64) -> Result<Fused, LogError> {
    let mut found = Fused::new();
    each(recording, ego, |query, message, age| {
        if query == seq {
            found.push((message, age));
        }
    })?;
    Ok(found)
}

/// Numbers of the ego's sweeps for which something was fused.
pub fn fused_sweeps(recording: &Path, ego: &str) -> Result<BTreeSet<u64>, LogError> {
    let mut found = BTreeSet::new();
    each(recording, ego, |query, _, _| {
        found.insert(query);
    })?;
    Ok(found)
}

/// Every use of a message for the ego: the number of its sweep, the message and its age, ns.
fn each(recording: &Path, ego: &str, mut found: impl FnMut(u64, Crossing, Nanos)) -> Result<(), LogError> {
    for report in reports_of(recording)? {
        let report = report?;
        if report["topic"] != FATES {
            continue;
        }
        // A document of another form says nothing here.
        let Ok(fates) = Vec::<Fated>::deserialize(&report["report"]) else {
            continue;
        };
        for fated in fates.into_iter().filter(|fated| fated.message.to == ego) {
            if let Some(r#use) = fated.r#use {
                found(r#use.query, fated.message, r#use.age_ns);
            }
        }
    }
    Ok(())
}
