use arrow_buffer::{Buffer, ScalarBuffer};
use nalgebra::{Isometry3, Vector3};
use serde::{Deserialize, Serialize};

use crate::geometry::View;
use crate::{Message, Name, Nanos};

/// Points of one sweep; all columns have the same length.
#[derive(Clone, Debug, PartialEq)]
pub struct PointCloud {
    /// Metres, forward.
    pub x: ScalarBuffer<f32>,
    /// Metres, left.
    pub y: ScalarBuffer<f32>,
    /// Metres, up.
    pub z: ScalarBuffer<f32>,
    /// Reflected intensity, 0–255; the scale is the sensor's own.
    pub intensity: ScalarBuffer<u8>,
    /// Signed offset of each point from the header's stamp, ns.
    pub time: ScalarBuffer<i32>,
    /// Index of the beam.
    pub ring: ScalarBuffer<u16>,
}

impl PointCloud {
    /// A cloud from its columns.
    ///
    /// Returns `None` unless all columns have the same length.
    pub fn new(
        x: impl Into<ScalarBuffer<f32>>,
        y: impl Into<ScalarBuffer<f32>>,
        z: impl Into<ScalarBuffer<f32>>,
        intensity: impl Into<ScalarBuffer<u8>>,
        time: impl Into<ScalarBuffer<i32>>,
        ring: impl Into<ScalarBuffer<u16>>,
    ) -> Option<Self> {
        let cloud = PointCloud {
            x: x.into(),
            y: y.into(),
            z: z.into(),
            intensity: intensity.into(),
            time: time.into(),
            ring: ring.into(),
        };
        let n = cloud.x.len();
        let same = [
            cloud.y.len(),
            cloud.z.len(),
            cloud.intensity.len(),
            cloud.time.len(),
            cloud.ring.len(),
        ]
        .iter()
        .all(|len| *len == n);
        same.then_some(cloud)
    }

    /// A cloud without points.
    pub fn empty() -> Self {
        PointCloud {
            x: Vec::new().into(),
            y: Vec::new().into(),
            z: Vec::new().into(),
            intensity: Vec::new().into(),
            time: Vec::new().into(),
            ring: Vec::new().into(),
        }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.x.len()
    }

    /// Whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.x.is_empty()
    }
}

/// How far a pose can be trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseStatus {
    /// Exact, from a simulator or a survey.
    Truth,
    /// As recorded by the agent's own localization.
    Recorded,
    /// Carried forward from older measurements.
    Extrapolated,
    /// Estimated, and not known yet: the position may be, the heading is not.
    Init,
    /// Estimated, and corrected by absolute positions.
    Tracking,
    /// Estimated, and carried on by the agent's own motion alone.
    DeadReckoning,
    /// Estimated, and not known any more.
    Lost,
}

impl PoseStatus {
    /// All, in the order of their numbers.
    pub const ALL: [PoseStatus; 7] = [
        PoseStatus::Truth,
        PoseStatus::Recorded,
        PoseStatus::Extrapolated,
        PoseStatus::Init,
        PoseStatus::Tracking,
        PoseStatus::DeadReckoning,
        PoseStatus::Lost,
    ];
    /// Those of estimates.
    pub const ESTIMATED: [PoseStatus; 4] = [
        PoseStatus::Init,
        PoseStatus::Tracking,
        PoseStatus::DeadReckoning,
        PoseStatus::Lost,
    ];

    /// Its name in messages and tables.
    pub fn name(self) -> &'static str {
        match self {
            PoseStatus::Truth => "truth",
            PoseStatus::Recorded => "recorded",
            PoseStatus::Extrapolated => "extrapolated",
            PoseStatus::Init => "init",
            PoseStatus::Tracking => "tracking",
            PoseStatus::DeadReckoning => "dead_reckoning",
            PoseStatus::Lost => "lost",
        }
    }

    /// Whether the pose may be used: not while it is not known yet, or any more.
    pub fn is_usable(self) -> bool {
        !matches!(self, PoseStatus::Init | PoseStatus::Lost)
    }
}

/// Where an agent is and how it moves, at the header's stamp.
#[derive(Clone, Debug, PartialEq)]
pub struct AgentState {
    /// Maps points of the agent's body frame into `map`; metres.
    pub map_from_body: Isometry3<f64>,
    /// Row-major 6×6 over (x, y, z, roll, pitch, yaw), m² and rad², where known.
    pub covariance: Option<Box<[f64; 36]>>,
    /// Velocity in `map`, m/s, where known.
    pub velocity: Option<Vector3<f64>>,
    /// Angular rate in the body frame, rad/s, where known.
    pub angular_rate: Option<Vector3<f64>>,
    /// How far the pose can be trusted.
    pub status: PoseStatus,
}

/// Element type of a feature map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DType {
    /// IEEE 754 single precision.
    F32,
    /// IEEE 754 half precision.
    F16,
    /// bfloat16.
    Bf16,
    /// Unsigned bytes.
    U8,
}

impl DType {
    /// Bytes per element.
    pub fn size(self) -> usize {
        match self {
            DType::F32 => 4,
            DType::F16 | DType::Bf16 => 2,
            DType::U8 => 1,
        }
    }
}

/// What the numbers of a feature map cross as, between machines or from a GPU to its host.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Elements {
    /// Single precision: exactly.
    F32,
    /// Half precision: to 2⁻¹¹ of the number, or 2⁻²⁵ where it is below 2⁻¹⁴; beyond ±65,504 it becomes ±65,504.
    F16,
    /// Codes of 8 bits: to half a step, which is a 255th of the channel's range in this map.
    #[default]
    Int8,
}

/// A BEV feature map, `[rows, columns, channels]`; rows run along y, columns along x.
#[derive(Clone, Debug, PartialEq)]
pub struct FeatureMap {
    /// Cells along y.
    pub rows: u32,
    /// Cells along x.
    pub columns: u32,
    /// Channels of a cell.
    pub channels: u32,
    /// Side of a cell, m.
    pub cell: f64,
    /// (x, y) of the outer corner of cell (0, 0) in the header's frame, m.
    pub origin: [f64; 2],
    /// Element type.
    pub dtype: DType,
    /// `rows × columns × channels` elements, little endian.
    pub data: Buffer,
    /// sha256 of the weights that made it, in hexadecimal.
    pub model: Name,
    /// How sure its maker is that each cell holds an object, 0 to 1, `[rows, columns]`. A cell of 0 is not there: its
    /// features are zeros, and its maker takes no part in what is said of it. `None`: not known, and all cells are there.
    pub confidence: Option<ScalarBuffer<f32>>,
}

impl FeatureMap {
    /// Bytes of a map of this shape; no three dimensions are too great for 128 bits.
    pub fn size_of([rows, columns, channels]: [u32; 3], dtype: DType) -> u128 {
        [rows, columns, channels].map(u128::from).iter().product::<u128>() * dtype.size() as u128
    }
}

/// What crosses a link: a payload as bytes.
#[derive(Clone, Debug, PartialEq)]
pub struct Packet {
    /// Codecs that made `bytes`, first applied first.
    pub codec: Vec<String>,
    /// The encoded header and payload.
    pub bytes: Buffer,
}

/// Begins the word behind a packet's codecs that [`Packet::moved`] adds.
const MOVED: &str = "moved_ns=";

impl Packet {
    /// The packet where the stamp of its header was moved by so many ns, onto another time line; its bytes stay as they are.
    pub fn moved(mut self, by: Nanos) -> Self {
        self.codec.push(format!("{MOVED}{by}"));
        self
    }

    /// The codecs that made the bytes, and how far the header's stamp was moved from the stamp that they say.
    pub fn origin(&self) -> (&[String], Nanos) {
        let by = |last: &String| last.strip_prefix(MOVED)?.parse().ok();
        match self
            .codec
            .split_last()
            .and_then(|(last, codec)| Some((codec, by(last)?)))
        {
            Some(moved) => moved,
            None => (&self.codec, 0),
        }
    }
}

/// The bank's answer to one query.
#[derive(Clone, Debug, PartialEq)]
pub struct Selection {
    /// `seq` of the ego's message that asked.
    pub query: u64,
    /// What the collaborators contributed, ordered by agent.
    pub entries: Vec<Message>,
}

/// Counters, timings or scores, as a JSON document.
#[derive(Clone, Debug, PartialEq)]
pub struct Report {
    /// What the document is, e.g. `evaluation`; readers refuse topics they do not know.
    pub topic: Name,
    /// JSON.
    pub json: String,
}

/// An oriented box, gravity-aligned.
#[derive(Clone, Debug, PartialEq)]
pub struct Box3 {
    /// Centre, m.
    pub center: [f64; 3],
    /// Extent along the heading, m.
    pub length: f64,
    /// Extent across the heading, m.
    pub width: f64,
    /// Vertical extent, m.
    pub height: f64,
    /// Heading, rad from +x towards +y.
    pub yaw: f64,
    /// Velocity in the header's frame, m/s, where known.
    pub velocity: Option<[f64; 3]>,
    /// Class as its source names it; protocols map it to a super-class.
    pub class: Name,
    /// Confidence in [0, 1].
    pub score: f32,
    /// Identity over time, where known.
    pub track: Option<u64>,
    /// Row-major 3×3 over (x, y, yaw), m² and rad², where known.
    pub covariance: Option<[f64; 9]>,
}

impl Box3 {
    /// A box of score 1 of which no more is known: centre (m), length, width and height (m), heading (rad), in the header's frame.
    pub fn new(class: impl Into<Name>, center: [f64; 3], [length, width, height]: [f64; 3], yaw: f64) -> Self {
        Box3 {
            center,
            length,
            width,
            height,
            yaw,
            velocity: None,
            class: class.into(),
            score: 1.0,
            track: None,
            covariance: None,
        }
    }
}

/// Detections, or any list of boxes, in the header's frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Boxes(pub Vec<Box3>);

/// What is really there around the ego at the header's stamp, in the ego's true body frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GroundTruth {
    /// The objects; score 1.
    pub boxes: Vec<Box3>,
    /// The agents of the mode, ego first.
    pub agents: Vec<Name>,
    /// Points that each agent has on each object: `[objects, agents]`, row-major; empty where the source does not say.
    pub points: Vec<u32>,
    /// The ego's own footprint in its body frame, [x min, x max, y min, y max], m; detections centred in it are its own.
    pub ego_footprint: Option<[f64; 4]>,
    /// The footprints of the other agents, each in its own body frame, in the order of `agents` after the ego; empty where the source
    /// does not say.
    pub other_footprints: Vec<Option<[f64; 4]>>,
    /// Whether the frame is scored.
    pub key: bool,
    /// Where objects could be labelled, in the ego's true body frame; empty where that is everywhere.
    pub views: Vec<View>,
    /// What the ego's own side labelled, where the source tells it apart.
    pub own: Option<Box<OwnLabels>>,
}

/// Objects that one agent's side labelled by its own sensors, in the agent's true body frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct OwnLabels {
    /// The objects; score 1.
    pub boxes: Vec<Box3>,
    /// Points that the agent has on each of them; empty where the source does not say.
    pub points: Vec<u32>,
    /// Whether the frame is scored by them.
    pub key: bool,
    /// Where they could be, in the same frame; empty where that is everywhere.
    pub views: Vec<View>,
}

impl GroundTruth {
    /// The agents whose footprints are known, and these.
    pub fn footprints(&self) -> impl Iterator<Item = (&Name, [f64; 4])> {
        let all = std::iter::once(&self.ego_footprint).chain(&self.other_footprints);
        let known = |(agent, footprint): (_, &Option<[f64; 4]>)| footprint.map(|footprint| (agent, footprint));
        self.agents.iter().zip(all).filter_map(known)
    }

    /// Points of all agents on an object; `None` where the source does not say.
    pub fn points_of_all(&self, object: usize) -> Option<u64> {
        self.row(object).map(|row| row.iter().map(|n| u64::from(*n)).sum())
    }

    /// The ego's points on an object; `None` where the source does not say.
    pub fn points_of_ego(&self, object: usize) -> Option<u64> {
        self.row(object).and_then(|row| row.first()).map(|n| u64::from(*n))
    }

    fn row(&self, object: usize) -> Option<&[u32]> {
        let n = self.agents.len();
        self.points
            .get(object * n..(object + 1) * n)
            .filter(|row| !row.is_empty())
    }
}

impl OwnLabels {
    /// The agent's points on an object; `None` where the source does not say.
    pub fn points_on(&self, object: usize) -> Option<u64> {
        self.points.get(object).map(|n| u64::from(*n))
    }
}

impl AgentState {
    /// The pose at `dt` ns from the state's stamp, by constant speed and angular rate: who turns, goes on along the arc.
    pub fn extrapolated(&self, dt: Nanos) -> Isometry3<f64> {
        let seconds = crate::to_seconds(dt);
        let mut pose = self.map_from_body;
        let turn = self.angular_rate.unwrap_or_default() * seconds;
        if let Some(velocity) = self.velocity {
            // The chord of an arc has the direction of its middle.
            let half = nalgebra::UnitQuaternion::from_scaled_axis(pose.rotation * (0.5 * turn));
            let angle = 0.5 * turn.norm();
            let chord = if angle > 1e-6 { libm::sin(angle) / angle } else { 1.0 };
            pose.translation.vector += half * velocity * (seconds * chord);
        }
        pose.rotation *= nalgebra::UnitQuaternion::from_scaled_axis(turn);
        pose
    }
}
