//! A scene that every layout can hold: ten sweeps a second, each with all points at one time.

use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::fs;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Point3, Translation3};
use realo_logs::{AgentKind, Log, Stream};
use realo_schemas::geometry::{normalize_yaw, transform_box};
use realo_schemas::{Box3, Boxes, Nanos, PointCloud};

use crate::common::{files_below, folder, once, simulated};
use crate::{import, lab_to};

/// Frames of the scenes.
pub const FRAMES: u64 = 10;
/// Height of the LiDARs over the ground, m.
pub const HEIGHT: f64 = 1.9;

/// `min_points` of the protocol by which the scenes are scored.
const MIN_POINTS: u32 = 5;

pub struct Scene {
    pub agents: Vec<Agent>,
}

pub struct Agent {
    pub name: String,
    pub kind: AgentKind,
    /// Height of its LiDAR over the ground, m.
    pub height: f64,
    pub sweeps: Vec<Sweep>,
}

/// A sweep; points and boxes are in the body frame, which is level and on the ground.
#[derive(Default)]
pub struct Sweep {
    pub stamp: Nanos,
    pub map_from_body: Isometry3<f64>,
    cloud: Option<PointCloud>,
    /// What the agent itself labelled.
    pub own: Vec<Box3>,
    pub truth: Vec<Box3>,
    /// The agent's own points on each object of the truth, where they are counted.
    points: Option<Vec<u32>>,
}

impl Sweep {
    pub fn cloud(&self) -> &PointCloud {
        self.cloud.as_ref().expect("a sweep has a cloud")
    }

    /// Map from a LiDAR that is so far over the body's origin, m.
    pub fn map_from_lidar(&self, height: f64) -> Isometry3<f64> {
        self.map_from_body * Translation3::new(0.0, 0.0, height)
    }

    /// Its points in the frame of that LiDAR.
    pub fn in_lidar(&self, height: f64) -> Vec<[f32; 3]> {
        let points = self
            .cloud()
            .x
            .iter()
            .zip(self.cloud().y.iter())
            .zip(self.cloud().z.iter());
        points
            .map(|((x, y), z)| [*x, *y, (f64::from(*z) - height) as f32])
            .collect()
    }

    /// Its intensities as parts of 1.
    pub fn intensities(&self) -> Vec<f32> {
        self.cloud()
            .intensity
            .iter()
            .map(|intensity| f32::from(*intensity) / 255.0)
            .collect()
    }

    /// Its own labels in the map.
    pub fn labels(&self) -> Vec<Box3> {
        self.own
            .iter()
            .map(|object| transform_box(&self.map_from_body, object))
            .collect()
    }
}

/// The simulator's scene of some agents, made once: regular stamps, no motion during sweeps, all frames scored.
pub fn original(agents: &str) -> PathBuf {
    let name = agents.replace(',', "_");
    once(&format!("layouts_{name}.mcap"), |path| {
        let set = ["--seconds", "1", "--key-hz", "10", "--agents", agents, "--seed", "921"];
        let simulated = simulated(&format!("layouts_simulated_{name}"), &set);
        let scene = folder(&format!("layouts_scene_{name}"));
        let data = scene.join("data");
        lab_to(&["export", "opv2v"], &simulated, &data, &[]);
        plain(&data);
        import("opv2v", &data, path, &["--force"]);
        fs::remove_dir_all(scene).expect("the folder can be removed");
    })
}

/// Removes what only our exporter writes, except names and heights. Each object of a frame gets the first agent's label: stamps of agents
/// differ by nanoseconds, a frame has one time.
fn plain(data: &Path) {
    let mut known = Known::new();
    let mut files = files_below(data);
    files.sort();
    for file in files {
        match file.extension().and_then(|end| end.to_str()) {
            Some("yaml") => {
                let text = fs::read_to_string(&file).expect("labels are text");
                let frame = file.file_name().expect("a name").to_os_string();
                fs::write(&file, plain_labels(&text, &frame, &mut known)).expect("it can be written");
            }
            Some("csv") => fs::remove_file(file).expect("it can be removed"),
            _ => {}
        }
    }
}

/// The lines of an object, by frame and id.
type Known = BTreeMap<(OsString, String), String>;

fn plain_labels(text: &str, frame: &OsStr, known: &mut Known) -> String {
    let ours = ["stamp_ns:", "scored:", "points:"];
    let is_ours = |line: &str| ours.iter().any(|key| line.trim().starts_with(key));
    let lines: Vec<&str> = text.lines().filter(|line| !is_ours(line)).collect();
    let starts = |line: &str| line.starts_with("  ") && !line.starts_with("   ");
    let blocks = lines
        .chunk_by(|_, next| !starts(next))
        .map(|block| format!("{}\n", block.join("\n")));
    let plain = blocks.map(|block| match block.split_once('\n') {
        Some((id, _)) if starts(id) => known.entry((frame.into(), id.into())).or_insert(block).clone(),
        _ => block,
    });
    plain.collect()
}

impl Scene {
    /// The truth of the first agent at a frame, of what all agents together have enough points on to count.
    pub fn seen(&self, frame: usize) -> Vec<&Box3> {
        let mut all = BTreeMap::<Option<u64>, u32>::new();
        for sweep in self.agents.iter().map(|agent| &agent.sweeps[frame]) {
            let points = sweep.points.as_ref().expect("points are counted");
            for (object, points) in sweep.truth.iter().zip(points) {
                *all.entry(object.track).or_default() += points;
            }
        }
        let truth = self.agents[0].sweeps[frame].truth.iter();
        truth.filter(|object| all[&object.track] >= MIN_POINTS).collect()
    }

    pub fn read(path: &Path) -> Scene {
        let log = Log::open(path).expect("a log");
        let agents = log.info().agents.iter();
        let agents = agents.map(|agent| Agent {
            name: agent.name.clone(),
            kind: agent.kind,
            height: agent.sensor_position.map_or(0.0, |[.., height]| height),
            sweeps: sweeps(&log, &agent.name),
        });
        Scene {
            agents: agents.collect(),
        }
    }
}

fn sweeps(log: &Log, agent: &str) -> Vec<Sweep> {
    let streams = [
        Stream::Points,
        Stream::Pose,
        Stream::OwnLabels,
        Stream::OwnLabelsInfo,
        Stream::GroundTruth,
        Stream::GroundTruthInfo,
    ];
    let wanted: Vec<_> = streams
        .into_iter()
        .filter(|stream| log.has(agent, *stream))
        .map(|stream| (agent, stream))
        .collect();
    let mut found = BTreeMap::<Nanos, Sweep>::new();
    let mut reader = log.read_all(&wanted).expect("a log");
    while let Some(entry) = reader.next().expect("an entry") {
        let sweep = found.entry(entry.stamp()).or_default();
        sweep.stamp = entry.stamp();
        match entry.stream {
            Stream::Points => sweep.cloud = Some(entry.cloud().expect("a cloud")),
            Stream::Pose => sweep.map_from_body = entry.pose().expect("a pose").map_from_body,
            Stream::OwnLabels => sweep.own = entry.boxes().expect("boxes").0,
            Stream::GroundTruth => sweep.truth = entry.boxes().expect("boxes").0,
            stream => {
                let is_truth = stream == Stream::GroundTruthInfo;
                let boxes = if is_truth { &mut sweep.truth } else { &mut sweep.own };
                let mut whole = Boxes(std::mem::take(boxes));
                let info = entry.info(&mut whole).expect("what is said of boxes");
                *boxes = whole.0;
                if is_truth {
                    sweep.points = info.points;
                }
            }
        }
    }
    found.into_values().filter(|sweep| sweep.cloud.is_some()).collect()
}

/// What labels of a layout are.
#[derive(Clone, Copy, PartialEq)]
pub enum Labels {
    /// Those of each agent, whose union is the truth.
    OfEachAgent,
    /// One list, which is the truth of all.
    OfAll,
    /// Those of each agent, and one list that is the truth of the first.
    Given,
}

/// Compares points, poses and boxes of a log that was imported with those of the scene that it came from. The agents have these names.
pub fn assert_same(scene: &Scene, found: &Scene, names: &[&str], labels: Labels) {
    assert_eq!(scene.agents.len(), names.len());
    let agent = |name: &str| {
        let mut agents = found.agents.iter();
        agents
            .find(|agent| agent.name == name)
            .unwrap_or_else(|| panic!("no `{name}`"))
    };
    // A layout may have another map: the last agent's first pose relates the two.
    let place = |agent: &Agent| agent.sweeps[0].map_from_body;
    let last = names.len() - 1;
    let map_from_theirs = place(&scene.agents[last]) * place(agent(names[last])).inverse();
    for (index, (expected, name)) in scene.agents.iter().zip(names).enumerate() {
        let found = agent(name);
        let [ours, theirs] = [&expected.sweeps, &found.sweeps];
        assert_eq!((found.kind, theirs.len()), (expected.kind, ours.len()), "{name}");
        for (frame, (one, other)) in ours.iter().zip(theirs).enumerate() {
            assert_eq!(one.stamp - ours[0].stamp, other.stamp - theirs[0].stamp, "{name}");
            assert_same_sweep(one, other, &map_from_theirs);
            let truth = match (labels, index) {
                (Labels::Given, 0) => scene.seen(frame),
                (Labels::Given, _) => Vec::new(),
                (Labels::OfEachAgent | Labels::OfAll, _) => one.truth.iter().collect(),
            };
            assert_same_boxes(&truth, &other.truth);
            assert_eq!(
                other.points.is_some(),
                labels != Labels::Given,
                "{name}: points are counted"
            );
            if labels != Labels::OfAll {
                assert_same_boxes(&one.own.iter().collect::<Vec<_>>(), &other.own);
            }
        }
    }
}

fn assert_same_sweep(one: &Sweep, other: &Sweep, map_from_theirs: &Isometry3<f64>) {
    let apart = one.map_from_body.inv_mul(&(map_from_theirs * other.map_from_body));
    assert!(
        apart.translation.vector.norm() < 1e-6 && apart.rotation.angle() < 1e-6,
        "{apart}"
    );
    let [one, other] = [one.cloud(), other.cloud()];
    assert_eq!(one.len(), other.len());
    for (a, b) in [(&one.x, &other.x), (&one.y, &other.y), (&one.z, &other.z)] {
        // A step of a float32 at 100 m.
        assert!(a.iter().zip(b.iter()).all(|(a, b)| (a - b).abs() < 8e-6));
    }
    assert_eq!(one.intensity, other.intensity);
}

fn assert_same_boxes(expected: &[&Box3], found: &[Box3]) {
    for object in found {
        let near = |known: &&&Box3| (Point3::from(known.center) - Point3::from(object.center)).norm() < 1e-5;
        let known = expected.iter().find(near).unwrap_or_else(|| panic!("{object:?}"));
        let turned = normalize_yaw(known.yaw - object.yaw).abs();
        assert!(turned < 1e-6, "{known:?}, {object:?}");
        let sizes = |object: &Box3| [object.length, object.width, object.height];
        let off = sizes(known).into_iter().zip(sizes(object)).map(|(a, b)| (a - b).abs());
        assert!(off.fold(0.0, f64::max) < 1e-6, "{known:?}, {object:?}");
        assert_eq!(known.class.to_lowercase(), object.class.to_lowercase());
    }
    assert_eq!(found.len(), expected.len());
}
