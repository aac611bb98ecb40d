//! Runs that are ended from outside, and machines that are too small.

use std::fs;
use std::io::{BufRead, BufReader};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use realo_operator::Registration;
use realo_operator::pipe::{frame, hello};

use crate::common::machine::{decided, quarter, three_quarters};
use crate::common::{REALO, folder, graph, hangups_are_ignored, json, kill, root, text, until};
use crate::scene::Scene;

/// What the player writes to the log once the first sweep of the ego is on its way.
const PLAYS: &str = "the first message of `truth` was sent";

/// Processes that a run of a folder started, and itself.
fn processes(out: &Path) -> Vec<(u32, String)> {
    let named = out.to_string_lossy().into_owned();
    let entries = fs::read_dir("/proc").expect("it is Linux").flatten();
    let found = entries.filter_map(|entry| {
        let id = entry.file_name().to_string_lossy().parse().ok()?;
        let arguments = text(&fs::read(entry.path().join("cmdline")).ok()?).replace('\0', " ");
        let is_there = fs::read_link(entry.path().join("cwd")).is_ok_and(|cwd| cwd.starts_with(out));
        (is_there || arguments.contains(&named)).then_some((id, arguments))
    });
    found.collect()
}

struct Run {
    child: Child,
    out: PathBuf,
}

impl Run {
    /// A run on dora that would take a minute.
    fn start(name: &str) -> Run {
        Run::start_after(name, |_| {})
    }

    /// The same, where something is done before in its folder.
    fn start_after(name: &str, before: impl FnOnce(&Path)) -> Run {
        Run::start_at("0.04", name, before)
    }

    /// The same at another rate.
    fn start_at(rate: &str, name: &str, before: impl FnOnce(&Path)) -> Run {
        let log = Scene::default().write(name);
        let out = folder(name);
        before(&out);
        let mut command = Command::new(REALO);
        command
            .args([
                "run",
                &graph("late_fusion"),
                "--recorded-detections",
                "--ego",
                "car",
                "--rate",
                rate,
            ])
            .arg("--log")
            .arg(&log)
            .arg("--out")
            .arg(&out)
            .current_dir(root())
            .process_group(0)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        let child = command.spawn().expect("realo can be started");
        Run { child, out }
    }

    /// A roadside unit on dora that scores nothing, and would send for minutes to nobody.
    fn start_roadside(name: &str) -> Run {
        let log = Scene::default().write(name);
        let out = folder(name);
        let mut command = Command::new(REALO);
        command
            .args(["run", &graph("attfuse.roadside"), "--ego", "mast"])
            .args(["--set", "player.repeat=100", "--set", "v2x.connect=tcp/127.0.0.1:1"])
            .arg("--log")
            .arg(&log)
            .arg("--out")
            .arg(&out)
            .current_dir(root())
            .process_group(0)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        let child = command.spawn().expect("realo can be started");
        Run { child, out }
    }

    fn dora_log(&self) -> String {
        let logs = fs::read_dir(&self.out).into_iter().flatten().flatten();
        let logs = logs.flat_map(|log| fs::read_dir(log.path()).into_iter().flatten().flatten());
        let read = logs.filter_map(|run| fs::read_to_string(run.path().join("dora.log")).ok());
        read.collect()
    }

    /// Waits until the first sweep of the ego is on its way.
    fn play(self) -> Run {
        until("the first sweep is sent", || self.dora_log().contains(PLAYS));
        self
    }

    fn signal(&self, name: &str) {
        kill(self.child.id(), name);
    }

    fn end(self) -> (Output, PathBuf) {
        let output = self.child.wait_with_output().expect("it was started");
        let out = self.out;
        until("no process is left", || processes(&out).is_empty());
        (output, out)
    }
}

/// A run in virtual time, which ends at once.
fn offline(log: &Path, out: &Path) -> Output {
    offline_command(log, out).output().expect("realo can be started")
}

fn offline_command(log: &Path, out: &Path) -> Command {
    let mut command = Command::new(REALO);
    command.args([
        "run",
        &graph("late_fusion"),
        "--recorded-detections",
        "--offline",
        "--ego",
        "car",
    ]);
    command.arg("--log").arg(log).arg("--out").arg(out);
    command.current_dir(root());
    command
}

/// The result of the only run in a folder.
fn result(out: &Path) -> serde_json::Value {
    json(&out.join("result.json"))
}

#[test]
fn a_signal_ends_a_run_in_good_order_with_the_table_so_far() {
    // A machine that others keep busy may have to kill what is left.
    decided(signals_end_a_run);
}

fn signals_end_a_run() {
    let _share = quarter();
    let log = Scene::default().write("life-complete");
    for (signal, code, name) in [("TERM", 143, "SIGTERM"), ("INT", 130, "Ctrl-C"), ("HUP", 129, "SIGHUP")] {
        if signal == "HUP" && hangups_are_ignored() {
            skipped::skip("a process that inherits SIGHUP as `nohup` leaves it, ignored, is not ended by it");
            continue;
        }
        let earlier = |out: &Path| assert!(offline(&log, out).status.success());
        let run = Run::start_after(&format!("life-{signal}"), earlier).play();
        run.signal(signal);
        let (output, out) = run.end();
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{signal}: {said}");
        assert!(said.contains(&format!("ended by {name}")), "{said}");
        assert!(text(&output.stdout).contains("late_fusion"), "{said}");
        let ended = result(&out);
        assert_eq!(ended["ended_by"], name);
        assert!(ended["frames"]["total"].as_u64() > Some(0), "{ended}");
        let first = ended["notes"][0].to_string();
        assert!(first.contains(&format!("{name} ended the run early")), "{first}");
        // What came to its end before is worth more.
        let kept = out.join("complete-run-before");
        assert!(said.contains(&format!("are kept in {}", kept.display())), "{said}");
        assert_eq!(
            (&result(&kept)["mode"], result(&kept).get("ended_by")),
            (&"offline".into(), None)
        );
        assert!(!out.join(".running").exists() && !out.join(".earlier").exists());
    }
}

#[test]
fn a_signal_before_the_first_message_leaves_the_results_of_an_earlier_run() {
    // On a machine that others keep busy the first sweep may go out meanwhile.
    decided(early_signal);
}

fn early_signal() {
    let _share = quarter();
    let log = Scene::default().write("life-early-log");
    let earlier = |out: &Path| {
        let output = offline(&log, out);
        assert!(output.status.success(), "{}", text(&output.stderr));
    };
    let run = Run::start_after("life-early", earlier);
    until("dora is there", || processes(&run.out).len() > 1);
    run.signal("INT");
    let Output { status, stderr, .. } = run.child.wait_with_output().expect("it was started");
    let said = text(&stderr);
    assert_eq!(status.code(), Some(130), "{said}");
    until("no process is left", || processes(&run.out).is_empty());
    assert!(
        said.contains("ended by Ctrl-C: ") && said.contains("no results: "),
        "{said}"
    );
    let left = result(&run.out);
    assert_eq!(
        (&left["mode"], &left["ended_by"]),
        (&"offline".into(), &serde_json::Value::Null),
        "{said}"
    );
    assert!(!run.out.join(".running").exists() && !run.out.join(".earlier").exists());
}

#[test]
fn a_signal_leaves_the_results_of_a_graph_that_scores_nothing() {
    // A machine that others keep busy may have to kill what is left.
    decided(roadside_signal);
}

fn roadside_signal() {
    let _share = three_quarters();
    let run = Run::start_roadside("life-roadside").play();
    run.signal("INT");
    let (output, out) = run.end();
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(130), "{said}");
    assert!(!said.contains("no results: "), "{said}");
    let ended = result(&out);
    assert_eq!(ended["ended_by"], "Ctrl-C", "{said}");
    assert_eq!(ended["frames"]["total"], 0, "it scores nothing");
}

#[test]
fn a_signal_ends_a_batch_with_the_table_of_the_runs_that_are_complete() {
    let written = Scene::default().write("life-batch");
    let logs = folder("life-batch-logs");
    const LOGS: u64 = 12;
    let out = folder("life-batch-out");
    let graph = graph("late_fusion");
    // Long enough that the first of them ends before the last begin.
    let mut command = Command::new(REALO);
    command.args(["run", &graph, "--recorded-detections", "--offline", "--ego", "car"]);
    command.args(["--set", "player.repeat=100"]).arg("--out").arg(&out);
    for number in 0..LOGS {
        let log = logs.join(format!("log{number}.mcap"));
        fs::copy(&written, &log).expect("the folder can be written");
        command.arg("--log").arg(log);
    }
    let (stdout, stderr) = (Stdio::piped(), Stdio::piped());
    let child = command.current_dir(root()).stdout(stdout).stderr(stderr).spawn();
    let child = child.expect("realo can be started");
    let complete = || {
        let runs = fs::read_dir(&out).into_iter().flatten().flatten();
        runs.filter(|run| run.path().join("car/result.json").exists()).count() as u64
    };
    until("a run is complete", || complete() > 0);
    kill(child.id(), "TERM");
    let ended = child.wait_with_output().expect("it was started");
    let said = text(&ended.stderr);
    assert_eq!(ended.status.code(), Some(143), "{said}");
    let pooled = result(&out);
    let runs = pooled["runs"].as_u64().expect("a number of runs");
    assert!(runs > 0 && runs < LOGS, "{runs}: {said}");
    assert_eq!(runs, complete());
    assert_eq!(pooled["ended_by"], "SIGTERM");
    let note = format!(
        "{} of {LOGS} runs had not come to the end of the log when SIGTERM ended the batch",
        LOGS - runs
    );
    assert!(pooled["notes"].to_string().contains(&note), "{pooled}");
    assert!(text(&ended.stdout).contains("late_fusion"), "the table so far");
    // Each complete run says that it is, none is half done.
    for run in fs::read_dir(&out).expect("a folder").flatten() {
        let of_run = run.path().join("car/result.json");
        assert!(
            !of_run.exists() || json(&of_run).get("ended_by").is_none(),
            "{}",
            of_run.display()
        );
    }
}

#[test]
fn nothing_of_a_run_outlives_it() {
    // While it plays, and while its nodes start.
    for plays in [true, false] {
        let mut run = Run::start(&format!("life-KILL-{plays}"));
        if plays {
            run = run.play();
        } else {
            until("dora is there", || processes(&run.out).len() > 1);
        }
        run.signal("KILL");
        let (output, out) = run.end();
        assert_eq!(output.status.code(), None);
        // The next run has the folder to itself.
        let log = Scene::default().write(&format!("life-KILL-{plays}-next"));
        let next = offline(&log, &out);
        assert!(next.status.success(), "{}", text(&next.stderr));
        assert_eq!(result(&out)["mode"], "offline");
    }
}

#[test]
fn a_folder_is_refused_while_nodes_write_there() {
    let run = Run::start("life-lock").play();
    let second = offline(&Scene::default().write("life-lock-second"), &run.out);
    assert!(
        text(&second.stderr).contains("another run writes there now"),
        "{}",
        text(&second.stderr)
    );
    // Nor into a folder in it, and what stands in them is left.
    let before = fs::read_dir(run.out.join("life-lock/car")).expect("a folder").count();
    for inside in ["life-lock", "life-lock/car", "new"] {
        let second = offline(&Scene::default().write("life-lock-second"), &run.out.join(inside));
        let said = text(&second.stderr);
        assert!(said.contains("another run writes there now"), "{inside}: {said}");
    }
    let after = fs::read_dir(run.out.join("life-lock/car")).expect("a folder").count();
    assert_eq!(before, after);
    run.signal("TERM");
    run.end();
}

#[test]
fn a_run_that_goes_on_after_its_log_names_the_nodes_that_have_not_ended() {
    let mut run = Run::start_at("0.5", "life-stopped", |_| {}).play();
    let log = run.dora_log();
    let process = log
        .lines()
        .find_map(|line| line.split_once("fusion: spawner spawned node with pid "));
    let process: u32 = process.and_then(|(_, id)| id.trim().parse().ok()).expect("its id");
    kill(process, "STOP");
    let stderr = run.child.stderr.take().expect("it is piped");
    let mut lines = BufReader::new(stderr).lines().map_while(Result::ok);
    let said = lines.find(|line| line.contains("Ctrl-C ends the run"));
    run.signal("INT");
    let (output, _) = run.end();
    let said = said.expect("it says what it waits for");
    assert!(said.contains("fusion (stopped)") && !said.contains("player"), "{said}");
    assert_eq!(output.status.code(), Some(130), "{said}");
}

/// A program in the place of the fusion that ignores signals, starts another one and answers nothing: not even which ports it
/// has, or no call.
fn hanging(folder: &Path, declares_ports: bool) -> PathBuf {
    let [hello, marker, program] = ["hello", "marker", "plugin.sh"].map(|name| folder.join(name));
    let own = Registration::operator::<realo_fusion_boxes::FusionBoxes>();
    let words = hello::write(&own, &[], false).expect("it has ports");
    frame::write_first(&mut fs::File::create(&hello).expect("a file can be made"), &words).expect("it can be written");
    let answer = match declares_ports {
        true => format!("cat '{}'; head -c 1 > '{}'", hello.display(), marker.display()),
        false => format!("echo > '{}'", marker.display()),
    };
    let script = format!(
        "#!/bin/sh\ntrap '' TERM HUP INT\n{answer}\ntail -f '{}'\n",
        marker.display()
    );
    fs::write(&program, script).expect("a file can be made");
    fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).expect("it can be made a program");
    program
}

#[test]
fn a_plug_in_that_hangs_ends_with_its_run() {
    let cases = [
        ("TERM", false, Some(143), "ended by SIGTERM before anything was run"),
        ("KILL", false, None, ""),
        ("INT", true, Some(130), "ended by Ctrl-C before the end of the log"),
        ("KILL", true, None, ""),
    ];
    let log = Scene::default().write("life-hanging");
    for (signal, declares_ports, code, expected) in cases {
        let folder = folder(&format!("life-hanging-{signal}-{declares_ports}"));
        let out = folder.join("out");
        let earlier = offline(&log, &out);
        assert!(earlier.status.success(), "{}", text(&earlier.stderr));
        let program = hanging(&folder, declares_ports);
        let mut command = offline_command(&log, &out);
        command.args(["--replace", &format!("fusion.fusion=program {}", program.display())]);
        command.stdout(Stdio::null()).stderr(Stdio::piped());
        let child = command.spawn().expect("realo can be started");
        // In a call once a byte of it has come.
        until("the plug-in hangs", || {
            fs::metadata(folder.join("marker")).is_ok_and(|marker| marker.len() > 0)
        });
        kill(child.id(), signal);
        let ended = child.wait_with_output().expect("it was started");
        let said = text(&ended.stderr);
        assert_eq!(ended.status.code(), code, "{signal}: {said}");
        assert!(said.contains(expected), "{signal}: {said}");
        until("no process is left", || processes(&folder).is_empty());
        if code.is_some() {
            assert_eq!(result(&out)["mode"], "offline", "the earlier results are there");
        }
    }
}

#[test]
fn a_node_that_is_killed_is_named_first() {
    let run = Run::start("life-node").play();
    let (id, _) = processes(&run.out)
        .into_iter()
        .find(|(id, _)| {
            let environment = fs::read(format!("/proc/{id}/environ")).unwrap_or_default();
            // Those of other nodes follow.
            let environment = text(&environment);
            environment
                .split("node_id: ")
                .nth(1)
                .is_some_and(|rest| rest.starts_with("score"))
        })
        .expect("there is a node `score`");
    kill(id, "KILL");
    let (output, _) = run.end();
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    let first = said.lines().find(|line| line.contains("failed")).unwrap_or_default();
    assert!(first.contains("node `score` was ended by SIGKILL"), "{said}");
    assert!(!said.contains('\u{1b}') && !said.contains("<unknown>"), "{said}");
}

#[test]
fn few_threads_are_said_before_anything_starts() {
    let as_somebody = "setpriv --reuid=65533 --regid=65533 --clear-groups";
    let script = format!("{as_somebody} {REALO} --version");
    let tried = Command::new("sh").args(["-c", &script]).current_dir("/").output();
    let tried = tried.expect("there is a shell");
    if !tried.status.success() {
        skipped::skip(
            "a user with a limit of threads: only root becomes another one, who must be able to read the program",
        );
        return;
    }
    let log = Scene::default().write("life-threads");
    for (mode, limit, said_of_it) in [
        ("realtime", 60, "threads are needed"),
        ("virtual", 3, "threads are needed"),
        ("virtual", 1, "no thread can be started"),
    ] {
        let out = folder(&format!("life-threads-{mode}-{limit}"));
        fs::set_permissions(&out, fs::Permissions::from_mode(0o777)).expect("it can be opened");
        let script = format!(
            "ulimit -u {limit}; exec {as_somebody} {REALO} run {} --recorded-detections --mode {mode} --ego car --log {} --out {}/run",
            graph("late_fusion"),
            log.display(),
            out.display()
        );
        let output = Command::new("bash").args(["-c", &script]).current_dir(root()).output();
        let output = output.expect("there is a shell");
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(said.contains(said_of_it) && said.contains("ulimit -u"), "{said}");
        assert!(!out.join("run").exists(), "{said}");
    }
}

#[test]
fn the_doctor_refuses_settings_that_change_nothing() {
    let output = Command::new(REALO).args(["doctor", "--set", "fusion.iou=0.3"]).output();
    let output = output.expect("realo can be started");
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("--set needs --log: "), "{said}");
}

#[test]
fn few_file_descriptors_are_said_before_anything_starts() {
    let script = format!(
        "ulimit -n 64; exec {REALO} run {} --recorded-detections --ego car --log {} --out {}",
        graph("late_fusion"),
        Scene::default().write("life-descriptors").display(),
        folder("life-descriptors-out").display()
    );
    let output = Command::new("sh")
        .args(["-c", &script])
        .current_dir(root())
        .output()
        .expect("there is a shell");
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(
        said.contains("64 file descriptors are allowed") && said.contains("ulimit -n"),
        "{said}"
    );
}

/// Runs a script with a small shared memory of its own, of so many MB; `None` where that needs what is not here.
fn with_shared_memory(megabytes: u32, script: &str) -> Option<Output> {
    let tried = Command::new("unshare")
        .args(["-m", "mount", "-t", "tmpfs", "tmpfs", "/dev/shm"])
        .output();
    if !tried.is_ok_and(|tried| tried.status.success()) {
        skipped::skip("small shared memory: mounting needs root");
        return None;
    }
    let script = format!("mount -t tmpfs -o size={megabytes}m tmpfs /dev/shm && {script}");
    let output = Command::new("unshare")
        .args(["-m", "sh", "-c", &script])
        .current_dir(root())
        .output();
    Some(output.expect("there is unshare"))
}

#[test]
fn messages_go_through_sockets_where_shared_memory_is_small() {
    let out = folder("life-shm-out");
    let script = format!(
        "exec {REALO} run {} --recorded-detections --ego car --rate 0.5 --log {} --out {}",
        graph("late_fusion"),
        Scene::default().write("life-shm").display(),
        out.display()
    );
    let Some(output) = with_shared_memory(1, &script) else {
        return;
    };
    let said = text(&output.stderr);
    assert!(output.status.success(), "{said}");
    assert!(
        said.contains("go through sockets") && said.contains("--shm-size"),
        "{said}"
    );
    assert!(result(&out)["frames"]["total"].as_u64() > Some(0));
}

#[test]
fn shared_memory_that_killed_processes_left_is_freed() {
    let out = folder("life-orphan-out");
    // What Zenoh names so and nobody has locked is of no process; a file of somebody else stays.
    let script = format!(
        "head -c 200M /dev/zero > /dev/shm/123456.zenoh && touch -d '1 hour ago' /dev/shm/123456.zenoh && \
         touch -d '1 hour ago' /dev/shm/mine.zenoh && \
         {{ {REALO} run {} --recorded-detections --ego car --rate 0.5 --log {} --out {}; code=$?; ls /dev/shm; exit $code; }}",
        graph("late_fusion"),
        Scene::default().write("life-orphan").display(),
        out.display()
    );
    let Some(output) = with_shared_memory(256, &script) else {
        return;
    };
    let (left, said) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{said}");
    assert!(!said.contains("go through sockets"), "{said}");
    assert!(!left.contains("123456.zenoh") && left.contains("mine.zenoh"), "{left}");
}
