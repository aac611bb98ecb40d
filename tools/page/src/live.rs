//! A run while it goes on: its newest sweeps for the page's player.
//!
//! A picture is a text of JSON and the points of all agents behind it: `u32` the bytes of the text, the text, steps of 2 cm as `i16`;
//! all little-endian.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::Vector3;
use realo_logs::{Log, MAX_GAP, program};
use realo_schemas::geometry::PoseTrack;
use realo_schemas::report::Fated;
use realo_schemas::{AgentState, Header, Kind, Message, Name, Nanos, Payload, PointCloud};
use realo_scoring::Protocol;
use serde_json::{Value, json};

use crate::PageError;
use crate::document::words;
use crate::html::live_html;
use crate::points::{centimetres, placed, steps};
use crate::recorded::{Recorded, Sweep};
use crate::scenes::{Names, ScenePart, SceneRun, begin, used_row};

/// Poses older than the newest by this are forgotten, ns.
const KEPT_POSES: Nanos = 5_000_000_000;
/// Sweeps of an agent that wait for boxes.
const KEPT_CLOUDS: usize = 8;
/// Sweeps whose boxes or truth may still come.
const KEPT_SWEEPS: usize = 64;
/// What an agent saw is drawn where it is so near to the ego's sweep, ns.
const NEAR: Nanos = 120_000_000;
/// An agent whose sweeps are older than this sends no more, ns.
const GONE: Nanos = 1_000_000_000;
/// Agents whose sweeps and poses are kept; a log has fewer.
const MOST_AGENTS: usize = 64;

/// What a run is, as far as its page says it.
pub struct Watched {
    /// Graph, log and ego, as the command names it.
    pub name: String,
    /// How it runs.
    pub mode: String,
    /// Name of the log.
    pub log: String,
    /// The ego.
    pub ego: String,
    /// Whether nothing of others is fused.
    pub alone: bool,
    /// What boxes are judged by.
    pub protocol: Protocol,
    /// Whether the graph says what is there.
    pub has_truth: bool,
}

/// The page itself, which asks `host` (name or number, and port) for pictures.
pub fn live_page(host: &str) -> String {
    let document = json!({
        "version": 1, "program": program(), "verdict": [], "iou": "", "differences": [], "runs": [], "classes": [],
        "scenes": [], "points": [], "left_out": [], "words": words(),
    });
    live_html(host, &document.to_string())
}

/// A run that is watched.
pub struct Live {
    watched: Watched,
    log: Option<Log>,
    scene: ScenePart,
    names: Names,
    recorded: Recorded,
    origin: Option<Vector3<f64>>,
    clouds: BTreeMap<Name, VecDeque<(Nanos, PointCloud)>>,
    sweeps: BTreeMap<u64, Sweep>,
    /// Number of the newest sweep that was drawn.
    drawn: Option<u64>,
}

impl Live {
    /// A run of which nothing is known yet; the log gives the outlines of agents.
    pub fn new(watched: Watched, log: Option<Log>) -> Self {
        let mut scene = ScenePart::new(&watched.log, &watched.ego, 0, &watched.protocol);
        scene.agent(&watched.ego, log.as_ref());
        let mut names = Names::default();
        watched.protocol.classes.iter().for_each(|class| {
            names.class(&class.name);
        });
        Live {
            watched,
            log,
            scene,
            names,
            recorded: Recorded::empty(),
            origin: None,
            clouds: BTreeMap::new(),
            sweeps: BTreeMap::new(),
            drawn: None,
        }
    }

    /// What the page needs to know before the first picture.
    ///
    /// # Errors
    /// A scene that JSON cannot hold.
    pub fn opening(&self) -> Result<String, PageError> {
        let Watched { name, mode, alone, .. } = &self.watched;
        let mut scene = serde_json::to_value(&self.scene)?;
        scene["runs"] = serde_json::to_value([SceneRun::empty()])?;
        Ok(json!({
            "what": "scene",
            "run": { "name": name, "alone": alone, "mode": mode },
            "scene": scene,
            "iou": self.scene.ious.last(),
            "classes": self.names.classes,
        })
        .to_string())
    }

    /// What the page is told when the run has ended.
    pub fn ending() -> String {
        json!({ "what": "ended" }).to_string()
    }

    /// Takes a message that the run sent, and gives the pictures that are whole by it.
    ///
    /// # Errors
    /// Truth and boxes that cannot be compared.
    pub fn see(&mut self, Message { header, payload }: Message) -> Result<Vec<Vec<u8>>, PageError> {
        let seq = header.seq;
        match payload {
            Payload::PointCloud(cloud) => self.see_cloud(&header, cloud),
            Payload::AgentState(state) => self.see_state(&header, &state),
            Payload::GroundTruth(truth) => self.sweeps.entry(seq).or_default().truth = Some((header, truth)),
            Payload::Boxes(boxes) => self.sweeps.entry(seq).or_default().boxes = Some((header, boxes)),
            _ => {}
        }
        while self.sweeps.len() > KEPT_SWEEPS {
            self.sweeps.pop_first();
        }
        self.whole_until().map_or(Ok(Vec::new()), |last| self.draw_until(last))
    }

    fn see_cloud(&mut self, header: &Header, cloud: PointCloud) {
        if self.clouds.len() >= MOST_AGENTS && !self.clouds.contains_key(&header.agent) {
            return;
        }
        let known = self.clouds.entry(header.agent.clone()).or_default();
        known.push_back((header.stamp, cloud));
        if known.len() > KEPT_CLOUDS {
            known.pop_front();
        }
    }

    fn see_state(&mut self, header: &Header, state: &AgentState) {
        let poses = &mut self.recorded.poses;
        if poses.len() >= MOST_AGENTS && !poses.contains_key(&header.agent) {
            return;
        }
        let track = poses
            .entry(header.agent.clone())
            .or_insert_with(|| PoseTrack::new(KEPT_POSES, MAX_GAP));
        track.insert(header.stamp, state.map_from_body);
        self.scene.agent(&header.agent, self.log.as_ref());
    }

    /// The newest sweep that can be drawn with all before it. The newest boxes wait for what is there and for the sweeps of others;
    /// once later boxes are there, nobody waits for that any more.
    fn whole_until(&self) -> Option<u64> {
        let mut with_boxes = self
            .sweeps
            .iter()
            .rev()
            .filter_map(|(seq, sweep)| Some((*seq, sweep.boxes.as_ref()?, sweep)));
        let (newest, (header, _), sweep) = with_boxes.next()?;
        let is_known = sweep.truth.is_some() || !self.watched.has_truth;
        match is_known && self.has_clouds(header.stamp) {
            true => Some(newest),
            false => with_boxes.next().and_then(|_| newest.checked_sub(1)),
        }
    }

    /// Whether every agent whose sweeps come has sent the one around a time.
    fn has_clouds(&self, stamp: Nanos) -> bool {
        let mut newest = self.clouds.values().filter_map(|known| Some(known.back()?.0));
        newest.all(|at| at >= stamp - NEAR / 2 || at < stamp - GONE)
    }

    /// Draws what is known up to a sweep.
    fn draw_until(&mut self, last: u64) -> Result<Vec<Vec<u8>>, PageError> {
        let later = self.sweeps.split_off(&last.saturating_add(1));
        let whole = std::mem::replace(&mut self.sweeps, later);
        let mut pictures = Vec::new();
        for (seq, sweep) in whole {
            // A log that begins anew counts on.
            if self.drawn.is_none_or(|drawn| drawn < seq) {
                pictures.extend(self.picture(seq, &sweep)?);
                self.drawn = Some(seq);
            }
        }
        Ok(pictures)
    }

    fn picture(&mut self, seq: u64, sweep: &Sweep) -> Result<Option<Vec<u8>>, PageError> {
        let Some((stamp, map_from_ego)) = begin(sweep) else {
            return Ok(None);
        };
        let origin = *self.origin.get_or_insert_with(|| {
            self.scene.start_ns = stamp;
            self.scene.start = stamp.to_string();
            map_from_ego.translation.vector.map(f64::round)
        });
        if let Some((_, truth)) = &sweep.truth {
            self.scene.take_footprints(truth.footprints());
            truth.agents.iter().for_each(|agent| {
                self.scene.agent(agent, self.log.as_ref());
            });
        }
        let mut run = SceneRun::empty();
        let protocol = &self.watched.protocol;
        self.scene
            .add_sweep(seq, sweep, &self.recorded, protocol, origin, &mut run, &mut self.names)?;
        let mut frame = self.scene.frames.remove(&seq).unwrap_or_default();
        let mut of_run = run.frames.remove(&seq).unwrap_or_default();
        frame.objects = of_run.objects.take().unwrap_or_default();
        let (mut index, mut points) = (Vec::new(), Vec::new());
        if of_run.boxes.is_some() {
            self.add_clouds(stamp, origin, &mut index, &mut points);
        }
        let head = json!({
            "seq": seq,
            "tracks": self.scene.names_of(&frame, &of_run),
            "frame": frame,
            "run": of_run,
            "start": self.scene.start,
            "agents": self.scene.agents,
            "classes": self.names.classes,
            "clouds": index,
        });
        Ok(Some(bytes(&head, &points)))
    }

    /// The sweeps of all agents around a time.
    fn add_clouds(&self, stamp: Nanos, origin: Vector3<f64>, index: &mut Vec<Value>, points: &mut Vec<u8>) {
        for (agent, known) in &self.clouds {
            let Some(track) = self.recorded.poses.get(agent) else {
                continue;
            };
            let nearest = known.iter().min_by_key(|(at, _)| (at - stamp).abs());
            let Some((at, cloud)) = nearest.filter(|(at, _)| (at - stamp).abs() <= NEAR) else {
                continue;
            };
            let Some(pose) = track.at(*at) else { continue };
            let (from, cloud) = placed(cloud, *at, track, &pose, origin);
            index.push(json!({
                "agent": &**agent,
                "t": (at - self.scene.start_ns) / 1_000_000,
                "from": centimetres(from),
                "points": [points.len() / 2, 3 * cloud.len()],
            }));
            points.extend(steps(&cloud));
        }
    }

    /// What became of messages, where some were fused.
    pub fn fates(&mut self, fates: &[Fated]) -> Option<String> {
        let mut used: BTreeMap<u64, Vec<[i64; 4]>> = BTreeMap::new();
        for fated in fates {
            let Some(of) = fated.r#use else { continue };
            if fated.message.to != self.watched.ego || fated.message.kind == Kind::AgentState {
                continue;
            }
            let agent = self.scene.agent(&fated.message.from, self.log.as_ref());
            used.entry(of.query)
                .or_default()
                .push(used_row(agent, fated, of.age_ns));
        }
        let agents = &self.scene.agents;
        (!used.is_empty()).then(|| json!({ "what": "used", "used": used, "agents": agents }).to_string())
    }
}

/// A picture as it is sent.
fn bytes(head: &Value, points: &[u8]) -> Vec<u8> {
    let mut text = head.to_string();
    // The points begin at an even place.
    if text.len() % 2 == 1 {
        text.push(' ');
    }
    let mut bytes = Vec::with_capacity(4 + text.len() + points.len());
    bytes.extend((text.len() as u32).to_le_bytes());
    bytes.extend(text.as_bytes());
    bytes.extend(points);
    bytes
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Translation3, UnitQuaternion};
    use realo_schemas::report::{Crossing, Fate, Use};
    use realo_schemas::{Box3, Boxes, GroundTruth, Pose, PoseStatus};

    use super::*;

    const TENTH: Nanos = 100_000_000;

    fn live(has_truth: bool) -> Live {
        let watched = Watched {
            name: "late_fusion, log, cav1".into(),
            mode: "realtime".into(),
            log: "log".into(),
            ego: "cav1".into(),
            alone: false,
            protocol: Protocol::load("default").unwrap(),
            has_truth,
        };
        Live::new(watched, None)
    }

    fn pose(x: f64) -> Isometry3<f64> {
        Isometry3::from_parts(Translation3::new(x, 5.0, 0.0), UnitQuaternion::identity())
    }

    fn header(agent: &str, kind: Kind, seq: u64) -> Header {
        let stamp = seq as Nanos * TENTH;
        let mut header = Header::origin(&"run".into(), &agent.into(), kind, seq, stamp, stamp);
        header.pose = Some(Pose::exact(pose(1000.0)));
        header
    }

    fn state(agent: &str, x: f64, seq: u64) -> Message {
        let state = AgentState {
            map_from_body: pose(x),
            covariance: None,
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Recorded,
        };
        Message::new(header(agent, Kind::AgentState, seq), state)
    }

    fn object(x: f64) -> Box3 {
        Box3::new("Car", [x, 0.0, 0.8], [4.0, 2.0, 1.6], 0.0)
    }

    fn boxes(seq: u64) -> Message {
        Message::new(
            header("cav1", Kind::Boxes, seq),
            Boxes(vec![object(10.0), object(30.0)]),
        )
    }

    fn truth(seq: u64) -> Message {
        let truth = GroundTruth {
            boxes: vec![object(10.0)],
            agents: vec!["cav1".into(), "rsu1".into()],
            points: vec![50, 3],
            ego_footprint: Some([-1.0, 3.5, -0.9, 0.9]),
            key: true,
            ..GroundTruth::default()
        };
        Message::new(header("cav1", Kind::Truth, seq), truth)
    }

    fn cloud(agent: &str, seq: u64) -> Message {
        let cloud = PointCloud::new(vec![1.0f32], vec![2.0f32], vec![0.5f32], vec![1u8], vec![0], vec![0u16]);
        Message::new(header(agent, Kind::Points, seq), cloud.unwrap())
    }

    fn read(picture: &[u8]) -> (Value, &[u8]) {
        let length = u32::from_le_bytes(picture[..4].try_into().unwrap()) as usize;
        let text = &picture[4..4 + length];
        (serde_json::from_slice(text).unwrap(), &picture[4 + length..])
    }

    #[test]
    fn a_picture_is_whole_with_boxes_and_truth_and_has_the_points_around() {
        let mut live = live(true);
        for message in [
            state("cav1", 1000.0, 3),
            state("rsu1", 1010.0, 3),
            cloud("cav1", 3),
            cloud("rsu1", 2),
            boxes(3),
            truth(3),
        ] {
            assert!(live.see(message).unwrap().is_empty());
        }
        let pictures = live.see(cloud("rsu1", 3)).unwrap();
        assert_eq!(pictures.len(), 1);
        let (head, points) = read(&pictures[0]);
        assert_eq!(head["seq"], 3);
        assert_eq!(head["frame"]["poses"][1], json!([1000, 0, 0, 0]));
        assert_eq!(head["agents"][0]["footprint"], json!([-100, 350, -90, 90]));
        assert_eq!(head["agents"][1]["footprint"], json!(null));
        let outcomes: Vec<&Value> = head["run"]["boxes"]
            .as_array()
            .unwrap()
            .iter()
            .map(|row| &row[9])
            .collect();
        assert_eq!(outcomes, [&json!(0), &json!(-1)], "one finds the object, one is false");
        assert_eq!(head["frame"]["objects"][0][1], json!([50, 3]));
        let clouds = head["clouds"].as_array().unwrap();
        assert_eq!((clouds.len(), points.len()), (2, 12));
        assert_eq!(clouds[1]["points"], json!([3, 3]));
        let step = |at: usize| i16::from_le_bytes([points[2 * at], points[2 * at + 1]]);
        assert_eq!([step(3), step(4), step(5)], [50, 100, 25]);
    }

    #[test]
    fn a_sweep_without_boxes_or_truth_does_not_hold_up_the_next() {
        let mut live = live(true);
        live.see(truth(1)).unwrap();
        live.see(boxes(2)).unwrap();
        let drawn = live.see(boxes(3)).unwrap();
        let heads: Vec<Value> = drawn.iter().map(|picture| read(picture).0).collect();
        assert_eq!(
            heads.iter().map(|head| &head["seq"]).collect::<Vec<_>>(),
            [&json!(1), &json!(2)]
        );
        assert!(heads[0]["run"]["boxes"].is_null() && heads[1]["run"]["known"] == false);
        assert_eq!(live.see(truth(3)).unwrap().len(), 1);
        assert!(
            live.see(truth(2)).unwrap().is_empty() && live.see(boxes(2)).unwrap().is_empty(),
            "drawn already"
        );
        let mut alone = self::live(false);
        assert_eq!(alone.see(boxes(0)).unwrap().len(), 1, "no truth comes");
    }

    #[test]
    fn memory_is_bounded_whatever_comes() {
        let mut live = live(true);
        for seq in 0..1000 {
            live.see(cloud(&format!("car{seq}"), seq)).unwrap();
            live.see(cloud("cav1", seq)).unwrap();
            live.see(truth(seq)).unwrap();
        }
        assert!(live.sweeps.len() <= KEPT_SWEEPS && live.clouds.len() <= MOST_AGENTS);
        assert!(live.clouds.values().all(|known| known.len() <= KEPT_CLOUDS));
    }

    #[test]
    fn what_was_fused_is_known_by_the_sweep_it_was_fused_for() {
        let mut live = live(true);
        let fated = |to: &str, r#use| Fated {
            message: Crossing {
                from: "rsu1".into(),
                to: to.into(),
                kind: Kind::Boxes,
                seq: 7,
            },
            fate: Fate::Used,
            r#use,
            entry: None,
        };
        let of = Some(Use {
            query: 9,
            age_ns: 12_300_000,
        });
        let said = live.fates(&[fated("cav1", of), fated("cav2", of), fated("cav1", None)]);
        let said: Value = serde_json::from_str(&said.unwrap()).unwrap();
        assert_eq!(said["used"], json!({"9": [[1, 2, 123, 7]]}));
        assert_eq!(live.fates(&[fated("cav1", None)]), None);
        let opening: Value = serde_json::from_str(&live.opening().unwrap()).unwrap();
        assert_eq!(opening["scene"]["agents"][0]["name"], "cav1");
    }
}
