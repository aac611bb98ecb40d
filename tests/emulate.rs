//! Two machines in one: graphs and benches over an emulated link, on namespaces where they can be made and over a relay everywhere.

mod common;

use std::io::{BufRead, BufReader, Lines, Write};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::mpsc::RecvTimeoutError;
use std::time::Duration;

use linkemu::{ADDRESSES, Link, Machines};

use common::machine::{decided, quarter};
use common::{LAB, Peer, REALO, arguments, end, folder, free_port, json, lab, root, simulated, text};
use serde_json::Value;

const NEEDS: &str = "network namespaces and /dev/net/tun, as root or in a user namespace";

/// `realo-lab emulate`, and what it has said.
struct Emulated {
    child: Child,
    lines: Lines<BufReader<ChildStdout>>,
    said: Vec<String>,
}

impl Emulated {
    fn start(args: &[&str]) -> Emulated {
        let mut command = Command::new(LAB.expect("a test of the package `realo-lab`"));
        command.arg("emulate").args(args).process_group(0).current_dir(root());
        command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null());
        let mut child = command.spawn().expect("the workbench can be started");
        let mut lines = BufReader::new(child.stdout.take().expect("a pipe")).lines();
        let mut said = Vec::new();
        while !said.last().is_some_and(|line: &String| line.starts_with("Ctrl-C")) {
            let line = lines.next().unwrap_or_else(|| panic!("it ended after {said:?}"));
            said.push(line.expect("text"));
        }
        Emulated { child, lines, said }
    }

    fn report(&mut self, line: &str) {
        let input = self.child.stdin.as_mut().expect("a pipe");
        writeln!(input, "{line}").expect("it listens");
    }

    /// Bytes that were carried there and back.
    fn carried(&mut self) -> [u64; 2] {
        self.report("stat");
        [0, 1].map(|_| {
            let line = self.lines.next().expect("an answer").expect("text");
            let bytes = line.split(" bytes").next().and_then(|head| head.rsplit(' ').next());
            let bytes = bytes.and_then(|word| word.parse().ok());
            bytes.unwrap_or_else(|| panic!("{line}"))
        })
    }

    /// The commands that it names for the two machines: what stands before `realo`, and the setting behind it.
    fn commands(&self) -> [(Vec<String>, Option<String>); 2] {
        let named: Vec<_> = self.said.iter().filter(|line| line.contains("realo run")).collect();
        assert_eq!(named.len(), 2, "{:?}", self.said);
        [0, 1].map(|at| {
            let words: Vec<String> = named[at].split_whitespace().map(String::from).collect();
            let realo = words
                .iter()
                .position(|word| word.ends_with("realo"))
                .expect("a command");
            let set = words.iter().find(|word| word.starts_with("v2x.")).cloned();
            (words[..realo].to_vec(), set)
        })
    }
}

impl Drop for Emulated {
    fn drop(&mut self) {
        end(&mut self.child);
    }
}

/// Sweeps of the agents lie at least 15 ms apart.
fn log() -> PathBuf {
    let args = "--seed 903 --seconds 3 --phase spread --no-clouds --key-hz 10";
    simulated("spread", &args.split(' ').collect::<Vec<_>>())
}

/// A graph as `realo-lab emulate` says that it is started, for recorded detections.
fn on_machine((enter, set): &(Vec<String>, Option<String>), name: &str, out: &Path, repeat: u32) -> Command {
    let mut settings: Vec<String> = set.iter().cloned().collect();
    settings.push(format!("player.repeat={repeat}"));
    let mut words = enter.iter().cloned().chain([REALO.to_string()]);
    let mut command = Command::new(words.next().expect("a program"));
    command.args(words).args(arguments(name, &log(), out, &settings));
    command.current_dir(root()).stdin(Stdio::null());
    command
}

/// Runs a vehicle and a roadside unit over the link, and gives the vehicle's result.
fn meet(emulated: &Emulated, name: &str) -> Value {
    let [vehicle, roadside] = emulated.commands();
    let (near, far) = (folder(&format!("{name}_vehicle")), folder(&format!("{name}_roadside")));
    let _peer = Peer::of(on_machine(&roadside, "late_fusion.roadside", &far, 20));
    let mut command = on_machine(&vehicle, "late_fusion.vehicle", &near, 2);
    let output = command.output().expect("a graph can be started");
    assert!(output.status.success(), "{}", text(&output.stderr));
    json(&near.join("result.json"))
}

fn assert_the_delay_shows(result: &Value, delay_ms: f64) {
    let books = &result["links"]["rsu1-cav1"]["boxes"];
    assert_eq!(books["unaccounted"], 0, "{books}");
    assert!(books["used"].as_u64() > Some(0), "{books}");
    let mut peers = result["peers"].as_array().expect("peers").iter();
    let peer = peers.find(|peer| peer["name"] == "rsu1").expect("the roadside unit");
    let round_trip = peer["round_trip_ms"].as_f64();
    assert!(round_trip >= Some(2.0 * delay_ms), "{peer}");
}

#[test]
fn graphs_meet_on_two_emulated_machines() {
    decided(meet_between_namespaces);
}

fn meet_between_namespaces() {
    let _share = quarter();
    let id = std::process::id();
    let names = format!("realo{id}car,realo{id}unit");
    let mut emulated = Emulated::start(&["--delay", "30", "--names", &names]);
    if emulated.said[0].contains("relay") {
        return skipped::skip(NEEDS);
    }
    assert!(emulated.said[0].contains("network namespaces"), "{:?}", emulated.said);
    let result = meet(&emulated, "emulated");
    assert_the_delay_shows(&result, 30.0);
    let carried = emulated.carried();
    assert!(carried.iter().all(|bytes| *bytes > 1000), "{carried:?}");
}

#[test]
fn graphs_meet_over_a_relay_on_loopback() {
    decided(meet_over_a_relay);
}

fn meet_over_a_relay() {
    let _share = quarter();
    let port = free_port().to_string();
    let mut emulated = Emulated::start(&["--loopback", "--delay", "30", "--port", &port]);
    assert!(
        emulated.said[0].contains("a relay on loopback: nothing is lost"),
        "{:?}",
        emulated.said
    );
    let result = meet(&emulated, "relayed");
    assert_the_delay_shows(&result, 30.0);
    let carried = emulated.carried();
    assert!(carried.iter().all(|bytes| *bytes > 1000), "{carried:?}");
}

#[test]
fn a_relay_refuses_what_it_cannot_do() {
    let port = free_port().to_string();
    for (args, expected) in [
        (["--loss", "0.1"], "--loss: the relay carries streams"),
        (["--duplicate", "0.1"], "--duplicate: the relay carries streams"),
        (
            ["--duplicate", "1.5"],
            "--duplicate: expected a number from 0 to 1, found 1.5",
        ),
        (["--port", "65535"], "--port: expected one with another behind it"),
        (["--port", "0"], "from 1 to 65534, found 0"),
        (
            ["--rate", "1e300"],
            "--rate: expected 0, for no limit, or a number of Mbit/s",
        ),
        (
            ["--rate", "1e-7"],
            "--rate: expected 0, for no limit, or a number of Mbit/s",
        ),
        (
            ["--delay", "1e300"],
            "--delay: expected a number of ms from 0 to 1000000",
        ),
        (
            ["--delay", "-3"],
            "--delay: expected a number of ms from 0 to 1000000, found -3",
        ),
    ] {
        let output = lab(["emulate", "--loopback"].iter().chain(&args));
        let said = text(&output.stderr);
        assert!(!output.status.success() && said.contains(expected), "{args:?}: {said}");
    }
    let taken = std::net::TcpListener::bind(format!("127.0.0.2:{port}")).expect("the port is free");
    let said = text(&lab(["emulate", "--loopback", "--port", &port]).stderr);
    assert!(said.contains("choose another --port") && said.contains(&port), "{said}");
    drop(taken);
}

#[test]
fn a_line_that_is_no_text_does_not_end_the_commands() {
    let port = free_port().to_string();
    let mut emulated = Emulated::start(&["--loopback", "--port", &port]);
    let input = emulated.child.stdin.as_mut().expect("a pipe");
    input.write_all(b"rate \xff\n").expect("it listens");
    // Where nobody answers it ends, and the wait for an answer with it.
    let (answered, waits) = std::sync::mpsc::channel::<()>();
    let id = emulated.child.id().to_string();
    let watch = std::thread::spawn(move || {
        if waits.recv_timeout(Duration::from_secs(20)) == Err(RecvTimeoutError::Timeout) {
            let _ = Command::new("kill").args(["-INT", &id]).status();
        }
    });
    let carried = emulated.carried();
    drop(answered);
    watch.join().expect("it only waits");
    assert_eq!(carried, [0, 0]);
}

#[test]
fn a_name_that_is_taken_or_none_is_reported_and_what_is_there_stays() {
    let taken = format!("realo{}taken", std::process::id());
    let said = text(&lab(["emulate", "--names", "a/b,roadside"]).stderr);
    assert!(said.contains("neither . nor - at the beginning, found `a/b`"), "{said}");
    let ip = |arguments: &[&str]| Command::new("ip").args(arguments).output().ok();
    if !ip(&["netns", "add", &taken]).is_some_and(|output| output.status.success()) {
        return skipped::skip("network namespaces, as root");
    }
    // As the second name too: what was made for the first one goes again.
    let other = format!("{taken}too");
    let mut all = Vec::new();
    for names in [format!("{taken},{other}"), format!("{other},{taken}")] {
        all.push(text(&lab(["emulate", "--names", &names]).stderr));
    }
    let left = ip(&["netns", "list"])
        .map(|output| text(&output.stdout))
        .unwrap_or_default();
    ip(&["netns", "del", &taken]);
    assert!(left.contains(&taken) && !left.contains(&other), "{left}");
    for said in all {
        assert!(said.contains(&format!("`ip netns del {taken}`")), "{said}");
    }
}

#[test]
fn a_clock_that_is_set_meanwhile_moves_no_latency() {
    decided(set_a_clock_meanwhile);
}

fn set_a_clock_meanwhile() {
    let _share = quarter();
    let link = Link::default();
    assert!(link.set("delay", 40.0));
    let names = ["answers", "asks"].map(|name| format!("realo{}{name}", std::process::id()));
    let machines = match Machines::join(&names[0], &names[1], link.into()) {
        Ok(machines) => machines,
        Err(linkemu::Error::Nowhere { .. }) => return skipped::skip("network namespaces and /dev/net/tun, as root"),
        Err(error) => panic!("{error}"),
    };
    let mut answering = machines.command(0, REALO);
    answering.args(["latency", "--listen", "tcp/0.0.0.0:7447"]);
    let _answering = Peer::of(answering);
    let (log, trace) = (log().display().to_string(), folder("latency_set").join("way.csv"));
    let peer = format!("tcp/{}:7447", ADDRESSES[0]);
    let mut asking = machines.command(1, REALO);
    asking.args([
        "latency",
        "--peer",
        &peer,
        "--log",
        &log,
        "--recorded-detections",
        "--json",
    ]);
    asking
        .args(["--graph", "dataflows/late_fusion.yml", "--messages", "30", "-o"])
        .arg(&trace);
    let asking = asking
        .current_dir(root())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn();
    let mut asking = asking.expect("the workbench can be started");
    let mut ahead_ms = 0.0;
    while asking.try_wait().expect("it is a child").is_none() {
        std::thread::sleep(Duration::from_millis(300));
        ahead_ms = 5000.0 - ahead_ms;
        machines.set_clock(1, ahead_ms).expect("its programs read it");
    }
    let output = asking.wait_with_output().expect("it has ended");
    assert!(output.status.success(), "{}", text(&output.stderr));
    let found: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let row = &found["kinds"][0];
    for way in ["half_of_round_trip_ms", "one_way_ms"] {
        let of = |share: &str| row[way][share].as_f64().expect("ms");
        assert!(of("p50") >= 30.0 && of("p99") < 1000.0, "{found}");
    }
}

/// What a bench says as JSON; `None` where it needs what is not here.
fn bench(args: &[&str]) -> Option<Value> {
    let (found, ends_well, said) = judged(args)?;
    assert!(ends_well, "{args:?}: {said}");
    Some(found)
}

/// The same of a bench that judges what it finds, with its verdict and what it says of it.
fn judged(args: &[&str]) -> Option<(Value, bool, String)> {
    let output = lab(["bench"].iter().chain(args).chain(&["--json"]));
    let said = text(&output.stderr);
    if said.contains("no network namespaces here") {
        skipped::skip(NEEDS);
        return None;
    }
    let found = serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{args:?}: {error}: {said}"));
    Some((found, output.status.success(), said))
}

/// Of each case: boxes came, none before the link lets it.
fn assert_boxes_cross(found: &Value, cases: usize) {
    let all = found["cases"].as_array().expect("cases");
    assert_eq!(all.len(), cases, "{found}");
    for case in all {
        let boxes = &case["kinds"]["boxes"];
        let (arrived, offered) = (boxes["arrived"].as_u64(), boxes["offered"].as_u64());
        assert!(arrived > Some(0) && arrived <= offered, "{case}");
        assert!(boxes["p50_ms"].as_f64() >= Some(20.0), "{case}");
    }
}

#[test]
fn boxes_cross_beside_clouds_between_namespaces() {
    decided(cross_between_namespaces);
}

fn cross_between_namespaces() {
    let _share = quarter();
    let Some(found) = bench(&["radio", "--seconds", "2", "--only", "1 % loss, bbr"]) else {
        return;
    };
    assert!(
        found["link"]
            .as_str()
            .is_some_and(|link| link.contains("two network namespaces")),
        "{found}"
    );
    assert_boxes_cross(&found, 2);
}

#[test]
fn boxes_cross_beside_clouds_over_a_relay() {
    decided(cross_over_a_relay);
}

fn cross_over_a_relay() {
    let _share = quarter();
    let found = bench(&["radio", "--loopback", "--seconds", "2", "--only", "no loss, clouds"]);
    let found = found.expect("it needs no namespaces");
    assert!(
        found["link"]
            .as_str()
            .is_some_and(|link| link.contains("a relay on loopback")),
        "{found}"
    );
    assert_boxes_cross(&found, 1);
    let output = lab(["bench", "radio", "--loopback", "--only", "frost"]);
    let said = text(&output.stderr);
    assert!(said.contains("no case is named so; there are: no loss; "), "{said}");
}

/// The one row of a bench of faults over so many passes of 10 s; `None` where it cannot be had.
fn row_of(name: &str, passes: u32) -> Option<Value> {
    let seconds = (10 * passes).to_string();
    let args = ["faults", "--recorded-detections", "--only", name, "--seconds", &seconds];
    let (found, ends_well, said) = judged(&args)?;
    let rows = found["rows"].as_array().expect("rows");
    assert_eq!(rows.len(), 1, "{found}");
    let row = &rows[0];
    assert_eq!(row["fault"], *name);
    let broken = row["broken"].as_array().expect("a list");
    assert_eq!(ends_well, broken.is_empty(), "{found}: {said}");
    for what in broken {
        let what = what.as_str().expect("text");
        assert!(what.contains("of the ego's frames") || what.contains("mAP"), "{row}");
        assert!(
            said.contains(&format!("realo-lab: {name}: ")) && said.contains(what),
            "{said}"
        );
    }
    let frames = |at: usize| row["frames"][at].as_u64().expect("a count");
    let all = 100 * u64::from(passes);
    assert!(frames(1) == all && frames(0) >= all - 10, "{row}");
    assert_eq!(row["unaccounted"], 0, "{row}");
    assert!(row["memory_mb"].as_f64() > Some(0.0), "{row}");
    assert!(found["alone"][0].as_f64() > Some(0.5), "{found}");
    Some(row.clone())
}

fn count(number: &Value) -> u64 {
    number.as_u64().expect("a count")
}

#[test]
fn the_ego_goes_on_while_the_link_is_cut() {
    decided(cut_the_link);
}

fn cut_the_link() {
    let _share = quarter();
    let Some(row) = row_of("cut for 5 s", 2) else { return };
    assert!(
        count(&row["fates"]["used"]) <= count(&row["sent"]) && count(&row["sent"]) < 190,
        "what is offered while the link is cut is not begun: {row}"
    );
}

#[test]
fn graphs_go_on_when_the_clock_of_the_roadside_unit_is_set() {
    // Of graphs that followed it the vehicle would find a clock that is off.
    decided(|| set_a_clock("roadside unit's clock set 200 ms ahead, then 200 ms behind"));
}

#[test]
fn graphs_go_on_when_the_clock_of_the_vehicle_is_set() {
    // A graph that followed it would stand still for an hour.
    decided(|| set_a_clock("vehicle's clock set an hour back"));
}

fn set_a_clock(name: &str) {
    let _share = quarter();
    let Some(row) = row_of(name, 2) else { return };
    let off = row["clock_ms"].as_f64().expect("its clock was asked for");
    assert!(off.abs() < 50.0, "{row}");
    assert!(count(&row["fates"]["used"]) > 100, "{row}");
}

#[test]
fn a_peer_that_comes_back_with_another_clock_is_placed_anew() {
    decided(come_back_with_another_clock);
}

fn come_back_with_another_clock() {
    let _share = quarter();
    let name = "roadside unit killed, back after 2 s with its clock 200 ms ahead";
    // On a slow machine it takes ten seconds until it is back.
    let Some(row) = row_of(name, 4) else { return };
    let off = row["clock_ms"].as_f64().expect("its clock was asked for");
    assert!((off - 200.0).abs() < 50.0, "{row}");
    assert!(count(&row["fates"]["used"]) > 50, "{row}");
}
