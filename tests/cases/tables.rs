//! Tables that say what to believe.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Output;

use serde_json::Value;

use crate::common::{self, REALO, folder, json, once, realo, realo_ok, root, simulated, text};
use crate::plugins::scripted;
use crate::scene::{SWEEPS, Scene, run};

/// Runs `realo` on a terminal of so many columns.
fn on_terminal(columns: &str, args: &[String]) -> Output {
    let mut command = std::process::Command::new(REALO);
    command.args(args).current_dir(root()).env("COLUMNS", columns);
    command.output().expect("realo can be started")
}

fn words(args: &[&str]) -> Vec<String> {
    args.iter().map(|arg| arg.to_string()).collect()
}

fn shown(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}

/// A log of two vehicles and a mast, without points.
fn log() -> PathBuf {
    let args = "--seed 921 --seconds 2 --no-clouds --agents cav1,cav2,rsu1";
    simulated("tables_log", &args.split(' ').collect::<Vec<_>>())
}

/// Runs of two strategies, and of one over another link and with poses that are off; made once: their folders.
fn runs() -> Vec<PathBuf> {
    let all = once("tables_runs", |all| {
        let _ = fs::remove_dir_all(all);
        let noise = ["--set", "others.sense.localization.position_noise_m=0.2"];
        let paper = ["--link", "paper"];
        for (name, graph, more) in [
            ("near", "no_fusion", Vec::new()),
            ("near", "late_fusion", Vec::new()),
            ("paper", "late_fusion", paper.to_vec()),
            ("noisy", "late_fusion", [paper, noise].concat()),
        ] {
            let (log, out) = (shown(&log()), shown(&all.join(name).join(graph)));
            let graph = common::graph(graph);
            let run = [
                "run",
                &graph,
                "--recorded-detections",
                "--mode",
                "virtual",
                "--log",
                &log,
                "--out",
                &out,
            ];
            realo_ok([&run[..], &more].concat());
        }
    });
    [
        "near/no_fusion",
        "near/late_fusion",
        "paper/late_fusion",
        "noisy/late_fusion",
    ]
    .map(|run| all.join(run))
    .into()
}

fn compare(runs: &[PathBuf], more: &[&str]) -> Vec<String> {
    let runs = runs.iter().map(|run| shown(run));
    words(&["compare"]).into_iter().chain(runs).chain(words(more)).collect()
}

/// The rows of a table: lines that have many numbers.
fn rows(table: &str) -> usize {
    let is_number = |word: &&str| word.parse::<f64>().is_ok() && word.contains('.');
    let is_row = |line: &&str| line.split_whitespace().filter(is_number).count() > 5;
    // Not the head, nor the scores in the other order below.
    let is_other = |line: &str| line.trim_start().starts_with("0.3") || line.contains(" / ");
    table.lines().filter(|line| is_row(line) && !is_other(line)).count()
}

#[test]
fn the_first_table_does_not_contradict_itself() {
    let scene = shown(&Scene::default().write("tables_first"));
    let graphs = ["no_fusion", "late_fusion"].map(common::graph);
    let out = shown(&folder("tables_first_out"));
    let fixed = ["--recorded-detections", "--offline", "--log", &scene, "--out", &out];
    let run = words(&[&["run", &graphs[0], &graphs[1]][..], &fixed].concat());
    let table = text(&on_terminal("80", &run).stdout);
    let at = |part: &str| table.find(part).unwrap_or_else(|| panic!("no `{part}` in {table}"));
    assert!(at("\nAP, IoU 0.3 / 0.5\n") < at("AP as V2X-Real's evaluator orders detections; only for"));
    let (above, below) = table.split_at(at("AP as V2X-Real's"));
    assert!(!above.contains("v2x") && !above.contains("sorted)"), "{table}");
    assert!(below.contains("average precision"), "the word is explained: {table}");
    // Four of the eight cars without fusion, all with it.
    let vehicle = above.lines().find(|line| line.trim_start().starts_with("vehicle"));
    let vehicle: Vec<&str> = vehicle.expect("a row").split_whitespace().collect();
    assert!(vehicle[1].starts_with("0.5") && vehicle[4] == "1.000", "{vehicle:?}");
    // Nothing is late offline.
    assert!(!table.contains("end to end") && !table.contains("latency"), "{table}");
    let is_below_zero = |word: &str| {
        word.strip_prefix('-')
            .is_some_and(|rest| rest.starts_with(|c: char| c.is_ascii_digit()))
    };
    assert!(
        !table.split_whitespace().any(is_below_zero),
        "no age is below zero: {table}"
    );
    assert!(table.contains("stamps apart"), "{table}");
    assert!(
        table
            .lines()
            .all(|line| line.chars().count() <= 80 || line.starts_with("results in")),
        "{table}"
    );
}

#[test]
fn four_runs_are_four_rows_and_the_terminals_width_is_used() {
    let runs = runs();
    let twelve: Vec<PathBuf> = runs.iter().cycle().take(12).cloned().collect();
    let mut narrowest = usize::MAX;
    for (columns, tables) in [("200", 1), ("100", 1), ("80", 1), ("50", 2)] {
        let said = text(&on_terminal(columns, &compare(&runs, &[])).stdout);
        let widest = said.lines().map(|line| line.chars().count()).max().unwrap_or(0);
        assert!(widest <= columns.parse().expect("a number"), "{columns}: {said}");
        let rules = said.lines().filter(|line| line.starts_with('─')).count();
        if tables == 1 {
            assert_eq!((rules, rows(&said)), (1, 4), "{columns}: {said}");
            let said = text(&on_terminal(columns, &compare(&twelve, &[])).stdout);
            assert_eq!(rows(&said), 12, "{columns}: {said}");
        } else {
            assert!(rules > 1, "{columns}: {said}");
        }
        assert!(said.contains("one log") && said.contains("chance"), "{said}");
        narrowest = narrowest.min(widest);
    }
    assert!(narrowest <= 50);
    // What was set stands once, below the rows.
    let said = text(&on_terminal("200", &compare(&runs, &[])).stdout);
    let noise = said
        .lines()
        .find(|line| line.contains("position_noise_m"))
        .expect("it is named");
    assert!(
        noise.starts_with("others.sense.localization.position_noise_m differs: "),
        "{said}"
    );
    let full = text(&on_terminal("100", &compare(&runs, &["--full"])).stdout);
    assert!(
        full.contains("recall / precision") && full.lines().count() > 2 * said.lines().count(),
        "{full}"
    );
}

#[test]
fn json_names_link_and_noise_among_the_differences() {
    let runs = runs();
    let runs = [runs[1].clone(), runs[3].clone()];
    let [one, other] = ["--json", "--format=json"].map(|format| realo_ok(compare(&runs, &[format])));
    assert_eq!(one, other);
    let document: Value = serde_json::from_str(&one).expect("JSON");
    let differences: Vec<&str> = document["differences"]
        .as_array()
        .expect("a list")
        .iter()
        .flat_map(Value::as_str)
        .collect();
    let link = differences
        .iter()
        .find(|difference| difference.starts_with("link differs: "));
    assert!(
        link.is_some_and(|link| link.contains("paper in noisy/late_fusion")),
        "{differences:?}"
    );
    let noise =
        "others.sense.localization.position_noise_m differs: not set in near/late_fusion; 0.2 in noisy/late_fusion";
    assert!(differences.contains(&noise), "{differences:?}");
    assert!(
        !differences.iter().any(|difference| difference.starts_with("agents")),
        "{differences:?}"
    );
}

#[test]
fn agents_that_differ_are_understood_at_once() {
    let log = shown(&log());
    let dir = folder("tables_agents");
    for (name, more) in [
        ("alone", &["--agents", "cav1"][..]),
        ("pair", &["--agents", "cav1,rsu1"]),
    ] {
        let (graph, out) = (common::graph("late_fusion"), shown(&dir.join(name)));
        let run = [
            "run",
            &graph,
            "--recorded-detections",
            "--offline",
            "--ego",
            "cav1",
            "--log",
            &log,
            "--out",
            &out,
        ];
        realo_ok([&run[..], more].concat());
    }
    let said = realo_ok(compare(&[dir.join("alone"), dir.join("pair")], &[]));
    assert_eq!(
        said.lines().next(),
        Some("note: agents differ: only pair has rsu1; all have cav1"),
        "{said}"
    );
}

/// The cells of a line of CSV.
fn cells(line: &str) -> Vec<String> {
    let (mut cells, mut quoted) = (vec![String::new()], false);
    for letter in line.chars() {
        match (letter, quoted) {
            ('"', _) => quoted = !quoted,
            (',', false) => cells.push(String::new()),
            _ => cells.last_mut().expect("a cell").push(letter),
        }
    }
    cells
}

#[test]
fn every_format_can_be_read_again() {
    let runs = runs();
    let csv = realo_ok(compare(&runs, &["--format", "csv"]));
    let lines: Vec<Vec<String>> = csv.lines().map(cells).collect();
    assert_eq!(lines.len(), 5, "{csv}");
    assert!(lines.iter().all(|line| line.len() == lines[0].len()), "{csv}");
    let column = |name: &str| {
        lines[0]
            .iter()
            .position(|field| field == name)
            .unwrap_or_else(|| panic!("no {name} in {csv}"))
    };
    let result = json(&runs[3].join("result.json"));
    let found: f64 = lines[4][column("AP_vehicle_0.5")].parse().expect("a number");
    assert_eq!(
        Some(found),
        result["accuracy"]["sorted"]["AP"]["vehicle"]["0.5"].as_f64(),
        "with all digits"
    );
    assert_eq!(lines[4][column("link")], "paper");
    assert!(lines[4][column("set")].contains("position_noise_m=0.2"));

    let markdown = realo_ok(compare(&runs, &["--format", "md"]));
    let table: Vec<&str> = markdown.lines().take_while(|line| line.starts_with("| ")).collect();
    assert_eq!(table.len(), 6, "{markdown}");
    assert!(
        table
            .iter()
            .all(|line| line.matches('|').count() == table[0].matches('|').count()),
        "{markdown}"
    );
    let latex = realo_ok(compare(&runs, &["--format", "latex"]));
    let table: Vec<&str> = latex.lines().filter(|line| line.ends_with("\\\\")).collect();
    assert_eq!(table.len(), 5, "{latex}");
    assert!(
        table
            .iter()
            .all(|line| line.matches(" & ").count() == table[0].matches(" & ").count()),
        "{latex}"
    );
    assert!(
        latex.starts_with("\\begin{tabular}") && table[1].starts_with("near/no\\_fusion & "),
        "{latex}"
    );

    // The commands that score have them too.
    let recording = shown(&runs[1].join("tables_log/cav1/recording.mcap"));
    let again = realo_ok(
        ["evaluate", "--log", &shown(&log())][..1]
            .iter()
            .map(|word| word.to_string())
            .chain([
                shown(&log()),
                "--detections".into(),
                recording,
                "--format".into(),
                "csv".into(),
            ]),
    );
    assert!(again.starts_with("run,graph,") && again.lines().count() == 2, "{again}");
    let out = shown(&folder("tables_formats"));
    let (graph, log) = (common::graph("no_fusion"), shown(&log()));
    let run = [
        "run",
        &graph,
        "--recorded-detections",
        "--offline",
        "--log",
        &log,
        "--out",
        &out,
        "--format",
        "csv",
    ];
    let said = realo_ok(run);
    assert!(
        said.lines().count() == 2 && said.lines().all(|line| line.contains(',')),
        "nothing but CSV: {said}"
    );
    let both = realo([&run[..], &["--json"]].concat());
    assert_eq!(both.status.code(), Some(2), "one format at a time");
}

/// A graph of late fusion whose fusion fails as soon as it is asked.
fn failing(dir: &Path) -> PathBuf {
    for shared in ["bin", "types"] {
        symlink(root().join("dataflows").join(shared), dir.join(shared)).expect("a link");
    }
    let read = |file: &str| fs::read_to_string(root().join("dataflows").join(file)).expect("a shipped file");
    symlink(root().join("dataflows/modules"), dir.join("modules")).expect("a link");
    fs::write(
        dir.join("fails.sh"),
        "#!/bin/sh\necho it has no heart for it >&2\nexit 7\n",
    )
    .expect("a file");
    let executable = std::os::unix::fs::PermissionsExt::from_mode(0o755);
    fs::set_permissions(dir.join("fails.sh"), executable).expect("a program");
    let graph = dir.join("fails.yml");
    fs::write(
        &graph,
        read("late_fusion.yml").replace(
            "modules/fuse.boxes.yml",
            "modules/fuse.boxes.yml 'fusion=program fails.sh'",
        ),
    )
    .expect("a file");
    graph
}

#[test]
fn a_graph_that_fails_does_not_hide_the_others() {
    let dir = folder("tables_failing");
    let fails = shown(&failing(&dir));
    let [alone, fused] = ["no_fusion", "late_fusion"].map(common::graph);
    let log = shown(&log());
    let run = |graphs: &[&str], out: &Path, more: &[&str]| {
        let out = shown(out);
        let fixed = [
            "--recorded-detections",
            "--mode",
            "virtual",
            "--log",
            &log,
            "--out",
            &out,
        ];
        realo([&["run"][..], graphs, &fixed, more].concat())
    };
    // One that cannot be read, one that fails while it runs.
    for (failing, because) in [(&*fails, "heart"), ("nowhere.yml", "nowhere.yml")] {
        let out = folder("tables_failing_out");
        let output = run(&[&alone, failing, &fused], &out, &[]);
        let (said, errors) = (text(&output.stdout), text(&output.stderr));
        assert_eq!(output.status.code(), Some(1), "{errors}");
        assert!(
            said.contains("no_fusion") && said.contains("late_fusion") && said.contains("AP, IoU"),
            "{said}\n{errors}"
        );
        assert!(errors.contains(because), "{errors}");
        assert!(
            errors.lines().last().is_some_and(|line| !line.contains("follows")),
            "the error comes last: {errors}"
        );
        for name in ["no_fusion", "late_fusion"] {
            assert!(out.join(name).join("result.json").exists(), "{name}");
        }
        assert!(!out.join("fails/result.json").exists());
        let output = run(&[&alone, failing, &fused], &out, &["--json"]);
        let document: Value = serde_json::from_slice(&output.stdout).expect("JSON of the others");
        assert_eq!(document["runs"].as_array().map(Vec::len), Some(2));
        assert_eq!(output.status.code(), Some(1));
    }
    // Alone it fails as ever, and what all fail by is said once.
    let output = run(&[&fails], &folder("tables_failing_alone"), &[]);
    assert_eq!((output.status.code(), output.stdout.len()), (Some(1), 0));
    let gone = shown(&dir.join("gone.mcap"));
    let output = realo(["run", &alone, &fused, "--mode", "virtual", "--log", &gone]);
    let errors = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{errors}");
    assert_eq!(errors.matches("gone.mcap").count(), 1, "{errors}");
}

#[test]
fn several_runs_are_drawn_side_by_side_as_the_same_ego_saw_them() {
    let runs = runs();
    let dir = folder("tables_render");
    let render = |name: &str, runs: &[&PathBuf], more: &[&str]| {
        let file = dir.join(name);
        let runs = runs.iter().map(|run| shown(run));
        let all = words(&["render"])
            .into_iter()
            .chain(runs)
            .chain(words(&["-o"]))
            .chain([shown(&file)]);
        let output = realo(all.chain(words(more)));
        (
            output.status.code(),
            format!("{}{}", text(&output.stdout), text(&output.stderr)),
            file,
        )
    };
    let (code, said, file) = render("both.svg", &[&runs[0], &runs[1]], &[]);
    assert_eq!(code, Some(0), "{said}");
    let lines: Vec<&str> = said.lines().collect();
    assert_eq!(lines.len(), 2, "{said}");
    let sweep = |line: &str| {
        line.split("sweep ")
            .nth(1)
            .and_then(|rest| rest.split(':').next())
            .map(String::from)
    };
    assert!(
        sweep(lines[0]).is_some() && sweep(lines[0]) == sweep(lines[1]),
        "{said}"
    );
    let svg = fs::read_to_string(&file).expect("a drawing");
    let document = roxmltree::Document::parse(&svg).expect("the drawing is XML");
    let root = document.root_element();
    assert_eq!(root.attribute("width"), Some("3200"));
    let title = root
        .children()
        .find(|node| node.has_tag_name("title"))
        .and_then(|node| node.text());
    assert_eq!(
        title,
        Some("no_fusion · log tables_log · ego cav1 | late_fusion · log tables_log · ego cav1")
    );
    // Each run by itself shows the same ego.
    for (name, run) in [("one.svg", &runs[0]), ("other.svg", &runs[1])] {
        let (code, said, file) = render(name, &[run], &[]);
        assert_eq!(code, Some(0), "{said}");
        assert!(
            fs::read_to_string(file)
                .expect("a drawing")
                .contains("· ego cav1</title>")
        );
    }
    // Runs of one graph are titled by their folders.
    let (code, said, file) = render("links.png", &[&runs[1], &runs[3]], &["--frame", "12", "--ego", "cav2"]);
    assert_eq!(code, Some(0), "{said}");
    assert!(
        said.contains("near/late_fusion, tables_log, sweep 12") && said.contains("noisy/late_fusion, "),
        "{said}"
    );
    let bytes = fs::read(file).expect("a picture");
    assert_eq!(minipng::decode_png_header(&bytes).expect("a PNG").width(), 3200);
}

#[test]
fn shipped_graphs_project_as_their_weights_were_trained() {
    let scene = shown(&Scene::default().write("tables_projection"));
    let graph = common::graph("attfuse");
    for (more, expected) in [(&[][..], "sender"), (&["--project", "receiver"], "receiver")] {
        let out = folder(&format!("tables_projection_{expected}"));
        let shown_out = shown(&out);
        let fixed = [
            "run",
            &graph,
            "--offline",
            "--set",
            "player.duration=0.3",
            "--log",
            &scene,
            "--out",
            &shown_out,
        ];
        realo_ok([&fixed[..], more].concat());
        assert_eq!(json(&out.join("result.json"))["project"], expected);
    }
}

#[test]
fn settings_reach_the_graphs_that_have_the_stage_and_every_format_names_them() {
    let log = shown(&log());
    let out = folder("tables_shared");
    let [alone, fused] = ["no_fusion", "late_fusion"].map(common::graph);
    let noise = "others.sense.localization.position_noise_m=0.2";
    let shown_out = shown(&out);
    let run = |set: &str, format: &str| {
        let all = [
            "run",
            &alone,
            &fused,
            "--recorded-detections",
            "--mode",
            "virtual",
            "--link",
            "delay_ms=90",
            "--set",
            set,
            "--log",
            &log,
            "--out",
            &shown_out,
            "--format",
            format,
        ];
        realo(all)
    };
    let link = "link delay_ms=90 (no_fusion has none)";
    let set = format!("{noise} (no_fusion has none)");
    let output = run(noise, "md");
    let (said, errors) = (text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(0), "{errors}");
    for part in [link, &set, "\n- Settings of all runs: virtual; "] {
        assert!(said.contains(part), "no `{part}` in {said}");
    }
    let note = format!(
        "1 of 1 setting skipped, because this graph has nothing to set there, while another graph of the run has: --set {noise}"
    );
    assert!(errors.contains(&format!("realo: no_fusion: {note}")), "{errors}");
    assert!(said.contains(&format!("note (no_fusion): {note}")), "{said}");
    assert_eq!(json(&out.join("no_fusion/result.json"))["set"], "");
    assert_eq!(json(&out.join("late_fusion/result.json"))["set"], noise);
    let runs = ["no_fusion", "late_fusion"].map(|name| out.join(name));
    let latex = realo_ok(compare(&runs, &["--format", "latex"]));
    let comment = latex.lines().find(|line| line.starts_with("% Settings of all runs: "));
    assert!(
        comment.is_some_and(|line| line.contains(link) && line.contains(&set)),
        "{latex}"
    );
    let document: Value = serde_json::from_str(&realo_ok(compare(&runs, &["--json"]))).expect("JSON");
    assert_eq!(document["common"]["link"], "delay_ms=90");
    assert_eq!(
        document["common"]["set"]["others.sense.localization.position_noise_m"],
        "0.2"
    );
    // What no graph has is an error of each.
    let output = run("others.localization.noise_m=0.2", "md");
    let errors = text(&output.stderr);
    assert_eq!((output.status.code(), output.stdout.len()), (Some(1), 0), "{errors}");
    assert!(errors.contains("no node `others.localization`"), "{errors}");
}

#[test]
fn folders_that_cannot_be_compared_do_not_take_the_table_of_the_others() {
    let log = Scene::default().write("compare-broken");
    let at = |name: &str| common::folder(&format!("compare-broken-{name}"));
    let whole = ["one", "two"].map(|name| {
        crate::scene::run("late_fusion", &log, &format!("compare-{name}"), &["--offline"]);
        PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("ran-compare-{name}-late_fusion"))
    });
    let (empty, broken) = (at("empty"), at("broken"));
    fs::write(broken.join("result.json"), "{").expect("the folder can be written");
    let all = [whole[0].clone(), empty.clone(), whole[1].clone(), broken.clone()];
    let output = realo(compare(&all, &[]));
    let (said, errors) = (text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(3), "{errors}");
    for name in ["ran-compare-one-late_fusion", "ran-compare-two-late_fusion"] {
        assert!(said.contains(name), "{said}");
    }
    for named in [&empty, &broken] {
        assert!(errors.contains(&*named.to_string_lossy()), "{errors}");
    }
    assert!(errors.contains("the table has 2 of 4 runs"), "{errors}");
    let output = realo(compare(&[empty, broken], &[]));
    assert_eq!(
        (output.status.code(), output.stdout.len()),
        (Some(1), 0),
        "{}",
        text(&output.stderr)
    );
}

#[test]
fn files_of_one_name_that_hold_something_else_differ() {
    let log = Scene::default().write("tables_files");
    let write = |folder: &str, name: &str, text: &str| {
        let file = folder_of(folder).join(name);
        fs::write(&file, text).expect("the folder can be written");
        shown(&file)
    };
    let of_run = |folder: &str, [delay, time]: [&str; 2]| {
        fs::create_dir_all(folder_of(folder)).expect("a folder");
        let link = write(folder, "radio.toml", &format!("[default]\nfixed_ms = {delay}"));
        let compute = write(folder, "times.toml", &format!("\"fusion.fusion\" = {time}"));
        let program = scripted(&format!("tables-{folder}"), "0", SWEEPS, |_| false);
        let stage = format!("fusion.fusion=program {}", program.display());
        let more = [
            "--mode",
            "virtual",
            "--link",
            &link,
            "--compute",
            &compute,
            "--replace",
            &stage,
        ];
        let ran = run("late_fusion", &log, &format!("tables-files-{folder}"), &more);
        ran.result
            .as_ref()
            .unwrap_or_else(|| panic!("no result: {ran:?}"))
            .clone()
    };
    let [one, other] = [("one", ["1", "1000"]), ("other", ["2", "2000"])].map(|(folder, made)| of_run(folder, made));
    for (field, name) in [
        ("link", "radio-"),
        ("compute", "times-"),
        ("programs", "fusion.fusion=plugin.sh-"),
    ] {
        let values = [&one, &other].map(|result| result[field].as_str().unwrap_or_default());
        assert!(
            values.iter().all(|value| value.starts_with(name)),
            "{field}: {values:?}"
        );
        assert_ne!(values[0], values[1], "{field}");
    }
    let named = ["one", "other"].map(|name| common_out(&format!("ran-tables-files-{name}-late_fusion")));
    let document: Value = serde_json::from_str(&realo_ok(compare(&named, &["--json"]))).expect("JSON");
    let differences = document["differences"].to_string();
    for field in ["link", "compute", "programs"] {
        assert!(differences.contains(&format!("{field} differs: ")), "{differences}");
    }
    // What has no file is reported as before.
    let near = json(&runs()[2].join("result.json"));
    assert_eq!((&near["link"], near.get("programs")), (&"paper".into(), None));
}

fn common_out(name: &str) -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join(name)
}

fn folder_of(name: &str) -> PathBuf {
    common_out(&format!("tables-files-{name}"))
}

#[test]
fn logs_that_hold_the_same_are_reported_and_logs_of_one_name_that_do_not() {
    let dir = folder("tables_contents");
    let log = |folder: &str, name: &str, scene: &Scene| {
        let log = dir.join(folder).join(format!("{name}.mcap"));
        fs::create_dir_all(dir.join(folder)).expect("a folder");
        fs::copy(scene.write(&format!("tables_{folder}")), &log).expect("the log can be copied");
        shown(&log)
    };
    let [first, second] = ["a", "b"].map(|name| log("same", name, &Scene::default()));
    let (graph, out) = (common::graph("late_fusion"), shown(&dir.join("pooled")));
    let fixed = ["run", &graph, "--recorded-detections", "--offline", "--ego", "car"];
    let output = realo([&fixed[..], &["--log", &first, "--log", &second, "--out", &out]].concat());
    let said = text(&output.stdout);
    assert_eq!(output.status.code(), Some(3), "{said}");
    let result = json(&dir.join("pooled/result.json"));
    let note = "the logs `a` and `b` hold the same, but count as 2";
    assert!(result["notes"].to_string().contains(note), "{}", result["notes"]);
    // Another log of one of these names.
    let changed = Scene {
        points: false,
        ..Scene::default()
    };
    let other = log("other", "a", &changed);
    let folders = [("one", &first), ("other", &other)].map(|(name, log)| {
        let folder = dir.join(format!("run-{name}"));
        realo_ok([&fixed[..], &["--log", log, "--out", &shown(&folder)]].concat());
        folder
    });
    let said = realo_ok(compare(&folders, &[]));
    let expected = "note: logs differ: the log `a` does not hold the same in run-one and run-other";
    assert!(said.lines().any(|line| line == expected), "{said}");
}
