//! Bad input gets a clear error, and nothing that is there is lost.

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use common::{folder, graph, json, realo, simulated, text};
use realo::registry;
use realo_graph::{FlatGraph, Graph, InputSource, Severity, validate};
use realo_logs::{AgentInfo, AgentKind, LogInfo, LogWriter};
use realo_schemas::{AgentState, Box3, Boxes, Nanos, PointCloud, PoseStatus};

fn small() -> PathBuf {
    simulated(
        "small",
        &[
            "--seed",
            "906",
            "--seconds",
            "4",
            "--no-clouds",
            "--agents",
            "cav1,rsu1",
            "--key-hz",
            "10",
        ],
    )
}

/// What `realo run` of late fusion says: exit code, standard error.
fn run(args: &[&str]) -> (Option<i32>, String) {
    let options = ["--mode", "virtual", "--recorded-detections"];
    let output = realo([&["run", &graph("late_fusion")][..], &options, args].concat());
    (output.status.code(), text(&output.stderr))
}

#[test]
fn a_cut_log_is_played_up_to_the_cut_and_reported() {
    let dir = folder("cut");
    let whole = fs::read(small()).expect("the log can be read");
    let cut = dir.join("cut.mcap");
    fs::write(&cut, &whole[..whole.len() * 6 / 10]).expect("the log can be written");
    let out = dir.join("out");
    let (code, said) = run(&["--log", &cut.to_string_lossy(), "--out", &out.to_string_lossy()]);
    assert_eq!(code, Some(3), "{said}");
    assert!(said.contains("cut.mcap"), "{said}");
    let frames = json(&out.join("result.json"))["frames"]["processed"]
        .as_u64()
        .expect("frames.processed");
    assert!((10..40).contains(&frames), "{frames} of 40 sweeps before the cut");
}

#[test]
fn of_a_cut_log_with_clouds_no_sweep_is_played_whose_poses_or_detections_are_missing() {
    let args = [
        "--seed",
        "907",
        "--seconds",
        "3",
        "--agents",
        "cav1,rsu1",
        "--key-hz",
        "10",
    ];
    let log = simulated("clouds", &args);
    let whole = fs::read(&log).expect("the log can be read");
    let dir = folder("cut_clouds");
    for percent in [55, 70, 85, 99] {
        let cut = dir.join(format!("cut{percent}.mcap"));
        fs::write(&cut, &whole[..whole.len() * percent / 100]).expect("the log can be written");
        let out = dir.join(format!("out{percent}"));
        let (code, said) = run(&["--log", &cut.to_string_lossy(), "--out", &out.to_string_lossy()]);
        assert_eq!(code, Some(3), "{percent} %: {said}");
        let frames = &json(&out.join("result.json"))["frames"];
        assert_eq!(frames["skipped"], 0, "{percent} %: {frames}");
        let total = frames["total"].as_u64().expect("frames.total");
        assert!((1..30).contains(&total), "{percent} %: {total} sweeps before the cut");
    }
}

#[test]
fn what_the_log_does_not_have_is_named_with_what_it_has() {
    let log = small();
    let log = log.to_string_lossy();
    let cases: [(&[&str], &[&str]); 6] = [
        (&["--log", &log, "--ego", "cav7"], &["cav7", "cav1", "rsu1"]),
        (&["--log", &log, "--agents", "cav1,bus"], &["bus", "rsu1"]),
        (
            &["--log", &log, "--coop", "v2v", "--ego", "rsu1"],
            &["rsu1", "v2v", "cav1"],
        ),
        (
            &["--log", &log, "--set", "fusion.bank.windowms=3"],
            &["windowms", "window_ms"],
        ),
        (
            &["--log", &log, "--set", "fusion.bnak.window_ms=3"],
            &["fusion.bnak", "fusion.bank"],
        ),
        (&["--log", "nowhere.mcap"], &["nowhere.mcap"]),
    ];
    for (args, named) in cases {
        let (code, said) = run(args);
        assert_eq!(code, Some(1), "{args:?}: {said}");
        assert!(named.iter().all(|name| said.contains(name)), "{args:?}: {said}");
    }
}

#[test]
fn a_run_that_fails_before_its_first_message_leaves_no_folder_behind() {
    let dir = folder("fails");
    let file = |name: &str, text: &str| {
        fs::write(dir.join(name), text).expect("the file can be written");
        dir.join(name).to_string_lossy().into_owned()
    };
    let (log, compute) = (small(), file("compute.toml", "nobody = 5"));
    let (log, broken) = (log.to_string_lossy(), file("broken.yml", "nodes: [{ id: a }]"));
    let (late, none) = (graph("late_fusion"), graph("no_fusion"));
    // A file of somebody else where the second graph's results would go.
    fs::create_dir_all(dir.join("occupied/no_fusion")).expect("the folder can be made");
    file("occupied/no_fusion/result.json", "{}");
    let cases: [(&str, &[&str]); 5] = [
        ("graph", &[&broken, "--log", &log]),
        ("log", &[&late, "--log", "nowhere.mcap"]),
        ("argument", &[&late, "--log", &log, "--set", "fusion.bank.window_ms=x"]),
        // Found when folders are there already.
        ("compute", &[&late, "--log", &log, "--compute", &compute]),
        ("occupied", &[&late, &none, "--log", &log]),
    ];
    for (name, args) in cases {
        let out = dir.join(name).to_string_lossy().into_owned();
        let options = ["--mode", "virtual", "--recorded-detections", "--out", &out];
        let output = realo([&["run"][..], args, &options].concat());
        assert_eq!(output.status.code(), Some(1), "{name}: {}", text(&output.stderr));
    }
    let mut left: Vec<String> = fs::read_dir(&dir)
        .expect("the folder is there")
        .chain(fs::read_dir(dir.join("occupied")).expect("it was there before"))
        .map(|entry| {
            entry
                .expect("it can be read")
                .file_name()
                .to_string_lossy()
                .into_owned()
        })
        .collect();
    left.sort();
    assert_eq!(left, ["broken.yml", "compute.toml", "no_fusion", "occupied"]);
}

#[test]
fn an_ego_without_collaborators_runs_alone_and_says_so() {
    let out = folder("alone");
    let (code, said) = run(&[
        "--log",
        &small().to_string_lossy(),
        "--coop",
        "v2v",
        "--out",
        &out.to_string_lossy(),
    ]);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("runs alone"), "{said}");
    assert_eq!(json(&out.join("result.json"))["frames"]["processed"], 40);
}

#[test]
fn a_network_on_a_log_without_points_is_refused() {
    let log = small();
    let output = realo(["run", &graph("no_fusion"), "--offline", "--log", &log.to_string_lossy()]);
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for named in ["without points", "`ego.encoder`", "--recorded-detections"] {
        assert!(said.contains(named), "`{named}` in: {said}");
    }
}

#[test]
fn options_that_exclude_each_other_are_refused() {
    for args in [
        &["--offline", "--mode", "realtime"][..],
        &["--offline", "--link", "paper"],
        &["--mode", "virtual", "--rate", "2"],
    ] {
        let output = realo([&["run", &graph("late_fusion")][..], args].concat());
        assert_eq!(output.status.code(), Some(1), "{args:?}");
        assert!(
            text(&output.stderr).contains("drop") || text(&output.stderr).contains("--rate"),
            "{args:?}"
        );
    }
}

/// Late fusion of recorded detections, wired anew.
fn rewired(name: &str, change: impl FnOnce(&mut FlatGraph)) -> PathBuf {
    let graph = Graph::load(Path::new(&graph("late_fusion"))).expect("the graph can be read");
    let flat = graph.with_detection("recorded").expand().expect("it can be expanded");
    let mut flat = flat.apart();
    change(&mut flat);
    let dir = folder(name);
    std::os::unix::fs::symlink(flat.types(), dir.join("types")).expect("links can be made");
    let path = dir.join(format!("{name}.yml"));
    fs::write(&path, flat.to_yaml().expect("it can be written")).expect("the graph can be written");
    path
}

/// Wires an input of a node anew, and says which type it takes.
fn wire(flat: &mut FlatGraph, [id, port]: [&str; 2], [from, output]: [&str; 2], takes: &str) {
    let node = flat.nodes.iter_mut().find(|node| node.id == id);
    let node = node.unwrap_or_else(|| panic!("no node {id}"));
    let input = node
        .inputs
        .get_mut(port)
        .unwrap_or_else(|| panic!("no input {port} of {id}"));
    input.source = InputSource::Output {
        node: from.into(),
        output: output.into(),
    };
    node.input_types.insert(port.into(), format!("realo/v1/{takes}"));
}

fn run_rewired(path: &Path) -> std::process::Output {
    let (log, out) = (small(), path.with_file_name("out"));
    let mut args: Vec<std::ffi::OsString> = vec!["run".into(), path.into(), "--mode".into(), "virtual".into()];
    args.extend(["--log".into(), log.into(), "--out".into(), out.into()]);
    realo(args)
}

#[test]
fn what_cannot_be_fused_with_the_egos_data_is_rejected_in_the_books() {
    let path = rewired("wrong_payload", |flat| {
        wire(
            flat,
            ["others.sender", "messages"],
            ["others.sense.localization", "clouds"],
            "PointCloud",
        );
        wire(
            flat,
            ["fusion.bank", "others"],
            ["fusion.receiver", "messages"],
            "PointCloud",
        );
        let decoder = flat.nodes.iter_mut().find(|node| node.id == "fusion.receiver");
        let types = &mut decoder.expect("the graph has a decoder").output_types;
        types.insert("messages".into(), "realo/v1/PointCloud".into());
    });
    let output = run_rewired(&path);
    assert_eq!(output.status.code(), Some(3), "{}", text(&output.stderr));
    let result = json(&path.with_file_name("out").join("result.json"));
    let books = &result["links"]["rsu1-cav1"]["points"];
    assert!(books["sent"].as_u64().is_some_and(|sent| sent > 0), "{result}");
    assert_eq!(books["rejected"], books["sent"], "{books}");
    let first = result["notes"][0].as_str().unwrap_or_default();
    assert!(first.starts_with("fusion.bank (feature-bank) failed on "), "{first}");
}

#[test]
fn a_link_without_the_states_of_agents_is_refused() {
    for missing in ["ego_state", "states"] {
        let path = rewired("no_states", |flat| {
            let link = flat
                .nodes
                .iter_mut()
                .find(|node| node.id == "v2x.link")
                .expect("a link");
            link.inputs.remove(missing);
            link.input_types.remove(missing);
        });
        let findings = validate(&FlatGraph::load(&path).expect("it can be read"), &registry());
        let found = findings
            .iter()
            .any(|f| f.severity == Severity::Error && f.node == "v2x.link" && f.port.as_deref() == Some(missing));
        assert!(found, "{missing}: {findings:?}");
        let output = run_rewired(&path);
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{missing}: {said}");
        assert!(said.contains("`v2x.link`") && said.contains(missing), "{said}");
    }
}

/// Sweeps of the odd log.
const SWEEPS: Nanos = 5;

fn standing() -> AgentState {
    AgentState {
        map_from_body: Default::default(),
        covariance: None,
        velocity: None,
        angular_rate: None,
        status: PoseStatus::Recorded,
    }
}

/// A log of one vehicle, a point cloud and its detections a sweep.
fn odd(name: &str, cloud: &PointCloud, detections: Option<&[Box3]>) -> PathBuf {
    odd_with(name, cloud, detections, Some(&[car([10.0, 0.0, 0.8], [4.0, 2.0, 1.6])]))
}

/// The same with this ground truth, or none.
fn odd_with(name: &str, cloud: &PointCloud, detections: Option<&[Box3]>, truth: Option<&[Box3]>) -> PathBuf {
    let path = folder(name).join("odd.mcap");
    let agent = AgentInfo {
        name: "cav1".into(),
        kind: AgentKind::Vehicle,
        footprint: None,
        sensor: String::new(),
        sensor_position: None,
    };
    let mut writer = LogWriter::create(&path, &LogInfo::new("odd", vec![agent])).expect("the log can be made");
    let write = |writer: &mut LogWriter, sweep: Nanos| {
        let (stamp, ready) = (1_000_000_000 + sweep * 100_000_000, 1_050_000_000 + sweep * 100_000_000);
        writer.pose("cav1", stamp, stamp, &standing())?;
        writer.cloud("cav1", stamp, ready, cloud)?;
        if let Some(detections) = detections {
            writer.detections("cav1", stamp, ready, &Boxes(detections.to_vec()))?;
        }
        match truth {
            Some(truth) => writer.truth("cav1", stamp, ready, truth, Some(&vec![9; truth.len()]), true),
            None => Ok(()),
        }
    };
    for sweep in 0..SWEEPS {
        write(&mut writer, sweep).expect("a sweep can be written");
    }
    writer.finish().expect("the log can be finished");
    path
}

fn car(center: [f64; 3], [length, width, height]: [f64; 3]) -> Box3 {
    Box3 {
        center,
        length,
        width,
        height,
        class: "Car".into(),
        score: 0.9,
        yaw: 0.0,
        velocity: None,
        track: None,
        covariance: None,
    }
}

fn cloud(points: &[[f32; 3]]) -> PointCloud {
    let column = |axis: usize| points.iter().map(|point| point[axis]).collect::<Vec<_>>();
    let n = points.len();
    PointCloud::new(column(0), column(1), column(2), vec![0; n], vec![0; n], vec![0u16; n])
        .expect("columns of one length")
}

/// Runs no fusion on a log, expects an exit code, and returns what it said and `result.json`.
fn run_odd(log: &Path, code: i32) -> (String, serde_json::Value) {
    let out = log.with_file_name("out");
    let args = [
        "--mode",
        "virtual",
        "--log",
        &log.to_string_lossy(),
        "--out",
        &out.to_string_lossy(),
    ]
    .map(String::from);
    let start = ["run".to_string(), graph("no_fusion"), "--recorded-detections".into()];
    let output = realo(start.into_iter().chain(args));
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{said}");
    (said, json(&out.join("result.json")))
}

#[test]
fn points_that_are_no_numbers_are_dropped_and_counted() {
    let points = [
        [10.0, 0.0, 1.0],
        [f32::NAN, 0.0, 0.0],
        [5.0, f32::INFINITY, 0.0],
        [5.0, 5.0, f32::NEG_INFINITY],
    ];
    let (_, result) = run_odd(&odd("odd_points", &cloud(&points), Some(&[])), 0);
    assert_eq!(result["nodes"]["ego.sense.sync"]["counters"]["nan_points"], 3 * SWEEPS);
    assert_eq!(result["frames"]["processed"], SWEEPS);
}

#[test]
fn an_empty_cloud_is_a_frame_like_any_other() {
    let (_, result) = run_odd(&odd("odd_empty", &PointCloud::empty(), Some(&[])), 0);
    assert_eq!(result["frames"]["processed"], SWEEPS);
    assert_eq!(common::counts(&result, "vehicle", "0.5"), (0, 0, SWEEPS as u64));
}

#[test]
fn boxes_without_extent_or_with_nan_are_dropped_and_counted() {
    let good = car([10.0, 0.0, 0.8], [4.0, 2.0, 1.6]);
    let boxes = [
        car([20.0, 0.0, 0.8], [0.0, 2.0, 1.6]),
        car([f64::NAN, 0.0, 0.8], [4.0, 2.0, 1.6]),
        car([30.0, 0.0, 0.8], [4.0, f64::INFINITY, 1.6]),
        good,
    ];
    let (_, result) = run_odd(&odd("odd_boxes", &cloud(&[[10.0, 0.0, 1.0]]), Some(&boxes)), 3);
    assert_eq!(result["nodes"]["ego.recorded"]["counters"]["invalid_boxes"], 3 * SWEEPS);
    assert_eq!(
        common::counts(&result, "vehicle", "0.5"),
        (SWEEPS as u64, 0, SWEEPS as u64)
    );
}

#[test]
fn a_missing_topic_is_named_with_what_the_log_has() {
    let log = odd("odd_topic", &cloud(&[[10.0, 0.0, 1.0]]), None);
    let (code, said) = run(&[
        "--log",
        &log.to_string_lossy(),
        "--out",
        &log.with_file_name("out").to_string_lossy(),
    ]);
    assert_eq!(code, Some(1), "{said}");
    for named in ["odd.mcap", "/cav1/detections", "points", "pose"] {
        assert!(said.contains(named), "`{named}` in: {said}");
    }
}

#[test]
fn two_agents_with_one_name_are_refused() {
    let bytes = fs::read(small()).expect("the log can be read");
    let (name, twin) = (br#""name":"rsu1""#, br#""name":"cav1""#);
    let mut twins = bytes.clone();
    let found: Vec<usize> = (0..bytes.len() - name.len())
        .filter(|at| bytes[*at..].starts_with(name))
        .collect();
    assert!(!found.is_empty(), "the log names its agents");
    found
        .iter()
        .for_each(|at| twins[*at..at + twin.len()].copy_from_slice(twin));
    let log = folder("twins").join("twins.mcap");
    fs::write(&log, twins).expect("the log can be written");
    let (code, said) = run(&[
        "--log",
        &log.to_string_lossy(),
        "--out",
        &log.with_file_name("out").to_string_lossy(),
    ]);
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("twins.mcap") && said.contains("cav1"), "{said}");
}

#[test]
fn a_full_disk_while_recording_fails_the_run_by_name() {
    let out = folder("full");
    let out = out.to_string_lossy();
    let (code, said) = run(&[
        "--log",
        &small().to_string_lossy(),
        "--out",
        &out,
        "--set",
        "score.recorder.path=/dev/full",
    ]);
    assert_eq!(code, Some(1), "{said}");
    assert!(
        said.contains("recorder") && said.contains("No space left on device"),
        "{said}"
    );
}

#[test]
fn a_log_that_is_played_is_never_recorded_into() {
    let dir = folder("refused").join("recording/cav1");
    fs::create_dir_all(&dir).expect("a folder");
    let log = dir.join("recording.mcap");
    fs::copy(small(), &log).expect("a copy");
    let out = dir.ancestors().nth(2).expect("a folder").to_string_lossy().into_owned();
    let log_name = log.to_string_lossy();
    let cases: [&[&str]; 2] = [
        &["--log", &log_name, "--ego", "cav1", "--out", &out],
        &[
            "--log",
            &log_name,
            "--out",
            "unused",
            "--set",
            &format!("score.recorder.path={log_name}"),
        ],
    ];
    for args in cases {
        let (code, said) = run(args);
        assert_eq!(code, Some(1), "{said}");
        assert!(said.contains("which is played"), "{said}");
        assert_eq!(
            fs::read(&log).expect("the log is there"),
            fs::read(small()).expect("the log")
        );
    }
}

#[test]
fn results_of_others_and_of_the_run_before_outlive_a_run_that_fails() {
    let dir = folder("claimed");
    let (log, out) = (small(), dir.join("out"));
    let (log, out) = (log.to_string_lossy(), out.to_string_lossy());
    let cell = dir.join("out/small/cav1");
    fs::create_dir_all(&cell).expect("a folder");
    fs::write(cell.join("result.json"), "{\"mine\": 1}").expect("a file");
    let args = ["--log", &log, "--out", &out, "--ego", "cav1"];
    let (code, said) = run(&args);
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("result.json"), "{said}");
    assert_eq!(
        fs::read_to_string(cell.join("result.json")).expect("it is there"),
        "{\"mine\": 1}"
    );
    fs::remove_file(cell.join("result.json")).expect("it is ours");

    assert_eq!(run(&args).0, Some(0));
    let files = || {
        [
            "out/result.json",
            "out/small/cav1/result.json",
            "out/small/cav1/recording.mcap",
        ]
        .map(|file| fs::read(dir.join(file)).expect("the run before wrote it"))
    };
    let before = files();
    let (code, said) = run(&[&args[..], &["--link", "papr"]].concat());
    assert!(code == Some(1) && said.contains("papr"), "{said}");
    assert!(files() == before, "what is wrong with the graph is found before");
    // Found when folders are claimed.
    let compute = dir.join("compute.toml");
    fs::write(&compute, "nobody = 5").expect("the file can be written");
    let (code, said) = run(&[&args[..], &["--compute", &compute.to_string_lossy()]].concat());
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("nobody") && said.contains("the run before"), "{said}");
    assert!(files() == before, "a run that fails changes nothing of the run before");
}

#[test]
fn what_an_option_decides_cannot_be_set_beside_it() {
    let log = small();
    let log = log.to_string_lossy();
    for (set, option) in [
        ("player.ego=rsu1", "--ego"),
        ("v2x.link.ego=rsu1", "--ego"),
        ("score.results.out=elsewhere", "--out"),
    ] {
        let (code, said) = run(&["--log", &log, "--ego", "cav1", "--set", set]);
        assert_eq!(code, Some(1), "{set}: {said}");
        assert!(said.contains(option), "{set}: {said}");
    }
}

#[test]
fn what_a_node_cannot_run_with_is_reported_before_dora_starts() {
    let dir = folder("examined");
    let (log, out) = (small(), dir.join("out"));
    let run = [
        "run".into(),
        graph("late_fusion.vehicle"),
        "--recorded-detections".into(),
        "--log".into(),
    ];
    let run = [
        &run[..],
        &[log.display().to_string(), "--out".into(), out.display().to_string()],
    ]
    .concat();
    for (set, expected) in [
        (&["v2x.deadline_ms=-3"][..], "setting `deadline_ms`: expected above 0"),
        (&["v2x.site=a*b"], "node `v2x`: setting `site`"),
        (&["v2x.max_bytes=3"], "`max_bytes`"),
        (&["v2x.key=none.key"], "setting `trust`: expected a file"),
        (&["v2x.key=none.key", "v2x.trust=none.toml"], "setting `key`: none.key"),
        (&["v2x.zenoh=/nope"], "setting `zenoh`: /nope"),
        (&["player.skew_ms=1e9"], "setting `skew_ms`: expected -10000000 to"),
        (
            &["fusion.bank.forget_ms=1", "v2x.site=a*b"],
            "node `fusion.bank`: setting `forget_ms`",
        ),
    ] {
        let sets = set.iter().flat_map(|set| ["--set".to_string(), set.to_string()]);
        let output = realo(run.iter().cloned().chain(sets));
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{set:?}: {said}");
        assert!(
            said.contains("cannot run") && said.contains(expected),
            "{set:?}: {said}"
        );
        assert!(!said.contains("dora"), "{set:?}: {said}");
    }
    assert!(!out.exists(), "nothing was started");
}

#[test]
fn what_a_node_cannot_run_with_is_found_by_validate() {
    let home = folder("validated");
    let validate = |change: (&str, &str)| {
        let path = common::changed_graph(&home, "late_fusion.vehicle", &[change]);
        let output = realo(["validate".as_ref(), path.as_os_str()]);
        (output.status.code(), text(&output.stdout))
    };
    assert_eq!(validate(("strict_types", "strict_types")).0, Some(0));
    let listen = "listen=tcp/0.0.0.0:7447";
    for (from, to, expected) in [
        (
            "radio: agent=cav1",
            "radio:",
            "node `v2x`: setting `agent`: expected a name",
        ),
        (listen, "", "node `v2x`: settings `listen`, `connect`"),
        (
            "agent=cav1 listen=tcp/0.0.0.0:7447",
            "'agent=cav1 listen=tcp/0.0.0.0:7447,tcp/10.0.0.1:7448'",
            "found tcp/0.0.0.0:7447 and tcp/10.0.0.1:7448",
        ),
        (
            listen,
            "listen=tcp/0.0.0.0:7447 key=keys/a.key trust=keys/b.toml",
            "setting `key`: keys/a.key",
        ),
        (
            "radio: agent=cav1",
            "radio: agent=cav2",
            "node `v2x`: expected `agent=cav1`, as node `player` has it, found `cav2`",
        ),
        (
            "log-recorder agent=$PARAM_AGENT",
            "log-recorder agent=rsu1",
            "node `log`: expected `agent=cav1`",
        ),
        (
            "log-recorder agent=$PARAM_AGENT",
            "log-recorder",
            "found setting `agent`: expected a value, found nothing",
        ),
    ] {
        let (code, said) = validate((from, to));
        assert_eq!(code, Some(1), "{to}: {said}");
        assert!(said.contains(expected), "{to}: {said}");
    }
    // Files are seen from the graph's folder.
    let keys = home.join("dataflows/keys").display().to_string();
    fs::create_dir(&keys).expect("a folder");
    assert!(realo(["keys", "new", "cav1", "-o", &keys]).status.success());
    let keys = format!("{listen} key=keys/cav1.key trust=keys/cav1.pub");
    let (code, said) = validate((listen, &keys));
    assert_eq!(code, Some(0), "{said}");
}

#[test]
fn negative_numbers_are_reported_the_range() {
    let output = realo(["run", &graph("late_fusion"), "--rate", "-2"]);
    let said = text(&output.stderr);
    assert!(!output.status.success(), "{said}");
    assert!(said.contains("--rate: expected a positive number, found -2"), "{said}");
}

#[test]
fn a_clock_that_is_said_twice_is_no_choice() {
    let log = small().to_string_lossy().into_owned();
    let clocks = ["--clock", "rsu1=0", "--clock", "rsu1=5"];
    let said = text(&realo(["merge", &log, &log, "-o", "unused.mcap"].iter().chain(&clocks)).stderr);
    assert!(said.contains("--clock rsu1: expected one for each agent"), "{said}");
}

#[test]
fn who_takes_part_is_not_chosen_in_the_graph_of_one_agent() {
    let log = small();
    let args = ["--log", &*log.to_string_lossy(), "--agents", "cav2,rsu1"].map(String::from);
    let said = text(&realo(["run".to_string(), graph("late_fusion.vehicle")].iter().chain(&args)).stderr);
    assert!(
        said.contains("--agents") && said.contains("late_fusion.vehicle.yml is the graph of one agent, cav1"),
        "{said}"
    );
}

#[test]
fn protocols_that_do_not_fit_the_log_say_what_to_do() {
    let dir = folder("protocol_keys");
    let sound = fs::read_to_string(common::root().join("operators/scoring/protocols/default.yml"));
    let sound = sound.expect("the protocol can be read");
    let log = small();
    let said = |name: &str, keys: &str| {
        let path = dir.join(name);
        fs::write(&path, format!("{sound}{keys}")).expect("the protocol can be written");
        let (code, said) = run(&[
            "--log",
            &log.to_string_lossy(),
            "--out",
            &dir.join("out").to_string_lossy(),
            "--protocol",
            &path.to_string_lossy(),
        ]);
        (code, said)
    };
    for (name, keys, expected) in [
        (
            "own.yml",
            "labels: own\n",
            ["no topic /cav1/own_labels", "`labels: all`"],
        ),
        ("ego.yml", "ego: roadside\n", ["scores a roadside", "--ego rsu1"]),
        (
            "set.yml",
            "labels: cooperative\n",
            ["set.yml", "expected `all` or `own`"],
        ),
        (
            "views.yml",
            "outside_views: dropped\n",
            ["views.yml", "expected `counted` or `ignored`"],
        ),
        ("typo.yml", "outside_view: ignored\n", ["typo.yml", "outside_view"]),
    ] {
        let (code, said) = said(name, keys);
        assert_ne!(code, Some(0), "{name}");
        expected
            .into_iter()
            .for_each(|word| assert!(said.contains(word), "{name}: {said}"));
    }
    // Views that the log does not have leave the scores as they are, and a note says so.
    let (code, text) = said("blind.yml", "outside_views: ignored\n");
    assert_eq!(code, Some(0), "{text}");
    let result = json(&dir.join("out/result.json"));
    let notes = result["notes"].to_string();
    assert!(notes.contains("scored frames have no views"), "{notes}");
    assert_eq!(result["in_no_view"]["detections"], 0);
}

/// What `realo info` says of a file: standard output, standard error and exit code.
fn info(path: &Path) -> (String, String, Option<i32>) {
    let output = realo([Path::new("info"), path]);
    (text(&output.stdout), text(&output.stderr), output.status.code())
}

#[test]
fn info_names_problems_first() {
    let unicorn = Box3 {
        class: "Unicorn".into(),
        ..car([10.0, 0.0, 0.8], [4.0, 2.0, 1.6])
    };
    let log = odd_with("info_problems", &cloud(&[[5.0, 0.0, 1.0]]), None, Some(&[unicorn]));
    let (said, _, code) = info(&log);
    let lines: Vec<&str> = said.lines().collect();
    let problems: Vec<usize> = (0..lines.len())
        .filter(|line| lines[*line].starts_with("  PROBLEM: "))
        .collect();
    assert_eq!(problems, (1..=problems.len()).collect::<Vec<_>>(), "{said}");
    let of_protocol = "of 5 boxes of ground truth, classes that protocol `default` does not score: `Unicorn` 5";
    assert!(lines[problems.len()].contains(of_protocol), "{said}");
    let last = lines.last().unwrap();
    assert!(
        last.contains(&format!("{} problem", problems.len())) && last.ends_with("named at the top"),
        "{said}"
    );
    assert_eq!(code, Some(3), "{said}");
    let output = realo([Path::new("info"), Path::new("--json"), &log]);
    let described: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(described["problems"].as_array().map(Vec::len), Some(problems.len()));
}

#[test]
fn info_says_what_a_log_without_truth_can_say() {
    let points = cloud(&[[5.0, 0.0, 1.0]]);
    for (name, truth, words) in [
        (
            "info_no_truth",
            None,
            "  no truth  no agent has ground truth: a run reports rates, ages",
        ),
        (
            "info_empty_truth",
            Some(&[][..]),
            "  no truth  the ground truth of all agents has no object: a run reports rates, ages",
        ),
    ] {
        let (said, _, _) = info(&odd_with(name, &points, None, truth));
        assert_eq!(said.matches(words).count(), 1, "{said}");
    }
    let (said, _, code) = info(&odd_with("info_without", &points, None, None));
    assert!(said.contains("no problems found") && code == Some(0), "{said}");
    let (said, _, _) = info(&odd("info_with_truth", &points, None));
    assert!(!said.contains("no truth"), "{said}");
}

#[test]
fn the_error_of_a_damaged_bag_is_there_once() {
    let bag = folder("damaged_bag").join("cut.db3");
    fs::write(&bag, b"SQLite format 3\0 and nothing else").expect("it can be written");
    let (_, said, code) = info(&bag);
    assert_eq!(code, Some(1), "{said}");
    assert!(
        said.contains("expected an SQLite database, found less than its head"),
        "{said}"
    );
    assert!(!said.contains("is not an MCAP file"), "{said}");
    assert_eq!(
        said.matches("apart from that, it is a bag of ROS 2 in SQLite").count(),
        1,
        "{said}"
    );
}
