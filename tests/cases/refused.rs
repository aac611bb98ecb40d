//! Graphs and settings that would give other results than their writer meant: refused, by `validate` as by `run`.

use std::fs;
use std::path::Path;

use crate::common::{self, folder, realo, text};
use crate::scene::{Scene, run, run_into};

/// What `realo validate --no-start` and `realo run` say of late fusion with this change of its files; both must fail.
fn refused(test: &str, change: (&str, &str)) -> [String; 2] {
    let home = folder(&format!("refused-{test}"));
    let graph = common::changed_graph(&home, "late_fusion", &[change]);
    let log = Scene::default().write(&format!("refused-{test}-log"));
    let [graph, log, out] = [graph, log, home.join("out")].map(|path| path.to_string_lossy().into_owned());
    let commands = [
        vec!["validate", "--no-start", &graph],
        vec!["run", &graph, "--offline", "--log", &log, "--out", &out],
    ];
    let said = commands.map(|command| {
        let output = realo(&command);
        let said = text(&output.stdout) + &text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{command:?}: {said}");
        said
    });
    assert!(!Path::new(&out).exists(), "{}", said[1]);
    said
}

fn says(test: &str, change: (&str, &str), parts: &[&str]) {
    for said in refused(test, change) {
        for part in parts {
            assert!(said.contains(part), "{test}: no `{part}` in {said}");
        }
    }
}

#[test]
fn a_setting_that_is_there_twice_names_both() {
    let lane = "lane: modules/detect.network.yml";
    let twice = "lane: modules/detect.network.yml nms.threshold=0.1 nms.threshold=0.9";
    says(
        "twice",
        (lane, twice),
        &["`nms.threshold=0.1`", "`nms.threshold=0.9`", "keep one"],
    );
}

#[test]
fn a_path_with_a_space_is_refused_with_how_to_quote_it() {
    let change = ("log: ../target/realo/demo.mcap", "log: ../my logs/demo.mcap");
    says(
        "space",
        change,
        &[
            "parameter `log`",
            "found `logs/demo.mcap`",
            "\"'../my logs/demo.mcap'\"",
        ],
    );
}

#[test]
fn a_log_or_a_folder_of_results_that_is_missing_or_empty_is_an_error() {
    says(
        "no-log",
        ("log: ../target/realo/demo.mcap, ", ""),
        &["`player`", "$PARAM_LOG", "`params`"],
    );
    let log = ("log: ../target/realo/demo.mcap", "log: \"\"");
    says("empty-log", log, &["`player`", "`log`", "found nothing"]);
    let out = ("out: ../target/realo/late_fusion", "out: \"\"");
    says("empty-out", out, &["`score.results`", "`out`", "found nothing"]);
}

#[test]
fn a_key_of_deploy_that_dora_does_not_have_is_refused_wherever_the_graph_runs() {
    let change = (
        "module: modules/late.yml",
        "module: modules/late.yml\n    deploy: { machin: car }",
    );
    says("deploy", change, &["`machin`", "did you mean `machine`?"]);
}

#[test]
fn senders_and_a_fusion_that_do_not_fit_are_refused() {
    let features = ("others: modules/detect.network.yml", "others: modules/features.yml");
    let parts = [
        "`fusion.receiver`",
        "packets of boxes",
        "packets of features, which `others.sender` sends",
    ];
    says("mixed", features, &parts);
    let kind = (
        "fuse: modules/fuse.boxes.yml",
        "fuse: modules/fuse.boxes.yml receiver.kind=points",
    );
    says(
        "kind",
        kind,
        &["packets of boxes, which `others.sender` sends", "kind=points"],
    );
}

#[test]
fn values_that_do_not_fit_each_other_are_found_without_a_start() {
    let vote = (
        "fuse: modules/fuse.boxes.yml",
        "fuse: modules/fuse.boxes.yml nms.vote=0.01",
    );
    says("vote", vote, &["`fusion.nms`", "`vote`", "found 0.01"]);
    let region = (
        "fuse: modules/fuse.boxes.yml",
        "fuse: \"modules/fuse.boxes.yml nms.region=1,2,3\"",
    );
    says("region", region, &["`fusion.nms`", "`region`", "found 3 numbers"]);
}

#[test]
fn missing_weights_are_found_before_anything_is_made() {
    let home = folder("refused-bare");
    let model = fs::read_to_string(common::root().join("models/lite.toml")).expect("the model can be read");
    let path = home.join("bare.toml");
    fs::write(&path, model).expect("the model can be written");
    let lane = "lane: modules/detect.network.yml";
    let bare = format!("{lane} encoder.model={0} head.model={0}", path.display());
    // A graph of its own: the demo log that it names is not there, and is not made.
    says("weights", (lane, &bare), &["no weights", "`ego.encoder`"]);
    let graph = common::changed_graph(&home, "late_fusion", &[(lane, &bare)]);
    let output = realo(["run", &graph.to_string_lossy(), "--offline"]);
    assert!(text(&output.stderr).contains("no weights"), "{}", text(&output.stderr));
    assert!(!home.join("target").exists(), "the demo log");
}

#[test]
fn settings_of_a_network_beside_recorded_detections_say_what_took_its_place() {
    let home = folder("refused-recorded");
    let lane = "lane: modules/detect.network.yml";
    let change = (
        lane,
        "lane: modules/detect.network.yml encoder.model=../models/lite.toml",
    );
    let graph = common::changed_graph(&home, "late_fusion", &[change]);
    let output = realo(["run", &graph.to_string_lossy(), "--offline", "--recorded-detections"]);
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for part in [
        "no stage `encoder`",
        "--recorded-detections has put modules/detect.recorded.yml in the place of",
    ] {
        assert!(said.contains(part), "{part}: {said}");
    }
}

#[test]
fn roadside_units_that_the_log_does_not_have_are_refused() {
    let log = Scene::default().write("refused-roadside-log");
    let ran = run(
        "late_fusion",
        &log,
        "roadside",
        &["--offline", "--set", "others.sender.roadside=cat"],
    );
    assert_eq!((ran.code, ran.result), (1, None), "{}", ran.err);
    for part in ["`others.sender`", "`roadside`", "found `cat` (did you mean `car`?)"] {
        assert!(ran.err.contains(part), "{part}: {}", ran.err);
    }
}

#[test]
fn results_of_another_version_are_not_resumed_over() {
    let log = Scene::default().write("refused-resume-log");
    let out = folder("refused-resume");
    let graph = common::graph("late_fusion");
    let run = |more: &[&str]| run_into(&out, "car", Path::new(&graph), &log, &[&["--offline"], more].concat());
    assert!(run(&[]).status.success());
    let of_log = out.join(log.file_stem().expect("a name"));
    let result = of_log.join("car/result.json");
    let old = fs::read_to_string(&result)
        .expect("a result")
        .replace("\"version\": 2", "\"version\": 1");
    fs::write(&result, &old).expect("it can be written");
    let output = run(&["--resume"]);
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("version 1") && said.contains("drop --resume"), "{said}");
    assert_eq!(fs::read_to_string(&result).expect("a result"), old);
}

#[test]
fn a_log_without_faults_is_said_to_have_none() {
    let log = Scene::default().write("refused-no-faults");
    let (said, code) = crate::scene::info(&log);
    assert_eq!((said.contains("no problems found"), code), (true, Some(0)), "{said}");
}
