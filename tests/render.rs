//! `realo render`: a picture says what the evaluation says, and wrong input gets a clear error.

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use common::{folder, json, once, realo, realo_ok, run_virtual, simulated, text};
use realo_logs::{Log, LogInfo, LogWriter, Stream};
use realo_render::{Request, Scene};
use realo_schemas::Nanos;
use realo_scoring::{Evaluation, Outcome, Scope, match_frame};
use serde_json::Value;

const LOG: &str = "render_small";

fn log() -> PathBuf {
    simulated(
        LOG,
        &[
            "--seed",
            "903",
            "--seconds",
            "2",
            "--key-hz",
            "5",
            "--agents",
            "cav1,rsu1",
        ],
    )
}

/// A virtual run of late fusion over the small log, made once.
fn run() -> PathBuf {
    once("render_run", |_| {
        let args = [
            "--recorded-detections",
            "--link",
            "paper",
            "--set",
            "v2x.link.range_m=1000",
        ];
        run_virtual("render_run", "late_fusion", &log(), &args);
    })
}

fn render(run: &Path, output: &Path, args: &[&str]) -> (Option<i32>, String) {
    let (run, output) = (run.to_string_lossy(), output.to_string_lossy());
    let said = realo([&["render", &run, "-o", &output][..], args].concat());
    (
        said.status.code(),
        format!("{}{}", text(&said.stdout), text(&said.stderr)),
    )
}

/// The classes of a drawing's marks.
fn marks(svg: &str, class: &str) -> usize {
    let document = roxmltree::Document::parse(svg).expect("the drawing is XML");
    let of_class = |node: &roxmltree::Node| node.attribute("class") == Some(class);
    document.descendants().filter(of_class).count()
}

/// What the run's evaluation says of each scored frame: sweep, true detections, those on objects that the ego alone has
/// too few points on, false ones, missed objects.
fn counted(run: &Path) -> Vec<(u64, [usize; 4])> {
    let samples = json(&run.join(format!("{LOG}/cav1/evaluation.json")));
    let evaluation: Evaluation = serde_json::from_value(samples["evaluation"].clone()).expect("an evaluation");
    let protocol = &evaluation.protocol;
    let mut counted = Vec::new();
    for frame in evaluation.scenes[0].frames.iter().filter(|frame| frame.key) {
        let [mut hits, mut added, mut wrong] = [0; 3];
        for class in 0..protocol.classes.len() as u8 {
            for (_, outcome) in match_frame(frame, protocol, class, protocol.ious[0], Scope::All) {
                let Outcome::True(object) = outcome else {
                    wrong += 1;
                    continue;
                };
                hits += 1;
                let [_, ego] = frame.truths[object].points.expect("the simulator counts points");
                // Nothing can have crossed the link before the second sweep.
                added += usize::from(ego < 10 && frame.seq >= 1);
            }
        }
        counted.push((frame.seq, [hits, added, wrong, frame.truths.len() - hits]));
    }
    counted
}

#[test]
fn a_drawing_has_the_boxes_that_the_evaluation_counts() {
    let out = folder("render_svg");
    let log = log();
    let log = log.to_string_lossy();
    let counted = counted(&run());
    let mut kinds = [0; 4];
    for (seq, [hits, added, wrong, missed]) in &counted {
        let file = out.join(format!("{seq}.svg"));
        let (code, said) = render(&run(), &file, &["--log", &log, "--frame", &seq.to_string()]);
        assert_eq!(code, Some(0), "{said}");
        let svg = fs::read_to_string(&file).expect("the drawing is there");
        let found = ["hit", "added", "false", "missed", "there"].map(|class| marks(&svg, class));
        assert_eq!(found, [hits - added, *added, *wrong, *missed, *hits], "sweep {seq}");
        assert_eq!((marks(&svg, "agent"), marks(&svg, "region")), (2, 1));
        assert!(
            marks(&svg, "points") >= 4,
            "points of two agents, on the ground and above"
        );
        assert!(svg.len() < 2_000_000, "{} bytes", svg.len());
        assert!(!svg.contains("<text"), "letters must not depend on fonts");
        kinds = [kinds[0] + hits, kinds[1] + added, kinds[2] + wrong, kinds[3] + missed];
    }
    assert!(
        kinds.iter().all(|count| *count > 0),
        "every kind of box is tested: {kinds:?}"
    );
}

#[test]
fn without_a_number_the_frame_that_gains_most_is_drawn_the_same_every_time() {
    let out = folder("render_default");
    let log = log();
    let log = log.to_string_lossy();
    let most = counted(&run()).into_iter().map(|(_, [_, added, ..])| added).max();
    let mut drawings = Vec::new();
    for name in ["a.svg", "b.svg"] {
        let file = out.join(name);
        let (code, said) = render(&run(), &file, &["--log", &log]);
        assert_eq!(code, Some(0), "{said}");
        drawings.push(fs::read_to_string(&file).expect("the drawing is there"));
    }
    assert_eq!(Some(marks(&drawings[0], "added")), most);
    assert!(drawings[0] == drawings[1], "two drawings of a frame differ");
}

#[test]
fn pixels_show_points_and_boxes() {
    let file = folder("render_png").join("frame.png");
    let (code, said) = render(&run(), &file, &["--log", &log().to_string_lossy()]);
    assert_eq!(code, Some(0), "{said}");
    let bytes = fs::read(&file).expect("the picture is there");
    let header = minipng::decode_png_header(&bytes).expect("a PNG");
    assert_eq!(header.width(), 1600);
    assert!((700..1000).contains(&header.height()), "{}", header.height());
    let mut buffer = vec![0; header.required_bytes()];
    let image = minipng::decode_png(&bytes, &mut buffer).expect("a PNG");
    let pixels: Vec<&[u8]> = image.pixels().chunks_exact(3).collect();
    assert_eq!(pixels.len(), 1600 * header.height() as usize);
    let share =
        |like: &dyn Fn(&[u8]) -> bool| pixels.iter().filter(|pixel| like(pixel)).count() as f64 / pixels.len() as f64;
    let ground = share(&|pixel| pixel.iter().all(|channel| *channel < 50));
    assert!((0.3..0.98).contains(&ground), "{ground} of the picture is ground");
    let yellow = share(&|pixel| pixel[0] > 200 && pixel[1] > 200 && pixel[2] < 120);
    assert!(yellow > 1e-4, "what only cooperation saw stands out: {yellow}");
}

#[test]
fn a_log_without_points_still_gives_a_picture() {
    let log = simulated(
        "render_bare",
        &[
            "--seed",
            "903",
            "--seconds",
            "1",
            "--no-clouds",
            "--agents",
            "cav1,rsu1",
        ],
    );
    let args = ["--recorded-detections", "--ego", "cav1"];
    run_virtual("render_bare_run", "no_fusion", &log, &args);
    let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join("render_bare_run");
    let file = folder("render_bare_out").join("bare.svg");
    let (code, said) = render(&dir, &file, &["--log", &log.to_string_lossy()]);
    assert_eq!(code, Some(0), "{said}");
    let svg = fs::read_to_string(file).expect("the drawing is there");
    assert!(
        marks(&svg, "hit") > 0 && marks(&svg, "added") == 0,
        "the ego alone: {said}"
    );
    assert!(!said.contains("cooperation"), "{said}");
}

#[test]
fn wrong_input_is_named_with_what_helps() {
    let dir = folder("render_bad");
    let log = log();
    let log = log.to_string_lossy();
    let (run, file) = (run(), dir.join("x.png"));
    let check = |run: &Path, output: &Path, args: &[&str], expected: &[&str]| {
        let (code, said) = render(run, output, args);
        assert_eq!(code, Some(1), "{said}");
        for part in expected {
            assert!(said.contains(part), "no `{part}` in: {said}");
        }
    };
    check(
        &run,
        &file,
        &["--log", &log, "--frame", "77"],
        &["no sweep 77", "sweeps 0 to 19", "scored: "],
    );
    check(
        &run,
        &file,
        &["--log", &log, "--ego", "cav9"],
        &["no ego `cav9`", "ego cav1"],
    );
    check(
        &run,
        &dir.join("x.jpg"),
        &["--log", &log],
        &["x.jpg", ".svg or .png", "found .jpg"],
    );
    check(
        &run,
        &dir.join("picture"),
        &["--log", &log],
        &[".svg or .png", "no ending"],
    );
    check(
        &run,
        &dir.join("gone/x.png"),
        &["--log", &log],
        &["gone/x.png", "cannot be written", "-o"],
    );
    let moved = reported_of_log(&dir.join("moved"), Some(&dir.join(format!("away/{LOG}.mcap"))));
    check(
        &moved,
        &file,
        &[],
        &[&format!("log `{LOG}`"), &format!("away/{LOG}.mcap"), "--log"],
    );
    let gone = dir.join("gone.mcap");
    check(&run, &file, &["--log", &gone.to_string_lossy()], &["gone.mcap"]);
    check(
        &dir.join("nothing"),
        &file,
        &["--log", &log],
        &["no such folder", "realo run"],
    );
    let other = simulated(
        "render_other",
        &["--seed", "904", "--seconds", "1", "--agents", "cav2,rsu1"],
    );
    check(
        &run,
        &file,
        &["--log", &other.to_string_lossy()],
        &["render_other.mcap", "no agent `cav1`", "--log"],
    );
    assert!(!file.exists(), "nothing is written beside an error");
}

/// A copy of the run in which this stands as the path of its log.
fn reported_of_log(copy: &Path, log: Option<&Path>) -> PathBuf {
    let cell = copy.join(LOG).join("cav1");
    fs::create_dir_all(&cell).expect("the folder can be made");
    for file in ["result.json", "timing.json", "evaluation.json", "recording.mcap"] {
        fs::copy(run().join(LOG).join("cav1").join(file), cell.join(file)).expect("the run can be copied");
    }
    let mut timing = json(&cell.join("timing.json"));
    timing["log_path"] = log.map(|log| log.to_string_lossy()).into();
    fs::write(cell.join("timing.json"), timing.to_string()).expect("the file can be written");
    copy.into()
}

#[test]
fn a_log_that_has_not_moved_is_found() {
    let dir = folder("render_found");
    let reported = reported_of_log(&dir.join("reported"), Some(&log()));
    let (code, said) = render(&reported, &dir.join("x.svg"), &[]);
    assert_eq!(code, Some(0), "{said}");
    let unreported = reported_of_log(&dir.join("unreported"), None);
    let (code, said) = render(&unreported, &dir.join("y.svg"), &[]);
    assert_eq!(code, Some(1), "{said}");
    assert!(
        said.contains(&format!("target/realo/{LOG}.mcap")) && said.contains("--log"),
        "{said}"
    );
    // A file of a run names its folder.
    let file = reported.join(LOG).join("cav1/result.json");
    let (code, said) = render(&file, &dir.join("z.svg"), &[]);
    assert_eq!(code, Some(0), "{said}");
}

#[test]
fn a_wrong_log_without_points_is_refused() {
    let args = [
        "--seed",
        "903",
        "--seconds",
        "1",
        "--no-clouds",
        "--agents",
        "cav1,rsu1",
    ];
    let played = simulated("render_bare", &args);
    run_virtual(
        "render_bare_wrong",
        "no_fusion",
        &played,
        &["--recorded-detections", "--ego", "cav1"],
    );
    let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join("render_bare_wrong");
    let file = folder("render_bare_wrong_out").join("x.svg");
    let refused = |name: &str, later: Nanos, by_m: f64, expected: &str| {
        let other = once(name, |path| bare(&played, path, later, by_m));
        let (code, said) = render(&dir, &file, &["--log", &other.to_string_lossy()]);
        assert_eq!(code, Some(1), "{said}");
        for part in [name, "expected the log `render_bare`", expected, "--log"] {
            assert!(said.contains(part), "no `{part}` in: {said}");
        }
    };
    refused("render_bare_late.mcap", HOUR, 0.0, "no sweep of the ego");
    // The same times, and another world.
    refused("render_bare_moved.mcap", 0, 0.5, "ground truth is another");
    assert!(!file.exists());
    // What was played needs no points.
    let same = once("render_bare_same.mcap", |path| bare(&played, path, 0, 0.0));
    let (code, said) = render(&dir, &file, &["--log", &same.to_string_lossy()]);
    assert_eq!(code, Some(0), "{said}");
}

/// A log of the ego alone, whose sweeps have no points and are so much later, and whose objects stand that far off.
fn bare(played: &Path, path: &Path, later: Nanos, by_m: f64) {
    let log = Log::open(played).expect("the log can be read");
    let mut writer = LogWriter::create_atomic(path, log.info()).expect("the log can be written");
    let entries = |stream| {
        let mut reader = log.read_all(&[("cav1", stream)]).expect("it has the stream");
        std::iter::from_fn(move || reader.next().expect("it can be read"))
    };
    for entry in entries(Stream::Pose) {
        let (stamp, pose) = (entry.stamp() + later, entry.pose().expect("a pose"));
        writer.pose("cav1", stamp, stamp, &pose).expect("it can be written");
    }
    let truth = entries(Stream::GroundTruth).zip(entries(Stream::GroundTruthInfo));
    for (boxes, info) in truth {
        let (stamp, ready) = (boxes.stamp() + later, boxes.ready() + later);
        let mut objects = boxes.boxes().expect("boxes");
        let info = info.info(&mut objects).expect("their companion");
        objects.0.iter_mut().for_each(|object| object.center[0] += by_m);
        writer.sweep("cav1", stamp, ready).expect("it can be written");
        let points = info.points.as_deref();
        let written = writer.truth("cav1", stamp, ready, &objects.0, points, info.key);
        written.expect("it can be written");
    }
    writer.finish().expect("the log can be finished");
}

#[test]
fn a_run_without_recording_and_a_log_of_another_run_are_refused() {
    let dir = folder("render_copy");
    let cell = dir.join(LOG).join("cav1");
    fs::create_dir_all(&cell).expect("the folder can be made");
    for file in ["result.json", "timing.json", "evaluation.json"] {
        fs::copy(run().join(LOG).join("cav1").join(file), cell.join(file)).expect("the run can be copied");
    }
    let log = log().to_string_lossy().into_owned();
    let (code, said) = render(&dir, &dir.join("x.svg"), &["--log", &log]);
    assert_eq!(code, Some(1), "{said}");
    assert!(
        said.contains("recording.mcap") && said.contains("node `recorder`"),
        "{said}"
    );

    // The same agents at other times: the log's name does not tell.
    let later = once("render_later.mcap", |path| {
        shifted(Path::new(&log), path, [("cav1", HOUR), ("rsu1", HOUR)])
    });
    let (code, said) = render(&run(), &dir.join("x.svg"), &["--log", &later.to_string_lossy()]);
    assert_eq!(code, Some(1), "{said}");
    assert!(
        said.contains("render_later.mcap") && said.contains("no sweep of the ego"),
        "{said}"
    );
}

#[test]
fn an_agent_with_rare_poses_is_drawn_by_that_of_its_sweep() {
    let log = log();
    let rare = once("render_rare.mcap", |path| {
        shifted(&log, path, [("cav1", HOUR), ("rsu1", HOUR + 30_000_000)]);
    });
    let args = ["--recorded-detections", "--offline", "--ego", "cav1"];
    run_virtual("render_rare_run", "late_fusion", &rare, &args);
    let chosen = realo_render::choose(&Request {
        run: Path::new(env!("CARGO_TARGET_TMPDIR")).join("render_rare_run"),
        frame: None,
        ego: None,
        log: Some(rare),
        log_folders: Vec::new(),
    });
    let scene = Scene::of(chosen.expect("the run has a frame")).expect("the frame can be drawn");
    let agents: Vec<_> = scene
        .agents
        .iter()
        .map(|agent| (agent.name.as_str(), !agent.points.is_empty()))
        .collect();
    assert_eq!(agents, [("cav1", true), ("rsu1", true)]);
}

#[test]
fn an_agent_whose_poses_are_too_far_apart_is_named() {
    let log = log();
    let sparse = once("render_sparse.mcap", |path| without_poses(&log, path, "rsu1"));
    let dir = folder("render_sparse_run");
    let (out, sparse) = (dir.to_string_lossy(), sparse.to_string_lossy());
    let graph = common::graph("late_fusion");
    let args = [
        "run",
        &graph,
        "--log",
        &sparse,
        "--out",
        &out,
        "--mode",
        "virtual",
        "--ego",
        "cav1",
        "--recorded-detections",
    ];
    let said = realo(args);
    // Sweeps without a pose are a fault of the log.
    assert_eq!(said.status.code(), Some(3), "{}", text(&said.stderr));
    let file = dir.join("x.svg");
    let (code, said) = render(&dir, &file, &["--frame", "10", "--log", &sparse]);
    assert_eq!(code, Some(0), "{said}");
    assert!(
        said.contains("agent `rsu1` is not drawn: the log has no pose of it then") && said.contains("max_gap_ms"),
        "{said}"
    );
    let svg = fs::read_to_string(&file).expect("the drawing is there");
    assert_eq!(marks(&svg, "agent"), 1);
}

/// A log of the same sweeps and detections, of which one agent has a pose at the beginning and one at the end, 20 cm further.
fn without_poses(from: &Path, to: &Path, unposed: &str) {
    let log = Log::open(from).expect("the log can be read");
    let mut writer = LogWriter::create_atomic(to, log.info()).expect("the log can be written");
    for agent in ["cav1", "rsu1"] {
        let entries = |stream| {
            let mut reader = log.read_all(&[(agent, stream)]).expect("it has the stream");
            std::iter::from_fn(move || reader.next().expect("it can be read"))
        };
        let mut poses: Vec<_> = entries(Stream::Pose).collect();
        if agent == unposed {
            poses.drain(1..poses.len() - 1);
        }
        for (at, entry) in poses.iter().enumerate() {
            let mut pose = entry.pose().expect("a pose");
            // A unit that moves a little is not known in between.
            pose.map_from_body.translation.x += 0.2 * at as f64;
            writer
                .pose(agent, entry.stamp(), entry.ready(), &pose)
                .expect("it can be written");
        }
        for entry in entries(Stream::Points) {
            let cloud = entry.cloud().expect("a cloud");
            writer
                .cloud(agent, entry.stamp(), entry.ready(), &cloud)
                .expect("it can be written");
        }
        for entry in entries(Stream::Detections) {
            let boxes = entry.boxes().expect("boxes");
            writer
                .detections(agent, entry.stamp(), entry.ready(), &boxes)
                .expect("it can be written");
        }
    }
    writer.finish().expect("the log can be finished");
}

const HOUR: Nanos = 3_600_000_000_000;

/// A log of a sweep, its recorded detections and a pose of each agent, so much later than they were.
fn shifted(from: &Path, to: &Path, agents: [(&str, Nanos); 2]) {
    let log = Log::open(from).expect("the log can be read");
    let info: LogInfo = log.info().clone();
    let mut writer = LogWriter::create_atomic(to, &info).expect("the log can be written");
    for (agent, later) in agents {
        let first = |stream| {
            let mut reader = log.read_all(&[(agent, stream)]).expect("it has the stream");
            reader.next().expect("it can be read").expect("it has messages")
        };
        let sweep = first(Stream::Points);
        let (stamp, ready) = (sweep.stamp() + later, sweep.ready() + later);
        let pose = first(Stream::Pose).pose().expect("a pose");
        let (cloud, boxes) = (sweep.cloud().expect("a cloud"), first(Stream::Detections).boxes());
        let boxes = boxes.expect("boxes");
        writer.pose(agent, stamp, ready, &pose).expect("it can be written");
        writer.cloud(agent, stamp, ready, &cloud).expect("it can be written");
        writer
            .detections(agent, stamp, ready, &boxes)
            .expect("it can be written");
    }
    writer.finish().expect("the log can be finished");
}

#[test]
fn a_frame_that_is_not_scored_is_drawn_and_says_so() {
    let out = folder("render_other_frame");
    let log = log();
    let result: Value = json(&run().join(LOG).join("cav1/result.json"));
    assert_eq!(result["frames"]["total"], 20);
    let file = out.join("frame.svg");
    let log = log.to_string_lossy();
    let run = run().to_string_lossy().into_owned();
    let seq = (0..20u64)
        .find(|seq| !counted(Path::new(&run)).iter().any(|(key, _)| key == seq))
        .expect("not every sweep is scored")
        .to_string();
    let path = file.to_string_lossy();
    let said = realo_ok(["render", &run, "--frame", &seq, "--log", &log, "-o", &path]);
    assert!(said.contains(&format!("sweep {seq}")), "{said}");
    let svg = fs::read_to_string(&file).expect("the drawing is there");
    assert!(marks(&svg, "hit") > 0, "its boxes are matched as well");
}
