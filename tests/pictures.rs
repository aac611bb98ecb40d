//! `realo graph`: every shipped graph and a finished run as a picture and in a terminal, and the pictures of the docs.

mod common;

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use common::{changed_graph, folder, json, once, realo, realo_ok, root, run_virtual, simulated, text};
use realo_diagram::{Diagram, Picture, Rect, picture};

/// The pictures of the docs, each with its graph.
const IN_DOCS: [(&str, &str); 3] = [
    ("attfuse", "docs/attfuse.svg"),
    ("late_fusion", "docs/late_fusion.svg"),
    ("late_fusion.vehicle", "docs/guide/late_fusion.vehicle.svg"),
];

fn log() -> PathBuf {
    let args = ["--seed", "77", "--seconds", "2", "--no-clouds", "--agents", "cav1,rsu1"];
    simulated("pictures_small", &args)
}

/// A virtual run over a link that loses, made once.
fn run() -> PathBuf {
    once("pictures_run", |_| {
        let profile = folder("pictures_compute").join("compute.toml");
        fs::write(&profile, "\"fusion.nms\" = 3000000\n").expect("it can be written");
        let profile = profile.to_string_lossy();
        let args = [
            "--recorded-detections",
            "--link",
            "delay_ms=40,loss=0.3",
            "--compute",
            &profile,
        ];
        let args = [&args[..], &["--set", "v2x.link.range_m=1000"]].concat();
        run_virtual("pictures_run", "late_fusion", &log(), &args);
    })
}

fn shipped() -> Vec<PathBuf> {
    let folders = [
        "dataflows",
        "examples/fusion_mean",
        "examples/fusion_nearest",
        "examples/onnx",
        "examples/python",
    ];
    let entries = folders
        .iter()
        .flat_map(|folder| fs::read_dir(root().join(folder)).expect("it can be listed"));
    let mut graphs: Vec<PathBuf> = entries
        .map(|entry| entry.expect("an entry").path())
        .filter(|path| path.extension().is_some_and(|ending| ending == "yml"))
        .collect();
    graphs.sort();
    assert!(graphs.len() > 20);
    graphs
}

fn drawn(path: &Path) -> (Diagram, Picture) {
    let diagram = realo::graph::diagram(path).unwrap_or_else(|error| panic!("{}: {error:#}", path.display()));
    let picture = picture(&diagram);
    (diagram, picture)
}

/// What must be so of every picture, beside what its own tests say.
fn check(name: &str, diagram: &Diagram, picture: &Picture) {
    assert_eq!(picture.boxes.len(), diagram.stages.len(), "{name}");
    assert_eq!(picture.wires.len(), diagram.wires.len(), "{name}: every wire is drawn");
    let rects: Vec<&Rect> = picture.boxes.iter().map(|drawn| &drawn.rect).collect();
    for (at, one) in rects.iter().enumerate() {
        assert!(rects[at + 1..].iter().all(|other| !one.overlaps(other)), "{name}");
    }
    let outputs = diagram.stages.iter().flat_map(|stage| &stage.outputs);
    for output in outputs {
        let types: Vec<&str> = output.payload.split(" or ").collect();
        let known = |name: &&str| {
            realo_schemas::PayloadType::ALL
                .iter()
                .any(|known| known.as_str() == *name)
        };
        assert!(types.iter().all(known), "{name}: {output:?}");
    }
}

#[test]
fn every_shipped_graph_is_drawn_whole() {
    for graph in shipped() {
        let name = graph.display().to_string();
        let (diagram, picture) = drawn(&graph);
        check(&name, &diagram, &picture);
        let flat = realo_graph::FlatGraph::load(&graph).expect("it can be read");
        assert_eq!(diagram.stages.len(), flat.nodes.len(), "{name}");
        assert_eq!(diagram.processes.len(), flat.processes().len(), "{name}");
        let names: BTreeSet<String> = (0..diagram.stages.len()).map(|stage| diagram.name_of(stage)).collect();
        assert!(
            flat.nodes.iter().all(|node| names.contains(&node.id)),
            "{name}: {names:?}"
        );
        let said = realo_diagram::text(
            &diagram,
            realo_diagram::Terminal {
                width: 80,
                colour: false,
            },
        );
        let longest = said.lines().map(|line| line.chars().count()).max();
        assert!(longest <= Some(80), "{name}: {longest:?}\n{said}");
        assert!(
            said.contains("│ player │"),
            "{name}: its processes fit a terminal of 80 columns\n{said}"
        );
    }
}

#[test]
fn modules_keep_their_names() {
    let (diagram, picture) = drawn(&root().join("dataflows/hybrid_features_guarded.yml"));
    let framed: BTreeSet<&str> = picture.frames.iter().map(|frame| frame.name.as_str()).collect();
    for module in ["sense", "detected", "cells", "rest"] {
        assert!(framed.contains(module), "no `{module}` in {framed:?}");
    }
    // A module that only groups processes is named at each.
    let what = |name: &str| {
        diagram
            .processes
            .iter()
            .find(|process| process.name == name)
            .map(|process| &process.what)
    };
    assert!(
        what("others").is_some_and(|what| what.ends_with("in scene")),
        "{:?}",
        what("others")
    );
    assert!(
        what("fusion").is_some_and(|what| what.ends_with("in perception")),
        "{:?}",
        what("fusion")
    );
    assert!(
        diagram.wires.iter().any(|wire| wire.feedback),
        "what the link tells its senders"
    );
}

#[test]
fn pictures_of_the_docs_are_of_the_graphs_as_they_are() {
    let out = folder("pictures_docs");
    for (graph, picture) in IN_DOCS {
        let new = out.join("new.svg");
        let args = ["graph", &format!("dataflows/{graph}.yml"), "-o", &new.to_string_lossy()].map(String::from);
        let said = realo_ok(args);
        assert!(said.contains(graph) && said.contains("stages"), "{said}");
        let [old, new] = [root().join(picture), new].map(|path| fs::read_to_string(path).unwrap_or_default());
        assert!(
            old == new,
            "{picture} is stale: renew it by `realo graph dataflows/{graph}.yml -o {picture}`"
        );
        assert!(new.len() < 80_000, "{} bytes", new.len());
    }
}

#[test]
fn a_run_has_its_rates_latencies_losses_and_bytes_on_its_arrows() {
    let (diagram, picture) = drawn(&run());
    check("run", &diagram, &picture);
    let (graph, _) = drawn(&root().join("dataflows/late_fusion.yml"));
    assert!(diagram.title.starts_with("late_fusion: ") && diagram.wires.len() <= graph.wires.len());
    let result = json(&run().join("result.json"));
    let find = |name: &str| {
        (0..diagram.stages.len())
            .find(|stage| diagram.name_of(*stage) == name)
            .expect("a stage")
    };
    let facts = |stage: &str, output: &str| {
        let ports = &diagram.stages[find(stage)].outputs;
        ports
            .iter()
            .find(|port| port.name == output)
            .map(|port| port.facts.clone())
            .expect("an output")
    };
    let link = facts("v2x.link", "to_ego");
    let books = &result["links"]["rsu1-cav1"]["boxes"];
    let lost = books["lost"].as_u64().expect("a number");
    assert!(lost > 0);
    for part in ["Hz", "boxes ", " KB/s", " ms old", &format!("{lost} lost")] {
        assert!(link.contains(part), "no `{part}` in {link}");
    }
    // Twenty sweeps in two seconds.
    assert_eq!(facts("player", "ego_clouds"), "10.0 Hz");
    assert_eq!(result["nodes"]["player"]["sent"]["ego_clouds"], 20);
    let taken = diagram
        .stages
        .iter()
        .flat_map(|stage| &stage.facts)
        .any(|fact| fact.contains(" ms a call"));
    assert!(taken, "some stage takes the time of the profile");
    let (of_graph, _) = drawn(&root().join("dataflows/late_fusion.yml"));
    let groups = |diagram: &Diagram| -> BTreeSet<String> {
        let names = diagram.groups.iter().map(|group| group.name.clone());
        names.collect()
    };
    assert_eq!(groups(&of_graph).len(), 2);
    assert_eq!(groups(&diagram), groups(&of_graph));
    // The same in the terminal and in the file.
    let said = realo_ok(["graph".into(), run().to_string_lossy().into_owned()]);
    assert!(said.contains(&link) && !said.contains('\u{1b}'), "{said}");
    let file = folder("pictures_of_run").join("run.svg");
    realo_ok([
        "graph".into(),
        run().to_string_lossy().into_owned(),
        "-o".into(),
        file.to_string_lossy().into_owned(),
    ]);
    let svg = fs::read_to_string(&file).expect("it is there");
    assert!(svg.contains(&link), "{svg}");
    roxmltree::Document::parse(&svg).expect("it is XML");
    // One run of it, and without what was recorded.
    let cell = run().join("pictures_small/cav1");
    let copy = folder("pictures_copy");
    for file in ["result.json", "timing.json", "evaluation.json"] {
        fs::copy(cell.join(file), copy.join(file)).expect("it can be copied");
    }
    let (of_one, _) = drawn(&copy.join("result.json"));
    assert_eq!(of_one.wires, diagram.wires);
}

#[test]
fn quotes_and_html_in_names_stay_in_their_place() {
    let home = folder("pictures_names");
    let name = "a<b>&\"c'";
    let graph = changed_graph(&home, "late_fusion", &[]);
    let renamed = graph.with_file_name(format!("{name}.yml"));
    fs::rename(&graph, &renamed).expect("it can be renamed");
    let file = home.join("x.svg");
    realo_ok(["graph", &renamed.to_string_lossy(), "-o", &file.to_string_lossy()]);
    let svg = fs::read_to_string(&file).expect("it is there");
    let document = roxmltree::Document::parse(&svg).expect("it is XML");
    let title = document
        .descendants()
        .find(|node| node.has_tag_name("title"))
        .and_then(|node| node.text());
    assert!(
        title.is_some_and(|title| title.starts_with(&format!("{name}: "))),
        "{title:?}"
    );
    assert!(!svg.contains("<b>"));
}

#[test]
fn wrong_input_is_named_with_what_helps() {
    let dir = folder("pictures_bad");
    let check = |args: &[&str], expected: &[&str]| {
        let said = realo([&["graph"], args].concat());
        let error = text(&said.stderr);
        assert_eq!(said.status.code(), Some(1), "{error}");
        for part in expected {
            assert!(error.contains(part), "no `{part}` in {error}");
        }
    };
    let place = |name: &str| dir.join(name).to_string_lossy().into_owned();
    check(&["late_fusio"], &["late_fusio", "late_fusion"]);
    check(
        &["late_fusion", "-o", &place("x.png")],
        &["x.png", ".svg", "found .png"],
    );
    check(
        &["late_fusion", "-o", &place("gone/x.svg")],
        &["gone/x.svg", "cannot be written", "-o"],
    );
    fs::write(dir.join("mine.svg"), "my notes").expect("it can be written");
    check(&["late_fusion", "-o", &place("mine.svg")], &["mine.svg", "--force"]);
    check(&[&place("")], &["result.json", "no run has come to its end"]);
    let copy = |name: &str, change: &dyn Fn(&str, String) -> String| {
        let folder = dir.join(name);
        fs::create_dir_all(&folder).expect("it can be made");
        for file in ["result.json", "timing.json", "evaluation.json"] {
            let text = fs::read_to_string(run().join(file)).expect("it can be read");
            fs::write(folder.join(file), change(file, text)).expect("it can be written");
        }
        folder.to_string_lossy().into_owned()
    };
    let newer = copy("newer", &|_, text| {
        text.replacen("\"version\": 2", "\"version\": 99", 1)
    });
    check(&[&newer], &["result.json", "version 99", "release that wrote it"]);
    let cut = copy("cut", &|file, text| match file {
        "evaluation.json" => text[..text.len() / 2].to_string(),
        _ => text,
    });
    check(&[&cut], &["cut/evaluation.json", "expected a file of realo", "EOF"]);
    let bare = copy("bare", &|file, text| {
        let mut document: serde_json::Value = serde_json::from_str(&text).expect("it is JSON");
        if file == "evaluation.json" {
            document.as_object_mut().expect("an object").shift_remove("graph");
        }
        document.to_string()
    });
    check(&[&bare], &["bare", "does not say which graph", "realo graph GRAPH"]);
    // A run of a program that did not count has all but rates.
    let old = copy("old", &|_, text| {
        let mut document: serde_json::Value = serde_json::from_str(&text).expect("it is JSON");
        for node in document
            .get_mut("nodes")
            .and_then(|nodes| nodes.as_object_mut())
            .into_iter()
            .flatten()
        {
            node.1.as_object_mut().expect("an object").shift_remove("sent");
        }
        document.to_string()
    });
    let said = realo_ok(["graph", &old]);
    assert!(
        said.contains("no rates") && said.contains(" KB/s") && !said.contains("10.0 Hz"),
        "{said}"
    );
}
