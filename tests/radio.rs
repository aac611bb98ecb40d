//! Agents on machines of their own, here on one: each has its graph, and they meet over Zenoh alone.

mod common;
#[path = "radio/latency.rs"]
mod latency;
#[path = "radio/security.rs"]
mod security;

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::time::Duration;

use common::machine::{decided, quarter, three_quarters};
use common::{
    Peer, REALO, arguments, boxes, files_below, folder, free_port, json, realo, realo_ok, root, run_virtual,
    run_virtual_faulty, simulated, text,
};
use serde_json::Value;

/// Sweeps of the agents lie at least 15 ms apart, so that no race decides which message is the newest.
fn log() -> PathBuf {
    let args = "--seed 903 --seconds 3 --phase spread --no-clouds --key-hz 10";
    simulated("spread", &args.split(' ').collect::<Vec<_>>())
}

/// With points, for networks: one sweep a second leaves any machine time to compute. The other agent's sweeps are 76 ms later than the
/// ego's, so the ego always fuses the sweep before.
fn clouds() -> PathBuf {
    let args = "--seed 923 --seconds 10 --phase spread --key-hz 1 --key-sweeps-only --agents cav1,rsu1";
    simulated("radio_slow", &args.split(' ').collect::<Vec<_>>())
}

/// Arguments of a run that detects by itself.
fn with_networks(name: &str, log: &Path, out: &Path, set: &[String]) -> Vec<String> {
    let all = arguments(name, log, out, set);
    all.into_iter().filter(|one| one != "--recorded-detections").collect()
}

/// sent = used + … + lost, for what the peer sent.
fn assert_books_add_up(result: &Value) {
    let link = &result["links"]["rsu1-cav1"]["boxes"];
    assert_eq!(link["unaccounted"], 0, "{link}");
    assert!(link["sent"].as_u64() > Some(0), "{link}");
}

#[test]
fn agents_that_meet_over_zenoh_find_what_a_perfect_link_finds() {
    decided(late_fusion_over_zenoh);
}

fn late_fusion_over_zenoh() {
    let _share = three_quarters();
    let (log, port) = (log(), free_port());
    let (near, far) = (folder("radio_vehicle"), folder("radio_roadside"));
    let together = ["--recorded-detections", "--ego", "cav1", "--agents", "cav1,rsu1"];
    run_virtual("radio_virtual", "late_fusion", &log, &together);
    let virtual_out = Path::new(env!("CARGO_TARGET_TMPDIR")).join("radio_virtual");
    let expected = boxes(&virtual_out);
    // Both machines are one, and so their clocks.
    let synchronised = "v2x.clock_error_ms=0.001";
    let _peer = Peer::start("late_fusion.roadside", &log, &far, port, &[synchronised]);
    // A machine that stands still for a moment delays a message by more than the sweeps lie apart.
    let mut different = Vec::new();
    for _ in 0..3 {
        let set = [format!("v2x.listen=tcp/127.0.0.1:{port}"), synchronised.into()];
        realo_ok(arguments("late_fusion.vehicle", &log, &near, &set));
        let result = json(&near.join("result.json"));
        assert_books_add_up(&result);
        let peer = &result["peers"][0];
        assert_eq!(peer["clock_by"], "machines", "{peer}");
        assert!(
            peer["clock_ms"].as_f64().is_some_and(|clock| clock.abs() < 2.0),
            "{peer}"
        );
        let trace = files_below(&near)
            .into_iter()
            .find(|path| path.ends_with("channels/rsu1.csv"));
        let trace = std::fs::read_to_string(trace.expect("what the way from rsu1 was like")).expect("a file");
        assert!(
            trace.starts_with("seconds,bits_per_second,") && trace.lines().count() > 2,
            "{trace}"
        );
        let found = boxes(&near);
        assert_eq!(found.len(), expected.len());
        different = (0..found.len())
            .filter(|frame| found[*frame] != expected[*frame])
            .collect();
        if different.is_empty() {
            return;
        }
    }
    panic!("other boxes in frames {different:?} of three runs");
}

/// What the vehicle finds with others' points or maps that come over a link without limits, beside what its sister on one machine finds
/// over a perfect one. Ages are those of the log on any machine.
fn assert_same_boxes(strategy: &str, projected_by: &str, sender: &[&str], roadside: &[&str], banks: &[&str]) {
    let _share = three_quarters();
    let (log, port) = (clouds(), free_port());
    let of_bank = |bank: &&str| ["window_ms=1500", "patience_ms=0"].map(|setting| format!("{bank}.bank.{setting}"));
    let windows: Vec<String> = banks.iter().flat_map(of_bank).collect();
    let of_others: Vec<String> = sender.iter().map(|one| format!("others.{one}")).collect();
    let together = folder(&format!("radio_{strategy}_together"));
    let mut args = with_networks(strategy, &log, &together, &[&of_others[..], &windows].concat());
    let virtually = [
        "--mode",
        "virtual",
        "--ego",
        "cav1",
        "--agents",
        "cav1,rsu1",
        "--project",
        projected_by,
    ];
    args.extend(virtually.map(String::from));
    realo_ok(args);
    let expected = boxes(&together);
    let fused = json(&together.join("result.json"))["links"]["rsu1-cav1"].to_string();
    // Of the first frame nothing was heard before; senders that project have heard of no ego then either.
    let used = [1, 2].map(|without| format!("\"used\":{},", expected.len() - without));
    assert!(used.iter().any(|used| fused.contains(used)), "{fused}");

    let (near, far) = (
        folder(&format!("radio_{strategy}_near")),
        folder(&format!("radio_{strategy}_far")),
    );
    let of_radio = |more: [String; 2]| {
        let set = more.into_iter().chain(["v2x.clock_error_ms=0.001".into()]);
        set.collect::<Vec<String>>()
    };
    let mut connects = of_radio([format!("v2x.connect=tcp/127.0.0.1:{port}"), "player.repeat=20".into()]);
    connects.extend(roadside.iter().map(|setting| setting.to_string()));
    let _peer = Peer::spawn(with_networks(&format!("{strategy}.roadside"), &log, &far, &connects));
    let listens = of_radio([format!("v2x.listen=tcp/127.0.0.1:{port}"), "player.repeat=2".into()]);
    let vehicle = with_networks(
        &format!("{strategy}.vehicle"),
        &log,
        &near,
        &[listens, windows].concat(),
    );
    // The first pass may begin before the other agent is heard, the second goes on from it, and a machine that stands still costs a frame.
    let mut same = Vec::new();
    for _ in 0..3 {
        realo_ok(vehicle.clone());
        let found = boxes(&near);
        assert_eq!(found.len(), 2 * expected.len());
        let second = &found[expected.len()..];
        let of_both = (1..expected.len()).filter(|frame| second[*frame] == expected[*frame]);
        same.push(of_both.count());
        if same.last() >= Some(&(expected.len() - 2)) {
            return;
        }
    }
    let links = &json(&near.join("result.json"))["links"];
    panic!(
        "{same:?} of {} frames have the boxes of a perfect link: {links}",
        expected.len() - 1
    );
}

#[test]
fn early_fusion_over_zenoh_finds_what_a_perfect_link_finds() {
    decided(early_fusion_over_zenoh);
}

fn early_fusion_over_zenoh() {
    assert_same_boxes("early_fusion", "receiver", &["sender.step_m=0.01"], &[], &["fusion"]);
}

#[test]
fn attfuse_over_zenoh_finds_what_a_perfect_link_finds() {
    decided(attfuse_over_zenoh);
}

fn attfuse_over_zenoh() {
    let sender = ["encoder.confidence=true", "sender.budget_bytes=60000"];
    assert_same_boxes("attfuse", "sender", &sender, &[], &["fusion"]);
}

#[test]
fn hybrid_fusion_over_zenoh_finds_what_a_perfect_link_finds() {
    decided(hybrid_fusion_over_zenoh);
}

fn hybrid_fusion_over_zenoh() {
    assert_same_boxes(
        "hybrid_fusion",
        "receiver",
        &["sender.step_m=0.01"],
        &[],
        &["fusion.points", "fusion.rest"],
    );
}

#[test]
fn hybrid_features_over_zenoh_find_what_a_perfect_link_finds() {
    decided(hybrid_features_over_zenoh);
}

fn hybrid_features_over_zenoh() {
    // A budget that follows the radio is not the same in every run.
    assert_same_boxes(
        "hybrid_features",
        "sender",
        &["sender.follow=false"],
        &["others.sender.follow=false"],
        &["fusion.cells", "fusion.rest"],
    );
}

#[test]
fn an_agent_alone_finds_what_it_finds_without_others() {
    decided(an_agent_alone);
}

fn an_agent_alone() {
    let _share = quarter();
    let (log, near) = (log(), folder("radio_alone"));
    run_virtual(
        "radio_alone_virtual",
        "no_fusion",
        &log,
        &["--recorded-detections", "--ego", "cav1"],
    );
    let set = [format!("v2x.listen=tcp/127.0.0.1:{}", free_port())];
    realo_ok(arguments("late_fusion.vehicle", &log, &near, &set));
    let virtual_out = Path::new(env!("CARGO_TARGET_TMPDIR")).join("radio_alone_virtual");
    assert!(boxes(&near) == boxes(&virtual_out), "the same boxes in every frame");
    let result = json(&near.join("result.json"));
    assert_eq!(result["links"], serde_json::json!({}));
    assert!(
        result["notes"].to_string().contains("took no message of another agent"),
        "{}",
        result["notes"]
    );
}

#[test]
fn a_peer_that_is_killed_and_comes_back_is_heard_again() {
    decided(kill_a_peer);
}

fn kill_a_peer() {
    let _share = quarter();
    let (log, port) = (log(), free_port());
    let (near, far) = (folder("radio_killed"), folder("radio_killed_roadside"));
    let vehicle = std::thread::spawn({
        let (log, near) = (log.clone(), near.clone());
        move || {
            let set = [format!("v2x.listen=tcp/127.0.0.1:{port}"), "player.repeat=6".into()];
            realo_ok(arguments("late_fusion.vehicle", &log, &near, &set));
        }
    });
    let peer = Peer::start("late_fusion.roadside", &log, &far, port, &[]);
    std::thread::sleep(Duration::from_secs(16));
    drop(peer);
    let peer = Peer::start("late_fusion.roadside", &log, &far, port, &[]);
    vehicle.join().expect("the vehicle's run is complete");
    drop(peer);
    let result = json(&near.join("result.json"));
    assert_books_add_up(&result);
    let processed = result["frames"]["processed"].as_u64();
    assert!(
        processed >= Some(6 * 30 - 2),
        "the ego never stalls: {}",
        result["frames"]
    );
}

#[test]
fn an_agent_that_joins_while_others_send_loses_nothing_of_what_comes() {
    decided(join_while_others_send);
}

fn join_while_others_send() {
    let _share = quarter();
    let (log, port) = (log(), free_port());
    let (near, far) = (folder("radio_joins"), folder("radio_joins_roadside"));
    let _peer = Peer::start("late_fusion.roadside", &log, &far, port, &[]);
    std::thread::sleep(Duration::from_secs(12));
    let set = [format!("v2x.listen=tcp/127.0.0.1:{port}"), "player.repeat=2".into()];
    realo_ok(arguments("late_fusion.vehicle", &log, &near, &set));
    let result = json(&near.join("result.json"));
    assert_books_add_up(&result);
    assert_eq!(result["transport"]["total_lost"], 0, "{}", result["transport"]);
}

#[test]
fn a_roadside_unit_shares_maps_in_the_frame_of_who_fuses_them() {
    decided(share_maps);
}

fn share_maps() {
    let _share = three_quarters();
    let (log, port) = (clouds(), free_port());
    let (near, far) = (folder("radio_maps_vehicle"), folder("radio_maps_roadside"));
    let repeat = "player.repeat=3".to_string();
    let roadside = std::thread::spawn({
        let connect = format!("v2x.connect=tcp/127.0.0.1:{port}");
        let run = with_networks("attfuse.roadside", &log, &far, &[connect, repeat.clone()]);
        move || realo_ok(run)
    });
    let listen = format!("v2x.listen=tcp/127.0.0.1:{port}");
    let window = "fusion.bank.window_ms=1500".to_string();
    realo_ok(with_networks("attfuse.vehicle", &log, &near, &[listen, repeat, window]));
    roadside
        .join()
        .expect("the roadside unit's run is complete, though its lane hangs on its own radio");
    let books = |out: &Path, link: &str, kind: &str| {
        let result = json(&out.join("result.json"));
        let books = result["links"][link][kind].clone();
        assert_eq!(books["unaccounted"], 0, "{link} {kind} of {}", result["links"]);
        let count = |term: &str| books[term].as_u64().expect("a count");
        [count("sent"), count("used"), count("bytes")]
    };
    let [sent, used, bytes] = books(&near, "rsu1-cav1", "features");
    assert!(
        used >= 10 && bytes <= 60_100 * sent,
        "{used} used of {sent}, {bytes} bytes"
    );
    let [reported, used, _] = books(&far, "cav1-rsu1", "agent_state");
    assert!(
        used >= 10,
        "{used} of {reported} states of the ego, by which it projected"
    );
    assert_eq!(
        json(&far.join("result.json"))["frames"]["processed"],
        0,
        "it fuses nothing"
    );
}

/// The log that an agent's graph recorded.
fn recorded(out: &Path, agent: &str) -> String {
    let name = format!("{agent}.mcap");
    let found = files_below(out).into_iter().find(|path| path.ends_with(&name));
    found.expect("the agent's log").display().to_string()
}

/// Milliseconds that `realo merge` says a log was moved by at its beginning.
fn moved(said: &str) -> f64 {
    let rest = said.split("moved by ").nth(1).unwrap_or_else(|| panic!("{said}"));
    rest.split(' ')
        .next()
        .and_then(|word| word.parse().ok())
        .expect("a number")
}

#[test]
fn what_agents_recorded_is_one_log_again_though_a_clock_is_off() {
    decided(merge_recordings);
}

fn merge_recordings() {
    let _share = quarter();
    let (log, port) = (log(), free_port());
    let (near, far) = (folder("radio_merge_vehicle"), folder("radio_merge_roadside"));
    let roadside = std::thread::spawn({
        let (log, far) = (log.clone(), far.clone());
        let connect = format!("v2x.connect=tcp/127.0.0.1:{port}");
        let set = [connect, "player.skew_ms=-200".into(), "player.repeat=3".into()];
        move || realo_ok(arguments("late_fusion.roadside", &log, &far, &set))
    });
    let set = [format!("v2x.listen=tcp/127.0.0.1:{port}"), "player.repeat=3".into()];
    realo_ok(arguments("late_fusion.vehicle", &log, &near, &set));
    roadside.join().expect("the roadside unit's run is complete");
    let clock = &json(&near.join("result.json"))["peers"][0];
    assert_eq!(clock["clock_by"], "exchanges", "{clock}");
    let merged = near.join("merged.mcap").display().to_string();
    let logs = [recorded(&near, "cav1"), recorded(&far, "rsu1")];
    let said = realo_ok(["merge", &logs[0], &logs[1], "-o", &merged]);
    assert!((moved(&said) - 200.0).abs() < 5.0, "{said}");
    let given = near.join("given.mcap").display().to_string();
    let said = realo_ok(["merge", &logs[1], &logs[0], "-o", &given, "--clock", "cav1=150"]);
    assert_eq!(moved(&said), -150.0, "{said}");
    assert!(
        realo(["merge", &logs[1], &logs[0], "-o", &given, "--clock", "cav1"])
            .status
            .code()
            == Some(2)
    );

    // Agents start at a multiple of 5 s: where one comes later, the log has fewer of its sweeps.
    let together = ["--recorded-detections", "--ego", "cav1"];
    let result = run_virtual_faulty("radio_merged", "late_fusion", Path::new(&merged), &together);
    assert_eq!(result["frames"]["processed"], 90);
    let books = &result["links"]["rsu1-cav1"]["boxes"];
    assert!(books["used"].as_u64() >= Some(28) && books["rejected"] == 0, "{books}");
    let original = [&together[..], &["--agents", "cav1,rsu1"]].concat();
    run_virtual("radio_unmerged", "late_fusion", &log, &original);
    let of = |name: &str| boxes(&Path::new(env!("CARGO_TARGET_TMPDIR")).join(name));
    let (all, pass) = (of("radio_merged"), of("radio_unmerged"));
    // Class, score, then x and y in micrometres.
    let centers = |frame: &Value| -> Vec<f64> {
        let detections = frame.as_array().expect("detections").iter();
        detections
            .flat_map(|one| [2, 3].map(|axis| one[axis].as_f64().expect("micrometres") * 1e-6))
            .collect()
    };
    assert!(pass[3..].iter().all(|frame| centers(frame).len() > 20));
    // A pass begins without what the others sent before.
    let near_frames = |k: usize| {
        (3..30)
            .filter(|frame| {
                let (found, expected) = (centers(&all[30 * k + frame]), centers(&pass[*frame]));
                let near = |(a, b): (&f64, &f64)| (a - b).abs() < 0.05;
                found.len() == expected.len() && found.iter().zip(&expected).all(near)
            })
            .count()
    };
    let best = (0..3).map(near_frames).max();
    assert!(
        best >= Some(25),
        "{:?} of 27 frames are those of the log that was played",
        (0..3).map(near_frames).collect::<Vec<_>>()
    );
}

#[test]
fn what_cannot_work_is_said_before_the_run() {
    let log = log();
    let near = folder("radio_wrong");
    let refused = |set: &[&str], more: &[&str]| {
        let set: Vec<String> = set.iter().map(|set| set.to_string()).collect();
        let mut all = arguments("late_fusion.vehicle", &log, &near, &set);
        all.extend(more.iter().map(|more| more.to_string()));
        let output = realo(all);
        assert!(!output.status.success(), "{set:?} {more:?}");
        text(&output.stderr)
    };
    for (set, more, expected) in [
        (&["v2x.listen=rsu1.local:7447"][..], &[][..], "tcp/HOST:PORT"),
        (&["v2x.listen=tcp/0.0.0.0:70000"], &[], "found `tcp/0.0.0.0:70000`"),
        (&["v2x.listen="], &[], "`listen`, `connect`"),
        (&["v2x.site=a*b"], &[], "setting `site`"),
        (&["v2x.deadline_ms=0"], &[], "setting `deadline_ms`"),
        (&[], &["--mode", "virtual"], "realtime only"),
        (&[], &["--rate", "2"], "clock=wall"),
        (&["player.skew_ms=1e9"], &[], "`skew_ms`"),
    ] {
        let found = refused(set, more);
        assert!(found.contains(expected), "{set:?} {more:?}: {found}");
    }
    let taken = TcpListener::bind("127.0.0.1:0").expect("a port is free");
    let port = taken.local_addr().expect("it has an address").port();
    let found = refused(&[&format!("v2x.listen=tcp/127.0.0.1:{port}")], &[]);
    assert!(found.contains(&port.to_string()), "{found}");
}
