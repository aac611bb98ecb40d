//! Runs on real dora: the same answers as virtual time, and failures that are seen.

mod common;
#[path = "realtime/daemons.rs"]
mod daemons;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::machine::{decided, half, quarter, three_quarters, whole};
use common::{changed_graph, files_below, folder, graph, json, realo_ok, run_virtual, simulated, text};
use realo_schemas::Nanos;
use realo_schemas::report::Fated;
use serde_json::Value;

/// A second of a world whose agents' sweeps are spread over a tenth of it.
const SPREAD_SECOND: [&str; 9] = [
    "--seed",
    "903",
    "--seconds",
    "1",
    "--phase",
    "spread",
    "--no-clouds",
    "--key-hz",
    "10",
];

/// Sweeps of the agents lie at least 15 ms apart, so that no race decides which message is the newest.
fn spread() -> PathBuf {
    simulated("spread_second", &SPREAD_SECOND)
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
    run_realtime_file(Path::new(&graph("late_fusion")), out, log, args)
}

fn run_realtime_file(graph: &Path, out: &Path, log: &Path, args: &[&str]) -> Value {
    let mut all = vec![
        "run".into(),
        graph.to_string_lossy().into_owned(),
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

/// A machine that stands still for a second makes dora lose messages: the run says so, and can't be compared. Repeats such runs.
fn undisturbed(run: impl Fn() -> Value) -> Value {
    let mut last = Value::Null;
    for _ in 0..3 {
        let result = run();
        if result["transport"]["total_lost"] == 0 {
            return result;
        }
        last = result["transport"].clone();
    }
    panic!("dora lost messages in each of three runs: {last}");
}

#[test]
fn realtime_without_delays_gives_the_boxes_of_virtual_time() {
    decided(realtime_as_virtual);
}

fn realtime_as_virtual() {
    let _share = half();
    let log = spread();
    let expected = run_virtual(
        "held_virtual",
        "late_fusion",
        &log,
        &["--recorded-detections", "--ego", "cav1"],
    );
    let out = folder("held_realtime");
    let result = undisturbed(|| run_realtime(&out, &log, &["--rate", "0.1"]));
    assert_eq!(
        result["links"], expected["links"],
        "the same messages were selected, with the same fate"
    );
    assert_eq!(result["accuracy"], expected["accuracy"]);
    let virtual_out = Path::new(env!("CARGO_TARGET_TMPDIR")).join("held_virtual");
    assert_eq!(frames(&out).as_array().map(Vec::len), Some(10));
    assert!(
        frames(&out) == frames(&virtual_out),
        "the boxes of every frame are the same"
    );
}

#[test]
fn what_motion_sensors_measured_reaches_localization() {
    decided(motion_on_dora);
}

fn motion_on_dora() {
    let _share = half();
    let log = simulated("moving", &[&SPREAD_SECOND[..], &["--inertial", "tactical"]].concat());
    let of =
        |result: &Value, stage: &str, counter: &str| result["nodes"][stage]["counters"][counter].as_u64().unwrap_or(0);
    let in_virtual = |name: &str, more: &[&str]| {
        let args = [["--recorded-detections", "--ego", EGO].as_slice(), more].concat();
        run_virtual(name, "late_fusion", &log, &args)
    };
    let expected = in_virtual("motion_virtual", &[]);
    let out = folder("motion_realtime");
    let result = undisturbed(|| run_realtime(&out, &log, &["--rate", "0.1"]));
    for (stage, vehicles) in [("ego.sense.localization", 1), ("others.sense.localization", 1)] {
        // 100 a second from 0.1 s before the first sweep to as long after the last.
        assert_eq!(of(&expected, stage, "imu_samples"), 120 * vehicles, "{stage}");
        for counter in ["imu_samples", "gnss_fixes", "wheel_speeds"] {
            assert_eq!(
                of(&result, stage, counter),
                of(&expected, stage, counter),
                "{stage} {counter}"
            );
        }
        assert_eq!(of(&result, stage, "motion_backwards"), 0, "{stage}");
    }
    assert_eq!(of(&expected, "player", "motion_unusable"), 0);
    assert_eq!(result["accuracy"], expected["accuracy"]);
    // Nothing is estimated from it yet: without it, all else is the same.
    let without = in_virtual("motion_off", &["--set", "player.motion=off"]);
    assert_eq!(of(&without, "ego.sense.localization", "imu_samples"), 0);
    for part in ["accuracy", "links", "age_ms", "notes"] {
        assert_eq!(without[part], expected[part], "{part}");
    }
}

/// The ego of every run.
const EGO: &str = "cav1";
/// What profile `paper` takes to carry boxes, ns.
const PAPER_BOXES: Nanos = 10_000_000;
/// What the bank selects from, ns.
const WINDOW: Nanos = 400_000_000;

/// Boxes of one agent, as they left it.
struct Made {
    agent: String,
    seq: u64,
    stamp: Nanos,
    done: Nanos,
}

fn made(recording: &Path) -> Vec<Made> {
    let detections = realo_recorder::read_detections(recording).expect("the recording can be read");
    let made = detections.into_iter().map(|message| Made {
        agent: message.header.agent.to_string(),
        seq: message.header.seq,
        stamp: message.header.stamp,
        done: message.header.ready,
    });
    made.collect()
}

/// Number and age of the message of a sender that a query at `asked` finds, by §4 of the design alone.
fn calculated(made: &[Made], sender: &str, asked: Nanos) -> Option<(u64, Nanos)> {
    let there = |boxes: &&Made| boxes.agent == sender && boxes.done + PAPER_BOXES <= asked;
    let newest = made.iter().filter(there).max_by_key(|boxes| boxes.stamp)?;
    let age = asked - newest.stamp;
    (age <= WINDOW).then_some((newest.seq, age))
}

/// By query and sender: number and age of the message that was fused.
type Fused = BTreeMap<(u64, String), (u64, Nanos)>;

fn fused(recording: &Path) -> Fused {
    let reports = realo_recorder::read_reports(recording).expect("the recording can be read");
    let of_fates = reports
        .into_iter()
        .filter(|report| report["topic"] == realo_recorder::FATES);
    let read = |mut report: Value| -> Vec<Fated> {
        serde_json::from_value(report["report"].take()).expect("what became of messages")
    };
    let uses = of_fates
        .flat_map(read)
        .filter_map(|fated| Some((fated.r#use?, fated.message)));
    uses.map(|(r#use, message)| ((r#use.query, message.from), (message.seq, r#use.age_ns)))
        .collect()
}

/// |Realised age - calculated age| of every fusion of the calculated message, ns, rising, and how many were of another one.
fn differences(made: &[Made], fused: &Fused) -> (Vec<Nanos>, usize) {
    let senders: BTreeSet<&str> = made.iter().map(|boxes| boxes.agent.as_str()).collect();
    let (mut differences, mut others) = (Vec::new(), 0);
    for query in made.iter().filter(|boxes| boxes.agent == EGO) {
        for sender in senders.iter().filter(|sender| **sender != EGO) {
            let realised = fused.get(&(query.seq, sender.to_string()));
            let calculated = calculated(made, sender, query.done);
            match (realised, calculated) {
                (Some((a, realised)), Some((b, calculated))) if *a == b => {
                    differences.push((realised - calculated).abs());
                }
                (None, None) => {}
                _ => others += 1,
            }
        }
    }
    differences.sort_unstable();
    (differences, others)
}

/// How much longer than asked for this machine lets a thread sleep, ns: the largest so far.
fn oversleep(stop: &std::sync::atomic::AtomicBool) -> Nanos {
    let mut most = 0;
    while !stop.load(std::sync::atomic::Ordering::Relaxed) {
        let begun = Instant::now();
        std::thread::sleep(Duration::from_millis(1));
        most = most.max(begun.elapsed().as_nanos() as Nanos - 1_000_000);
    }
    most
}

/// Lets the recorder hear what each agent detected by itself.
const RECORDED: [(&str, &str); 3] = [
    (
        "outputs: [packets, state, detected.sender.packets]",
        "outputs: [packets, state, boxes]",
    ),
    (
        "detected.sender.packets: realo/v1/Packet }\n\n  - id: v2x",
        "boxes: realo/v1/Boxes }\n\n  - id: v2x",
    ),
    (
        "truth: player/truth, ego_state",
        "truth: player/truth, ego_boxes: perception.ego/boxes, other_boxes: others/boxes, ego_state",
    ),
];

#[test]
fn realised_age_is_that_of_an_independent_calculation() {
    decided(realised_age);
}

fn realised_age() {
    let _share = three_quarters();
    let out = folder("age");
    let file = changed_graph(&folder("age_graph"), "late_fusion", &RECORDED);
    // Without the gate, so that the calculation needs no positions.
    let args = ["--link", "paper", "--set", "v2x.link.range_m=100000"];
    let stop = std::sync::atomic::AtomicBool::new(false);
    let (result, noise) = std::thread::scope(|scope| {
        let noise = scope.spawn(|| oversleep(&stop));
        let result = std::panic::catch_unwind(|| run_realtime_file(&file, &out, &locked(), &args));
        stop.store(true, std::sync::atomic::Ordering::Relaxed);
        let noise = noise.join().expect("sleeping does not panic");
        (result.unwrap_or_else(|panic| std::panic::resume_unwind(panic)), noise)
    });
    let recording = files_below(&out)
        .into_iter()
        .find(|path| path.ends_with("recording.mcap"));
    let recording = recording.expect("there is a recording");
    let (made, fused) = (made(&recording), fused(&recording));
    let (differences, others) = differences(&made, &fused);
    assert!(differences.len() >= 60, "only {} fusions", differences.len());
    let share = |percent: usize| differences[(differences.len() - 1) * percent / 100];
    let millis = |nanos: Nanos| nanos as f64 * 1e-6;
    println!(
        "{} fusions, {others} of another message than calculated; |realised age - calculated age| p50 {:.3} ms, p99 {:.3} \
         ms; a thread sleeps at most {:.3} ms too long; ages {}",
        differences.len(),
        millis(share(50)),
        millis(share(99)),
        millis(noise),
        result["age_ms"]
    );
    // The same message is as old as calculated but for what this machine lets threads wait.
    assert!(share(50) <= 5_000_000 + noise, "p50 {} ms", millis(share(50)));
    assert!(share(99) <= 5_000_000 + 4 * noise, "p99 {} ms", millis(share(99)));
}

#[test]
fn a_measured_profile_gives_the_latency_of_each_stage_in_virtual_time() {
    decided(measured_profile);
}

fn measured_profile() {
    let _share = whole();
    // No sweep is there at the time of a pose: which of the two comes first would change the trigger, and so what is charged.
    let args = "--seed 908 --seconds 2 --agents cav1,rsu1 --phase spread";
    let log = simulated("measured", &args.split(' ').collect::<Vec<_>>());
    let out = folder("measured");
    run_realtime(&out, &log, &[]);
    let profile = out.join("compute.toml");
    let profile = profile.to_string_lossy();
    let args = ["--recorded-detections", "--ego", EGO, "--compute", &profile];
    run_virtual("measured_virtual", "late_fusion", &log, &args);
    let latencies = |dir: &Path| json(&dir.join("timing.json"))["latency_ms"].take();
    let realtime = latencies(&out);
    let replayed = latencies(&Path::new(env!("CARGO_TARGET_TMPDIR")).join("measured_virtual"));
    let mut compared = 0;
    for (stage, spread) in realtime.as_object().expect("latencies") {
        let (Some(a), Some(b)) = (spread["p50"].as_f64(), replayed[stage]["p50"].as_f64()) else {
            continue;
        };
        // Stages of microseconds are as long as the threads' hand-over.
        if stage.contains('.') && a > 1.0 {
            assert!((a - b).abs() <= 0.15 * a, "{stage}: {a} ms in realtime, {b} ms charged");
            compared += 1;
        }
    }
    let sync = replayed["ego.sense.sync"]["p50"].as_f64().expect("sync");
    let measured = realtime["ego.sense.sync"]["p50"].as_f64().expect("sync");
    assert!(
        (sync - measured).abs() <= 0.15 * measured + 0.2,
        "sync: {measured} ms, {sync} ms charged"
    );
    println!("{compared} stages of more than 1 ms");
}

/// How dora carries a message for certain.
const RELIABLE: &str = "queue_policy: backpressure, queue_size: 1000";

/// Late fusion with a node between the others and the links that does something to messages; `what`: see the example.
/// Both edges take dora's path through the daemon, so that on a busy machine dora itself loses and shuffles nothing.
fn tampered(dir: &Path, report: &Path, what: &str) -> PathBuf {
    let example = Path::new(common::REALO).with_file_name("examples").join("tamper");
    assert!(example.exists(), "{} is built with the tests", example.display());
    let node = format!(
        "  - id: tamper\n    path: {}\n    args: {} {what}\n    inputs: {{ in: {{ source: others/packets, {RELIABLE} }} }}\n    \
         outputs: [out]\n    output_types: {{ out: realo/v1/Packet }}\n\n  - id: v2x",
        example.display(),
        report.display()
    );
    let packets = format!("packets: {{ source: tamper/out, {RELIABLE} }}");
    let changes = [("  - id: v2x", node.as_str()), ("packets: others/packets", &packets)];
    changed_graph(dir, "late_fusion", &changes)
}

#[test]
fn what_the_transport_does_to_messages_is_seen_and_counted() {
    decided(tampered_transport);
}

fn tampered_transport() {
    let _share = three_quarters();
    let dir = folder("tampered");
    let report = dir.join("tampered.json");
    let out = dir.join("out");
    let result = run_realtime_file(&tampered(&dir, &report, "all"), &out, &locked(), &[]);
    let did = json(&report);
    let edge = &result["transport"]["edges"]["v2x.link.others"];
    let get = |value: &Value, key: &str| value[key].as_u64().unwrap_or_else(|| panic!("{key} in {value}"));
    for (done, seen) in [("dropped", "lost"), ("repeated", "repeated"), ("swapped", "reordered")] {
        let (done, seen) = (get(&did, done), get(edge, seen));
        assert!(seen > 0 && seen == done, "{did} {edge}");
    }
    let lost = get(edge, "lost");
    assert_eq!(get(&result["transport"], "total_lost"), lost);
    let notes = result["notes"].as_array().expect("notes");
    let reported = format!("dora lost {lost} messages");
    assert!(
        notes
            .iter()
            .any(|note| note.as_str().is_some_and(|note| note.contains(&reported))),
        "{notes:?}"
    );
}

#[test]
fn repeated_messages_change_no_box() {
    decided(repeated_messages);
}

fn repeated_messages() {
    let _share = half();
    let dir = folder("repeated");
    let log = spread();
    run_virtual(
        "repeated_virtual",
        "late_fusion",
        &log,
        &["--recorded-detections", "--ego", EGO],
    );
    let out = dir.join("out");
    let report = dir.join("tampered.json");
    let file = tampered(&dir, &report, "repeat");
    undisturbed(|| run_realtime_file(&file, &out, &log, &["--rate", "0.1"]));
    let did = json(&report);
    assert!(did["repeated"].as_u64() > Some(0), "{did}");
    let virtual_out = Path::new(env!("CARGO_TARGET_TMPDIR")).join("repeated_virtual");
    assert!(
        frames(&out) == frames(&virtual_out),
        "the boxes of every frame are the same"
    );
}

#[test]
fn an_overloaded_machine_is_reported_beside_the_score() {
    let _share = whole();
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
    let notes = result["notes"].to_string();
    assert_eq!(notes.contains("dora lost"), lost > 0, "{notes}");
    assert_eq!(notes.contains("gave no boxes"), get(&frames["skipped"]) > 0, "{notes}");
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
    let _share = quarter();
    let out = folder(name);
    let child = start(&out);
    let deadline = Instant::now() + Duration::from_secs(60);
    let recording = || {
        files_below(&out)
            .into_iter()
            .find(|path| path.ends_with("recording.mcap"))
    };
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

#[test]
fn a_node_killed_in_mid_run_fails_the_run_by_name_and_the_recording_can_be_read() {
    let (output, out) = kill_in_mid_run("killed_node", "fuse.boxes.yml");
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stderr));
    assert!(text(&output.stderr).contains("`fusion`"), "{}", text(&output.stderr));
    assert!(
        files_below(&out).iter().all(|path| !path.ends_with("result.json")),
        "no results of a run that failed"
    );
    let recording = files_below(&out)
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
    let said = text(&output.stderr);
    assert!(said.contains("dora ended with signal: 9"), "{said}");
}
