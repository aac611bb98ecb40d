//! Sweeps over the small scene: what is varied reaches the runs, what is shared changes nothing, what is done stays.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use serde_json::Value;

use crate::common::{folder, graph, json, realo, text};
use crate::scene::Scene;

/// Sweeps a graph over the scene with the car as ego and recorded detections.
fn sweep(graphs: &[&str], log: &Path, out: &Path, more: &[&str]) -> Output {
    let mut args: Vec<String> = vec!["sweep".into()];
    args.extend(graphs.iter().map(|name| graph(name)));
    args.extend(["--log".into(), log.display().to_string()]);
    args.extend(["--ego".into(), "car".into(), "-o".into(), out.display().to_string()]);
    args.extend(more.iter().map(|more| more.to_string()));
    realo(args)
}

const RECORDED: &str = "--recorded-detections";
const DELAY: &str = "link.delay_ms=0,600";

/// All files of one name below a folder, in order.
fn files(below: &Path, name: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(below).into_iter().flatten().flatten() {
        match entry.path() {
            path if path.is_dir() => found.extend(files(&path, name)),
            path if path.ends_with(name) => found.push(path),
            _ => {}
        }
    }
    found.sort();
    found
}

/// The rows of a CSV table without quotes, by the names of its columns.
fn rows(file: &Path) -> Vec<Vec<(String, String)>> {
    let text = fs::read_to_string(file).expect("the table can be read");
    let mut lines = text
        .lines()
        .map(|line| line.split(',').map(String::from).collect::<Vec<_>>());
    let names = lines.next().expect("names of columns");
    lines.map(|line| names.iter().cloned().zip(line).collect()).collect()
}

fn cell<'a>(row: &'a [(String, String)], name: &str) -> &'a str {
    let found = row.iter().find(|(known, _)| known == name);
    &found.unwrap_or_else(|| panic!("no column {name}")).1
}

#[test]
fn a_sweep_finds_where_late_boxes_are_of_no_use() {
    let log = Scene::default().write("sweep-known");
    let out = folder("sweep-known-out");
    let ran = sweep(&["late_fusion"], &log, &out, &["--vary", DELAY, RECORDED]);
    let (said, err) = (text(&ran.stdout), text(&ran.stderr));
    assert_eq!(ran.status.code(), Some(0), "{err}");
    assert!(
        err.contains("3 runs, 0 done already, 3 to run") && err.contains("the first run took"),
        "{err}"
    );
    assert!(
        said.contains("do no harm") && said.contains("blocks") && said.contains("no objects of "),
        "{said}"
    );
    let table = fs::read_to_string(out.join("link.delay_ms.md")).expect("the curves as a table");
    assert!(
        table.starts_with("| link.delay_ms | no_fusion | late_fusion |\n|---|---:|---:|\n| 0 | "),
        "{table}"
    );
    assert!(table.contains("\n| turns negative | – | never |"), "{table}");
    let rows = rows(&out.join("sweep.csv"));
    let mean = |at: usize| cell(&rows[at], "mean_AP_0.5").parse::<f64>().expect("a number");
    let names: Vec<[&str; 2]> = rows
        .iter()
        .map(|row| [cell(row, "strategy"), cell(row, "link.delay_ms")])
        .collect();
    assert_eq!(
        names,
        [
            ["no_fusion", "0"],
            ["no_fusion", "600"],
            ["late_fusion", "0"],
            ["late_fusion", "600"]
        ]
    );
    // Half of the objects are the ego's own; the others come too late where the link takes longer than the bank's window.
    assert_eq!([mean(0), mean(1)], [mean(3), mean(3)]);
    assert!(mean(2) > mean(3) + 0.1, "{rows:?}");
    let margin: f64 = cell(&rows[2], "margin_0.5").parse().expect("a number");
    assert!((margin - (mean(2) - mean(0))).abs() < 1e-12);
    let [low, high] =
        ["mean_AP_0.5_low", "mean_AP_0.5_high"].map(|name| cell(&rows[2], name).parse::<f64>().expect("a number"));
    assert!(low <= mean(2) && mean(2) <= high);
    let picture = fs::read_to_string(out.join("link.delay_ms.svg")).expect("a picture");
    let picture = roxmltree::Document::parse(&picture).expect("SVG");
    let values = picture
        .descendants()
        .filter(|node| node.attribute("class") == Some("value"));
    assert_eq!(values.count(), 4);
    let margins = fs::read_to_string(out.join("margins.csv")).expect("a table");
    assert!(
        margins
            .lines()
            .any(|line| line.starts_with("late_fusion,link.delay_ms,")),
        "{margins}"
    );
}

#[test]
fn what_runs_share_changes_no_digit() {
    let log = Scene::default().write("sweep-shared");
    let noise = "others.sense.localization.position_noise_m=0,0.3";
    // Without bounds, with too little memory for payloads, and without sharing.
    let outs = ["2048", "1", "0"].map(|mib| {
        let out = folder(&format!("sweep-shared-{mib}"));
        let vary = ["--vary", DELAY, "--vary", noise, "--share-mib", mib];
        let ran = sweep(&["late_fusion", "attfuse", "early_fusion"], &log, &out, &vary);
        assert_eq!(ran.status.code(), Some(0), "{}", text(&ran.stderr));
        assert_eq!(
            text(&ran.stderr).contains("took their calls"),
            mib != "0",
            "{}",
            text(&ran.stderr)
        );
        out
    });
    for name in ["result.json", "evaluation.json", "timing.json"] {
        let [all, few, none] = outs.each_ref().map(|out| files(&out.join("runs"), name));
        assert_eq!(all.len(), 13, "four points of three graphs, and the ego alone");
        for ((all, few), none) in all.iter().zip(&few).zip(&none) {
            let [all, few, none] = [all, few, none].map(|file| fs::read(file).expect("a result"));
            assert!(all == none && few == none, "{name}");
        }
    }
    // A run by itself gives the same as well.
    let alone = folder("sweep-shared-alone");
    let args = [
        "run",
        &graph("attfuse"),
        "--mode",
        "virtual",
        "--ego",
        "car",
        "--link",
        "delay_ms=600",
    ]
    .map(String::from);
    let places = [
        "--log",
        &log.display().to_string(),
        "--out",
        &alone.display().to_string(),
    ]
    .map(String::from);
    let noise = ["--set", "others.sense.localization.position_noise_m=0.3"].map(String::from);
    assert!(realo([&args[..], &places, &noise].concat()).status.success());
    let same = files(&outs[0].join("runs/attfuse"), "result.json").into_iter();
    let same: Vec<Value> = same.map(|file| json(&file)).collect();
    let alone = json(&files(&alone.join("sweep-shared"), "result.json")[0]);
    assert!(same.contains(&alone), "{alone}");
}

#[test]
fn what_is_done_stays_and_shards_come_together() {
    let log = Scene::default().write("sweep-shards");
    let vary = ["--vary", "link.delay_ms=0,100,200,600", RECORDED];
    let run = |out: &Path, more: &[&str]| {
        let ran = sweep(&["late_fusion"], &log, out, &[&vary[..], more].concat());
        (ran.status.code(), text(&ran.stderr), text(&ran.stdout))
    };
    let [all, one, two, merged] = ["all", "one", "two", "merged"].map(|name| folder(&format!("sweep-shards-{name}")));
    assert_eq!(run(&all, &[]).0, Some(0));
    let (_, err, _) = run(&all, &[]);
    assert!(err.contains("5 runs, 5 done already, 0 to run"), "{err}");
    // A run that was killed has no record.
    let record = files(&all, "done.json").remove(0);
    fs::remove_file(record).expect("it is there");
    assert!(run(&all, &[]).1.contains("4 done already, 1 to run"));
    // One whose result was cut says what to do, which helps.
    let result = files(&all, "result.json").remove(0);
    let whole = fs::read(&result).expect("a result");
    fs::write(&result, &whole[..whole.len() / 2]).expect("it can be cut");
    let (code, err, _) = run(&all, &[]);
    let of = result.parent().expect("a folder");
    let remedy = format!(
        "remove its folder `{}`, and the same command makes it again",
        of.display()
    );
    assert!(code == Some(1) && err.contains(&remedy), "{err}");
    fs::remove_dir_all(of).expect("it is there");
    assert_eq!(run(&all, &[]).0, Some(0));
    let (code, err, _) = run(&one, &["--shard", "1/2"]);
    assert!(
        code == Some(0) && err.contains("2 runs in shard 1/2, 0 done already"),
        "{err}"
    );
    assert_eq!(run(&two, &["--shard", "2/2", "--jobs", "1"]).0, Some(0));
    let [a, b] = [&one, &two].map(|out| out.to_string_lossy().into_owned());
    let (code, err, said) = run(&merged, &["--merge", &a]);
    assert_eq!(code, Some(3), "{err}");
    assert!(
        err.contains("in none of these folders") && said.contains("are missing"),
        "{err}{said}"
    );
    let (code, err, _) = run(&merged, &["--merge", &a, &b]);
    assert_eq!(code, Some(0), "{err}");
    let table = |out: &Path| fs::read_to_string(out.join("sweep.csv")).expect("a table");
    assert_eq!(table(&all), table(&merged));
    let other = ["--vary", "link.delay_ms=0,100", RECORDED, "--merge", &a];
    let nowhere = folder("sweep-shards-other").join("new");
    let ran = sweep(&["late_fusion"], &log, &nowhere, &other);
    let err = text(&ran.stderr);
    assert!(!ran.status.success() && !nowhere.exists(), "{err}");
    assert!(
        err.contains("--vary link.delay_ms: `0,100` here, `0,100,200,600` there"),
        "{err}"
    );
}

#[test]
fn a_failed_run_names_itself_and_the_others_go_on() {
    let log = Scene::default().write("sweep-failed");
    let out = folder("sweep-failed-out");
    // A file where the folder of one run has to be.
    let place = out.join("runs/late_fusion/link.delay_ms=0/sweep-failed");
    fs::create_dir_all(&place).expect("folders");
    fs::write(place.join("car"), "mine").expect("a file");
    let vary = ["--vary", DELAY, RECORDED];
    let ran = sweep(&["late_fusion"], &log, &out, &vary);
    let err = text(&ran.stderr);
    assert_eq!(ran.status.code(), Some(1), "{err}");
    assert!(
        err.contains("failed: late_fusion/link.delay_ms=0/sweep-failed/car: "),
        "{err}"
    );
    assert!(
        err.contains("a file is where a folder is needed") && err.contains("1 of the runs failed"),
        "{err}"
    );
    assert_eq!(files(&out.join("runs"), "done.json").len(), 2);
    fs::remove_file(place.join("car")).expect("it is there");
    let ran = sweep(&["late_fusion"], &log, &out, &vary);
    assert!(ran.status.success() && text(&ran.stderr).contains("2 done already, 1 to run"));
}

#[test]
fn settings_that_do_not_exist_are_named_before_anything_runs() {
    let log = Scene::default().write("sweep-refused");
    let out = folder("sweep-refused-out");
    for (vary, expected) in [
        ("link.delay=0,1", "did you mean `delay_ms`?"),
        (
            "others.sense.localisation.position_noise_m=0,1",
            "did you mean `others.sense.localization`?",
        ),
        ("others.sense.localization.position_nois_m=0,1", "position_noise_m"),
        ("others.sense.localization.position_noise_m=a,1", "`a`"),
        ("protocl=a", "did you mean `protocol`?"),
        ("link.delay_ms=0,0", "there twice"),
        ("link.delay_ms", "no `=`"),
        ("coop=v2x", "expected one of v2v, v2i, i2i"),
        (
            "seed=1.5",
            "--vary seed=1.5: expected a whole number from 0 on, found `1.5`",
        ),
        ("simulator.seed=1,2", "drop --log"),
        ("protocol=no_such", "no_such"),
    ] {
        let ran = sweep(&["late_fusion"], &log, &out, &["--vary", vary, RECORDED]);
        let err = text(&ran.stderr);
        assert!(!ran.status.success() && err.contains(expected), "{vary}: {err}");
        assert!(!out.join("runs").exists(), "{vary}: nothing was run");
    }
    let bare = Scene {
        truth: false,
        ..Scene::default()
    };
    let bare = sweep(
        &["late_fusion"],
        &bare.write("sweep-bare"),
        &out,
        &["--vary", DELAY, RECORDED],
    );
    let err = text(&bare.stderr);
    assert!(
        bare.status.code() == Some(1)
            && err.contains("sweep-bare.mcap: expected ground truth of an ego, found none of `car`"),
        "{err}"
    );
    assert!(!out.join("runs").exists(), "nothing was run");
    let offline = sweep(&["late_fusion"], &log, &out, &["--vary", DELAY, "--offline", RECORDED]);
    assert!(text(&offline.stderr).contains("--offline has neither delays nor loss"));
    let shard = sweep(&["late_fusion"], &log, &out, &["--vary", DELAY, "--shard", "5/4"]);
    assert!(text(&shard.stderr).contains("as 3/16"));
}

#[test]
fn worlds_are_made_for_the_values_of_the_simulator() {
    let out = folder("sweep-worlds");
    let args = [
        "sweep",
        &graph("late_fusion"),
        "--offline",
        RECORDED,
        "--ego",
        "cav1",
        "-o",
        &out.to_string_lossy(),
    ];
    let vary = [
        "--vary",
        "simulator.seed=900+901,902",
        "--vary",
        "simulator.seconds=1",
        "--vary",
        "simulator.vehicles=2",
    ];
    let ran = realo([&args[..], &vary].concat());
    assert!(ran.status.success(), "{}", text(&ran.stderr));
    assert_eq!(fs::read_dir(out.join("logs")).expect("logs").count(), 3);
    let rows = rows(&out.join("sweep.csv"));
    let logs: Vec<&str> = rows.iter().map(|row| cell(row, "logs")).collect();
    assert_eq!(logs, ["2", "1", "2", "1"]);
    let again = text(&realo([&args[..], &vary].concat()).stderr);
    assert!(
        again.contains("6 done already, 0 to run") && !again.contains("simulating"),
        "{again}"
    );
}
