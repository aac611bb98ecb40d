//! Forms that sets of the family have, and what editors and libraries make of their files.

use std::fs;
use std::path::{Path, PathBuf};

use realo_importer::look_at;
use realo_logs::{AgentKind, Log};

use crate::AGENTS;
use crate::layouts::{OPV2V, Style, V2V4REAL, V2X_REAL, pcd, write};
use crate::reading::{import, read};
use crate::round_trip::edit;
use crate::world::Agent;

struct Made {
    dir: tempfile::TempDir,
}

impl Made {
    /// A scene of OPV2V of the first two agents.
    fn new(style: &Style) -> Self {
        let made = Made {
            dir: tempfile::tempdir().unwrap(),
        };
        style.write(&made.scene(), &AGENTS[..2]);
        made
    }

    fn scene(&self) -> PathBuf {
        self.dir.path().join("data").join("Szene 7 – Süd")
    }

    fn out(&self) -> PathBuf {
        self.dir.path().join("out.mcap")
    }

    fn import(&self, set: &[(&str, &str)]) -> Result<realo_importer::SceneSummary, String> {
        Ok(import("opv2v", &self.dir.path().join("data"), &self.out(), set)?.remove(0))
    }

    fn labels(&self, folder: &str, number: u64) -> PathBuf {
        self.scene().join(folder).join(format!("{number:06}.yaml"))
    }
}

/// What matters of a log: agents, poses, points, boxes.
fn content(path: &Path) -> Vec<String> {
    let (_, found) = read(path);
    let line = |((agent, stamp), read): (&(String, i64), &crate::reading::Read)| {
        let boxes: Vec<_> = read
            .truth
            .iter()
            .map(|object| (object.track, object.center, object.yaw))
            .collect();
        format!(
            "{agent} {stamp} {:?} {} {boxes:?}",
            read.map_from_body,
            read.cloud.as_ref().unwrap().len()
        )
    };
    found.iter().map(line).collect()
}

#[test]
fn marks_line_ends_tags_and_missing_fields_change_nothing() {
    let made = Made::new(&OPV2V);
    made.import(&[]).unwrap();
    let plain = content(&made.out());
    let file = made.labels("641", 68);
    edit(&file, |text| format!("\u{feff}{}", text.replace('\n', "\r\n")));
    // Other frames' files, and images, are not frames.
    let scene = made.scene();
    write(&scene.join("data_protocol.yaml"), b"additional: yes\n");
    write(&scene.join("641/000068_camera0.png"), b"");
    write(&scene.join("641/000068_additional.yaml"), b"[");
    let six: Vec<f64> = AGENTS[1].at(0).to_vec();
    let [x, y, z, roll, yaw, pitch] = six[..] else { panic!() };
    let six = [x, -y, z, -roll, -yaw, pitch];
    let bytes: Vec<u8> = six.iter().flat_map(|number: &f64| number.to_le_bytes()).collect();
    edit(&made.labels("650", 68), |text| {
        let (before, after) = text.split_once("lidar_pose:\n").unwrap();
        let (_, after) = after.split_once("predicted_ego_pos").unwrap();
        format!("{before}lidar_pose: {}predicted_ego_pos{after}", numpy(&bytes))
    });
    made.import(&[]).unwrap();
    assert_eq!(content(&made.out()), plain);
}

/// Six doubles as a numpy array in YAML.
fn numpy(bytes: &[u8]) -> String {
    const LETTERS: &[u8] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let letters = |three: &[u8]| {
        let bits = three.iter().fold(0_u32, |bits, byte| bits << 8 | u32::from(*byte));
        [18, 12, 6, 0].map(|shift| char::from(LETTERS[(bits >> shift & 63) as usize]))
    };
    let text: String = bytes.chunks_exact(3).flat_map(letters).collect();
    format!(
        "!!python/object/apply:numpy.core.multiarray._reconstruct
  args:
  - !!python/name:numpy.ndarray ''
  - !!python/tuple
    - 0
  - !!binary |
    Yg==
  state: !!python/tuple
  - 1
  - !!python/tuple
    - 6
  - &id001 !!python/object/apply:numpy.dtype
    args:
    - f8
    - false
    - true
    state: !!python/tuple
    - 3
    - <
    - null
    - null
    - null
    - -1
    - -1
    - 0
  - false
  - !!binary |
    {text}
"
    )
}

#[test]
fn v2xset_and_adver_city_name_their_roadside_units_each_in_its_way() {
    let roadside = |style: Style, folder| {
        let dir = tempfile::tempdir().unwrap();
        let agents = [AGENTS[0], Agent { folder, ..AGENTS[2] }];
        style.write(&dir.path().join("data/scene"), &agents);
        let out = dir.path().join("out.mcap");
        import("opv2v", &dir.path().join("data"), &out, &[]).unwrap();
        let agents = Log::open(&out).unwrap().info().agents.clone();
        agents
            .into_iter()
            .map(|agent| (agent.name, agent.kind))
            .collect::<Vec<_>>()
    };
    let expected = |name: &str| {
        vec![
            ("cav_641".to_string(), AgentKind::Vehicle),
            (name.to_string(), AgentKind::Roadside),
        ]
    };
    let v2xset = Style {
        digits: 5,
        first: 1,
        ..OPV2V
    };
    assert_eq!(roadside(v2xset, "-1"), expected("rsu_1"));
    let adver_city = Style {
        head: |folder| if folder == "3" { "RSU: true\n" } else { "RSU: false\n" },
        class_key: Some("object_type"),
        ..OPV2V
    };
    assert_eq!(roadside(adver_city, "3"), expected("rsu_3"));
}

#[test]
fn v2x_infraset_has_clouds_of_several_lidars_and_cars_on_the_ground() {
    let made = Made::new(&Style {
        pose_key: "lidar_pose0",
        head: |_| "RSU: true\nradar_pose0: [1, 2, 3, 0, 0, 0]\n",
        agents_are_objects: false,
        ..OPV2V
    });
    made.import(&[]).unwrap();
    let plain = content(&made.out());
    for folder in ["641", "650"] {
        for number in [68, 70, 72] {
            let labels = made.labels(folder, number);
            let cloud = labels.with_extension("pcd");
            let named = |lidar: &str| made.scene().join(folder).join(format!("{number:06}_{lidar}.pcd"));
            fs::rename(&cloud, named("lidar0")).unwrap();
            fs::write(named("lidar1"), b"a LiDAR that is not read").unwrap();
            edit(&labels, |text| text.replace("vehicles:", "cars:"));
        }
    }
    made.import(&[]).unwrap();
    assert_eq!(
        content(&made.out()),
        plain,
        "what says the middle of its box is there, whatever the key"
    );
    let kinds: Vec<AgentKind> = Log::open(made.out())
        .unwrap()
        .info()
        .agents
        .iter()
        .map(|agent| agent.kind)
        .collect();
    assert_eq!(kinds, [AgentKind::Roadside; 2]);
    let seen = look_at(&made.dir.path().join("data"));
    assert_eq!(seen.only(made.dir.path()).unwrap().kind().name, "opv2v", "{seen}");
    // Without a middle the location is on the ground.
    let first = made.labels("641", 68);
    edit(&first, |text| {
        let lines = text.lines().filter(|line| !line.trim_start().starts_with("center:"));
        lines.map(|line| format!("{line}\n")).collect()
    });
    made.import(&[]).unwrap();
    let (_, found) = read(&made.out());
    let own = &found.iter().next().unwrap().1.own;
    let bottom = |object: &realo_schemas::Box3| object.center[2] - object.height / 2.0;
    // The made-up boxes are 0.25 m above their locations, whose bottoms would else be at the same height.
    let lower: Vec<f64> = own.iter().map(bottom).collect();
    assert!(lower.iter().all(|z| (z - 0.75).abs() < 0.05), "{lower:?}");
}

#[test]
fn other_keys_of_the_pose_are_taken_and_an_estimate_only_if_named() {
    for key in ["true_ego_pos", "true_ego_pose"] {
        let made = Made::new(&Style { pose_key: key, ..OPV2V });
        let said = made.import(&[]).unwrap().to_string();
        let line = format!("in 3 of 3 sweeps of `cav_641` the LiDAR is where `{key}` says its vehicle is");
        assert!(said.contains(&line), "{said}");
        let said = made.import(&[("pose-key", key)]).unwrap().to_string();
        assert!(!said.contains("says its vehicle is"), "it was asked for: {said}");
    }
    let made = Made::new(&Style {
        pose_key: "my_pose",
        ..OPV2V
    });
    let error = made.import(&[]).unwrap_err();
    assert!(
        error.contains("expected the pose of the LiDAR") && error.contains("--pose-key"),
        "{error}"
    );
    made.import(&[("pose-key", "my_pose")]).unwrap();
    made.import(&[("pose-key", "predicted_ego_pos")]).unwrap();
}

#[test]
fn agents_appear_and_vanish_and_frames_may_have_no_object() {
    let made = Made::new(&OPV2V);
    for end in ["yaml", "pcd"] {
        fs::remove_file(made.labels("650", 68).with_extension(end)).unwrap();
        fs::remove_file(made.labels("641", 72).with_extension(end)).unwrap();
    }
    edit(&made.labels("641", 68), |text| {
        format!("{}vehicles: {{}}\n", text.split_once("vehicles:").unwrap().0)
    });
    let summary = made.import(&[]).unwrap();
    assert_eq!(
        (summary.frames, summary.agents[0].sweeps, summary.agents[1].sweeps),
        (3, 2, 2)
    );
    let said = summary.to_string();
    for name in ["cav_641", "cav_650"] {
        let line = format!("the truth of 1 of 3 frames lacks what only `{name}` labelled");
        assert!(said.contains(&line), "{said}");
    }
    let said = made.import(&[("agents", "641")]).unwrap().to_string();
    assert!(
        said.contains("the truth lacks what only `650` labelled (--agents)"),
        "{said}"
    );
    let (_, found) = read(&made.out());
    assert!(
        found.values().next().unwrap().truth.is_empty(),
        "the first frame has one agent, that labelled nothing"
    );
}

#[test]
fn places_of_the_size_of_utm_keep_their_millimetres() {
    let far = AGENTS.map(|agent| {
        let [x, y, z, roll, yaw, pitch] = agent.six;
        Agent {
            six: [x + 500_000.123, y + 5_400_000.456, z, roll, yaw, pitch],
            labels: &[],
            ..agent
        }
    });
    let dir = tempfile::tempdir().unwrap();
    let style = Style {
        left_handed: false,
        agents_are_objects: false,
        ..OPV2V
    };
    style.write(&dir.path().join("data/scene"), &far[..1]);
    let out = dir.path().join("out.mcap");
    import("opv2v", &dir.path().join("data"), &out, &[("handed", "right")]).unwrap();
    let (_, found) = read(&out);
    let at = found.values().next().unwrap().map_from_body.translation.vector;
    assert!(
        (at.x - 500_000.123).abs() < 1e-6 && (at.y - 5_400_000.456).abs() < 1e-6,
        "{at}"
    );
    // Points in the map do not fit single precision, and are not a LiDAR's.
    let cloud = dir.path().join("data/scene/641/000068.pcd");
    fs::write(&cloud, pcd(&[[500_000.1, 5_400_000.0, 3.0]; 3])).unwrap();
    let error = import(
        "opv2v",
        &dir.path().join("data"),
        &out,
        &[("handed", "right"), ("height", "1.9")],
    )
    .unwrap_err();
    assert!(
        error.contains("000068.pcd: expected points within 100000 m of the LiDAR"),
        "{error}"
    );
}

#[test]
fn points_and_poses_of_different_hands_do_not_overlap() {
    let made = Made::new(&OPV2V);
    for folder in ["641", "650"] {
        let agent = AGENTS.iter().position(|agent| agent.folder == folder).unwrap();
        for frame in 0..3 {
            let points = OPV2V.points(&AGENTS[agent], frame, agent);
            let turned: Vec<[f32; 3]> = points.into_iter().map(|[x, y, z]| [x, -y, z]).collect();
            fs::write(made.labels(folder, 68 + 2 * frame).with_extension("pcd"), pcd(&turned)).unwrap();
        }
    }
    let summary = made.import(&[]).unwrap();
    let residual = &summary.residuals[0];
    assert!(residual.metres.is_none_or(|metres| metres > 0.5), "{residual}");
    assert!(summary.to_string().contains("try --handed"), "{summary}");
}

#[test]
fn a_folder_says_what_it_is() {
    let dir = tempfile::tempdir().unwrap();
    let level = |folder| Agent {
        folder,
        six: [0.0, 0.0, 1.9, 0.0, 10.0, 0.0],
        ..AGENTS[0]
    };
    for (kind, style, agents) in [
        ("opv2v", OPV2V, AGENTS.to_vec()),
        ("v2x-real", V2X_REAL, AGENTS.to_vec()),
        ("v2v4real", V2V4REAL, vec![level("0")]),
    ] {
        let data = dir.path().join(kind);
        style.write(&data.join("test/scene"), &agents);
        let seen = look_at(&data);
        let only = seen.only(&data).unwrap_or_else(|error| panic!("{error}"));
        assert_eq!(only.kind().name, kind, "{seen}");
        assert!(seen.to_string().starts_with(&format!("it is `{kind}`: ")), "{seen}");
        assert!(
            seen.to_string()
                .contains("it is not `dair`: there is no `cooperative/data_info.json`"),
            "{seen}"
        );
    }
    let error = look_at(dir.path().parent().unwrap().join("nowhere").as_path());
    assert!(error.fits.is_empty());
}

#[test]
fn a_height_that_the_files_say_counts_before_the_ground() {
    let made = Made::new(&OPV2V);
    let say = |height: &str| {
        for number in [0, 2, 4, 6].map(|step| 68 + step) {
            let path = made.labels("641", number);
            if let Ok(text) = fs::read_to_string(&path) {
                let kept: Vec<&str> = text.lines().filter(|line| !line.starts_with("lidar_height")).collect();
                fs::write(&path, format!("lidar_height: {height}\n{}\n", kept.join("\n"))).unwrap();
            }
        }
    };
    say("2.25");
    let height = |agent: usize| {
        let log = Log::open(made.out()).unwrap();
        log.info().agents[agent].sensor_position.unwrap()[2]
    };
    made.import(&[]).unwrap();
    assert_eq!(height(0), 2.25);
    assert!(
        (height(1) - AGENTS[1].six[2]).abs() < 0.02,
        "the other agent's files say none"
    );
    made.import(&[("height", "1.5")]).unwrap();
    assert_eq!(height(0), 1.5, "an option counts before files");
    say("high");
    let error = made.import(&[]).unwrap_err();
    assert!(
        error.contains("lidar_height: expected 0 to 50 m, found `high`"),
        "{error}"
    );
}

#[test]
fn names_stamps_and_outlines_that_the_files_say_count_before_guesses() {
    let made = Made::new(&OPV2V);
    let say = |folder: &str, lines: &dyn Fn(u64) -> String| {
        for frame in 0..4 {
            let path = made.labels(folder, 68 + 2 * frame);
            let Ok(text) = fs::read_to_string(&path) else { continue };
            let is_old = |line: &&str| {
                ["agent_name", "stamp_ns", "footprint"]
                    .iter()
                    .any(|key| line.starts_with(key))
            };
            let kept: Vec<&str> = text.lines().filter(|line| !is_old(line)).collect();
            fs::write(&path, format!("{}{}\n", lines(frame), kept.join("\n"))).unwrap();
        }
    };
    let stamp = |frame: u64| 1_700_000_000_000_123_457 + 100_000_000 * frame as i64;
    let all = |name: &str, frame: u64| {
        format!(
            "agent_name: {name}\nstamp_ns: {}\nfootprint: [-1.5, 3.25, -0.75, 0.75]\n",
            stamp(frame)
        )
    };
    say("641", &|frame| all("truck-7", frame));
    made.import(&[]).unwrap();
    let log = Log::open(made.out()).unwrap();
    let named = log.info().agent("truck-7").unwrap();
    assert_eq!(named.footprint, Some([-1.5, 3.25, -0.75, 0.75]));
    assert!(
        log.info().agent("cav_650").unwrap().footprint != named.footprint,
        "the other agent's files say none"
    );
    let (_, found) = crate::reading::read(&made.out());
    let stamps: Vec<i64> = found
        .keys()
        .filter(|(name, _)| name == "truck-7")
        .map(|(_, stamp)| *stamp)
        .collect();
    assert_eq!(stamps[..2], [stamp(0), stamp(1)]);
    assert_eq!(found[&("truck-7".to_string(), stamp(0))].ready, stamp(0) + 100_000_000);
    let refused = |lines: &dyn Fn(u64) -> String| {
        say("641", lines);
        made.import(&[]).unwrap_err().to_string()
    };
    let cases: [(&dyn Fn(u64) -> String, &str); 6] = [
        (
            &|_| "agent_name: a/b\n".into(),
            "agent_name: `a/b` cannot name an agent",
        ),
        (
            &|_| "stamp_ns: 1.5\n".into(),
            "stamp_ns: expected a whole number of ns since 1970, found `1.5`",
        ),
        (
            &|_| "stamp_ns: 5\n".into(),
            "expected one later than that of the sweep before, 5 ns, found 5 ns",
        ),
        (
            &|_| "footprint: [3, -1, 0, 1]\n".into(),
            "footprint: expected [x min, x max, y min, y max]",
        ),
        (
            &|frame| format!("footprint: [-1.5, {}, -0.75, 0.75]\n", 3 + frame / 2),
            "footprint: expected one outline in all files of an agent, found [-1.5, 4.0, -0.75, 0.75] here and [-1.5, 3.0, -0.75, 0.75] in \
             its first files",
        ),
        (
            &|_| "footprint: wide\n".into(),
            "footprint: expected [x min, x max, y min, y max]",
        ),
    ];
    for (lines, expected) in cases {
        let error = refused(lines);
        assert!(error.contains(expected) && error.contains("641"), "{error}");
    }
    say("650", &|frame| all("twin", frame));
    let error = refused(&|frame| all("twin", frame));
    assert!(
        error.contains("found `twin` in the files of `641` and of `650`"),
        "{error}"
    );
}

/// Rewrites the clouds of a scene of OPV2V: the head's fields, and each row of x, y, z and intensity.
fn rewrite(made: &Made, head: [&str; 3], row: impl Fn(usize, &[u8]) -> Vec<u8>) {
    for folder in ["641", "650"] {
        for number in [68, 70, 72] {
            let path = made.labels(folder, number).with_extension("pcd");
            let file = fs::read(&path).unwrap();
            let at = file.windows(12).position(|part| part == b"DATA binary\n").unwrap() + 12;
            let count = file[at..].len() / 16;
            let [fields, sizes, types] = head;
            let mut changed = format!(
                "VERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nWIDTH {count}\nHEIGHT 1\nPOINTS {count}\nDATA binary\n"
            )
            .into_bytes();
            changed.extend(
                file[at..]
                    .chunks(16)
                    .enumerate()
                    .flat_map(|(index, bytes)| row(index, bytes)),
            );
            write(&path, &changed);
        }
    }
}

#[test]
fn intensities_come_from_the_grey_of_colours_or_are_said_to_be_missing() {
    for (head, alpha, said, expected) in [
        (
            ["x y z rgb", "4 4 4 4", "F F F F"],
            0,
            "of the colour `rgb`, its first channel",
            200,
        ),
        (
            ["x y z rgb", "4 4 4 4", "F F F F"],
            255,
            "of the colour `rgb`, its first channel",
            200,
        ),
        (
            ["x y z rgba", "4 4 4 4", "F F F U"],
            255,
            "of the colour `rgba`, its first channel",
            200,
        ),
        (
            ["x y z shade", "4 4 4 4", "F F F U"],
            0,
            "NONE, all are 0: the clouds have x, y, z, shade",
            0,
        ),
    ] {
        let made = Made::new(&OPV2V);
        rewrite(&made, head, |_, bytes| [&bytes[..12], &[200, 200, 200, alpha]].concat());
        let summary = made.import(&[]).unwrap().to_string();
        let line = format!("intensities of `cav_641`: {said}");
        assert!(summary.contains(&line), "{line} is not in\n{summary}");
        let (_, found) = read(&made.out());
        for sweep in found.values() {
            let cloud = sweep.cloud.as_ref().unwrap();
            assert!(cloud.intensity.iter().all(|byte| *byte == expected), "{head:?} {alpha}");
        }
    }
    let made = Made::new(&OPV2V);
    rewrite(&made, ["x y z reflectivity", "4 4 4 4", "F F F F"], |_, bytes| {
        bytes.to_vec()
    });
    let summary = made.import(&[]).unwrap().to_string();
    assert!(
        summary.contains("intensities of `cav_641`: of the field `reflectivity`: float32"),
        "{summary}"
    );
}

#[test]
fn times_of_points_count_from_the_first_of_their_sweep() {
    for (begin, end) in [(1_700_000_000.0, "start"), (0.0, "start"), (0.0, "end")] {
        let made = Made::new(&OPV2V);
        let head = ["x y z intensity timestamp", "4 4 4 4 8", "F F F F F"];
        rewrite(&made, head, |index, bytes| {
            let time: f64 = begin + 1e-5 * index as f64;
            [bytes, &time.to_le_bytes()].concat()
        });
        let summary = made.import(&[("stamp", end)]).unwrap().to_string();
        let which = if end == "start" { "first" } else { "last" };
        let line = format!("times of points of `cav_641`: the field `timestamp` (s), from the {which} of each sweep");
        assert!(summary.contains(&line), "{summary}");
        let (_, found) = read(&made.out());
        for sweep in found.values() {
            let times = &sweep.cloud.as_ref().unwrap().time;
            let near = |time: i32, expected: i32| (time - expected).abs() < 1000;
            let span = 10_000 * (times.len() as i32 - 1);
            let first = if end == "start" { 0 } else { -span };
            assert!(
                near(times[0], first) && near(times[times.len() - 1], first + span),
                "{begin} {end}"
            );
        }
    }
}

#[test]
fn whole_numbers_of_time_are_read_by_their_unit() {
    // ns and µs since 1970, and counts of µs and of ns from the begin of the sweep.
    for (begin, step, kind, words) in [
        (1_700_000_000_000_000_000_u64, 10_000_u64, ("8", "U"), "(s)"),
        (1_700_000_000_000_000, 10, ("8", "I"), "(s)"),
        (0, 10, ("4", "U"), "(µs)"),
        (0, 10_000, ("4", "U"), "(ns)"),
    ] {
        let made = Made::new(&OPV2V);
        let head = [
            "x y z intensity timestamp",
            &format!("4 4 4 4 {}", kind.0),
            &format!("F F F F {}", kind.1),
        ];
        rewrite(&made, head, |index, bytes| {
            let time = begin + step * index as u64;
            let wide = time.to_le_bytes();
            [bytes, if kind.0 == "8" { &wide[..] } else { &wide[..4] }].concat()
        });
        let summary = made.import(&[]).unwrap().to_string();
        let line = format!("times of points of `cav_641`: the field `timestamp` {words}, from the first of each sweep");
        assert!(summary.contains(&line), "{summary}");
        let (_, found) = read(&made.out());
        for sweep in found.values() {
            let times = &sweep.cloud.as_ref().unwrap().time;
            let last = 10_000 * (times.len() as i32 - 1);
            assert!(
                times[0] == 0 && (times[times.len() - 1] - last).abs() < 1000,
                "{last}: {summary}"
            );
        }
    }
}

#[test]
fn clouds_of_ply_are_read_as_those_of_pcd() {
    let made = Made::new(&OPV2V);
    made.import(&[]).unwrap();
    let expected = content(&made.out());
    fs::remove_file(made.out()).unwrap();
    for folder in ["641", "650"] {
        for number in [68, 70, 72] {
            let path = made.labels(folder, number).with_extension("pcd");
            let file = fs::read(&path).unwrap();
            let at = file.windows(12).position(|part| part == b"DATA binary\n").unwrap() + 12;
            let head = format!(
                "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
                 property float intensity\nend_header\n",
                file[at..].len() / 16
            );
            fs::remove_file(&path).unwrap();
            write(&path.with_extension("ply"), &[head.as_bytes(), &file[at..]].concat());
        }
    }
    made.import(&[]).unwrap();
    assert_eq!(content(&made.out()), expected);
}
