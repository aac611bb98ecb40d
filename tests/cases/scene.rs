//! A small scene whose answer is known, and logs that differ from it.
//!
//! A car drives along x at 8 m/s, a mast stands at (45, 12). Of eight parked cars, four have points of the car alone, the
//! other four of the mast alone, and each agent's recorded detections are what it has points on. So recorded detections
//! in `--offline` find 4 of 8 without fusion, and 8 of 8 with late fusion.
#![allow(dead_code)]

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::process::Output;

use realo_logs::{AgentInfo, AgentKind, LogInfo, LogWriter, McapFile};
use realo_schemas::{AgentState, Box3, Boxes, Nanos, PointCloud, Pose, PoseStatus};
use serde_json::Value;

use crate::common;

/// Stamp of the first sweep.
pub const T0: Nanos = 1_700_000_000_000_000_000;
/// Time between sweeps.
pub const SWEEP: Nanos = 100_000_000;
/// The mast's sweeps are this much later than the car's.
pub const MAST_LATER: Nanos = 20_000_000;
/// Sweeps of each agent.
pub const SWEEPS: i64 = 20;
/// The agents.
pub const AGENTS: [&str; 2] = ["car", "mast"];

const CARS: [[f64; 2]; 8] = [
    [12.0, 6.0],
    [20.0, -6.0],
    [28.0, 6.5],
    [36.0, -7.0],
    [44.0, 5.5],
    [52.0, -6.5],
    [60.0, 7.0],
    [68.0, -5.5],
];
const SIZE: [f64; 3] = [4.4, 1.8, 1.5];
const POINTS: u32 = 60;

/// What the scene is made of; [`Scene::default`] is the one with the known answer.
#[derive(Clone)]
pub struct Scene {
    /// Poses a second, of the car and of the mast; 0: one in all.
    pub pose_hz: [i64; 2],
    /// Class of an object, by its index.
    pub class: fn(usize) -> &'static str,
    /// Adds `realo_log`'s own points of each sweep; otherwise sweeps are empty.
    pub points: bool,
    /// Names of the car and of the mast.
    pub agents: [&'static str; 2],
    /// Adds the ground truth.
    pub truth: bool,
}

impl Default for Scene {
    fn default() -> Self {
        Scene {
            pose_hz: [20, 20],
            class: |_| "Car",
            points: true,
            agents: AGENTS,
            truth: true,
        }
    }
}

impl Scene {
    /// Writes the scene as a log into the tests' folder and returns its path.
    pub fn write(&self, name: &str) -> PathBuf {
        let path = common::folder(&format!("scene-{name}")).join(format!("{name}.mcap"));
        let [car, mast] = self.agents;
        let agents = vec![agent(car, AgentKind::Vehicle), agent(mast, AgentKind::Roadside)];
        let mut log = LogWriter::create(&path, &LogInfo::new("a made-up scene", agents)).expect("the log is created");
        for (stamp, what, who) in self.events() {
            self.event(&mut log, stamp, what, who);
        }
        log.finish().expect("the log is finished");
        path
    }

    fn events(&self) -> Vec<(Nanos, What, usize)> {
        let mut events = Vec::new();
        for (who, hz) in self.pose_hz.into_iter().enumerate() {
            let span = SWEEPS * SWEEP + 600_000_000;
            let step = if hz == 0 { span } else { 1_000_000_000 / hz };
            let poses = (0..(span + step - 1) / step).map(|k| (T0 - 200_000_000 + k * step, What::Pose, who));
            events.extend(poses);
            let later = if who == 1 { MAST_LATER } else { 0 };
            events.extend((0..SWEEPS).map(|k| (T0 + k * SWEEP + later, What::Sweep, who)));
        }
        events.sort();
        events
    }

    fn event(&self, log: &mut LogWriter, stamp: Nanos, what: What, who: usize) {
        let name = self.agents[who];
        let seconds = (stamp - T0) as f64 / 1e9;
        if what == What::Pose {
            let written = log.pose(name, stamp, stamp, &state_of(who, seconds));
            return written.expect("a pose is written");
        }
        let ready = stamp + 90_000_000;
        let own = if who == 0 { 0..4 } else { 4..8 };
        let objects: Vec<Box3> = (0..CARS.len()).map(|i| self.object(who, seconds, i)).collect();
        let cloud = match self.points {
            true => cloud_of(&objects[own.clone()]),
            false => PointCloud::empty(),
        };
        log.cloud(name, stamp, ready, &cloud).expect("a sweep is written");
        let detections = objects[own.clone()].iter().cloned().map(|object| Box3 {
            track: None,
            score: 0.9,
            ..object
        });
        log.detections(name, stamp, ready, &Boxes(detections.collect()))
            .expect("detections are written");
        if !self.truth {
            return;
        }
        let points: Vec<u32> = (0..CARS.len())
            .map(|i| if own.contains(&i) { POINTS } else { 0 })
            .collect();
        log.truth(name, stamp, ready, &objects, Some(&points), true)
            .expect("truth is written");
    }

    fn object(&self, who: usize, seconds: f64, index: usize) -> Box3 {
        let ([x, y], yaw) = pose_of(who, seconds);
        let (sin, cos) = yaw.sin_cos();
        let [dx, dy] = [CARS[index][0] - x, CARS[index][1] - y];
        Box3 {
            center: [cos * dx + sin * dy, -sin * dx + cos * dy, SIZE[2] / 2.0],
            length: SIZE[0],
            width: SIZE[1],
            height: SIZE[2],
            yaw: -yaw,
            velocity: None,
            class: (self.class)(index).into(),
            score: 1.0,
            track: Some(index as u64 + 1),
            covariance: None,
        }
    }
}

#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum What {
    Pose,
    Sweep,
}

fn agent(name: &str, kind: AgentKind) -> AgentInfo {
    AgentInfo {
        name: name.into(),
        kind,
        footprint: (kind == AgentKind::Vehicle).then_some([-1.5, 3.3, -0.9, 0.9]),
        sensor: String::new(),
        sensor_position: None,
    }
}

fn pose_of(who: usize, seconds: f64) -> ([f64; 2], f64) {
    match who {
        0 => ([8.0 * seconds, 0.0], 0.0),
        _ => ([45.0, 12.0], 0.9 * std::f64::consts::PI),
    }
}

fn state_of(who: usize, seconds: f64) -> AgentState {
    let ([x, y], yaw) = pose_of(who, seconds);
    let rotation = [0.0, 0.0, (yaw / 2.0).sin(), (yaw / 2.0).cos()];
    let pose = Pose::from_parts([x, y, 0.0], rotation).expect("a rotation");
    AgentState {
        map_from_body: pose.map_from_frame,
        covariance: None,
        velocity: None,
        angular_rate: None,
        status: PoseStatus::Recorded,
    }
}

/// Points on the sides of objects, and on the ground.
fn cloud_of(objects: &[Box3]) -> PointCloud {
    let mut points: Vec<[f32; 3]> = Vec::new();
    for object in objects {
        let (sin, cos) = object.yaw.sin_cos();
        for k in 0..POINTS {
            let share = f64::from(k) / f64::from(POINTS) - 0.5;
            let side = if k % 2 == 0 { 0.5 } else { -0.5 };
            let [u, v] = [side * object.length, share * object.width];
            let z = object.height * f64::from(k % 7) / 7.0;
            points.push([
                (object.center[0] + cos * u - sin * v) as f32,
                (object.center[1] + sin * u + cos * v) as f32,
                z as f32,
            ]);
        }
    }
    points.extend((0..300).map(|k| [(k % 20 * 4 - 40) as f32, (k / 20 * 5 - 37) as f32, 0.0]));
    let axis = |axis: usize| points.iter().map(|point| point[axis]).collect::<Vec<f32>>();
    let n = points.len();
    PointCloud::new(
        axis(0),
        axis(1),
        axis(2),
        vec![60_u8; n],
        vec![0_i32; n],
        vec![0_u16; n],
    )
    .expect("columns of one length")
}

/// A message of a log, as a test changes it.
#[derive(Clone, Debug)]
pub struct Raw {
    /// Its topic, e.g. `/mast/points`.
    pub topic: String,
    /// Its number on the topic.
    pub sequence: u32,
    /// When it existed, ns.
    pub log_time: i64,
    /// Its stamp, ns.
    pub publish_time: i64,
    /// CDR.
    pub data: Vec<u8>,
}

impl Raw {
    /// The agent and the stream of the topic.
    pub fn parts(&self) -> (&str, &str) {
        let topic = self.topic.strip_prefix('/').unwrap_or(&self.topic);
        topic.split_once('/').unwrap_or((topic, ""))
    }

    /// The stamp of the header that the message begins with.
    pub fn header_stamp(&self) -> i64 {
        let word = |at: usize| <[u8; 4]>::try_from(&self.data[at..at + 4]).expect("four bytes");
        i64::from(i32::from_le_bytes(word(4))) * 1_000_000_000 + i64::from(u32::from_le_bytes(word(8)))
    }

    /// Changes the stamp of the header that the message begins with; boxes inside keep theirs.
    pub fn set_header_stamp(&mut self, stamp: i64) {
        let seconds = i32::try_from(stamp.div_euclid(1_000_000_000)).expect("seconds of a header");
        let nanos = stamp.rem_euclid(1_000_000_000) as u32;
        self.data[4..8].copy_from_slice(&seconds.to_le_bytes());
        self.data[8..12].copy_from_slice(&nanos.to_le_bytes());
    }

    /// Moves the header's stamp and the publish time.
    pub fn shift(&mut self, by: i64) {
        self.set_header_stamp(self.header_stamp() + by);
        self.publish_time += by;
    }
}

/// Copies a log message by message; `change` gives what is written in the place of each, nothing to leave it out.
pub fn rewrite(from: &Path, name: &str, change: impl FnMut(Raw) -> Vec<Raw>) -> PathBuf {
    rewrite_with(from, name, &[], |_| {}, change)
}

/// The same; `more` are topics that the log does not have, each with one whose type it has, and `record` changes what the log says
/// of itself.
pub fn rewrite_with(
    from: &Path,
    name: &str,
    more: &[[&str; 2]],
    record: impl Fn(&mut BTreeMap<String, String>),
    mut change: impl FnMut(Raw) -> Vec<Raw>,
) -> PathBuf {
    let to = common::folder(&format!("scene-{name}")).join(format!("{name}.mcap"));
    let bytes = fs::read(from).expect("the log can be read");
    let out = BufWriter::new(File::create(&to).expect("the folder can be written"));
    let options = mcap::WriteOptions::new().compression(None);
    let mut writer = mcap::Writer::with_options(out, options).expect("a writer");
    let mut metadata = McapFile::open(from).expect("a log").metadata().clone();
    record(metadata.get_mut("realo").expect("a log"));
    let record = |writer: &mut mcap::Writer<BufWriter<File>>, wanted: fn(&str) -> bool| {
        for (name, entries) in metadata.iter().filter(|(name, _)| wanted(name)) {
            let metadata = mcap::records::Metadata {
                name: name.clone(),
                metadata: entries.clone(),
            };
            writer.write_metadata(&metadata).expect("metadata are written");
        }
    };
    record(&mut writer, |name| name == "realo");
    let mut channels = BTreeMap::new();
    let mut schemas = BTreeMap::new();
    for message in mcap::MessageStream::new(&bytes).expect("messages") {
        let message = message.expect("a message");
        let topic = message.channel.topic.clone();
        schemas
            .entry(topic.clone())
            .or_insert_with(|| message.channel.schema.clone().expect("a schema"));
        for [new, of] in more {
            if let Some(schema) = schemas.get(*of).cloned() {
                schemas.entry((*new).to_string()).or_insert(schema);
            }
        }
        let raw = Raw {
            topic,
            sequence: message.sequence,
            log_time: message.log_time as i64,
            publish_time: message.publish_time as i64,
            data: message.data.to_vec(),
        };
        for raw in change(raw) {
            let id = *channels.entry(raw.topic.clone()).or_insert_with(|| {
                let schema = schemas.get(&raw.topic).expect("messages keep to topics of the log");
                let schema = writer
                    .add_schema(&schema.name, &schema.encoding, &schema.data)
                    .expect("a schema");
                writer
                    .add_channel(schema, &raw.topic, "cdr", &BTreeMap::new())
                    .expect("a channel")
            });
            let header = mcap::records::MessageHeader {
                channel_id: id,
                sequence: raw.sequence,
                log_time: raw.log_time as u64,
                publish_time: raw.publish_time as u64,
            };
            writer
                .write_to_known_channel(&header, &raw.data)
                .expect("a message is written");
        }
    }
    record(&mut writer, |name| name != "realo");
    writer.finish().expect("the log is finished");
    to
}

/// What a run said and gave.
#[derive(Debug)]
pub struct Ran {
    /// Its exit code.
    pub code: i32,
    /// Its standard output.
    pub out: String,
    /// Its standard error.
    pub err: String,
    /// `result.json`, where there is one.
    pub result: Option<Value>,
}

impl Ran {
    /// AP of vehicles in the order `sorted`.
    pub fn ap(&self, iou: &str) -> f64 {
        let result = self
            .result
            .as_ref()
            .unwrap_or_else(|| panic!("no result: {}", self.err));
        result["accuracy"]["sorted"]["AP"]["vehicle"][iou]
            .as_f64()
            .unwrap_or_else(|| panic!("no AP in {}", result["accuracy"]["sorted"]))
    }

    /// The notes of the result, a line each.
    pub fn notes(&self) -> String {
        let notes = self.result.as_ref().and_then(|result| result["notes"].as_array());
        let lines = notes.into_iter().flatten().filter_map(Value::as_str);
        lines.collect::<Vec<_>>().join("\n")
    }
}

/// Runs a shipped graph over a log with the car as ego and recorded detections, with these options more.
pub fn run(graph: &str, log: &Path, name: &str, more: &[&str]) -> Ran {
    run_ego("car", graph, log, name, more)
}

/// The same with another ego.
pub fn run_ego(ego: &str, graph: &str, log: &Path, name: &str, more: &[&str]) -> Ran {
    let out = common::folder(&format!("ran-{name}-{graph}"));
    let output = run_into(&out, ego, Path::new(&common::graph(graph)), log, more);
    let result = out.join("result.json");
    Ran {
        code: output.status.code().unwrap_or(-1),
        out: common::text(&output.stdout),
        err: common::text(&output.stderr),
        result: result.exists().then(|| common::json(&result)),
    }
}

/// Runs a graph in a file over a log with recorded detections, results into a folder that stays as it is.
pub fn run_into(out: &Path, ego: &str, graph: &Path, log: &Path, more: &[&str]) -> Output {
    let [graph, log, out] = [graph, log, out].map(Path::to_string_lossy);
    let fixed = [
        "run",
        &graph,
        "--log",
        &log,
        "--ego",
        ego,
        "--recorded-detections",
        "--out",
        &out,
    ];
    common::realo([&fixed[..], more].concat())
}

#[test]
fn the_scene_has_its_known_answer_written_and_rewritten() {
    let written = Scene::default().write("base");
    let copied = rewrite(&written, "copied", |message| vec![message]);
    for (name, log) in [("base", written), ("copied", copied)] {
        assert_eq!(run("no_fusion", &log, name, &["--offline"]).ap("0.5"), 0.5);
        let late = run("late_fusion", &log, name, &["--offline"]);
        assert_eq!((late.ap("0.5"), late.code), (1.0, 0), "{late:?}");
    }
}

/// What `realo info` says of a log, and its exit code.
pub fn info(log: &Path) -> (String, Option<i32>) {
    let output = common::realo(["info", &log.to_string_lossy()]);
    (common::text(&output.stdout), output.status.code())
}
