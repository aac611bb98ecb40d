//! Graphs of one name that were not the same.

use std::collections::{BTreeMap, BTreeSet};

use realo_results::{GROUP, Run};

use crate::differences::{by_value, listed};
use crate::settings::{changes, places_of};

/// What stands for an entry that a graph does not have.
const MISSING: &str = "not there";

/// A sentence for each name that several graphs bear, with what differs; changes by `--set` and `--replace` are said elsewhere.
pub fn of_graphs(runs: &[(&str, &Run)]) -> Vec<String> {
    let mut by_name: BTreeMap<&str, Vec<(&str, &Run)>> = BTreeMap::new();
    for (name, run) in runs {
        let settings = &run.result.settings;
        if !settings.graph_hash.is_empty() {
            by_name.entry(&settings.graph).or_default().push((name, run));
        }
    }
    let found = by_name.into_iter().filter_map(|(graph, runs)| of_graph(graph, &runs));
    found.collect()
}

fn of_graph(graph: &str, runs: &[(&str, &Run)]) -> Option<String> {
    let hashes: Vec<(&str, String)> = runs
        .iter()
        .map(|(name, run)| (*name, run.result.settings.graph_hash.clone()))
        .collect();
    if hashes.iter().all(|(_, hash)| *hash == hashes[0].1) {
        return None;
    }
    let said = format!("graphs differ: not all runs have the same `{graph}`");
    if runs.iter().any(|(_, run)| run.samples.graph.is_empty()) {
        return Some(format!("{said}: hash {}", by_value(&hashes)));
    }
    let differing = differing(runs);
    let named: Vec<&str> = differing.iter().map(String::as_str).collect();
    (!named.is_empty()).then(|| format!("{said}: {}", listed(&named)))
}

/// What is not the same in all graphs: `fusion.bank.window_ms (400 in one; 500 in other)`.
fn differing(runs: &[(&str, &Run)]) -> Vec<String> {
    let stages: BTreeSet<&String> = runs.iter().flat_map(|(_, run)| run.samples.graph.keys()).collect();
    let made: Vec<BTreeMap<String, String>> = runs.iter().map(|(_, run)| changes(&run.result.settings.set)).collect();
    let is_everywhere = |key: &&String| made.iter().all(|changes| changes.get(*key) == made[0].get(*key));
    let keys = made.iter().flat_map(BTreeMap::keys).filter(|key| !is_everywhere(key));
    let changed: BTreeSet<&str> = keys.flat_map(|key| places_of(key)).collect();
    let mut found = Vec::new();
    for stage in stages {
        let of_stage = |run: &Run| run.samples.graph.get(stage).cloned();
        let graphs: Option<Vec<_>> = runs.iter().map(|(_, run)| of_stage(run)).collect();
        let Some(graphs) = graphs else {
            found.extend(entry(runs, &changed, stage, None));
            continue;
        };
        let entries: BTreeSet<&String> = graphs.iter().flat_map(BTreeMap::keys).collect();
        // How processes are grouped is for pictures: it changes nothing of a run.
        let entries = entries.into_iter().filter(|key| *key != GROUP);
        let differing = entries.filter_map(|key| entry(runs, &changed, stage, Some(key)));
        found.extend(differing);
    }
    found
}

/// An entry of a stage whose values differ, or the stage itself; `None` where a change by hand explains that.
fn entry(runs: &[(&str, &Run)], changed: &BTreeSet<&str>, stage: &str, key: Option<&str>) -> Option<String> {
    let value = |run: &Run| {
        let entries = run.samples.graph.get(stage)?;
        Some(
            key.map_or("there", |key| entries.get(key).map_or(MISSING, String::as_str))
                .to_string(),
        )
    };
    let values: Vec<(&str, String)> = runs
        .iter()
        .map(|(name, run)| (*name, value(run).unwrap_or_else(|| MISSING.into())))
        .collect();
    let name = match key {
        None => stage.to_string(),
        Some(key) => match key.strip_prefix("settings.") {
            Some(setting) => format!("{stage}.{setting}"),
            None => format!("{stage}: {key}"),
        },
    };
    let is_changed = |text: &str| changed.iter().any(|place| is_in(place, text));
    let is_explained = is_changed(&name) || values.iter().any(|(_, value)| is_changed(value));
    let differs = values.iter().any(|(_, value)| *value != values[0].1);
    (differs && !is_explained).then(|| format!("{name} ({})", by_value(&values)))
}

/// Whether a text names a place: a stage, something of it, or a setting.
fn is_in(place: &str, text: &str) -> bool {
    let rest = text.strip_prefix(place);
    rest.is_some_and(|rest| rest.is_empty() || rest.starts_with(['.', '/', ':']))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::{run, table};

    /// A run of a graph with a bank and a fusion behind it.
    fn ran(hash: &str, window: &str, stages: &[&str]) -> Run {
        let mut run = run("a", "cav1", 1);
        run.result.settings.graph_hash = hash.into();
        for stage in stages {
            let entries = [
                ("runs", "operator"),
                ("settings.window_ms", window),
                ("inputs.in", "fusion.bank/out"),
            ];
            let entries = entries.map(|(key, value)| (key.to_string(), value.to_string()));
            run.samples.graph.insert(stage.to_string(), entries.into());
        }
        run
    }

    fn said(one: &Run, other: &Run) -> Vec<String> {
        of_graphs(&[("one", one), ("other", other)])
    }

    #[test]
    fn graphs_of_one_name_are_compared_by_all_their_settings() {
        let one = ran("12", "400", &["fusion.bank"]);
        assert_eq!(said(&one, &one), [""; 0]);
        let expected = "graphs differ: not all runs have the same `late_fusion`: ";
        let other = ran("34", "500", &["fusion.bank"]);
        let values = "fusion.bank.window_ms (400 in one; 500 in other)";
        assert_eq!(said(&one, &other), [format!("{expected}{values}")]);
        // Of a stage that only one has no setting is named.
        let more = ran("56", "400", &["fusion.bank", "fusion.nms"]);
        let values = "fusion.nms (not there in one; there in other)";
        assert_eq!(said(&one, &more), [format!("{expected}{values}")]);
        let mut wired = one.clone();
        wired.result.settings.graph_hash = "78".into();
        let entries = wired.samples.graph.get_mut("fusion.bank").unwrap();
        entries.insert("inputs.in".into(), "v2x/out".into());
        let values = "fusion.bank: inputs.in (fusion.bank/out in one; v2x/out in other)";
        assert_eq!(said(&one, &wired), [format!("{expected}{values}")]);
        let mut bare = other.clone();
        bare.samples.graph.clear();
        assert_eq!(said(&one, &bare), [format!("{expected}hash 12 in one; 34 in other")]);
    }

    #[test]
    fn other_names_unknown_graphs_and_changes_by_hand_are_no_difference() {
        let one = ran("12", "400", &["fusion.bank"]);
        let mut other = ran("34", "500", &["fusion.bank"]);
        other.result.settings.set = "fusion.bank.window_ms=500".into();
        assert_eq!(said(&one, &other), [""; 0]);
        // The same change in both explains nothing.
        let mut same = one.clone();
        same.result.settings.set.clone_from(&other.result.settings.set);
        assert_eq!(said(&same, &other).len(), 1);
        // In place of the bank stands another stage, and the wires behind it are others.
        let mut replaced = ran("56", "500", &["fusion.bank", "fusion.nms"]);
        replaced.result.settings.set = "fusion.bank=operator mine".into();
        let before = ran("12", "400", &["fusion.bank", "fusion.nms"]);
        let named = said(&before, &replaced).concat();
        assert!(
            named.contains("fusion.nms.window_ms") && !named.contains("fusion.bank"),
            "{named}"
        );
        other.result.settings.set.clear();
        other.result.settings.graph = "attfuse".into();
        assert_eq!(said(&one, &other), [""; 0]);
        let unknown = ran("", "500", &[]);
        assert_eq!(said(&one, &unknown), [""; 0]);
    }

    #[test]
    fn graphs_of_one_name_that_differ_are_a_note_and_no_pool() {
        let [mut one, mut other] = [run("a", "cav1", 1), run("b", "cav1", 2)];
        (one.result.settings.graph_hash, other.result.settings.graph_hash) = ("12".into(), "34".into());
        let error = crate::pool(&[one.clone(), other.clone()]).unwrap_err().to_string();
        assert!(error.contains("graph_hash `12` and `34`"), "{error}");
        let note = "graphs differ: not all runs have the same `late_fusion`: hash 12 in one; 34 in other";
        let text = table(&[("one", &one), ("other", &other)], false, 100);
        assert!(text.contains(&format!("note: {note}")), "{text}");
        let document: serde_json::Value =
            serde_json::from_str(&crate::json(&[("one", &one), ("other", &other)])).unwrap();
        assert_eq!(document["differences"][1], note);
        assert_eq!(document["runs"][0]["result"]["graph_hash"], "12");
    }
}
