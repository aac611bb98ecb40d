//! `realo latency` between two processes.

use std::process::{Command, Stdio};

use serde_json::Value;

use super::{Peer, REALO, folder, free_port, quarter, root, run_virtual, text};

/// An end that sends back what comes, until it is dropped.
fn answering(port: u16) -> Peer {
    let address = format!("tcp/127.0.0.1:{port}");
    Peer::spawn(["latency", "--listen", &address].map(String::from).into())
}

fn realo_in(folder: &std::path::Path, args: &[&str]) -> std::process::Output {
    let mut command = Command::new(REALO);
    command.args(args).current_dir(folder).stdin(Stdio::null());
    command.output().expect("realo can be started")
}

#[test]
fn messages_of_each_kind_go_there_and_back_and_the_way_is_replayed() {
    let _share = quarter();
    let (log, out, port) = (super::clouds(), folder("latency"), free_port());
    let [address, log_text, trace] = [
        format!("tcp/127.0.0.1:{port}"),
        log.display().to_string(),
        out.join("way.csv").display().to_string(),
    ];
    let args = [
        "latency",
        "--peer",
        &address,
        "--log",
        &log_text,
        "--messages",
        "5",
        "--json",
        "-o",
        &trace,
    ];
    let _answering = answering(port);
    let output = realo_in(&root(), &args);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let found: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let kinds = found["kinds"].as_array().expect("kinds");
    let names: Vec<_> = kinds.iter().map(|row| row["kind"].as_str().expect("a kind")).collect();
    assert_eq!(names, ["points", "features", "boxes"]);
    for row in kinds {
        assert_eq!((&row["sent"], &row["came_back"]), (&5.into(), &5.into()), "{row}");
        let half = row["half_of_round_trip_ms"]["p50"].as_f64().expect("ms");
        let one_way = row["one_way_ms"]["p50"].as_f64().expect("ms");
        // One clock, so that both are the same but for how differently both ways were disturbed.
        assert!(
            half > 0.0 && one_way > 0.0 && (half - one_way).abs() < 0.5 * half + 50.0,
            "{row}"
        );
    }
    let size = |of: usize| kinds[of]["kilobytes"].as_f64().expect("KB");
    assert!(
        size(0) > size(1) && size(1) > size(2),
        "points, features, boxes: {found}"
    );

    let profile = out.join("way.toml");
    std::fs::write(&profile, "[channel]\ntrace = \"way.csv\"\n").expect("a file");
    let link = [
        "--recorded-detections",
        "--ego",
        "cav1",
        "--link",
        profile.to_str().expect("UTF-8"),
    ];
    let result = run_virtual("latency_replayed", "late_fusion", &super::log(), &link);
    let books = &result["links"]["rsu1-cav1"]["boxes"];
    assert!(books["used"].as_u64() > Some(20) && books["lost"] == 0, "{books}");
}

#[test]
fn what_cannot_be_measured_is_reported() {
    let (log, out) = (super::log().display().to_string(), folder("latency_wrong"));
    let refused = |args: &[&str]| {
        let output = realo_in(&out, &[&["latency"], args].concat());
        assert!(!output.status.success(), "{args:?}");
        text(&output.stderr)
    };
    for (args, expected) in [
        (&[][..], "<--peer <PEER>|--listen <LISTEN>>"),
        (&["--peer", "tcp/127.0.0.1:1"], "--log <LOG>"),
        (&["--listen", "7447"], "tcp/HOST:PORT"),
        (&["--listen", "tcp/127.0.0.1:1", "--log", &log], "cannot be used with"),
        (&["--peer", "tcp/127.0.0.1:1", "--log", "none.mcap"], "none.mcap"),
        (&["--peer", "tcp/127.0.0.1:1", "--log", &log, "--agent", "bus"], "bus"),
        (
            &["--peer", "tcp/127.0.0.1:1", "--log", &log, "--graph", "none.yml"],
            "none.yml",
        ),
        // Before it looks for the other end.
        (
            &["--peer", "tcp/127.0.0.1:1", "--log", &log, "-o", "none/way.csv"],
            "none/way.csv: the trace cannot be written there",
        ),
        (&["--listen", "tcp/127.0.0.1:1", "--key", "a.key"], "--trust <TRUST>"),
        (
            &["--listen", "tcp/127.0.0.1:1", "--key", "a.key", "--trust", "b.toml"],
            "a.key",
        ),
    ] {
        let found = refused(args);
        assert!(found.contains(expected), "{args:?}: {found}");
    }
    assert!(!out.join("channel.csv").exists(), "nothing was measured");
}
