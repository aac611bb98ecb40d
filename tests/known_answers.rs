//! Runs whose answer is known: the DAIR sample, and simulated geometry that cannot hide an error.

mod common;

use std::path::{Path, PathBuf};

use common::{counts, lab_ok, realo_ok, run_virtual, simulated};

fn dair() -> Option<PathBuf> {
    imported("start")
}

/// The sample, with the roadside stamps taken as the start or the end of its sweeps.
fn imported(stamp: &str) -> Option<PathBuf> {
    let data = skipped::shared("data/dair")?;
    Some(common::once(&format!("dair_{stamp}.mcap"), |path| {
        lab_ok([
            "import".as_ref(),
            "dair".as_ref(),
            data.as_os_str(),
            "--roadside-stamp".as_ref(),
            stamp.as_ref(),
            "-o".as_ref(),
            path.as_os_str(),
        ]);
    }))
}

const DAIR_OFFLINE: [&str; 4] = ["--recorded-detections", "--offline", "--coop", "v2i"];

#[test]
fn dair_late_fusion_gives_the_known_counts() {
    let Some(log) = dair() else {
        return;
    };
    let result = run_virtual("dair_late", "late_fusion", &log, &DAIR_OFFLINE);
    assert_eq!(result["protocol"], "dair", "an imported log names its protocol");
    assert_eq!(counts(&result, "vehicle", "0.5"), (170, 0, 171));
    let recording = Path::new(env!("CARGO_TARGET_TMPDIR")).join("dair_late/dair_start/vehicle/recording.mcap");
    let table = realo_ok([
        "evaluate".as_ref(),
        log.as_os_str(),
        "--detections".as_ref(),
        recording.as_os_str(),
        "--frames".as_ref(),
    ]);
    let last: Vec<&str> = table
        .lines()
        .map(|line| line.rsplit(' ').next().unwrap_or_default())
        .collect();
    let objects: u64 = last[1..]
        .iter()
        .map(|count| count.parse::<u64>().expect("a count"))
        .sum();
    assert_eq!(
        (last.len(), objects),
        (12, 171),
        "a head and a line for each pair:\n{table}"
    );
}

#[test]
fn dair_vehicle_alone_gives_the_known_counts() {
    let Some(log) = dair() else {
        return;
    };
    let result = run_virtual("dair_alone", "no_fusion", &log, &DAIR_OFFLINE);
    assert_eq!(counts(&result, "vehicle", "0.5"), (92, 0, 171));
}

#[test]
fn dair_roadside_alone_gives_the_known_counts() {
    let Some(log) = dair() else {
        return;
    };
    let args = [&DAIR_OFFLINE[..], &["--set", "fusion.fusion.ego_boxes=false"]].concat();
    let result = run_virtual("dair_roadside", "late_fusion", &log, &args);
    assert_eq!(counts(&result, "vehicle", "0.5"), (89, 7, 171));
}

#[test]
fn dair_is_scored_in_views_and_each_side_by_its_own_labels() {
    let Some(log) = dair() else {
        return;
    };
    // Recorded labels as detections: each side finds what it labelled, all of it in the view of its camera.
    for (ego, objects) in [("vehicle", 92), ("roadside", 117)] {
        let protocol = format!("dair-{ego}");
        let args = [
            "--recorded-detections",
            "--offline",
            "--ego",
            ego,
            "--protocol",
            &protocol,
        ];
        let result = run_virtual(&format!("dair_own_{ego}"), "no_fusion", &log, &args);
        assert_eq!(result["protocol"], *protocol);
        assert_eq!(counts(&result, "vehicle", "0.5"), (objects, 0, objects), "{ego}");
        let ignored = &result["in_no_view"];
        assert_eq!(
            (&ignored["detections"], &ignored["objects"]),
            (&0.into(), &0.into()),
            "{ego}"
        );
        // The same recording after the fact, by another protocol.
        let recording =
            Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("dair_own_{ego}/dair_start/{ego}/recording.mcap"));
        let evaluate = |protocol: &str| {
            let args = ["evaluate", "--json", "--protocol", protocol, "--detections"].map(std::ffi::OsStr::new);
            let args = [&args[..], &[recording.as_os_str(), log.as_os_str()]].concat();
            common::realo(args)
        };
        let again = evaluate(&protocol);
        assert!(again.status.success(), "{}", common::text(&again.stderr));
        let table: serde_json::Value = serde_json::from_slice(&again.stdout).expect("JSON");
        let found = counts(&table["runs"][0]["result"], "vehicle", "0.5");
        assert_eq!(found, (objects, 0, objects), "{ego} after the fact");
    }
    let wrong = |args: &[&str]| {
        let graph = common::graph("no_fusion");
        let fixed = ["run", &graph, "--recorded-detections", "--offline", "--log"].map(std::ffi::OsStr::new);
        let args = args.iter().map(std::ffi::OsStr::new);
        let output = common::realo(fixed.into_iter().chain([log.as_os_str()]).chain(args));
        assert!(!output.status.success());
        common::text(&output.stderr)
    };
    let said = wrong(&["--ego", "vehicle", "--protocol", "dair-roadside"]);
    assert!(
        said.contains("`dair-roadside` scores a roadside") && said.contains("--ego roadside"),
        "{said}"
    );
}

#[test]
fn dair_may_be_scored_as_before_there_were_views() {
    let Some(log) = dair() else {
        return;
    };
    let path = common::folder("protocol_before").join("before.yml");
    let text = std::fs::read_to_string(common::root().join("operators/scoring/protocols/dair.yml"));
    let text = text
        .expect("the protocol can be read")
        .replace("outside_views: ignored\n", "");
    std::fs::write(&path, text).expect("the protocol can be written");
    let path = path.to_string_lossy();
    let args = [&DAIR_OFFLINE[..], &["--protocol", &path]].concat();
    let result = run_virtual("dair_before", "late_fusion", &log, &args);
    assert_eq!(counts(&result, "vehicle", "0.5"), (170, 0, 171));
    assert!(result["in_no_view"].is_null());
}

#[test]
fn dair_with_the_papers_latencies_depends_on_what_the_roadside_stamp_means() {
    for (stamp, known) in [("start", (126, 28, 171)), ("end", (169, 0, 171))] {
        let Some(log) = imported(stamp) else {
            return;
        };
        let args = ["--recorded-detections", "--coop", "v2i", "--link", "paper"];
        let result = run_virtual(&format!("dair_paper_{stamp}"), "late_fusion", &log, &args);
        assert_eq!(counts(&result, "vehicle", "0.5"), known, "stamp = {stamp}");
    }
}

/// Four agents, rotated against each other, 100 km from the map's origin, who report exactly what they have points on.
fn exact(name: &str, scenario: &str) -> PathBuf {
    let args = [
        "--scenario",
        scenario,
        "--seed",
        "901",
        "--seconds",
        "2",
        "--key-hz",
        "5",
        "--no-clouds",
    ];
    let args = [&args[..], &["--noise-free-detections", "--detection-min-points", "1"]].concat();
    simulated(name, &[&args[..], &["--map-offset", "70000,-71000"]].concat())
}

/// The default protocol, but one point is enough to be there and to be seen.
fn one_point() -> String {
    let path = common::folder(&format!("protocol_{:?}", std::thread::current().id())).join("one_point.yml");
    let text = std::fs::read_to_string(common::root().join("operators/scoring/protocols/default.yml"));
    let text = text
        .expect("the protocol can be read")
        .replace("min_points: 5", "min_points: 1");
    std::fs::write(&path, text.replace("seen_points: 10", "seen_points: 1")).expect("the protocol can be written");
    path.to_string_lossy().into_owned()
}

const CLASSES: [&str; 3] = ["vehicle", "pedestrian", "truck"];

#[test]
fn late_fusion_of_exact_boxes_finds_the_whole_truth_and_nothing_else() {
    let protocol = one_point();
    for scenario in ["intersection", "corridor"] {
        let log = exact(&format!("exact_{scenario}"), scenario);
        for (mode, args) in [
            ("all", vec![]),
            ("v2v", vec!["--coop", "v2v"]),
            ("v2i", vec!["--coop", "v2i"]),
            ("i2i", vec!["--coop", "i2i"]),
        ] {
            let args = [
                &["--offline", "--recorded-detections", "--set", "v2x.link.range_m=1000"][..],
                &["--protocol", &protocol],
                &args,
            ]
            .concat();
            let result = run_virtual(&format!("exact_{scenario}_{mode}"), "late_fusion", &log, &args);
            let mut objects = 0;
            for class in CLASSES {
                let (found, wrong, total) = counts(&result, class, "0.5");
                assert_eq!((found, wrong), (total, 0), "{scenario} {mode} {class}");
                objects += total;
            }
            assert!(objects > 50, "{scenario} {mode}: only {objects} objects");
        }
    }
}

#[test]
fn no_fusion_of_exact_boxes_is_what_the_ego_has_points_on() {
    let log = exact("exact_intersection", "intersection");
    let protocol = one_point();
    let args = ["--offline", "--recorded-detections", "--protocol", &protocol];
    let alone = run_virtual("exact_alone", "no_fusion", &log, &args);
    let together = run_virtual("exact_together", "late_fusion", &log, &args);
    let (mut found_alone, mut total_alone) = (0, 0);
    for class in CLASSES {
        let (found, wrong, total) = counts(&alone, class, "0.5");
        assert_eq!(wrong, 0, "{class}");
        assert_eq!(total, counts(&together, class, "0.5").2, "one truth for all methods");
        let seen = &alone["accuracy_seen"]["sorted"]["counts"][class]["0.5"];
        assert_eq!(
            seen["true"], seen["total"],
            "everything that the ego sees is reported: {class}"
        );
        found_alone += found;
        total_alone += total;
    }
    assert!(found_alone < total_alone, "cooperation has something to add");
}

#[test]
fn networks_give_the_same_bytes_on_any_number_of_threads() {
    let log = simulated(
        "bytes_of_networks",
        &[
            "--seed",
            "907",
            "--seconds",
            "0.6",
            "--key-hz",
            "10",
            "--agents",
            "cav1,rsu1",
        ],
    );
    let run = |threads: &str| {
        let out = common::folder(&format!("network_bytes_{threads}"));
        let output = std::process::Command::new(common::REALO)
            .args([
                "run",
                &common::graph("early_fusion"),
                "--mode",
                "virtual",
                "--ego",
                "cav1",
            ])
            .args(["--set", &format!("fusion.encoder.threads={threads}")])
            .args(["--set", &format!("fusion.head.threads={threads}"), "--log"])
            .arg(&log)
            .arg("--out")
            .arg(&out)
            .env("RAYON_NUM_THREADS", threads)
            .output()
            .expect("realo can be started");
        assert!(output.status.success(), "{}", common::text(&output.stderr));
        let samples = common::json(&out.join("evaluation.json"));
        let frames = samples["evaluation"]["scenes"][0]["frames"]
            .as_array()
            .cloned()
            .unwrap_or_default();
        let found = frames.iter().filter_map(|frame| frame["detections"].as_array());
        let boxes: usize = found.map(Vec::len).sum();
        (evaluated(&out), boxes)
    };
    let (one, boxes) = run("1");
    assert!(boxes > 20, "the network finds something: {boxes}");
    assert!(
        one == run("2").0 && one == run("3").0,
        "what is evaluated differs between numbers of threads"
    );
}

/// Everything in `evaluation.json` but the graph, whose settings differ where a run has other ones.
fn evaluated(out: &Path) -> String {
    let mut written = common::json(&out.join("evaluation.json"));
    let whole = written.as_object_mut().expect("an object");
    assert!(whole.remove("graph").is_some() && whole.contains_key("evaluation"));
    written.to_string()
}

#[test]
fn noise_of_poses_is_the_same_in_every_run_and_moves_what_others_say() {
    let args = ["--seed", "905", "--seconds", "2", "--no-clouds", "--phase", "spread"];
    let log = simulated("noise", &args);
    let run = |out: &str, settings: &[&str]| {
        let set = settings.iter().flat_map(|setting| ["--set", setting]);
        let args: Vec<&str> = ["--recorded-detections", "--offline", "--ego", "cav1"]
            .into_iter()
            .chain(set)
            .collect();
        common::run_virtual(out, "late_fusion", &log, &args);
        evaluated(&Path::new(env!("CARGO_TARGET_TMPDIR")).join(out))
    };
    let [position, same, none] = ["position_noise_m=2", "noise=same", "heading_noise_deg=0"]
        .map(|setting| format!("others.sense.localization.{setting}"));
    let clean = run("noise_none", &[]);
    assert!(clean == run("noise_zero", &[&none]));
    let each = run("noise_each", &[&position]);
    assert!(each == run("noise_again", &[&position]));
    let all_alike = run("noise_same", &[&position, &same]);
    assert!(clean != each && clean != all_alike && each != all_alike);
}

#[test]
fn two_runs_give_the_same_bytes_on_any_number_of_threads() {
    let args = ["--seed", "902", "--seconds", "3", "--no-clouds", "--phase", "spread"];
    let log = simulated("bytes", &args);
    let compute = common::folder("bytes_compute").join("slow.toml");
    // Stages that take longer than a sweep, so that they pass messages over.
    let nodes = "ego.recorded = 30_000_000\nfusion.fusion = 150_000_000\nothers.nms = 30_000_000\n";
    std::fs::write(&compute, nodes).expect("the profile can be written");
    let lossy = common::folder("bytes_link").join("lossy.toml");
    let profile = "[default]\nfixed_ms = 20.0\njitter = { gaussian_ms = 15.0 }\nloss = 0.1\nduplicate = 0.05\n";
    std::fs::write(&lossy, profile).expect("the profile can be written");
    let mut results = Vec::new();
    for (round, threads) in ["1", "2", "2"].into_iter().enumerate() {
        for link in ["paper", lossy.to_str().expect("the path is text")] {
            let out = common::folder(&format!("bytes_{round}"));
            let output = std::process::Command::new(common::REALO)
                .args([
                    "run",
                    &common::graph("late_fusion"),
                    "--recorded-detections",
                    "--mode",
                    "virtual",
                    "--link",
                    link,
                    "--log",
                ])
                .arg(&log)
                .arg("--compute")
                .arg(&compute)
                .arg("--out")
                .arg(&out)
                .env("RAYON_NUM_THREADS", threads)
                .output()
                .expect("realo can be started");
            assert!(output.status.success(), "{}", common::text(&output.stderr));
            results.push((link, std::fs::read(out.join("result.json")).expect("there are results")));
        }
    }
    for (link, bytes) in &results {
        let (_, first) = results
            .iter()
            .find(|(other, _)| other == link)
            .expect("it is there itself");
        assert!(first == bytes, "result.json differs between runs with {link}");
    }
    let result: serde_json::Value = serde_json::from_slice(&results[1].1).expect("JSON");
    let skipped = result["frames"]["skipped"].as_u64().expect("frames.skipped");
    assert!(skipped > 0, "the profile makes stages pass frames over");
    let channel = &result["links"]["cav2-cav1"]["boxes"];
    let term = |name: &str| channel[name].as_u64().unwrap_or_else(|| panic!("{name} in {channel}"));
    let sum: u64 = [
        "used",
        "skipped",
        "over_limit",
        "distrusted",
        "stale",
        "superseded",
        "lost",
        "rejected",
        "in_flight",
    ]
    .into_iter()
    .map(term)
    .sum();
    assert_eq!(term("sent"), sum, "{channel}");
    assert!(
        term("lost") > 0 && term("skipped") > 0 && term("duplicated") > 0,
        "{channel}"
    );
}
