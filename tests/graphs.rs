//! Every shipped graph, by our checks and by dora's, and started the plain dora way.

mod common;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use common::machine::decided;
use common::{changed_graph, folder, graph, json, realo, realo_ok, root, run_virtual, simulated, text};
use realo::registry;
use realo_graph::{FlatGraph, Graph, audit, validate};
use serde_json::Value;

fn graphs() -> Vec<PathBuf> {
    let mut graphs: Vec<PathBuf> = std::fs::read_dir(root().join("dataflows"))
        .expect("dataflows can be listed")
        .map(|entry| entry.expect("an entry").path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "yml"))
        .collect();
    graphs.sort();
    assert!(graphs.len() >= 2);
    graphs
}

/// The dora CLI; installed as `realo run` does it.
fn dora() -> PathBuf {
    realo::run::find_dora().expect("dora is there or can be installed")
}

fn dora_ok(args: &[&str], graph: &Path) -> String {
    let output = Command::new(dora())
        .args(args)
        .arg(graph)
        .current_dir(root())
        .output()
        .expect("dora can be started");
    let said = format!("{}\n{}", text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "dora {args:?} {}: {said}", graph.display());
    said
}

#[test]
fn graphs_are_fine_by_our_checks_and_doras() {
    for graph in graphs() {
        let findings = validate(&FlatGraph::load(&graph).expect("it can be read"), &registry());
        assert!(findings.is_empty(), "{}: {findings:#?}", graph.display());
        dora_ok(&["validate", "--strict-types"], &graph);
    }
}

#[test]
fn graphs_of_two_fusions_of_features_differ_in_what_they_are_their_model_and_their_results() {
    let [attfuse, fcooper] =
        ["attfuse", "fcooper"].map(|name| std::fs::read_to_string(graph(name)).expect("the graph can be read"));
    assert_eq!(attfuse.lines().count(), fcooper.lines().count());
    let differing = attfuse.lines().zip(fcooper.lines()).filter(|(a, b)| a != b);
    let differing: Vec<&str> = differing.map(|(line, _)| line).collect();
    assert_eq!(differing.len(), 3, "{differing:#?}");
    for (line, says) in differing.iter().zip(["# ", "env: { MODEL: ", "out: "]) {
        assert!(line.contains(says), "{line}");
    }
    for name in ["attfuse", "fcooper"] {
        let flat = FlatGraph::load(Path::new(&graph(name))).expect("it can be read");
        let model = format!("model=../models/lite-{name}.toml");
        let stages = flat.nodes.iter().filter(|node| node.args.contains(&model));
        let ids: Vec<&str> = stages.map(|node| node.id.as_str()).collect();
        assert_eq!(ids, ["others.encoder", "ego.encoder", "fusion.fusion", "fusion.head"]);
    }
}

#[test]
fn a_strategy_says_what_is_special_about_it() {
    let modules = std::fs::read_dir(root().join("dataflows/modules")).expect("modules can be listed");
    let modules = modules.map(|entry| entry.expect("an entry").path());
    let read = |path: &PathBuf| std::fs::read_to_string(path).expect("it can be read");
    let strategies: Vec<(PathBuf, String)> = graphs().into_iter().map(|path| (path.clone(), read(&path))).collect();
    for (path, text) in &strategies {
        let lines = text.lines().count();
        assert!(lines <= 25, "{}: {lines} lines", path.display());
        let flat = FlatGraph::load(path).expect("it can be read");
        let processes = flat.processes().len();
        assert!(processes <= 6, "{}: {processes} processes", path.display());
    }
    let modules: Vec<String> = modules.map(|path| read(&path)).collect();
    let texts = strategies.iter().map(|(_, text)| text).chain(&modules);
    let lines: Vec<&str> = texts
        .flat_map(|text| text.lines())
        .map(str::trim)
        .filter(|line| !line.is_empty())
        .collect();
    let distinct: std::collections::BTreeSet<&str> = lines.iter().copied().collect();
    assert!(
        2 * distinct.len() >= lines.len(),
        "{} of {} lines",
        distinct.len(),
        lines.len()
    );
}

#[test]
fn types_ports_and_graphs_say_the_same() {
    let differences = audit(&registry(), &root().join("dataflows"));
    assert!(differences.is_empty(), "{differences:#?}");
}

/// A log whose agents have boxes, but no points.
fn boxes_in_motion() -> PathBuf {
    let args = ["--seed", "901", "--seconds", "4", "--no-clouds", "--key-hz", "10"];
    simulated("boxes_in_motion", &args)
}

#[test]
fn boxes_that_are_followed_are_moved_to_the_time_of_the_ego_and_have_identities() {
    let log = boxes_in_motion();
    let run = |out: &str, graph: &str, more: &[&str]| {
        let args = ["--recorded-detections", "--ego", "cav1", "--link", "delay_ms=500"];
        let window = ["--set", "fusion.bank.window_ms=1000"];
        run_virtual(out, graph, &log, &[&args[..], &window, more].concat())
    };
    let still = run("motion_still", "late_fusion", &[]);
    let moved = run("motion_moved", "late_fusion_tracked", &[]);
    let plain = [
        "fusion.fusion.move_boxes=false",
        "fusion.tracker.filter_centers=false",
        "others.tracker.filter_centers=false",
    ];
    let left = run(
        "motion_left",
        "late_fusion_tracked",
        &plain.map(|setting| ["--set", setting]).concat(),
    );
    let ap = |result: &Value| {
        result["accuracy"]["sorted"]["AP"]["vehicle"]["0.5"]
            .as_f64()
            .expect("an AP")
    };
    let [still_ap, moved_ap, left_ap] = [&still, &moved, &left].map(ap);
    assert!(moved_ap > still_ap + 0.05, "{moved_ap} and {still_ap}");
    assert_eq!(left_ap, still_ap, "who only follows boxes changes none");
    let counters = |result: &Value, stage: &str, name: &str| result["nodes"][stage]["counters"][name].as_u64();
    assert!(counters(&moved, "fusion.fusion", "moved_boxes") > counters(&moved, "fusion.fusion", "unmoved_boxes"));
    assert_eq!(counters(&left, "fusion.fusion", "moved_boxes"), None);
    assert!(
        counters(&moved, "others.tracker", "tracked_boxes") > Some(500),
        "{moved}"
    );
    let of = |result: &Value, name: &str| result["tracking"]["vehicle"][name].as_f64();
    assert!(still["tracking"].is_null(), "its boxes have no identities");
    assert!(
        of(&moved, "HOTA") > Some(0.5) && of(&moved, "HOTA") > of(&left, "HOTA"),
        "{moved}"
    );
    assert!(
        of(&moved, "velocity_error_moving").is_some_and(|error| error < 1.5),
        "{moved}"
    );
    let again = run("motion_again", "late_fusion_tracked", &[]);
    assert_eq!(again, moved);
}

#[test]
fn late_fusion_of_boxes_in_motion_runs_on_dora() {
    let log = boxes_in_motion();
    let out = folder("motion_on_dora");
    let (log, to) = (log.to_string_lossy(), out.to_string_lossy());
    let args = [
        "run",
        &graph("late_fusion_tracked"),
        "--recorded-detections",
        "--ego",
        "cav1",
    ];
    realo_ok(args.into_iter().chain(["--log", &*log, "--out", &*to]));
    let result = json(&out.join("result.json"));
    assert_eq!(result["complete"], true);
    assert!(result["tracking"]["vehicle"]["HOTA"].as_f64() > Some(0.3), "{result}");
}

/// A log of four agents with a sweep a second.
fn guarded_log() -> PathBuf {
    let args = [
        "--scenario",
        "mixed",
        "--place",
        "907",
        "--seed",
        "907",
        "--seconds",
        "3",
        "--key-sweeps-only",
    ];
    simulated("guarded", &args)
}

/// AP of vehicles at IoU 0.5 and the result of a run whose settings are changed so.
fn guarded_run(out: &str, graph: &str, changes: &[&str]) -> (f64, Value) {
    let sets: Vec<&str> = changes.iter().flat_map(|change| ["--set", change]).collect();
    let args = ["--recorded-detections", "--offline", "--ego", "cav1"];
    let result = run_virtual(out, graph, &guarded_log(), &[&args[..], &sets].concat());
    let ap = result["accuracy"]["sorted"]["AP"]["vehicle"]["0.5"]
        .as_f64()
        .expect("an AP");
    (ap, result)
}

#[test]
fn a_guard_wins_back_what_wrong_poses_cost_and_costs_nothing_where_they_are_right() {
    let noise = [
        "others.sense.localization.position_noise_m=3",
        "others.sense.localization.heading_noise_deg=1",
    ];
    let (alone, _) = guarded_run("guard_alone", "no_fusion", &[]);
    let (exact, _) = guarded_run("guard_exact", "late_fusion", &[]);
    let (wrong, _) = guarded_run("guard_wrong", "late_fusion", &noise);
    assert!(exact > alone && wrong < alone, "{exact}, {alone} alone, {wrong}");
    let (kept, right) = guarded_run("guard_right", "late_fusion_guarded", &[]);
    assert!(kept >= exact - 0.005, "{kept} of {exact}");
    assert_eq!(
        right["nodes"]["fusion.guard"]["counters"]["corrected_messages"],
        Value::Null,
        "{right}"
    );
    let (won, corrected) = guarded_run("guard_corrects", "late_fusion_guarded", &noise);
    assert!(
        won - wrong >= 0.75 * (exact - wrong),
        "{won} of {exact}, {wrong} without a guard"
    );
    assert!(corrected["nodes"]["fusion.guard"]["counters"]["corrected_messages"].as_u64() > Some(4));
    let (again, _) = guarded_run("guard_again", "late_fusion_guarded", &noise);
    assert_eq!(again, won);
}

#[test]
fn guards_of_points_of_maps_and_of_both_with_boxes_keep_wrong_poses_from_harm() {
    let noise = ["--set", "others.sense.localization.position_noise_m=3"];
    let run_with = |out: &str, graph: &str, guard: &str, more: &[&str]| {
        let result = run_virtual(
            out,
            graph,
            &guarded_log(),
            &[&["--offline", "--ego", "cav1"], more].concat(),
        );
        let map = result["accuracy"]["sorted"]["mAP"]["0.3"].as_f64().expect("an mAP");
        let counters = result["nodes"][guard]["counters"].clone();
        assert_eq!(counters["unchecked_messages"], Value::Null, "{counters}");
        (map, counters)
    };
    let run = |out: &str, graph: &str, more: &[&str]| run_with(out, graph, "fusion.guard", more);
    let (alone, _) = run("guard_sees_alone", "no_fusion", &[]);
    for (graph, guard) in [
        ("early_fusion", "fusion.guard"),
        ("attfuse", "fusion.guard"),
        ("hybrid_fusion", "fusion.points.guard"),
        ("hybrid_features", "fusion.rest.guard"),
    ] {
        let run = |out: &str, graph: &str, more: &[&str]| run_with(out, graph, guard, more);
        let guarded = format!("{graph}_guarded");
        let (exact, _) = run(&format!("guard_{graph}"), graph, &[]);
        let (kept, _) = run(&format!("guard_{guarded}"), &guarded, &[]);
        assert!(kept >= exact - 0.02, "{guarded}: {kept} of {exact}");
        let (wrong, _) = run(&format!("guard_{graph}_wrong"), graph, &noise);
        let (won, counters) = run(&format!("guard_{guarded}_wrong"), &guarded, &noise);
        assert!(
            won > wrong && won >= alone - 0.02,
            "{guarded}: {won}, {wrong} without a guard, {alone} alone"
        );
        assert!(counters["corrected_messages"].as_u64() > Some(0), "{counters}");
    }
    let fcooper = ["--model", "lite-fcooper"];
    let (exact, _) = run("guard_fcooper", "fcooper", &[]);
    let (kept, _) = run("guard_fcooper_guarded", "attfuse_guarded", &fcooper);
    assert!(
        kept > alone && kept >= exact - 0.02,
        "F-Cooper: {kept} of {exact}, {alone} alone"
    );
}

#[test]
fn a_liar_is_left_out_by_name_and_costs_the_others_nothing() {
    let lies = [
        "others.liar.agents=cav2",
        "others.liar.scatter_m=4",
        "others.liar.ghosts=30",
        "others.liar.score=0.99",
    ];
    let (alone, _) = guarded_run("guard_alone_again", "no_fusion", &[]);
    let (guarded, result) = guarded_run("guard_liar", "late_fusion_attacked", &lies);
    let off = [&lies[..], &["fusion.guard.enabled=false"]].concat();
    let (unguarded, _) = guarded_run("guard_off", "late_fusion_attacked", &off);
    assert!(
        unguarded < alone && guarded >= alone - 0.005,
        "{guarded}, {alone} alone, {unguarded} without a guard"
    );
    let books = |agent: &str| result["links"][format!("{agent}-cav1")]["boxes"]["distrusted"].as_u64();
    assert!(books("cav2") > Some(0), "{result}");
    assert_eq!(["rsu1", "rsu2"].map(books), [Some(0); 2]);
    let notes = result["notes"].as_array().expect("notes");
    let named = |note: &Value| {
        note.as_str()
            .is_some_and(|note| note.contains("cav2") && note.contains("left out"))
    };
    assert!(notes.iter().any(named), "{notes:#?}");
}

#[test]
fn noise_in_the_place_of_features_is_left_out_whatever_its_size() {
    let run = |out: &str, graph: &str, more: &[&str]| {
        let args = [&["--offline", "--ego", "cav1", "--model", "lite-attfuse"], more].concat();
        let result = run_virtual(out, graph, &guarded_log(), &args);
        (
            result["accuracy"]["sorted"]["mAP"]["0.3"].as_f64().expect("an mAP"),
            result,
        )
    };
    let (alone, _) = run("noise_alone", "no_fusion", &[]);
    for noise in ["1", "10", "1000"] {
        let liar = format!("others.sender.messages=operator liar agents=cav2 feature_noise={noise}");
        let lies = ["--replace", &liar];
        let (guarded, result) = run(&format!("noise_{noise}"), "attfuse_guarded", &lies);
        assert!(guarded >= alone - 0.005, "{noise}: {guarded}, {alone} alone");
        let books = &result["links"]["cav2-cav1"]["features"];
        let count = |fate: &str| books[fate].as_u64();
        assert!(
            count("used") == Some(0) && count("distrusted") > Some(2),
            "{noise}: {books}"
        );
    }
}

#[test]
fn inputs_that_hang_on_one_wire_do_so_with_others() {
    let mut stages: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for stage in registry().0 {
        let wires = stage.inputs.iter().filter_map(|port| port.wire);
        wires.for_each(|wire| stages.entry(wire).or_default().push(stage.name));
    }
    assert!(!stages.is_empty());
    assert!(stages.values().all(|stages| stages.len() > 1), "{stages:?}");
}

#[test]
fn dora_run_and_dora_start_give_results() {
    realo_ok([
        "run",
        &graph("no_fusion"),
        "--recorded-detections",
        "--offline",
        "--out",
        &folder("demo_made").to_string_lossy(),
    ]);
    // Without networks the cores keep up.
    let dir = folder("recorded_by_dora");
    dora_ok(&["run"], &late_fusion_of_recorded(&dir));
    let kept_up = processed(&dir.join("out/result.json"));
    assert!(kept_up > 50, "{kept_up} of 100 sweeps");
    let result = root().join("target/realo/late_fusion/result.json");
    for start in ["run", "start"] {
        let _ = std::fs::remove_file(&result);
        if start == "run" {
            dora_ok(&["run"], Path::new(&graph("late_fusion")));
        } else {
            let up = Command::new(dora())
                .arg("up")
                .current_dir(root())
                .output()
                .expect("dora can be started");
            assert!(up.status.success(), "dora up: {}", text(&up.stderr));
            let started =
                std::panic::catch_unwind(|| dora_ok(&["start", "--attach"], Path::new(&graph("late_fusion"))));
            let _ = Command::new(dora()).arg("destroy").current_dir(root()).output();
            if let Err(panic) = started {
                std::panic::resume_unwind(panic);
            }
        }
        // Two cores that run three networks beside the rest pass over most of the 100 sweeps.
        let processed = processed(&result);
        assert!(processed > 10, "{processed} of 100 sweeps");
    }
}

/// Late fusion of the demo log's recorded detections, whose results go to a folder.
fn late_fusion_of_recorded(dir: &Path) -> PathBuf {
    let late = Graph::load(Path::new(&graph("late_fusion"))).expect("it can be read");
    let mut flat = late.with_detection("recorded").expand().expect("its modules fit");
    std::os::unix::fs::symlink(flat.types(), dir.join("types")).expect("links can be made");
    for (node, key, value) in [
        ("player", "log", root().join("target/realo/demo.mcap")),
        ("score.results", "out", dir.join("out")),
        ("score.recorder", "path", dir.join("out/recording.mcap")),
    ] {
        flat.set(node, key, &value.to_string_lossy()).expect("the graph has it");
    }
    let path = dir.join("late.yml");
    std::fs::write(&path, flat.to_yaml().expect("it can be written")).expect("the graph can be written");
    path
}

fn processed(result: &Path) -> u64 {
    let result = json(result);
    assert_eq!(result["complete"], true);
    result["frames"]["processed"].as_u64().expect("frames.processed")
}

/// A graph with `module:` wherever it hosts one, so that dora starts a process for each stage.
fn with_a_process_for_each_stage(graph: &FlatGraph) -> String {
    let mut lines = vec!["strict_types: true\nnodes:".to_string()];
    for process in graph.processes() {
        let wires = process.inputs.iter().map(|(port, input)| {
            let queue = input
                .queue_size
                .map_or(String::new(), |size| format!(", queue_size: {size}"));
            format!("{port}: {{ source: {}{queue} }}", input.source)
        });
        let inputs = format!("inputs: {{ {} }}", wires.collect::<Vec<_>>().join(", "));
        lines.push(match process.args.as_slice() {
            [word, module, ..] if word == "host" => {
                let file = Path::new(module).file_name().expect("a file").to_string_lossy();
                format!("  - {{ id: {}, module: modules/{file}, {inputs} }}", process.id)
            }
            args => {
                let types = process.output_types.iter().map(|(port, name)| format!("{port}: {name}"));
                let types = types.collect::<Vec<_>>().join(", ");
                let outputs = process.outputs.iter().cloned().collect::<Vec<_>>().join(", ");
                let (id, args) = (&process.id, args.join(" "));
                format!(
                    "  - {{ id: {id}, path: bin/realo, args: {args}, {inputs}, outputs: [{outputs}], output_types: {{ {types} }} }}"
                )
            }
        });
    }
    lines.join("\n")
}

#[test]
fn a_module_runs_as_a_process_or_as_a_process_for_each_stage() {
    let home = folder("apart");
    let hosted = FlatGraph::load(Path::new(&graph("late_fusion"))).expect("it can be read");
    let apart = changed_graph(&home, "late_fusion", &[]).with_file_name("apart.yml");
    std::fs::write(&apart, with_a_process_for_each_stage(&hosted)).expect("the graph can be written");
    let flat = FlatGraph::load(&apart).expect("it can be read");
    assert_eq!(flat.processes().len(), flat.nodes.len());
    dora_ok(&["validate", "--strict-types"], &apart);
    let apart = apart.to_string_lossy();
    let run = |name: &str, graph: &str, more: &[&str]| {
        let out = home.join(name);
        let args = ["run", graph, "--recorded-detections", "--ego", "cav1", "--out"];
        realo_ok(args.iter().chain(&[&*out.to_string_lossy()]).chain(more));
        json(&out.join("result.json"))
    };
    let virtually = |name: &str, graph: &str| run(name, graph, &["--mode", "virtual", "--link", "paper"]);
    let (one, mut each) = (virtually("one", &graph("late_fusion")), virtually("each", &apart));
    // A host leaves out the stage that sends to nobody.
    let idle = each["nodes"]
        .as_object_mut()
        .and_then(|nodes| nodes.remove("ego.sender"));
    assert!(idle.is_some());
    for (field, value) in one
        .as_object()
        .expect("an object")
        .iter()
        .filter(|(field, _)| !["graph", "graph_hash"].contains(&field.as_str()))
    {
        assert!(each[field] == *value, "{field}: {value} and {}", each[field]);
    }
    let result = run("dora", &apart, &[]);
    assert_eq!(result["complete"], true);
    let processed = result["frames"]["processed"].as_u64().expect("frames.processed");
    assert!(processed > 50, "{processed} of 100 sweeps");
}

#[test]
fn a_broken_graph_is_refused_with_what_mends_it() {
    let home = folder("broken_graph");
    let cases = [
        (
            "modules/fuse.boxes.yml",
            "modules/fuse.boxes.yml nms.treshold=0.2",
            "threshold",
        ),
        (
            "modules/fuse.boxes.yml",
            "modules/fuse.boxes.yml nns.threshold=0.2",
            "`nms`",
        ),
        (
            "modules/fuse.boxes.yml",
            "modules/fuse.boxes.yml nms.threshold=1.5",
            "setting `threshold`: expected 0 to 1, found 1.5",
        ),
        ("modules/fuse.boxes.yml", "modules/fuse.boxen.yml", "fuse.boxen.yml"),
        (
            "path: ../bin/realo\n    args: host modules/v2x.yml",
            "path: ../bin/radio",
            "bin/radio",
        ),
        ("host modules/v2x.yml", "program ../my/links", "my/links"),
        ("{ ego: ego/boxes", "{ ego: ego/packets", "`ego`"),
        (
            "outputs: [to_ego, to_others, on_air]",
            "outputs: [to_ego, to_all, on_air]",
            "to_others",
        ),
        ("modules/detect.network.yml", "detect.away.yml", "--model"),
        (
            "fuse: modules",
            "fuze: modules",
            "has no parameter `fuze` (did you mean `fuse`?)",
        ),
        (", fuse: modules/fuse.boxes.yml", "", "needs the parameter `fuse`"),
        ("modules/late.yml", "modules/later.yml", "later.yml"),
    ];
    let detect = std::fs::read_to_string(root().join("dataflows/modules/detect.network.yml")).expect("it can be read");
    let away = detect
        .replace("lite.toml", "away.toml")
        .replace("../bin", "bin")
        .replace("sense.yml", "modules/sense.yml");
    for (from, to, named) in cases {
        let path = changed_graph(&home, "late_fusion", &[(from, to)]);
        std::fs::write(path.with_file_name("detect.away.yml"), &away).expect("it can be written");
        let output = realo(["validate", &path.to_string_lossy()]);
        let said = format!("{}{}", text(&output.stdout), text(&output.stderr));
        assert_eq!(output.status.code(), Some(1), "{to}: {said}");
        assert!(said.contains(named), "{to}: {said}");
    }
}

#[test]
fn a_graph_without_a_detect_module_takes_no_recorded_detections() {
    let dir = folder("no_module");
    let flat = FlatGraph::load(Path::new(&graph("no_fusion")))
        .expect("it can be read")
        .apart();
    std::fs::write(dir.join("flat.yml"), flat.to_yaml().expect("it can be written")).expect("the graph can be written");
    let output = realo([
        "run",
        &dir.join("flat.yml").to_string_lossy(),
        "--recorded-detections",
        "--offline",
    ]);
    assert_eq!(output.status.code(), Some(1));
    assert!(text(&output.stderr).contains("detect"), "{}", text(&output.stderr));
}

/// Three agents for a second, every sweep scored.
fn shared() -> PathBuf {
    let args = [
        "--seed",
        "911",
        "--seconds",
        "1",
        "--key-hz",
        "10",
        "--agents",
        "cav1,cav2,rsu1",
    ];
    simulated("shared", &args)
}

/// All APs of a run, in the order `sorted`.
fn precisions(result: &Value) -> Vec<f64> {
    let classes = result["accuracy"]["sorted"]["AP"].as_object().expect("classes");
    let of_class = |class: &Value| class.as_object().expect("IoUs").values().cloned().collect::<Vec<_>>();
    classes
        .values()
        .flat_map(of_class)
        .filter_map(|ap| ap.as_f64())
        .collect()
}

/// Bytes of a message with features from `cav2`, all of which were used.
fn bytes_of_a_map(result: &Value) -> u64 {
    let books = &result["links"]["cav2-cav1"]["features"];
    let count = |term: &str| books[term].as_u64().unwrap_or_else(|| panic!("{term} in {books}"));
    assert!(count("used") >= 8 && count("rejected") == 0, "{books}");
    count("bytes") / count("sent")
}

/// Runs a shipped graph of which a stage fails on its messages, into an own folder, and returns `result.json` of it.
fn run_failing(out: &str, name: &str, log: &Path, args: &[&str]) -> Value {
    let out = folder(out);
    let (graph, log, dir) = (graph(name), log.to_string_lossy(), out.to_string_lossy());
    let fixed = ["run", &graph, "--log", &log, "--out", &dir];
    let output = realo(fixed.iter().chain(args));
    assert_eq!(output.status.code(), Some(3), "{}", text(&output.stderr));
    json(&out.join("result.json"))
}

#[test]
fn boxes_cross_as_cpms_and_late_fusion_sees_as_much() {
    let log = shared();
    let run = |name: &str, settings: &[&str]| {
        let settings: Vec<&str> = settings.iter().flat_map(|setting| ["--set", setting]).collect();
        run_virtual(
            name,
            "late_fusion",
            &log,
            &[&["--ego", "cav1", "--offline"], &settings[..]].concat(),
        )
    };
    let plain = run("boxes_plain", &[]);
    let origins = [
        "others.sender.origin=48.1,11.5,500",
        "fusion.receiver.origin=48.1,11.5,500",
    ];
    let cpm = run("boxes_cpm", &[&["others.sender.boxes=cpm"], &origins[..]].concat());
    for sender in ["cav2-cav1", "rsu1-cav1"] {
        let (plain, cpm) = (&plain["links"][sender]["boxes"], &cpm["links"][sender]["boxes"]);
        assert_eq!(
            (&cpm["used"], &cpm["rejected"]),
            (&plain["used"], &plain["rejected"]),
            "{sender}"
        );
        let bytes = [cpm, plain].map(|books| books["bytes"].as_u64().expect("bytes"));
        assert!(bytes[0] > 0 && bytes[0] < bytes[1], "{sender}: {bytes:?}");
    }
    let pairs = precisions(&cpm).into_iter().zip(precisions(&plain));
    for (cpm, plain) in pairs {
        assert!((cpm - plain).abs() < 0.02, "AP {cpm} as CPMs, {plain} as they are");
    }
    // A receiver that takes the map for another place than the sender does refuses what it gets.
    let settings = ["--set", "others.sender.boxes=cpm", "--set", origins[0]];
    let all = [&["--ego", "cav1", "--offline"], &settings[..]].concat();
    let lost = run_failing("boxes_lost", "late_fusion", &log, &all);
    let books = &lost["links"]["cav2-cav1"]["boxes"];
    assert_eq!(
        (&books["used"], &books["rejected"]),
        (&0.into(), &books["sent"]),
        "{books}"
    );
}

#[test]
fn features_cross_in_all_elements_and_detect_alike() {
    let log = shared();
    let run = |name: &str, elements: &str, zstd: &str| {
        let (elements, zstd) = (
            format!("others.sender.elements={elements}"),
            format!("others.sender.zstd={zstd}"),
        );
        let out = format!("elements_{name}");
        let settings = [
            "--set",
            &elements,
            "--set",
            &zstd,
            "--ego",
            "cav1",
            "--offline",
            "--project",
            "sender",
        ];
        run_virtual(&out, "attfuse", &log, &settings)
    };
    let plain = run("plain", "f32", "null");
    let exact = precisions(&plain);
    assert!(exact.len() >= 4 && exact.iter().any(|ap| *ap > 0.5), "{exact:?}");
    let elements = 100 * 256 * 64;
    assert!((4 * elements..4 * elements + 300).contains(&bytes_of_a_map(&plain)));
    // Elements, how they are compressed, most bytes per element, largest difference of an AP.
    for (elements_name, zstd, most, bound) in [
        ("f32", "1", 2.0, 0.0),
        ("f16", "null", 2.01, 0.005),
        ("f16", "1", 1.0, 0.005),
        ("int8", "null", 1.01, 0.02),
        ("int8", "1", 0.6, 0.02),
    ] {
        let result = run(&format!("{elements_name}_{zstd}"), elements_name, zstd);
        let share = bytes_of_a_map(&result) as f64 / elements as f64;
        assert!(share < most, "{elements_name}, zstd={zstd}: {share} bytes per element");
        let found = precisions(&result);
        assert_eq!(found.len(), exact.len());
        for (found, exact) in found.iter().zip(&exact) {
            assert!(
                (found - exact).abs() <= bound,
                "{elements_name}, zstd={zstd}: AP {found}, in f32 {exact}"
            );
        }
    }
}

#[test]
fn a_few_sure_cells_are_worth_the_map() {
    let log = shared();
    let run = |graph: &str, name: &str, more: &[&str]| {
        let settings = ["--ego", "cav1", "--set", "others.encoder.confidence=true"];
        run_virtual(&format!("cells_{name}"), graph, &log, &[&settings, more].concat())
    };
    for graph in ["attfuse", "fcooper"] {
        let dense = run(
            graph,
            &format!("dense_{graph}"),
            &["--set", "others.sender.elements=f32"],
        );
        let within = ["--set", "others.sender.budget_bytes=60000"];
        let sparse = run(graph, &format!("sparse_{graph}"), &within);
        let bytes = bytes_of_a_map(&sparse);
        assert!((50_000..=60_000).contains(&bytes), "{bytes}");
        let [of_all, of_some] = [&dense, &sparse].map(|result| {
            let all = precisions(result);
            all.iter().sum::<f64>() / all.len() as f64
        });
        assert!(
            of_all > 0.3 && of_some >= of_all - 0.01,
            "{graph}: {of_some}, of all cells {of_all}"
        );
    }
    let unknown = [
        "--set",
        "others.encoder.confidence=false",
        "--set",
        "others.sender.budget_bytes=60000",
    ];
    let settings = [
        "--ego",
        "cav1",
        "--mode",
        "virtual",
        "--set",
        "others.encoder.confidence=true",
    ];
    let refused = run_failing("cells_unknown", "attfuse", &log, &[&settings[..], &unknown].concat());
    let first = refused["notes"][0].as_str().unwrap_or_default();
    assert!(
        first.starts_with("others.sender (transmission-encoder) failed on "),
        "{refused}"
    );
}

#[test]
fn the_shipped_v2xvit_sees_more_with_others_than_the_detector_alone_whoever_projects() {
    // The ego does not see half of what is there.
    let args = "--seed 914 --seconds 2 --key-hz 5 --agents cav1,cav2,rsu1";
    let log = simulated("much_hidden", &args.split(' ').collect::<Vec<_>>());
    let run = |out: &str, graph: &str, settings: &[&str]| {
        let result = run_virtual(out, graph, &log, &[&["--ego", "cav1"], settings].concat());
        let all = precisions(&result);
        (all.iter().sum::<f64>() / all.len() as f64, result)
    };
    let (alone, _) = run("v2xvit_alone", "no_fusion", &["--offline"]);
    for (out, settings) in [
        ("v2xvit_sender", &["--offline", "--project", "sender"][..]),
        ("v2xvit_receiver", &["--offline", "--project", "receiver"]),
        ("v2xvit_virtual", &["--project", "sender"]),
    ] {
        let (together, result) = run(out, "v2xvit", settings);
        println!("{out}: mean AP {together}, alone {alone}");
        assert!(bytes_of_a_map(&result) > 100_000);
        assert!(together > alone + 0.05, "{out}: {together}, alone {alone}");
    }
}

/// Books of a kind from `rsu1`.
fn books(result: &Value, kind: &str, term: &str) -> u64 {
    let books = &result["links"]["rsu1-cav1"][kind];
    books[term].as_u64().unwrap_or_else(|| panic!("{term} in {books}"))
}

#[test]
fn boxes_and_cells_share_a_budget_and_see_more_than_boxes_alone() {
    let log = shared();
    let within = [
        "--ego",
        "cav1",
        "--offline",
        "--set",
        "others.sender.follow=false",
        "--set",
        "others.sender.budget_bytes=6700",
    ];
    let result = run_virtual("hybrid_cells", "hybrid_features", &log, &within);
    let frames = books(&result, "boxes", "sent");
    assert_eq!(
        (books(&result, "boxes", "used"), books(&result, "boxes", "rejected")),
        (frames, 0)
    );
    assert!(books(&result, "features", "used") >= 8);
    let bytes = books(&result, "boxes", "bytes") + books(&result, "features", "bytes");
    assert!(
        (5_000 * frames..=6_700 * frames).contains(&bytes),
        "{bytes} in {frames} frames"
    );
    let alone = run_virtual("hybrid_alone", "no_fusion", &log, &["--ego", "cav1", "--offline"]);
    let [together, alone] = [&result, &alone].map(|result| {
        let all = precisions(result);
        all.iter().sum::<f64>() / all.len() as f64
    });
    assert!(together > alone + 0.01, "{together}, alone {alone}");
}

#[test]
fn hybrid_features_keep_within_a_shared_channel() {
    let args = "--seed 912 --seconds 5 --agents cav1,cav2,rsu1,rsu2";
    let log = simulated("crowded_channel", &args.split(' ').collect::<Vec<_>>());
    let result = run_virtual(
        "hybrid_shared",
        "hybrid_features",
        &log,
        &["--ego", "cav1", "--link", "cv2x-measured"],
    );
    let (mut bytes, mut lost) = (0, 0);
    for books in result["links"].as_object().expect("links").values() {
        for kind in ["boxes", "features"] {
            bytes += books[kind]["bytes"].as_u64().unwrap_or(0);
            lost += books[kind]["lost"].as_u64().unwrap_or(0);
        }
    }
    let frames = result["frames"]["total"].as_u64().expect("frames");
    let share = bytes as f64 / (20_000 * frames) as f64;
    assert!((0.6..=1.0).contains(&share), "{share} of the channel");
    assert!(lost == 0, "{lost} were lost");
    let age = result["age_ms"]["p95"].as_f64().expect("an age");
    assert!(age < 200.0, "{age} ms");
    let sender = &result["nodes"]["others.sender"]["counters"];
    assert!(
        sender["budgets"].as_u64() > Some(0) && sender["budget_bytes"].as_u64() > Some(0),
        "{sender}"
    );
}

#[test]
fn hybrid_features_run_on_dora() {
    decided(hybrid_features_on_dora);
}

fn hybrid_features_on_dora() {
    let (log, out) = (shared(), folder("hybrid_realtime"));
    let (log, dir) = (log.to_string_lossy().into_owned(), out.to_string_lossy().into_owned());
    let graph = graph("hybrid_features");
    realo_ok([
        "run", &graph, "--log", &log, "--out", &dir, "--rate", "0.1", "--ego", "cav1",
    ]);
    let result = json(&out.join("result.json"));
    assert_eq!(result["complete"], true);
    for kind in ["boxes", "features"] {
        assert!(books(&result, kind, "used") >= 5, "{}", result["links"]);
    }
    // A perfect link: its words have the budget grow from its first 2,000 bytes to the max.
    let counters = &result["nodes"]["others.sender"]["counters"];
    let mean = counters["budget_bytes"].as_f64().expect("bytes") / counters["budgets"].as_f64().expect("frames");
    assert!(mean > 30_000.0, "{counters}");
}

#[test]
fn features_cross_on_dora_and_their_steps_are_timed() {
    decided(features_on_dora);
}

fn features_on_dora() {
    let (log, out) = (shared(), folder("elements_realtime"));
    let (log, dir) = (log.to_string_lossy().into_owned(), out.to_string_lossy().into_owned());
    let attfuse = graph("attfuse");
    // Which state of the ego a sender has heard last is not the same under both drivers.
    let alike = ["--ego", "cav1", "--project", "receiver"];
    let virtually = run_virtual("elements_virtual", "attfuse", Path::new(&log), &alike);
    let args = ["run", &attfuse, "--log", &log, "--out", &dir, "--rate", "0.1", "--full"];
    let args = [&args[..], &alike].concat();
    let table = realo_ok(args);
    let result = json(&out.join("result.json"));
    assert_eq!(result["frames"]["processed"], virtually["frames"]["processed"]);
    assert_eq!(result["nodes"]["fusion.receiver"]["errors"], 0);
    assert_eq!(
        bytes_of_a_map(&result),
        bytes_of_a_map(&virtually),
        "the same maps crossed"
    );
    let (timing, steps) = (json(&out.join("timing.json")), |stage: &str, timing: &Value| {
        let steps = timing["steps_ms"][stage].as_object().expect("steps").clone();
        assert!(
            steps
                .values()
                .all(|step| step["p50"].is_number() && step["count"].as_u64() > Some(0)),
            "{steps:?}"
        );
        steps.keys().cloned().collect::<Vec<_>>()
    });
    let encoding = ["compression", "packaging", "quantisation", "serialisation", "shuffling"];
    assert_eq!(steps("others.sender", &timing), encoding);
    let decoding = [
        "decompression",
        "dequantisation",
        "deserialisation",
        "parsing",
        "unshuffling",
    ];
    assert_eq!(steps("fusion.receiver", &timing), decoding);
    for step in encoding.iter().map(|step| format!("others.sender, {step}")) {
        assert!(table.contains(&step), "{step} in {table}");
    }
    let virtual_out = Path::new(env!("CARGO_TARGET_TMPDIR")).join("elements_virtual");
    let untimed = json(&virtual_out.join("timing.json"));
    assert_eq!(untimed["steps_ms"], serde_json::json!({}), "virtual time has no clock");
}
