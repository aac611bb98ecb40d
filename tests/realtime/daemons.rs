//! One agent's graph on two machines: two of dora's daemons, each with folders of its own.

use std::fs::{self, File};
use std::net::TcpStream;
use std::os::unix::fs::symlink;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::common::machine::{decided, quarter};
use crate::common::{Peer, boxes, end, folder, free_port, graph, json, realo, realo_ok, root, simulated, text};
use serde_json::Value;

const GRAPH: &str = "late_fusion.deployed";
const MACHINES: [&str; 2] = ["sensors", "compute"];
/// A run of three seconds takes so long at most.
const LONGEST: Duration = Duration::from_secs(150);

/// A coordinator, and a daemon for each machine.
struct Daemons {
    dora: PathBuf,
    home: PathBuf,
    port: u16,
    children: Vec<Child>,
}

impl Daemons {
    /// `None` without dora.
    fn start(home: &Path) -> Option<Daemons> {
        let Ok(dora) = realo::run::find_dora() else {
            skipped::skip("dora 1.1 in REALO_DORA, target/dora-cli or PATH, to start two of its daemons");
            return None;
        };
        let mut daemons = Daemons {
            dora,
            home: home.into(),
            port: free_port(),
            children: Vec::new(),
        };
        let (port, overlay) = (daemons.port.to_string(), root().join("dataflows/zenoh.json5"));
        daemons.spawn(
            "coordinator",
            home,
            &["coordinator", "--port", &port, "--store", "memory"],
        );
        daemons.wait_for("coordinator", "istening on port");
        for machine in MACHINES {
            let (own_port, overlay) = (free_port().to_string(), overlay.to_string_lossy());
            let mut all = vec!["daemon", "--machine-id", machine, "--coordinator-port", &port];
            all.extend(["--local-listen-port", &own_port, "--zenoh-no-multicast"]);
            all.extend(["--zenoh-config-overlay", &overlay]);
            daemons.spawn(machine, &home.join(machine), &all);
        }
        MACHINES
            .iter()
            .for_each(|machine| daemons.wait_for(machine, "Connected to dora-coordinator"));
        Some(daemons)
    }

    fn log(&self, name: &str) -> PathBuf {
        self.home.join(format!("{name}.log"))
    }

    fn command(&self, name: &str, folder: &Path, args: &[&str]) -> Command {
        let log = File::create(self.log(name)).expect("the folder can be written");
        let mut command = Command::new(&self.dora);
        command.args(args).current_dir(folder).stdin(Stdio::null());
        command.stderr(log.try_clone().expect("a file has copies")).stdout(log);
        command.process_group(0);
        command
    }

    fn spawn(&mut self, name: &str, folder: &Path, args: &[&str]) {
        let child = self.command(name, folder, args).spawn();
        self.children.push(child.expect("dora can be started"));
    }

    fn wait_for(&self, name: &str, word: &str) {
        let begun = Instant::now();
        while !self.said(name).contains(word) {
            assert!(begun.elapsed() < Duration::from_secs(30), "{name}: {}", self.said(name));
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    fn said(&self, name: &str) -> String {
        text(&fs::read(self.log(name)).unwrap_or_default())
    }

    /// Runs a graph of the machine `compute` to its end.
    fn run(&self) {
        let (port, file) = (self.port.to_string(), format!("dataflows/{GRAPH}.yml"));
        let args = ["start", &*file, "--attach", "--coordinator-port", &port];
        let started = self.command("start", &self.home.join("compute"), &args).spawn();
        let (mut child, begun) = (started.expect("dora can be started"), Instant::now());
        let status = loop {
            if let Some(status) = child.try_wait().expect("a child can be waited for") {
                break status;
            }
            if begun.elapsed() > LONGEST {
                end(&mut child);
                panic!("no end after {LONGEST:?}: {}", self.said("start"));
            }
            std::thread::sleep(Duration::from_millis(100));
        };
        assert!(status.success(), "{status}: {}", self.said("start"));
    }
}

impl Drop for Daemons {
    fn drop(&mut self) {
        self.children.iter_mut().rev().for_each(end);
    }
}

/// What a machine has of the repository: the shipped graph, with recorded detections and another port for the radio.
fn install(home: &Path, port: u16) {
    let shipped = root().join("dataflows");
    let dataflows = home.join("dataflows");
    fs::create_dir_all(home.join("target/realo")).expect("a folder can be made");
    fs::create_dir_all(&dataflows).expect("a folder can be made");
    for name in ["modules", "types", "bin"] {
        symlink(shipped.join(name), dataflows.join(name)).expect("links can be made");
    }
    let mut graph = fs::read_to_string(graph(GRAPH)).expect("the graph can be read");
    for (from, to) in [
        ("detect.network.yml", "detect.recorded.yml".into()),
        ("listen=tcp/0.0.0.0:7447", format!("listen=tcp/127.0.0.1:{port}")),
    ] {
        assert!(graph.contains(from), "{from}");
        graph = graph.replace(from, &to);
    }
    fs::write(dataflows.join(format!("{GRAPH}.yml")), graph).expect("the graph can be written");
}

fn processed(out: &Path) -> u64 {
    let result = json(&out.join("result.json"));
    assert_eq!(result["complete"], true);
    result["frames"]["processed"].as_u64().expect("frames.processed")
}

#[test]
fn a_graph_on_two_daemons_gives_what_it_gives_on_one() {
    decided(two_daemons);
}

fn two_daemons() {
    let _share = quarter();
    let home = folder("daemons");
    let args = "--seed 903 --seconds 3 --phase spread --key-hz 10 --agents cav1,rsu1";
    let log = simulated("daemons", &args.split(' ').collect::<Vec<_>>());
    let port = free_port();
    MACHINES.iter().for_each(|machine| install(&home.join(machine), port));
    let [sensors, compute] = MACHINES.map(|machine| home.join(machine).join("target/realo"));
    // Sweeps are where the sensors are, results where the graph scores.
    symlink(&log, sensors.join("demo.mcap")).expect("links can be made");
    let Some(daemons) = Daemons::start(&home) else { return };
    let (near, recorded) = (compute.join(GRAPH), sensors.join(GRAPH).join("cav1.mcap"));

    let one = home.join("one");
    let said = realo([
        "run",
        &home
            .join("compute/dataflows")
            .join(format!("{GRAPH}.yml"))
            .to_string_lossy(),
        "--log",
        &log.to_string_lossy(),
        "--out",
        &one.to_string_lossy(),
    ]);
    assert!(said.status.success(), "{}", text(&said.stderr));
    let reported = text(&said.stderr);
    assert!(
        reported.contains("for the machines compute, sensors runs on this one"),
        "{reported}"
    );
    let expected = boxes(&one);

    // A machine that stands still for a second lets a sweep wait until the next one takes its place. What is sent before the daemons'
    // processes have found each other is lost.
    let lost = || json(&near.join("result.json"))["transport"]["total_lost"].as_u64();
    let mut kept_up = (0, None);
    for _ in 0..3 {
        daemons.run();
        kept_up = (processed(&near), lost());
        if kept_up == (30, Some(0)) {
            break;
        }
    }
    assert_eq!(
        kept_up,
        (30, Some(0)),
        "frames that the ego scored, of 30, and messages that dora lost"
    );
    assert!(boxes(&near) == expected, "the same boxes in every frame");
    let info = realo_ok(["info", "--json", &recorded.to_string_lossy()]);
    let info: Value = serde_json::from_str(&info).expect("JSON");
    let sweeps = &info["topics"]["/cav1/points"]["messages"];
    assert_eq!(*sweeps, 30, "what the sensors gave is recorded beside them: {info}");
    assert!(!sensors.join(GRAPH).join("result.json").exists());

    // With another agent, whose messages come by the radio. It comes later: what agents send to one whose processes have not yet
    // found each other is lost there.
    let file = home.join("compute/dataflows").join(format!("{GRAPH}.yml"));
    let text = fs::read_to_string(&file).expect("the graph can be read");
    let sensors_module = file.with_file_name("modules/sensors.yml");
    let sensors_text = fs::read_to_string(sensors_module).expect("the module can be read");
    assert!(sensors_text.contains("clock=wall") && text.contains("modules/sensors.yml"));
    let repeated = file.with_file_name("repeated");
    fs::create_dir_all(&repeated).expect("the folder can be made");
    let sensors_text = sensors_text.replace("clock=wall", "clock=wall repeat=8");
    fs::write(repeated.join("sensors.yml"), sensors_text).expect("the module can be written");
    let text = text.replace("modules/sensors.yml", "repeated/sensors.yml");
    fs::write(&file, text).expect("the graph can be written");
    for _ in 0..3 {
        std::thread::scope(|scope| {
            let run = scope.spawn(|| daemons.run());
            let begun = Instant::now();
            while TcpStream::connect(("127.0.0.1", port)).is_err() && begun.elapsed() < LONGEST {
                std::thread::sleep(Duration::from_millis(100));
            }
            std::thread::sleep(Duration::from_secs(3));
            let _peer = Peer::start("late_fusion.roadside", &log, &home.join("far"), port, &[]);
            run.join().expect("the run is complete");
        });
        if lost() == Some(0) {
            break;
        }
    }
    let result = json(&near.join("result.json"));
    let books = &result["links"]["rsu1-cav1"]["boxes"];
    assert_eq!(books["unaccounted"], 0, "{books}");
    assert!(books["used"].as_u64() > Some(0), "{books}");
    assert_eq!(result["transport"]["total_lost"], 0, "{}", result["transport"]);
}
