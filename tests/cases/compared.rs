//! Runs of graphs that bear one name.

use std::path::{Path, PathBuf};

use crate::common::{self, changed_graph, folder, json, realo_ok};
use crate::scene::{Scene, run_into};

fn run(graph: &Path, log: &Path, out: PathBuf, more: &[&str]) -> PathBuf {
    let output = run_into(&out, "car", graph, log, &[&["--offline"], more].concat());
    assert!(output.status.success(), "{}", common::text(&output.stderr));
    out
}

#[test]
fn graphs_of_one_name_are_told_apart_by_what_was_run() {
    let log = Scene::default().write("compared");
    let home = folder("compared-home");
    let copy = changed_graph(&home.join("copy"), "late_fusion", &[]);
    let changed = changed_graph(
        &home.join("changed"),
        "late_fusion",
        &[("window_ms=400", "window_ms=500")],
    );
    let shipped = PathBuf::from(common::graph("late_fusion"));
    let set = ["--set", "fusion.bank.window_ms=500", "--seed", "3"];
    let at = |name: &str| home.join(name);
    let first = run(&shipped, &log, at("first"), &[]);
    let copied = run(&copy, &log, at("copied"), &[]);
    let edited = run(&changed, &log, at("edited"), &[]);
    let chosen = run(&shipped, &log, at("chosen"), &set);
    let hash = |run: &Path| json(&run.join("result.json"))["graph_hash"].clone();
    assert_eq!(hash(&first), hash(&copied), "where a graph is does not matter");
    assert_eq!(hash(&edited), hash(&chosen), "they ran the same");
    assert_ne!(hash(&first), hash(&edited));
    let compared = |other: &Path| realo_ok(["compare".as_ref(), first.as_os_str(), other.as_os_str()]);
    let note = "note: graphs differ: not all runs have the same `late_fusion`: fusion.bank.window_ms (400 in first; 500 in edited)";
    assert_eq!(compared(&edited).lines().next(), Some(note));
    assert!(!compared(&copied).contains("graphs differ"));
    // A setting is in a row of its own.
    let said = compared(&chosen);
    assert!(
        !said.contains("graphs differ") && said.contains("fusion.bank.window_ms="),
        "{said}"
    );
    let row = said.lines().find(|line| line.trim_start().starts_with("seed "));
    assert!(row.is_some_and(|row| row.ends_with(" 3")), "{said}");
    let given = |run: &Path| json(&run.join("evaluation.json"))["given"].clone();
    assert_eq!(given(&chosen), serde_json::json!(["seed"]));
    assert!(given(&first).is_null());
}
