//! Values of a log that do not fit their types, sequences and stamps of other writers, and files of other programs.

use std::fs;
use std::path::Path;

use realo_logs::cdr::CdrWriter;
use realo_logs::{Log, Stream, boxes, cloud};
use realo_schemas::{Box3, Nanos};

use crate::common;
use crate::scene::{Raw, SWEEP, SWEEPS, Scene, rewrite, run};

/// Boxes whose `id` is the text that `name` gives for their track.
fn renamed(message: &Raw, name: impl Fn(u64) -> String) -> Vec<u8> {
    let (stamp, found) = boxes::decode(&message.data).expect("boxes");
    let frame = format!("{}/body", message.parts().0);
    let mut data = Vec::new();
    let mut out = CdrWriter::new(&mut data);
    out.header(stamp, &frame);
    out.length(found.0.len());
    found
        .0
        .iter()
        .for_each(|object| write_box(&mut out, stamp, &frame, object, &name));
    data
}

fn write_box(out: &mut CdrWriter, stamp: Nanos, frame: &str, object: &Box3, name: &impl Fn(u64) -> String) {
    let [x, y, z] = object.center;
    let (sin, cos) = (object.yaw / 2.0).sin_cos();
    let pose = [x, y, z, 0.0, 0.0, sin, cos];
    out.header(stamp, frame);
    out.length(1);
    out.string(&object.class);
    out.f64(f64::from(object.score));
    out.f64s(&pose);
    out.f64s(&[0.0; 36]);
    out.f64s(&pose);
    out.f64s(&[object.length, object.width, object.height]);
    out.string(&object.track.map(name).unwrap_or_default());
}

fn with_tracks(name: &str, track: impl Fn(&str, u64) -> String) -> std::path::PathBuf {
    let base = Scene::default().write(&format!("{name}-base"));
    rewrite(&base, name, |mut message| {
        if message.topic.ends_with("/ground_truth") {
            let agent = message.parts().0.to_string();
            message.data = renamed(&message, |number| track(&agent, number));
        }
        vec![message]
    })
}

#[test]
fn tracks_of_any_text_join_the_points_of_collaborators() {
    // One object each: a token, a float of pandas, hyphens, a negative number, a fraction, a UUID, beyond 64 bits, padded.
    let log = with_tracks("tracks", |_, number| match number {
        1 => "obj00a7f3c9".into(),
        2 => "2.0".into(),
        3 => "0003-123".into(),
        4 => "-4".into(),
        5 => "5.5".into(),
        6 => "6b29fc40-ca47-1067-b31d-00dd010662da".into(),
        7 => "700000000000000000000000".into(),
        _ => format!("{number:06}"),
    });
    assert_eq!(run("no_fusion", &log, "tracks", &["--offline"]).ap("0.5"), 0.5);
    let late = run("late_fusion", &log, "tracks", &["--offline"]);
    assert_eq!((late.ap("0.5"), late.code), (1.0, 0), "{late:?}");
}

#[test]
fn agents_that_number_objects_each_by_itself_are_named() {
    let log = with_tracks("own-tracks", |agent, number| match agent {
        "car" => number.to_string(),
        _ => (number % 8 + 1).to_string(),
    });
    let late = run("late_fusion", &log, "own-tracks", &["--offline"]);
    assert!(
        late.notes().contains("tracks of car and mast name different objects"),
        "{}",
        late.notes()
    );
    let info = common::realo(["info", &log.to_string_lossy()]);
    let said = common::text(&info.stdout);
    assert!(
        said.contains("PROBLEM: tracks of `car` and `mast` name different objects"),
        "{said}"
    );
    assert_eq!(info.status.code(), Some(3));
}

#[test]
fn tracks_that_are_wrong_in_part_are_named() {
    let reported = |name: &str, track: fn(&str, u64) -> String, note: &str, problem: &str| {
        let log = with_tracks(name, track);
        let late = run("late_fusion", &log, name, &["--offline"]);
        assert_eq!(late.code, 3, "{late:?}");
        assert!(late.notes().contains(note), "{}", late.notes());
        let info = common::realo(["info", &log.to_string_lossy()]);
        let said = common::text(&info.stdout);
        assert!(said.contains(problem) && info.status.code() == Some(3), "{said}");
    };
    // Three of eight objects have numbers of the mast's own, or none.
    let split = "are of two tracks or of none";
    reported(
        "own-3-of-8",
        |agent, number| match (agent, number) {
            ("mast", 6..) => (number + 100).to_string(),
            _ => number.to_string(),
        },
        split,
        "PROBLEM: 117 of 312 objects that `car` and `mast` both have are of two tracks or of none",
    );
    reported(
        "none-of-the-mast",
        |agent, number| {
            if agent == "mast" {
                String::new()
            } else {
                number.to_string()
            }
        },
        split,
        "PROBLEM: 312 of 312 objects that",
    );
    reported(
        "minus-one",
        |_, _| "-1".into(),
        "have the track of another one of the same message",
        "PROBLEM: 160 of 160 objects in the truth of `car` have the track",
    );
}

/// A field of times: its name, its datatype of `PointCloud2`, and the bytes of a stamp and an offset, ns.
type Times = (&'static str, u8, fn(Nanos, i32) -> Vec<u8>);

const UINT32: u8 = 6;
const FLOAT32: u8 = 7;
const FLOAT64: u8 = 8;

/// The scene whose car measures its points one after the other during 0.1 s, with times as `times` writes them.
fn with_times(name: &str, (field, kind, bytes): Times) -> std::path::PathBuf {
    let base = Scene::default().write(&format!("{name}-base"));
    rewrite(&base, name, |mut message| {
        if message.topic == "/car/points" {
            let (stamp, points) = cloud::decode(&message.data).expect("a cloud");
            let offset = |i: usize| (99_900_000 * i as i64 / (points.len() as i64 - 1)) as i32;
            let width = bytes(stamp, 0).len();
            let mut data = Vec::new();
            let mut out = CdrWriter::new(&mut data);
            out.header(stamp, "car/body");
            out.u32(1);
            out.length(points.len());
            out.length(4);
            for (name, at, kind) in [
                ("x", 0, FLOAT32),
                ("y", 4, FLOAT32),
                ("z", 8, FLOAT32),
                (field, 12, kind),
            ] {
                out.string(name);
                out.u32(at);
                out.u8(kind);
                out.u32(1);
            }
            out.bool(false);
            out.length(12 + width);
            out.length((12 + width) * points.len());
            let mut rows = Vec::new();
            for i in 0..points.len() {
                for column in [&points.x, &points.y, &points.z] {
                    rows.extend(column[i].to_le_bytes());
                }
                rows.extend(bytes(stamp, offset(i)));
            }
            out.bytes_mut(rows.len()).copy_from_slice(&rows);
            out.bool(true);
            message.data = data;
        }
        vec![message]
    })
}

/// Times of the car's first sweep, µs.
fn first_times(log: &Path) -> Vec<i32> {
    let log = Log::open(log).expect("a log");
    let mut reader = log.read_all(&[("car", Stream::Points)]).expect("points");
    let sweep = reader.next().expect("a message").expect("a sweep");
    let points = sweep.cloud().expect("a cloud");
    points
        .time
        .iter()
        .map(|time| (f64::from(*time) / 1e3).round() as i32)
        .collect()
}

#[test]
fn times_of_points_are_understood_as_drivers_write_them() {
    let forms: [(Times, &str); 6] = [
        (
            ("time", FLOAT64, |s, d| {
                ((s as f64 + f64::from(d)) / 1e9).to_le_bytes().to_vec()
            }),
            "s since 1970",
        ),
        (
            ("timestamp", FLOAT64, |s, d| {
                (s as f64 + f64::from(d)).to_le_bytes().to_vec()
            }),
            "ns since 1970",
        ),
        (
            ("time_stamp", UINT32, |_, d| (d as u32).to_le_bytes().to_vec()),
            "ns from the stamp",
        ),
        (
            ("offset_time", UINT32, |_, d| (d as u32 / 1000).to_le_bytes().to_vec()),
            "µs from the stamp",
        ),
        (
            ("time", FLOAT32, |_, d| (d as f32 / 1e3).to_le_bytes().to_vec()),
            "µs from the stamp",
        ),
        (
            ("t", UINT32, |s, d| {
                let since_the_hour = (s + Nanos::from(d)).rem_euclid(3_600_000_000_000) / 1000;
                (since_the_hour as u32).to_le_bytes().to_vec()
            }),
            "µs since the full hour",
        ),
    ];
    for (index, (times, understood)) in forms.into_iter().enumerate() {
        let log = with_times(&format!("times-{index}"), times);
        let found = first_times(&log);
        let last = found.len() as i64 - 1;
        for (i, time) in found.iter().enumerate() {
            let expected = 99_900 * i as i64 / last;
            assert!(
                (i64::from(*time) - expected).abs() <= 2,
                "{understood}: {time} µs, expected {expected}"
            );
        }
        let said = common::realo_ok(["info", &log.to_string_lossy()]);
        let line = format!("times from {} (", times.0);
        assert!(
            said.contains(&line) && said.contains(understood),
            "{understood}: {said}"
        );
    }
}

#[test]
fn times_that_no_rule_explains_are_refused_by_name() {
    // An hour that is not the stamp's.
    let strange: Times = ("t", UINT32, |_, d| {
        (2_900_000_000 + d as u32 / 1000).to_le_bytes().to_vec()
    });
    let log = with_times("times-strange", strange);
    let opened = Log::open(&log).expect("a log");
    let mut reader = opened.read_all(&[("car", Stream::Points)]).expect("points");
    let sweep = reader.next().expect("a message").expect("a sweep");
    let error = sweep.cloud().expect_err("times of another hour").to_string();
    assert!(
        error.contains("`/car/points`") && error.contains("`t` (uint32) is 2900"),
        "{error}"
    );
    let said = common::text(&common::realo(["info", &log.to_string_lossy()]).stdout);
    for part in [
        "car",
        "`t` (uint32)",
        "within a period of the sweeps",
        "int32 ns from the stamp",
    ] {
        assert!(said.contains(part), "no `{part}` in {said}");
    }
}

#[test]
fn sequences_of_other_writers_do_not_matter() {
    let base = Scene::default().write("sequence-base");
    type Form = (&'static str, fn(u32) -> u32);
    let forms: [Form; 2] = [("zero", |_| 0), ("wrap", |n| n.wrapping_sub(10))];
    for (name, sequence) in forms {
        let log = rewrite(&base, &format!("sequence-{name}"), |mut message| {
            message.sequence = sequence(message.sequence);
            vec![message]
        });
        let late = run("late_fusion", &log, &format!("sequence-{name}"), &["--offline"]);
        assert_eq!((late.ap("0.5"), late.code), (1.0, 0), "{name}: {late:?}");
    }
}

/// What two modes of a run and `realo info` say of a log that cannot be played.
fn refused(log: &Path, name: &str, expected: &[&str]) {
    let mut said = Vec::new();
    for mode in ["--offline", "--mode=virtual"] {
        let run = run("late_fusion", log, name, &[mode]);
        assert_eq!((run.code == 0, run.result.is_some()), (false, false), "{run:?}");
        said.push(run.err);
    }
    let info = common::realo(["info", &log.to_string_lossy()]);
    assert_eq!(info.status.code(), Some(3));
    said.push(common::text(&info.stdout));
    for said in said {
        // Messages are wrapped to the terminal's width.
        let said = said.split_whitespace().collect::<Vec<_>>().join(" ");
        expected
            .iter()
            .for_each(|part| assert!(said.contains(part), "no `{part}` in {said}"));
    }
}

#[test]
fn a_looped_bag_and_doubled_messages_are_named() {
    let base = Scene::default().write("loop-base");
    let again = SWEEPS * SWEEP + 1_000_000_000;
    let later = |message: &Raw| Raw {
        log_time: message.log_time + again,
        sequence: message.sequence + 1_000,
        ..message.clone()
    };
    let looped = rewrite(&base, "loop", |message| vec![message.clone(), later(&message)]);
    refused(
        &looped,
        "loop",
        &["the stamps start again here", "played in a loop", "cut the log"],
    );
    let twice = rewrite(&base, "twice", |message| vec![message.clone(), message]);
    refused(&twice, "twice", &["the message is there twice", "two recorders"]);
    let poses = rewrite(&base, "poses-twice", |message| match message.topic.ends_with("/pose") {
        true => vec![message.clone(), message],
        false => vec![message],
    });
    let late = run("late_fusion", &poses, "poses-twice", &["--offline"]);
    assert_eq!((late.ap("0.5"), late.code), (1.0, 0), "{late:?}");
}

#[test]
fn a_log_that_goes_on_after_its_end_is_refused_with_what_to_do() {
    let log = Scene::default().write("whole");
    let whole = fs::read(&log).expect("the log can be read");
    let other = fs::read(Scene::default().write("other")).expect("the log can be read");
    let folder = common::folder("goes-on");
    let end = whole.len();
    let junk: &[u8] = b"\0\0\0\0 not of the log \x89MCAP0\r\n";
    for (name, more, expected) in [
        ("twice", &whole[..], "another MCAP file of"),
        ("another", &other, "another MCAP file of"),
        ("junk", junk, "B, is not of an MCAP file"),
        ("one", b"\0", "what follows, 1 B, is not of an MCAP file"),
    ] {
        let path = folder.join(format!("{name}.mcap"));
        fs::write(&path, [&whole[..], more].concat()).expect("the folder can be written");
        let shown = path.to_string_lossy();
        let ran = run("late_fusion", &path, &format!("goes-on-{name}"), &["--offline"]);
        let info = common::realo(["info", &shown]);
        assert!(
            ran.code == 1 && ran.result.is_none() && info.status.code() == Some(1),
            "{name}: {ran:?}"
        );
        let parts = [
            format!("goes on after its end at byte {end}"),
            expected.into(),
            format!("head -c {end} {shown}"),
        ];
        for said in [ran.err, common::text(&info.stderr)] {
            // Messages are wrapped to the terminal's width.
            let said = said.split_whitespace().collect::<Vec<_>>().join(" ");
            for part in &parts {
                assert!(said.contains(part.as_str()), "{name}: no `{part}` in {said}");
            }
        }
    }
    // What the message says to do mends it.
    let mended = folder.join("mended.mcap");
    let twice = fs::read(folder.join("twice.mcap")).expect("the file can be read");
    fs::write(&mended, &twice[..end]).expect("the folder can be written");
    assert_eq!(
        run("late_fusion", &mended, "goes-on-mended", &["--offline"]).ap("0.5"),
        1.0
    );
}

#[test]
fn files_of_other_programs_are_named() {
    let folder = common::folder("foreign-files");
    let bag = folder.join("bag");
    fs::create_dir_all(&bag).expect("a folder");
    let metadata = "rosbag2_bagfile_information:\n  topics_with_message_count:\n    - topic_metadata:\n        name: /points\n        \
                    type: sensor_msgs/msg/PointCloud2\n      message_count: 4\n";
    fs::write(bag.join("metadata.yaml"), metadata).expect("a file");
    fs::write(bag.join("bag_0.db3"), b"SQLite format 3\0").expect("a file");
    let pointer = folder.join("pointer.mcap");
    fs::write(
        &pointer,
        b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 123\n",
    )
    .expect("a file");
    let packed = folder.join("bag.mcap.zstd");
    fs::write(&packed, b"\x28\xb5\x2f\xfd\x04\x00").expect("a file");
    let db3 = bag.join("bag_0.db3");
    let cases: [(&Path, &[&str]); 4] = [
        (
            &bag,
            &[
                "folder of a bag",
                "/points (sensor_msgs/msg/PointCloud2)",
                "docs/reference/log-format.md",
            ],
        ),
        (
            &db3,
            &["SQLite", "/points (sensor_msgs/msg/PointCloud2)", "realo_log.py"],
        ),
        (&pointer, &["git-LFS", "git lfs pull"]),
        (&packed, &["zstd", "unpack it"]),
    ];
    for (path, expected) in cases {
        for command in [&["info"][..], &["run", &common::graph("late_fusion"), "--log"]] {
            let out = folder.join("out");
            let mut args: Vec<String> = command.iter().map(|part| (*part).to_string()).collect();
            args.push(path.to_string_lossy().into());
            if args[0] == "run" {
                args.extend(["--out".into(), out.to_string_lossy().into_owned()]);
            }
            let output = common::realo(&args);
            let said = common::text(&output.stderr);
            let flat = said.split_whitespace().collect::<Vec<_>>().join(" ");
            assert!(!output.status.success(), "{args:?}");
            expected
                .iter()
                .for_each(|part| assert!(flat.contains(part), "no `{part}` in {flat}"));
        }
    }
}
