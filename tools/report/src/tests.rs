use realo_results::{Accounted, Ages, Fates, FinalBoxes, LinkBooks, NodeSummary, Run, Settings, Timing, TimingSamples};
use realo_schemas::{Box3, Boxes, GroundTruth, Header, Kind, Nanos};
use realo_scoring::{Evaluation, Protocol, TrackScores, evaluate, score};

use super::*;

const MS: Nanos = 1_000_000;

fn car(x: f64, score: f32) -> Box3 {
    Box3 {
        score,
        ..Box3::new("Car", [x, 0.0, 0.8], [4.0, 2.0, 1.6], 0.0)
    }
}

/// Frames in which two of three cars are found, and which differ with `luck`.
fn evaluation(log: &str, ego: &str, luck: u64) -> Evaluation {
    let header = |seq: u64, kind| Header::origin(&"r".into(), &ego.into(), kind, seq, seq as Nanos * 100 * MS, 0);
    let truth = || GroundTruth {
        boxes: vec![car(10.0, 1.0), car(40.0, 1.0), car(70.0, 1.0)],
        agents: vec![ego.into(), "rsu1".into()],
        points: vec![30, 0, 20, 9, 0, 50],
        key: true,
        ..GroundTruth::default()
    };
    let found = |seq: u64| {
        let noise = |i: u64| ((seq * 7 + i * 3 + luck) % 11) as f32 / 11.0;
        let at = if (seq + luck).is_multiple_of(3) { 60.0 } else { 70.0 };
        Boxes(vec![car(10.1, noise(0)), car(at, noise(1))])
    };
    let truths = (0..6).map(|seq| (header(seq, Kind::Truth), truth()));
    let boxes = (0..6)
        .filter(|seq| *seq != luck)
        .map(|seq| (header(seq, Kind::Boxes), found(seq)));
    let mut evaluation = evaluate(truths, boxes, &Protocol::load("default").unwrap()).unwrap();
    evaluation.scenes[0].name = log.into();
    evaluation
}

pub(crate) fn run(log: &str, ego: &str, luck: u64) -> Run {
    let settings = Settings {
        graph: "late_fusion".into(),
        mode: "virtual".into(),
        ego: ego.into(),
        seed: "7".into(),
        ..Settings::default()
    };
    let mut run = Run::of_evaluation(settings, evaluation(log, ego, luck), []);
    let fates = Fates {
        used: 4 + luck,
        stale: 2,
        ..Fates::default()
    };
    let books = LinkBooks {
        sent: 7 + luck,
        bytes: 2000,
        lost: 1,
        accounted: Some(Accounted { fates, unaccounted: 0 }),
        ..LinkBooks::default()
    };
    let state = LinkBooks {
        sent: 60,
        bytes: 6000,
        ..LinkBooks::default()
    };
    let kinds = [("boxes".to_string(), books), ("agent_state".to_string(), state)];
    run.result.links.insert(format!("rsu1-{ego}"), kinds.into());
    let node = NodeSummary {
        operator: "nms".into(),
        skipped: luck,
        counters: [("invalid_boxes".to_string(), 2)].into(),
        ..NodeSummary::default()
    };
    run.result.nodes.insert("joint-nms".into(), node);
    let mut ages = Ages::default();
    let mut timing = TimingSamples {
        processed: 5,
        duration_ns: 600 * MS,
        ..TimingSamples::default()
    };
    for i in 0..5 {
        ages.record((30 + 7 * luck as Nanos + i) * MS);
        timing.end_to_end.record((5 + luck as Nanos + i) * MS);
        timing
            .stages
            .entry("fusion".into())
            .or_default()
            .latency
            .record((1 + i) * MS);
    }
    run.samples.ages_ns.insert(Kind::Boxes, ages);
    run.timing = Timing::of(timing);
    let samples = run.samples.clone();
    run.result.conclude(&samples);
    run
}

/// Of two sweeps.
pub(crate) fn three_boxes() -> FinalBoxes {
    FinalBoxes {
        frames: 2,
        total: 3,
        per_frame: 1.5,
        by_class: [("Car".to_string(), 2), ("Bus\n".to_string(), 1)].into(),
    }
}

#[test]
fn a_run_without_truth_says_how_many_boxes_it_found() {
    let mut one = run("a", "cav1", 1);
    one.result.boxes = Some(three_boxes());
    let label = "boxes: all / for each frame";
    let short = table(&[("late_fusion", &one)], false, 100);
    assert!(!short.contains(label), "scores say more: {short}");
    let full = table(&[("late_fusion", &one)], true, 100);
    assert_eq!(cells(&full, label), ["3 / 1.5"]);
    assert_eq!(cells(&full, "Car"), ["2"]);
    // An evaluator without truth gives a table without an AP; without an evaluator there is no table.
    let mut silent = one.clone();
    let sorted = &mut silent.result.accuracy.as_mut().unwrap().sorted;
    sorted.mean_ap.values_mut().for_each(|mean| *mean = None);
    let aps = sorted.ap.values_mut().flat_map(|ap| ap.values_mut());
    aps.for_each(|ap| *ap = None);
    one.result.accuracy = None;
    for run in [&one, &silent] {
        let unscored = table(&[("late_fusion", run)], false, 100);
        assert_eq!(cells(&unscored, label), ["3 / 1.5"]);
        assert_eq!([cells(&unscored, "Car"), cells(&unscored, "Bus")], [["2"], ["1"]]);
        let opening = opening(&[("late_fusion", run)], &[], 100);
        assert!(
            opening.contains("1.5 boxes a sweep") && !opening.contains("mAP"),
            "{opening}"
        );
    }
    let [name, value] = ["boxes", "boxes_per_frame"].map(|field| {
        let fields = fields(&[&one]);
        let found = fields.into_iter().find(|(name, _)| name == field);
        found.expect("a column").1.remove(0)
    });
    assert_eq!([&*name, &*value], ["3", "1.5"]);
    let three = [("a", &one), ("b", &one), ("c", &one)];
    assert!(table(&three, false, 100).contains("per frame"));
    let mut other = run("b", "cav1", 2);
    other.result.boxes = Some(FinalBoxes {
        frames: 3,
        ..FinalBoxes::default()
    });
    let pooled = pool(&[one, other]).unwrap().result.boxes.unwrap();
    assert_eq!((pooled.frames, pooled.total, pooled.per_frame), (5, 3, 0.6));
    assert_eq!(pooled.by_class, three_boxes().by_class);
}

#[test]
fn identities_and_velocities_have_blocks_where_they_are_known() {
    let mut tracked = run("a", "cav1", 1);
    let text = table(&[("late_fusion", &tracked)], false, 100);
    assert!(!text.contains("HOTA") && !text.contains("velocity error"), "{text}");
    let scores = TrackScores {
        hota: 0.71,
        detection: 0.64,
        association: 0.8,
        velocity_error: Some(0.4),
        velocities: 12,
        ..TrackScores::default()
    };
    tracked.result.tracking = Some([("vehicle".to_string(), scores)].into());
    let text = table(&[("late_fusion", &tracked)], false, 100);
    assert!(
        text.contains("0.710 / 0.640 / 0.800") && text.contains("0.40 / –"),
        "{text}"
    );
    assert!(
        crate::words::explained(&text).contains("HOTA: higher order tracking accuracy"),
        "{text}"
    );
}

#[test]
fn pooling_is_scoring_all_frames_at_once() {
    let runs = [run("b", "cav1", 1), run("a", "cav1", 2), run("a", "cav2", 3)];
    let pooled = pool(&runs).unwrap();
    let mut joined = evaluation("a", "cav1", 2);
    joined.scenes.extend(evaluation("a", "cav2", 3).scenes);
    joined.scenes.extend(evaluation("b", "cav1", 1).scenes);
    let scores = score(&joined);
    assert_eq!(pooled.result.accuracy, Some(scores.accuracy));
    assert_eq!(pooled.result.accuracy_seen, Some(scores.accuracy_seen));
    assert_eq!(pooled.result.intervals, scores.intervals);
    assert!(pooled.result.intervals.is_some(), "two logs");
    let mean = runs.iter().map(ap).sum::<f64>() / 3.0;
    assert!(
        (ap(&pooled) - mean).abs() > 1e-3,
        "pooled scores are no means of scores"
    );
}

fn ap(run: &Run) -> f64 {
    run.result.accuracy.as_ref().unwrap().sorted.ap["vehicle"]["0.5"].unwrap()
}

#[test]
fn pooling_adds_what_was_counted_whatever_the_order() {
    let (one, other, third) = (run("b", "cav1", 1), run("a", "cav1", 2), run("a", "cav2", 3));
    let pooled = pool(&[one.clone(), other.clone(), third.clone()]).unwrap();
    assert_eq!(pooled, pool(&[third.clone(), one.clone(), other.clone()]).unwrap());
    let result = &pooled.result;
    assert_eq!(
        (result.runs, &*result.settings.ego, &*result.settings.seed),
        (3, "cav1, cav2", "7")
    );
    assert_eq!(
        (result.frames.total, result.frames.skipped, result.frames.key_skipped),
        (18, 3, 3)
    );
    let books = &result.links["rsu1-cav1"]["boxes"];
    let fates = books.accounted.unwrap().fates;
    assert_eq!((books.sent, books.lost, fates.used, fates.stale), (17, 2, 11, 4));
    assert_eq!(result.links["rsu1-cav2"]["boxes"].sent, 10);
    let node = &result.nodes["joint-nms"];
    assert_eq!((node.skipped, node.counters["invalid_boxes"]), (6, 6));
    assert_eq!(result.age_ms.by_kind["boxes"].count, 15);
    assert_eq!(
        (pooled.timing.latency_ms["end_to_end"].count, pooled.timing.rate_hz),
        (15, Some(15.0 / 1.8))
    );
    // Pooling in two steps is pooling in one.
    let steps = pool(&[pool(&[other, third]).unwrap(), one]).unwrap();
    assert_eq!(steps, pooled);
}

#[test]
fn a_single_run_stays_what_it_is_through_files_and_pool() {
    let folder = tempfile::tempdir().unwrap();
    let one = run("a", "cav1", 1);
    write_run(folder.path(), &one).unwrap();
    let read = read_run(folder.path()).unwrap();
    assert_eq!(read, one);
    assert_eq!(pool(&[read]).unwrap(), one);
}

#[test]
fn refuses_what_does_not_belong_together() {
    assert!(matches!(pool(&[]), Err(PoolError::Empty)));
    let one = run("a", "cav1", 1);
    let mut other = run("b", "cav1", 1);
    other.result.settings.graph = "no_fusion".into();
    let error = pool(&[one.clone(), other]).unwrap_err().to_string();
    assert!(
        error.contains("graph `late_fusion` and `no_fusion`") && error.contains("realo compare"),
        "{error}"
    );
    let error = pool(&[one.clone(), one.clone()]).unwrap_err().to_string();
    assert!(error.contains("log `a` with ego `cav1` is there twice"), "{error}");
    let mut other = run("b", "cav1", 1);
    other.samples.evaluation.as_mut().unwrap().protocol = Protocol::load("dair").unwrap();
    let error = pool(&[one.clone(), other]).unwrap_err().to_string();
    assert!(error.contains("protocols"), "{error}");
    let mut silent = run("b", "cav1", 1);
    silent.samples.evaluation = None;
    let pooled = pool(&[one, silent]).unwrap();
    assert!(
        pooled
            .result
            .notes
            .iter()
            .any(|note| note.contains("1 of 2 runs have no evaluation"))
    );
}

fn line<'a>(table: &'a str, label: &str) -> &'a str {
    let found = table.lines().find(|line| line.trim_start().starts_with(label));
    found.unwrap_or_else(|| panic!("no line `{label}` in\n{table}"))
}

fn cells<'a>(table: &'a str, label: &str) -> Vec<&'a str> {
    let row = line(table, label).trim_start();
    let cells = row[label.len()..].split("   ").map(str::trim);
    cells.filter(|cell| !cell.is_empty()).collect()
}

/// As text for a terminal.
pub(crate) fn table(runs: &[(&str, &Run)], full: bool, width: usize) -> String {
    let format = Format::Text;
    shown(runs, &Options { format, full, width })
}

fn is_as_wide(text: &str, width: usize) -> bool {
    text.lines().all(|line| line.chars().count() <= width)
}

#[test]
fn the_table_says_what_was_measured() {
    let mut alone = run("a", "cav1", 1);
    alone.result.links.clear();
    let mut fused = run("a", "cav1", 2);
    fused.result.transport.total_lost = 3;
    let text = table(&[("no_fusion", &alone), ("late_fusion", &fused)], true, 100);
    assert!(
        text.lines().next().unwrap().trim_start().starts_with("no_fusion   "),
        "{text}"
    );
    assert!(is_as_wide(&text, 100), "{text}");
    let titles: Vec<&str> = text.lines().filter(|line| line.starts_with("AP")).collect();
    let expected = [
        "AP, IoU 0.3 / 0.5",
        "AP, objects that the ego itself sees, IoU 0.3 / 0.5",
        "AP, processed frames only, IoU 0.3 / 0.5",
        // Below all else, and labelled as what it is.
        "AP as V2X-Real's evaluator orders detections; only for comparing with its published numbers, IoU",
        "AP: average precision, from 0 to 1 (best), of the detections of all scored frames sorted by score.",
    ];
    assert_eq!(titles, expected, "{text}");
    let ap = |run: &Run| format!("{:.3}", ap(run));
    assert!(
        line(&text, "vehicle").contains(&ap(&alone)) && line(&text, "vehicle").ends_with(&ap(&fused)),
        "{text}"
    );
    assert_eq!(cells(&text, "messages that dora lost"), ["0", "! 3"]);
    assert_eq!(cells(&text, "sweeps of the ego"), ["6", "6"]);
    assert_eq!(cells(&text, "used"), ["–", "6"]);
    assert_eq!(cells(&text, "stale"), ["–", "2"]);
    assert_eq!(cells(&text, "agent_state"), ["–", "10.00 / 1.00"]);
    assert!(!text.contains("over limit") && !text.contains("unaccounted"), "{text}");
    assert_eq!(cells(&text, "end to end")[1].split(" / ").count(), 3);
    assert!(text.contains("note (no_fusion, late_fusion): "), "{text}");
}

#[test]
fn the_main_rows_are_few() {
    let one = run("a", "cav1", 1);
    let [main, full] = [false, true].map(|full| table(&[("late_fusion", &one)], full, 80));
    let rows = |text: &str| text.lines().filter(|line| line.starts_with("  ")).count();
    assert!(rows(&main) + 10 < rows(&full), "{main}");
    assert!(
        main.contains("end to end") && !main.contains("recall / precision"),
        "{main}"
    );
    assert!(!main.contains("  fusion "), "stages are not the main rows: {main}");
}

#[test]
fn offline_nothing_is_late_and_no_age_is_below_zero() {
    let mut one = run("a", "cav1", 1);
    one.result.settings.mode = "offline".into();
    one.samples.ages_ns.values_mut().for_each(|ages| {
        *ages = Ages::default();
        [-30, -20, 20].iter().for_each(|ms| ages.record(ms * MS));
    });
    one.result.age_ms = one.samples.ages();
    let text = table(&[("late_fusion", &one)], true, 100);
    assert!(!text.contains("end to end"), "{text}");
    let rows: Vec<&str> = text
        .lines()
        .filter(|line| line.trim_start().starts_with("boxes "))
        .collect();
    assert!(rows[0].contains("20.0 / 30.0 / 30.0"), "{text}");
    assert!(text.contains("stamps apart of the data that were fused, ms"), "{text}");
    assert!(!text.contains("age of the data"), "{text}");
    let list = table(&[("a", &one), ("b", &one), ("c", &one)], false, 100);
    let row = list.lines().find(|line| line.starts_with("a ")).unwrap();
    assert!(row.contains(" 20 ") && !list.contains("-2"), "{list}");
    assert!(list.contains("Offline nothing is late"), "{list}");
    let age = one.result.age_ms.by_kind["boxes"].p50;
    assert!(age < Some(-19.0), "in result.json ages stay what they are");
}

/// Twelve runs: three strategies over four links.
fn sweep() -> Vec<(String, Run)> {
    let mut runs = Vec::new();
    for link in ["perfect", "10ms", "100ms", "300ms"] {
        for (luck, graph) in ["late_fusion", "attfuse", "v2xvit"].into_iter().enumerate() {
            let mut run = run("a", "cav1", luck as u64);
            run.result.settings.graph = graph.into();
            run.result.settings.link = link.into();
            run.result.settings.set =
                format!("others.sense.localization.position_noise_m=0.{luck}, fusion.bank.window_ms=400");
            runs.push((format!("{link}/{graph}"), run));
        }
    }
    runs
}

#[test]
fn logs_of_one_name_programs_and_rates_that_differ_are_reported() {
    let [mut one, mut other] = [run("a", "cav1", 1), run("a", "cav1", 1)];
    let differ = |one: &Run, other: &Run| differences(&[("one", one), ("other", other)]);
    assert_eq!(differ(&one, &other), [""; 0]);
    one.samples.logs.insert("a".into(), "12".into());
    assert_eq!(
        differ(&one, &other),
        [""; 0],
        "of one log it is not known what it holds"
    );
    other.samples.logs.insert("a".into(), "34".into());
    one.result.settings.programs = "fusion.fusion=mine.py-12".into();
    other.result.settings.programs = "fusion.fusion=mine.py-34".into();
    one.result.settings.rate = "0.5".into();
    let expected = [
        "logs differ: the log `a` does not hold the same in one and other",
        "rate differs: 0.5 in one; not set in other",
        "programs differs: fusion.fusion=mine.py-12 in one; fusion.fusion=mine.py-34 in other",
    ];
    assert_eq!(differ(&one, &other), expected);
    assert_eq!(pool(&[one.clone()]).unwrap().samples.logs, one.samples.logs);
}

#[test]
fn names_with_control_characters_break_no_table() {
    let mut run = run("a\nb", "cav1", 1);
    run.result.settings.set = "x.y=\u{1b}]0;title\u{7}".into();
    run.result.ended_by = Some("Ctrl-C".into());
    run.result.logs_cut = vec!["a".into()];
    let name = "one\u{1b}[2J\n| two";
    for format in [Format::Text, Format::Markdown, Format::Csv, Format::Latex] {
        for full in [false, true] {
            let options = Options {
                format,
                full,
                ..Options::default()
            };
            let said = shown(&[(name, &run), ("other", &run), ("third", &run)], &options);
            let control = said.chars().find(|letter| letter.is_control() && *letter != '\n');
            assert_eq!(control, None, "{format:?}: {said}");
            let rows = said
                .lines()
                .filter(|line| line.contains("| two") || line.contains("\\| two"));
            assert!(format == Format::Text || rows.count() == 1, "{format:?}: {said}");
        }
    }
    let options = Options {
        format: Format::Csv,
        ..Options::default()
    };
    let said = shown(&[("one", &run)], &options);
    let lines: Vec<Vec<&str>> = said.lines().map(|line| line.split(',').collect()).collect();
    let cell = |field: &str| lines[1][lines[0].iter().position(|name| *name == field).unwrap()];
    assert_eq!((cell("ended_by"), cell("logs_cut")), ("Ctrl-C", "a"));
}

fn named(runs: &[(String, Run)]) -> Vec<(&str, &Run)> {
    runs.iter().map(|(name, run)| (name.as_str(), run)).collect()
}

#[test]
fn twelve_runs_are_twelve_rows_at_any_width() {
    let runs = sweep();
    let runs = named(&runs);
    for width in [40, 60, 80, 100, 200] {
        let text = table(&runs, false, width);
        assert!(is_as_wide(&text, width), "{width}: {text}");
        let rows = |name: &str| text.lines().filter(|line| line.starts_with(name)).count();
        let blocks = text.lines().filter(|line| line.starts_with('─')).count();
        if width >= 80 {
            assert_eq!(blocks, 1, "{width}: {text}");
            let names = ["perfect/", "10ms/", "100ms/", "300ms/"];
            let rows = text
                .lines()
                .filter(|line| names.iter().any(|name| line.starts_with(name)));
            assert_eq!(rows.count(), 12, "{width}: {text}");
        }
        if width >= 100 {
            assert!(runs.iter().all(|(name, _)| rows(name) == blocks), "{width}: {text}");
        }
        // What was set makes no row longer; what differs of it stands below.
        let differing = "others.sense.localization.position_noise_m differs: 0.0 in";
        assert!(width < 80 || text.contains(differing), "{text}");
        // What is alike stands once, above.
        assert_eq!(text.matches("fusion.bank.window_ms=400").count(), 1, "{text}");
        assert!(!text.contains("window_ms differs"), "{text}");
    }
    let full = table(&runs, true, 100);
    assert!(is_as_wide(&full, 100), "{full}");
    assert!(full.matches("recall / precision").count() > 1, "{full}");
}

#[test]
fn a_row_for_each_run_as_a_reader_sees_it() {
    let runs = [run("a", "cav1", 0), run("a", "cav1", 1), run("a", "cav1", 2)];
    let text = table(
        &[
            ("no_fusion", &runs[0]),
            ("late_fusion", &runs[1]),
            ("early_fusion", &runs[2]),
        ],
        false,
        80,
    );
    let ap = |run: &Run, iou: &str| {
        format!(
            "{:.3}",
            run.result.accuracy.as_ref().unwrap().sorted.ap["vehicle"][iou].unwrap()
        )
    };
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(
        lines[0], "virtual; ego cav1; seed 7; log a; protocol default; 6 scored frames",
        "{text}"
    );
    assert_eq!(
        lines[1].split_whitespace().collect::<Vec<_>>(),
        ["mAP", "KB", "per", "age", "vehicle"]
    );
    assert_eq!(
        lines[2].split_whitespace().collect::<Vec<_>>(),
        ["0.3", "0.5", "frame", "ms", "0.3", "0.5"],
        "classes without objects have no column"
    );
    for (line, (name, run)) in lines[4..]
        .iter()
        .zip(["no_fusion", "late_fusion", "early_fusion"].iter().zip(&runs))
    {
        let row: Vec<&str> = line.split_whitespace().collect();
        let at = if row[1] == "!" { 2 } else { 1 };
        assert_eq!(row[0], *name);
        assert_eq!(row[at + 4..at + 6], [ap(run, "0.3"), ap(run, "0.5")], "{text}");
    }
    let foot = text.lines().skip(7).collect::<Vec<_>>().join(" ");
    let foot = foot.split_whitespace().collect::<Vec<_>>().join(" ");
    for part in [
        "vehicle, pedestrian, truck: AP of the class (average precision",
        "mAP: mean of the classes' AP. ",
        "age: from the stamp of the data",
        "note: one log, 6 scored frames: there is no 95 % interval",
    ] {
        assert!(foot.contains(part), "no `{part}` in: {foot}");
    }
}

#[test]
fn several_logs_give_intervals() {
    let of = |luck| pool(&[run("a", "cav1", luck), run("b", "cav1", luck + 1)]).unwrap();
    let runs = [of(1), of(2), of(3)];
    let text = table(&[("one", &runs[0]), ("two", &runs[1]), ("three", &runs[2])], false, 120);
    assert!(!text.contains("one log"), "{text}");
    let mut both = [runs[0].clone(), run("a", "cav1", 1)];
    both[1].result.settings.graph = "other".into();
    let text = table(&[("one", &both[0]), ("two", &both[1])], false, 120);
    assert!(text.contains("note: one log (1 of 2 runs), 6 scored frames"), "{text}");
}

#[test]
fn every_format_has_every_run_and_the_same_numbers() {
    let mut runs = sweep();
    runs[0].0 = "a|b, \"c\" & 100 %_#".into();
    let runs = named(&runs);
    let [markdown, csv, latex] = [Format::Markdown, Format::Csv, Format::Latex].map(|format| {
        let options = Options {
            format,
            ..Options::default()
        };
        shown(&runs, &options)
    });
    let lines: Vec<&str> = markdown.lines().take_while(|line| line.starts_with('|')).collect();
    assert_eq!(lines.len(), 14, "{markdown}");
    let cells = |line: &str| line.replace("\\|", "").matches('|').count();
    assert!(lines.iter().all(|line| cells(line) == cells(lines[0])), "{markdown}");
    assert!(
        lines[0].starts_with(
            "| run | link | others.sense.localization.position_noise_m | mAP 0.3 | mAP 0.5 | KB per frame | age ms | vehicle 0.3 |"
        ),
        "{markdown}"
    );
    let rows: Vec<&str> = csv.lines().collect();
    assert_eq!(rows.len(), 13, "{csv}");
    assert!(rows[0].starts_with("run,graph,mode,coop,ego,link,"), "{csv}");
    assert!(
        rows[1].starts_with("\"a|b, \"\"c\"\" & 100 %_#\",late_fusion,virtual,"),
        "{csv}"
    );
    let head: Vec<&str> = rows[0].split(',').collect();
    let at = head.iter().position(|field| *field == "AP_vehicle_0.5").unwrap();
    // No other cell of this row holds a comma but `set`.
    let cell = rows[2]
        .replace(", fusion", " fusion")
        .split(',')
        .nth(at)
        .unwrap()
        .to_string();
    assert_eq!(cell.parse::<f64>().unwrap(), ap(runs[1].1), "with all digits");
    let rows: Vec<&str> = latex.lines().filter(|line| line.ends_with("\\\\")).collect();
    assert_eq!(rows.len(), 13, "{latex}");
    assert!(
        rows.iter()
            .all(|row| row.matches(" & ").count() == rows[0].matches(" & ").count()),
        "{latex}"
    );
    assert!(rows[1].starts_with("a|b, \"c\" \\& 100 \\%\\_\\# & "), "{latex}");
    assert!(
        latex.starts_with("\\begin{tabular}{lllrrrr") && latex.contains("\\end{tabular}\n"),
        "{latex}"
    );
    for format in [Format::Markdown, Format::Csv, Format::Latex] {
        let options = Options {
            format,
            full: true,
            width: 80,
        };
        let full = shown(&runs, &options);
        assert!(
            full.contains("recall / precision") && full.lines().count() > 30,
            "{full}"
        );
    }
}

#[test]
fn json_gives_the_files_without_samples() {
    let one = run("a", "cav1", 1);
    let options = Options {
        format: Format::Json,
        ..Options::default()
    };
    let document: Value = serde_json::from_str(&shown(&[("late_fusion", &one)], &options)).unwrap();
    let entry = &document["runs"][0];
    assert_eq!(entry["name"], "late_fusion");
    assert_eq!(entry["result"]["accuracy"]["sorted"]["AP"]["vehicle"]["0.5"], ap(&one));
    assert!(entry["timing"]["latency_ms"]["end_to_end"]["p50"].is_number() && entry["timing"].get("samples").is_none());
}

#[test]
fn runs_of_one_thing_differ_in_nothing() {
    let (mut one, mut other) = (run("a", "cav1", 1), run("a", "cav1", 2));
    assert_eq!(differences(&[("one", &one), ("other", &other)]), [""; 0]);
    assert_eq!(differences(&[]), [""; 0]);
    // What others have on an object decides only whether it counts.
    other.samples.evaluation.as_mut().unwrap().scenes[0].frames[0].truths[0].points = Some([99, 30]);
    // Nor does it matter in which order they were read.
    (one.result.logs, other.result.logs) = (names(["a", "b"]), names(["b", "a"]));
    assert_eq!(differences(&[("one", &one), ("other", &other)]), [""; 0]);
    assert!(!table(&[("one", &one), ("other", &other)], false, 80).contains("differ:"));
}

pub(crate) fn names<const N: usize>(names: [&str; N]) -> Vec<String> {
    names.map(String::from).to_vec()
}

#[test]
fn what_makes_runs_hard_to_compare_stands_above_the_table() {
    let (one, same) = (run("a", "cav1", 1), run("a", "cav1", 2));
    let mut other = run("b", "cav2", 1);
    other.result.agents = names(["cav2", "rsu1"]);
    let (mut one, mut same) = (one, same);
    one.result.agents = names(["cav1", "rsu1"]);
    same.result.agents = names(["rsu1", "cav1"]);
    let runs = [("one", &one), ("same", &same), ("other", &other)];
    let found = differences(&runs);
    let expected = [
        "logs differ: other lacks a; only other has b",
        "egos differ: other lacks cav1; only other has cav2",
        "agents differ: other lacks cav1; only other has cav2; all have rsu1",
    ];
    assert_eq!(found, expected);
    let text = table(&runs, false, 80);
    let above: Vec<&str> = text.lines().take_while(|line| line.starts_with("note: ")).collect();
    assert_eq!(above.len(), 3, "{text}");
    assert_eq!(above[0], format!("note: {}", expected[0]));
    let document: Value = serde_json::from_str(&json(&runs)).unwrap();
    assert_eq!(document["differences"][1], expected[1]);
}

#[test]
fn every_setting_that_differs_is_named_by_itself() {
    let (mut one, mut other) = (run("a", "cav1", 1), run("a", "cav1", 2));
    (one.result.settings.link, other.result.settings.link) = ("perfect".into(), "lat100".into());
    one.result.settings.set = "v2x.connect=tcp/a:1, tcp/b:2, fusion.bank.window_ms=400".into();
    other.result.settings.set = "fusion.bank.window_ms=400, others.sense.localization.position_noise_m=0.2".into();
    (other.result.settings.seed, other.result.settings.compute) = ("8".into(), "paper".into());
    other.result.settings.model = "lite-1".into();
    for run in [&mut one, &mut other] {
        for stage in ["v2x", "fusion.bank", "others.sense.localization"] {
            run.result.nodes.insert(stage.into(), NodeSummary::default());
        }
    }
    let found = differences(&[("one", &one), ("other", &other)]);
    let expected = [
        "link differs: perfect in one; lat100 in other",
        "seed differs: 7 in one; 8 in other",
        "compute differs: none in one; paper in other",
        "others.sense.localization.position_noise_m differs: not set in one; 0.2 in other",
        "v2x.connect differs: tcp/a:1, tcp/b:2 in one; not set in other",
    ];
    assert_eq!(found, expected, "who has no network has no other model");
    one.result.settings.model = "lite-2".into();
    let found = differences(&[("one", &one), ("other", &other)]);
    assert!(
        found.contains(&"model differs: lite-2 in one; lite-1 in other".to_string()),
        "{found:?}"
    );
}

#[test]
fn agents_that_took_part_in_some_runs_only_are_named_with_these_runs() {
    let agents = |agents: &[&str]| {
        let mut run = run("a", "cav1", 1);
        run.result.agents = agents.iter().map(|agent| agent.to_string()).collect();
        run
    };
    let runs = [
        agents(&["cav1", "cav2", "rsu1"]),
        agents(&["cav1", "cav2", "rsu1", "rsu2"]),
        agents(&["cav1", "cav2"]),
    ];
    let found = differences(&[("late_fusion", &runs[0]), ("t5", &runs[1]), ("t6", &runs[2])]);
    assert_eq!(
        found,
        ["agents differ: t6 lacks rsu1; only t5 has rsu2; all have cav1, cav2"]
    );
}

#[test]
fn long_lists_are_cut_short_and_lacks_are_reported() {
    let (mut one, mut other) = (run("a", "cav1", 1), run("a", "cav1", 2));
    one.result.logs = (0..9).map(|i| format!("log{i}")).collect();
    other.result.logs = names(["log8"]);
    let found = differences(&[("one", &one), ("other", &other)]);
    assert_eq!(
        found,
        ["logs differ: only one has log0, log1, log2, log3, log4 and 3 more; all have log8"]
    );
    one.result.logs.truncate(5);
    other.result.logs.clear();
    let found = differences(&[("one", &one), ("other", &other)]);
    assert_eq!(found, ["logs differ: only one has log0, log1, log2, log3, log4"]);
}

#[test]
fn protocols_are_compared_by_what_they_say() {
    let (one, mut other, mut silent) = (run("a", "cav1", 1), run("a", "cav1", 2), run("a", "cav1", 3));
    other.samples.evaluation.as_mut().unwrap().protocol.min_points = 6;
    let found = differences(&[("one", &one), ("other", &other)]);
    assert_eq!(
        found,
        ["protocols differ: both are named `default`, but `min_points` is not the same in one and other"]
    );
    (silent.result.protocol, silent.samples.evaluation) = (None, None);
    let found = differences(&[("one", &one), ("silent", &silent)]);
    assert_eq!(found, ["protocols differ: default in one; no evaluation in silent"]);
}

#[test]
fn truth_is_compared_object_by_object() {
    let one = run("a", "cav1", 1);
    let changed = |change: fn(&mut Evaluation)| {
        let mut other = run("a", "cav1", 2);
        change(other.samples.evaluation.as_mut().unwrap());
        differences(&[("one", &one), ("other", &other)]).join("; ")
    };
    let missing = changed(|evaluation| _ = evaluation.scenes[0].frames[3].truths.pop());
    assert_eq!(
        missing,
        "truth differs, first in log `a`, ego cav1: 18 objects in 6 scored frames in one; 17 objects in 6 scored frames \
         in other"
    );
    let fewer = changed(|evaluation| _ = evaluation.scenes[0].frames.pop());
    assert!(fewer.contains("15 objects in 5 scored frames in other"), "{fewer}");
    let unscored = changed(|evaluation| evaluation.scenes[0].frames[0].key = false);
    assert!(
        unscored.contains("15 objects in 5 scored frames in other"),
        "{unscored}"
    );
    let moved = "as many, but not the same objects: 18 objects in 6 scored frames in one, other";
    let cases: [fn(&mut Evaluation); 4] = [
        |evaluation| evaluation.scenes[0].frames[2].truths[1].outline.yaw += 1,
        |evaluation| evaluation.scenes[0].frames[2].truths[1].class = 1,
        |evaluation| evaluation.scenes[0].frames[2].truths[1].points = Some([30, 29]),
        |evaluation| evaluation.scenes[0].frames[2].stamp += 1,
    ];
    for change in cases {
        let found = changed(change);
        assert!(found.ends_with(moved), "{found}");
    }
    // Scenes that only one of them has are reported as logs.
    assert_eq!(changed(|evaluation| evaluation.scenes[0].name = "b".into()), "");
    // Of two protocols the objects are never the same.
    let other = changed(|evaluation| {
        evaluation.protocol.min_points = 7;
        evaluation.scenes[0].frames.pop();
    });
    assert!(!other.contains("truth differs"), "{other}");
}

#[test]
fn a_pooled_run_names_the_log_of_all_its_runs_and_the_cut_ones() {
    let mut runs = [run("a", "cav1", 1), run("a", "cav2", 2)];
    for run in &mut runs {
        run.timing.log_path = Some("/logs/a.mcap".into());
        run.result.logs_cut = names(["a"]);
    }
    let pooled = pool(&runs).unwrap();
    assert_eq!(pooled.timing.log_path.as_deref(), Some("/logs/a.mcap"));
    assert_eq!(pooled.result.logs_cut, ["a"]);
    runs[1].timing.log_path = Some("/logs/b.mcap".into());
    assert_eq!(pool(&runs).unwrap().timing.log_path, None);
}

/// A run without cooperation, and two over a link with noise.
fn delayed() -> [Run; 3] {
    let mut runs = [run("a", "cav1", 1), run("a", "cav1", 2), run("a", "cav1", 3)];
    let graphs = ["no_fusion", "late_fusion", "attfuse"];
    for (run, graph) in runs.iter_mut().zip(graphs) {
        run.result.settings.graph = graph.into();
        if graph != "no_fusion" {
            run.result.settings.link = "delay_ms=90".into();
            run.result.settings.set = "others.sense.localization.position_noise_m=0.2".into();
            let localization = NodeSummary::default();
            run.result
                .nodes
                .insert("others.sense.localization".into(), localization);
        }
    }
    runs[2].result.settings.project = "sender".into();
    runs
}

#[test]
fn what_all_share_is_named_in_every_format_also_beside_a_run_that_has_no_such_thing() {
    let runs = delayed();
    let runs = [
        ("no_fusion", &runs[0]),
        ("late_fusion", &runs[1]),
        ("attfuse", &runs[2]),
    ];
    let said = "virtual; ego cav1; link delay_ms=90 (no_fusion has none); seed 7; project sender (only attfuse has one); \
                others.sense.localization.position_noise_m=0.2 (no_fusion has none); log a; protocol default; 6 scored frames";
    let in_format = |format| {
        shown(
            &runs,
            &Options {
                format,
                full: false,
                width: 400,
            },
        )
    };
    let text = in_format(Format::Text);
    assert_eq!(text.lines().next(), Some(said));
    assert!(!text.contains(" differs: "), "{text}");
    let markdown = in_format(Format::Markdown);
    assert!(
        markdown.contains(&format!("\n- Settings of all runs: {said}.\n")),
        "{markdown}"
    );
    let latex = in_format(Format::Latex);
    assert!(
        latex.contains(&format!("\n% Settings of all runs: {said}.\n")),
        "{latex}"
    );
    let csv = in_format(Format::Csv);
    let head: Vec<&str> = csv.lines().next().unwrap().split(',').collect();
    for (row, link, set) in [
        (1, "", ""),
        (2, "delay_ms=90", "others.sense.localization.position_noise_m=0.2"),
    ] {
        let row: Vec<&str> = csv.lines().nth(row).unwrap().split(',').collect();
        let cell = |name| row[head.iter().position(|field| *field == name).unwrap()];
        assert_eq!((cell("link"), cell("set")), (link, set), "{csv}");
    }
    let document: Value = serde_json::from_str(&in_format(Format::Json)).unwrap();
    let common = &document["common"];
    assert_eq!(
        (&common["link"], &common["mode"]),
        (&"delay_ms=90".into(), &"virtual".into())
    );
    assert_eq!(common["set"]["others.sense.localization.position_noise_m"], "0.2");
    // One run is named as such.
    let one = shown(
        &runs[1..2],
        &Options {
            format: Format::Markdown,
            ..Options::default()
        },
    );
    assert!(
        one.contains("\n- Settings: virtual; ego cav1; link delay_ms=90; seed 7; "),
        "{one}"
    );
}

#[test]
fn what_differs_is_a_label_of_the_row() {
    let [alone, mut fused, other] = delayed();
    fused.result.settings.link = "perfect".into();
    fused.result.settings.set.clear();
    let runs = [("alone", &alone), ("fused", &fused), ("other", &other)];
    let markdown = shown(
        &runs,
        &Options {
            format: Format::Markdown,
            ..Options::default()
        },
    );
    let rows: Vec<&str> = markdown.lines().collect();
    assert!(
        rows[0].starts_with("| run | link | others.sense.localization.position_noise_m | mAP"),
        "{markdown}"
    );
    assert!(rows[2].starts_with("| alone | – | – |"), "{markdown}");
    assert!(rows[3].starts_with("| fused | perfect | not set |"), "{markdown}");
    assert!(rows[4].starts_with("| other | delay_ms=90 | 0.2 |"), "{markdown}");
    assert!(!markdown.contains("link delay_ms=90"), "{markdown}");
}

#[test]
fn what_was_not_sent_is_no_part_of_what_was() {
    let mut one = run("a", "cav1", 1);
    let state = LinkBooks {
        sent: 198,
        out_of_range: 3,
        accounted: Some(Accounted {
            fates: Fates {
                superseded: 198,
                ..Fates::default()
            },
            unaccounted: 0,
        }),
        ..LinkBooks::default()
    };
    one.result
        .links
        .get_mut("rsu1-cav1")
        .unwrap()
        .insert("agent_state".into(), state);
    let text = table(&[("one", &one)], true, 100);
    let at = |label: &str| text.find(label).unwrap_or_else(|| panic!("no `{label}` in {text}"));
    let section = at("messages over links: agent_state");
    let rows: Vec<&str> = text[section..].lines().skip(1).take(4).collect();
    let labels = [
        "  not sent: out of range",
        "  sent",
        "    used",
        "    replaced by the next state (normal)",
    ];
    for (row, label) in rows.iter().zip(labels) {
        assert!(row.starts_with(label), "`{label}`: {text}");
    }
    let parts: u64 = rows[2..]
        .iter()
        .map(|row| row.split_whitespace().last().unwrap().parse::<u64>().unwrap())
        .sum();
    assert_eq!((parts, rows[1].split_whitespace().last()), (198, Some("198")));
    // Of other kinds it is no matter of course.
    assert!(!text[at("messages over links: boxes")..section].contains("normal"));
}

#[test]
fn a_note_names_a_run_once_and_a_cause_once() {
    let [mut alone, mut fused, _] = delayed();
    let cause = "mast: 20 of 60 messages were left out; set its clock";
    alone.result.notes = vec![cause.into(), "two links say it".into(), "two links say it".into()];
    fused.result.notes = vec![
        cause.replace("mast: ", "mast: no message was used: "),
        "two links say it".into(),
    ];
    let said = notes(&[("alone", &alone), ("fused", &fused), ("fused", &fused)]);
    assert_eq!(
        said,
        [
            "note (all 3): mast: no message was used: 20 of 60 messages were left out; set its clock",
            "note (all 3): two links say it"
        ]
    );
    assert_eq!(
        notes(&[("fused", &fused), ("fused", &fused)])[1],
        "note (fused): two links say it"
    );
}
