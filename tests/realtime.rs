//! Runs on real dora: the same answers as virtual time, and failures that are seen.

mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, MutexGuard};
use std::time::{Duration, Instant};

use common::{folder, graph, json, realo_ok, run_virtual, simulated, text};
use realo_runtime::graph::{FlatGraph, Graph};
use serde_json::Value;

/// Realtime runs share the machine's cores with nothing of ours.
static ALONE: Mutex<()> = Mutex::new(());

fn alone() -> MutexGuard<'static, ()> {
    ALONE.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

/// Sweeps of the agents lie at least 15 ms apart, so that no race decides which message is the newest.
fn spread() -> PathBuf {
    simulated(
        "spread",
        &[
            "--seed",
            "903",
            "--seconds",
            "3",
            "--phase",
            "spread",
            "--no-clouds",
            "--key-hz",
            "10",
        ],
    )
}

fn locked() -> PathBuf {
    simulated(
        "locked",
        &["--seed", "904", "--seconds", "4", "--no-clouds", "--key-hz", "10"],
    )
}

/// What was detected and what was there, frame by frame.
fn frames(dir: &Path) -> Value {
    let mut samples = json(&dir.join("evaluation.json"));
    samples["evaluation"]["scenes"][0]["frames"].take()
}

fn run_realtime(out: &Path, log: &Path, args: &[&str]) -> Value {
    let mut all = vec![
        "run".into(),
        graph("late_fusion"),
        "--recorded-detections".into(),
        "--log".into(),
        log.to_string_lossy().into_owned(),
    ];
    all.extend([
        "--ego".into(),
        "cav1".into(),
        "--out".to_string(),
        out.to_string_lossy().into_owned(),
    ]);
    all.extend(args.iter().map(|arg| arg.to_string()));
    realo_ok(all);
    json(&out.join("result.json"))
}

#[test]
fn realtime_without_delays_gives_the_boxes_of_virtual_time() {
    let _alone = alone();
    let log = spread();
    let expected = run_virtual(
        "held_virtual",
        "late_fusion",
        &log,
        &["--recorded-detections", "--ego", "cav1"],
    );
    let out = folder("held_realtime");
    let result = run_realtime(&out, &log, &["--rate", "0.1"]);
    assert_eq!(result["transport"]["total_lost"], 0, "{}", result["transport"]);
    assert_eq!(
        result["links"], expected["links"],
        "the same messages were selected, with the same fate"
    );
    assert_eq!(result["accuracy"], expected["accuracy"]);
    let virtual_out = Path::new(env!("CARGO_TARGET_TMPDIR")).join("held_virtual");
    assert_eq!(frames(&out).as_array().map(Vec::len), Some(30));
    assert!(
        frames(&out) == frames(&virtual_out),
        "the boxes of every frame are the same"
    );
}

#[test]
fn realised_age_follows_the_link() {
    let _alone = alone();
    let out = folder("age");
    let result = run_realtime(&out, &locked(), &["--link", "paper"]);
    // All sweeps end together; boxes take 10 ms, so a query finds those of the sweep before, whose stamp (mid-sweep) lies
    // 150 ms before the end of its own.
    let age = |share: &str| {
        result["age_ms"][share]
            .as_f64()
            .unwrap_or_else(|| panic!("{}", result["age_ms"]))
    };
    let timing = json(&out.join("timing.json"));
    let graph_ms = timing["latency_ms"]["end_to_end"]["p50"].as_f64().expect("a latency");
    println!(
        "age of the data used: p50 {:.2} ms, p99 {:.2} ms; 150 ms and the ego's way to its query, at most {graph_ms:.2} ms",
        age("p50"),
        age("p99")
    );
    let late = age("p50") - 150.0;
    assert!((0.0..graph_ms + 1.0).contains(&late), "{} {graph_ms}", result["age_ms"]);
}

fn tampered_graph(dir: &Path, report: &Path) -> PathBuf {
    let late = Graph::load(Path::new(&graph("late_fusion"))).expect("the graph can be read");
    let mut flat = late.with_recorded_detections().expand().expect("its modules fit");
    let example = Path::new(common::REALO).with_file_name("examples").join("tamper");
    assert!(example.exists(), "{} is built with the tests", example.display());
    let yaml = format!(
        "nodes:\n- id: tamper\n  path: {}\n  args: {}\n  inputs: {{ in: {{ source: nms/boxes, queue_size: 200 }} }}\n  \
         input_types: {{ in: realo/v1/Boxes }}\n  outputs: [out]\n  output_types: {{ out: realo/v1/Boxes }}\n",
        example.display(),
        report.display()
    );
    let tamper = Graph::parse(&yaml, &dir.join("tamper.yml")).expect("the node is a graph");
    let tamper = tamper.expand().expect("it has no modules").nodes.remove(0);
    flat.nodes.push(tamper);
    let encoder = flat
        .nodes
        .iter_mut()
        .find(|node| node.id == "encoder")
        .expect("the graph has an encoder");
    let input = encoder.inputs.get_mut("messages").expect("it has an input");
    input.source = realo_runtime::graph::InputSource::Output {
        node: "tamper".into(),
        output: "out".into(),
    };
    std::os::unix::fs::symlink(flat.types(), dir.join("types")).expect("links can be made");
    let path = dir.join("tampered.yml");
    fs::write(&path, flat.to_yaml().expect("it can be written")).expect("the graph can be written");
    path
}

#[test]
fn what_the_transport_does_to_messages_is_seen_and_counted() {
    let _alone = alone();
    let dir = folder("tampered");
    let report = dir.join("tampered.json");
    let path = tampered_graph(&dir, &report);
    let out = dir.join("out");
    let log = locked();
    realo_ok([
        "run",
        &path.to_string_lossy(),
        "--ego",
        "cav1",
        "--log",
        &log.to_string_lossy(),
        "--out",
        &out.to_string_lossy(),
    ]);
    let (did, result) = (json(&report), json(&out.join("result.json")));
    let edge = &result["transport"]["edges"]["encoder.messages"];
    let get = |value: &Value, key: &str| value[key].as_u64().unwrap_or_else(|| panic!("{key} in {value}"));
    for (done, seen) in [("dropped", "lost"), ("repeated", "repeated"), ("swapped", "reordered")] {
        let (done, seen) = (get(&did, done), get(edge, seen));
        assert!(seen > 0 && seen == done, "{did} {edge}");
    }
    assert_eq!(get(&result["transport"], "total_lost"), get(edge, "lost"));
}

#[test]
fn an_overloaded_machine_is_reported_beside_the_score() {
    let _alone = alone();
    let stop = std::sync::atomic::AtomicBool::new(false);
    let out = folder("overload");
    let result = std::thread::scope(|scope| {
        for _ in 0..16 {
            scope.spawn(|| {
                while !stop.load(std::sync::atomic::Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            });
        }
        let result = std::panic::catch_unwind(|| run_realtime(&out, &locked(), &[]));
        stop.store(true, std::sync::atomic::Ordering::Relaxed);
        result.unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    });
    let get = |value: &Value| {
        value
            .as_u64()
            .unwrap_or_else(|| panic!("{value} in {}", result["transport"]))
    };
    let edges = result["transport"]["edges"].as_object().expect("edges");
    let lost: u64 = edges.values().map(|edge| get(&edge["lost"])).sum();
    assert_eq!(lost, get(&result["transport"]["total_lost"]));
    let frames = &result["frames"];
    assert_eq!(
        get(&frames["total"]),
        get(&frames["processed"]) + get(&frames["skipped"]),
        "{frames}"
    );
    println!("with 16 busy loops: {lost} messages lost by dora, frames {frames}");
}

/// Starts a run on dora in the background.
fn start(out: &Path) -> Child {
    let log = simulated(
        "long",
        &[
            "--seed",
            "905",
            "--seconds",
            "20",
            "--no-clouds",
            "--agents",
            "cav1,rsu1",
        ],
    );
    Command::new(common::REALO)
        .args([
            "run",
            &graph("late_fusion"),
            "--recorded-detections",
            "--ego",
            "cav1",
            "--log",
        ])
        .arg(log)
        .arg("--out")
        .arg(out)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("realo can be started")
}

/// Processes below `root` whose command line contains `words`.
fn find_process(root: u32, words: &str) -> Option<u32> {
    let mut parents = Vec::new();
    for entry in fs::read_dir("/proc").expect("/proc can be read").flatten() {
        let Some(pid) = entry.file_name().to_str().and_then(|name| name.parse::<u32>().ok()) else {
            continue;
        };
        let Ok(stat) = fs::read_to_string(entry.path().join("stat")) else {
            continue;
        };
        let parent = stat
            .rsplit_once(')')
            .and_then(|(_, rest)| rest.split_whitespace().nth(1)?.parse::<u32>().ok());
        let line = fs::read(entry.path().join("cmdline")).unwrap_or_default();
        parents.push((pid, parent.unwrap_or(0), text(&line).replace('\0', " ")));
    }
    let mut family = vec![root];
    let mut at = 0;
    while at < family.len() {
        let of = family[at];
        family.extend(
            parents
                .iter()
                .filter(|(_, parent, _)| *parent == of)
                .map(|(pid, ..)| *pid),
        );
        at += 1;
    }
    parents
        .iter()
        .find(|(pid, _, line)| family.contains(pid) && *pid != root && line.contains(words))
        .map(|(pid, ..)| *pid)
}

fn kill_in_mid_run(name: &str, words: &str) -> (std::process::Output, PathBuf) {
    let _alone = alone();
    let out = folder(name);
    let child = start(&out);
    let deadline = Instant::now() + Duration::from_secs(60);
    let recording = || walk(&out).into_iter().find(|path| path.ends_with("recording.mcap"));
    let running = || recording().is_some_and(|path| fs::metadata(path).is_ok_and(|meta| meta.len() > 100_000));
    while !running() && Instant::now() < deadline {
        std::thread::sleep(Duration::from_millis(100));
    }
    let victim = find_process(child.id(), words).unwrap_or_else(|| panic!("no process `{words}`"));
    let killed = Command::new("kill")
        .args(["-9", &victim.to_string()])
        .status()
        .expect("kill can be started");
    assert!(killed.success());
    (child.wait_with_output().expect("realo ends"), out)
}

fn walk(dir: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(dir)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path());
    entries
        .flat_map(|path| if path.is_dir() { walk(&path) } else { vec![path] })
        .collect()
}

#[test]
fn a_node_killed_in_mid_run_fails_the_run_by_name_and_the_recording_can_be_read() {
    let (output, out) = kill_in_mid_run("killed_node", "operator feature-bank");
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stderr));
    assert!(text(&output.stderr).contains("bank"), "{}", text(&output.stderr));
    assert!(
        walk(&out).iter().all(|path| !path.ends_with("result.json")),
        "no results of a run that failed"
    );
    let recording = walk(&out)
        .into_iter()
        .find(|path| path.ends_with("recording.mcap"))
        .expect("there is a recording");
    let messages = realo_recorder::read_boxes(&recording).expect("the recording can be read");
    assert!(!messages.is_empty());
}

#[test]
fn a_daemon_killed_in_mid_run_fails_the_run() {
    let (output, _) = kill_in_mid_run("killed_daemon", " run ");
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stderr));
    assert!(text(&output.stderr).contains("dora"), "{}", text(&output.stderr));
}
