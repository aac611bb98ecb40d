use std::collections::BTreeMap;
use std::path::Path;

use realo_logs::LogError;
use realo_recorder::{FATES, read_reports};
use realo_schemas::Nanos;
use realo_schemas::report::{Crossing, Fated};
use serde::Deserialize;

/// Messages that a fusion used, and their ages: ns from their stamps to when the ego asked.
pub type Fused = Vec<(Crossing, Nanos)>;

/// What the ego's fusions used, by number of its sweep; nothing where none took place.
pub fn fused(recording: &Path, ego: &str) -> Result<BTreeMap<u64, Fused>, LogError> {
    let mut by_sweep: BTreeMap<u64, Fused> = BTreeMap::new();
    for report in read_reports(recording)?
        .iter()
        .filter(|report| report["topic"] == FATES)
    {
        // A document of another form says nothing here.
        let Ok(fates) = Vec::<Fated>::deserialize(&report["report"]) else {
            continue;
        };
        for fated in fates.into_iter().filter(|fated| fated.message.to == ego) {
            if let Some(r#use) = fated.r#use {
                let used = by_sweep.entry(r#use.query).or_default();
                used.push((fated.message, r#use.age_ns));
            }
        }
    }
    Ok(by_sweep)
}
