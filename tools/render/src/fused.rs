use std::collections::BTreeMap;
use std::path::Path;

use realo_logs::LogError;
use realo_recorder::read_reports;
use realo_schemas::Nanos;
use realo_schemas::report::{BankReport, FusionReport, MessageId};
use serde::de::DeserializeOwned;
use serde_json::Value;

/// Messages that a fusion used, and their ages: ns from their stamps to when the ego asked.
pub type Fused = Vec<(MessageId, Nanos)>;

/// What the ego's fusions used, by number of its sweep, as bank and fusion reported it; nothing where none took place.
pub fn fused(recording: &Path, ego: &str) -> Result<BTreeMap<u64, Fused>, LogError> {
    let reports = read_reports(recording)?;
    let of_topic = |topic: &'static str| reports.iter().filter(move |report| report["topic"] == topic);
    let fusions = of_topic("fusion").filter_map(document::<FusionReport>);
    let fusions: BTreeMap<u64, FusionReport> = fusions
        .filter(|fusion| fusion.agent == ego)
        .map(|fusion| (fusion.query, fusion))
        .collect();
    let mut by_sweep = BTreeMap::new();
    for bank in of_topic("bank").filter_map(document::<BankReport>) {
        let Some(fusion) = bank.query.and_then(|query| fusions.get(&query)) else {
            continue;
        };
        if bank.agent == ego {
            let refused =
                |message: &MessageId| fusion.over_limit.contains(message) || fusion.rejected.contains(message);
            let used = bank.selected.into_iter().filter(|selected| !refused(&selected.message));
            let used = used.map(|selected| (selected.message, selected.age_ns));
            by_sweep.insert(fusion.query, used.collect());
        }
    }
    Ok(by_sweep)
}

/// The document of a report; one of another form says nothing here.
fn document<T: DeserializeOwned>(report: &Value) -> Option<T> {
    T::deserialize(&report["report"]).ok()
}
