use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use serde::{Deserialize, Serialize};

use crate::{Nanos, PayloadType};

/// A name that is shared by many messages: an agent, a frame, a class.
pub type Name = Arc<str>;

/// What a stream carries; `seq` counts per agent and kind, links account per kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// LiDAR sweeps, and what is made of them one to one before detection.
    Points,
    /// BEV feature maps.
    Features,
    /// Detections.
    Boxes,
    /// Poses and velocities of agents.
    AgentState,
    /// Ground truth.
    Truth,
    /// Counters, timings and scores.
    Report,
    /// Measurements of how an agent moves.
    Motion,
}

impl Kind {
    /// Every kind, in accounting order.
    pub const ALL: [Kind; 7] = [
        Kind::Points,
        Kind::Features,
        Kind::Boxes,
        Kind::AgentState,
        Kind::Truth,
        Kind::Report,
        Kind::Motion,
    ];

    /// The kind's name in logs, tables and files.
    pub fn as_str(self) -> &'static str {
        match self {
            Kind::Points => "points",
            Kind::Features => "features",
            Kind::Boxes => "boxes",
            Kind::AgentState => "agent_state",
            Kind::Truth => "truth",
            Kind::Report => "report",
            Kind::Motion => "motion",
        }
    }
}

impl Kind {
    /// The kind of a payload that crosses a link; `None` for those that never do.
    pub fn of(payload: PayloadType) -> Option<Self> {
        match payload {
            PayloadType::PointCloud => Some(Kind::Points),
            PayloadType::FeatureMap => Some(Kind::Features),
            PayloadType::Boxes => Some(Kind::Boxes),
            PayloadType::AgentState => Some(Kind::AgentState),
            _ => None,
        }
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for Kind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Kind::ALL
            .into_iter()
            .find(|kind| kind.as_str() == text)
            .ok_or_else(|| format!("unknown message kind `{text}`"))
    }
}

/// How the log's time line lies on the wall clock in a realtime run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Clock {
    /// Wall time, ns since the epoch, of `log_origin`.
    pub wall_origin: Nanos,
    /// Log time at which the replay starts.
    pub log_origin: Nanos,
    /// Seconds of log time per second of wall time, > 0.
    pub rate: f64,
}

impl Clock {
    /// Of a log that is written now: its time is that of the wall. `now`: ns since the epoch.
    pub fn live(now: Nanos) -> Clock {
        Clock {
            wall_origin: now,
            log_origin: now,
            rate: 1.0,
        }
    }

    /// Log time at a wall time.
    pub fn log_at(&self, wall: Nanos) -> Nanos {
        self.log_origin + ((wall - self.wall_origin) as f64 * self.rate).round() as Nanos
    }

    /// Wall time at a log time.
    pub fn wall_at(&self, log: Nanos) -> Nanos {
        self.wall_origin + ((log - self.log_origin) as f64 / self.rate).round() as Nanos
    }
}

/// Where a message's frame lies in `map` at its stamp.
#[derive(Clone, Debug, PartialEq)]
pub struct Pose {
    /// Maps points of the frame into `map`; metres.
    pub map_from_frame: Isometry3<f64>,
    /// Row-major 6×6 covariance over (x, y, z, roll, pitch, yaw), m² and rad², where known.
    pub covariance: Option<Box<[f64; 36]>>,
}

impl Pose {
    /// A pose without covariance.
    pub fn exact(map_from_frame: Isometry3<f64>) -> Self {
        Pose {
            map_from_frame,
            covariance: None,
        }
    }

    /// A pose from metres and a quaternion (x, y, z, w) that need not be normalised.
    ///
    /// Returns `None` for numbers that are not finite or a quaternion of no length.
    pub fn from_parts(translation: [f64; 3], rotation_xyzw: [f64; 4]) -> Option<Self> {
        let [x, y, z, w] = rotation_xyzw;
        let quaternion = Quaternion::new(w, x, y, z);
        let usable =
            translation.iter().all(|v| v.is_finite()) && quaternion.norm().is_finite() && quaternion.norm() > 1e-9;
        usable.then(|| {
            // A unit quaternion keeps its bits, so that a pose is the same on both sides of a wire.
            let rotation = match (quaternion.norm_squared() - 1.0).abs() < 1e-12 {
                true => UnitQuaternion::new_unchecked(quaternion),
                false => UnitQuaternion::from_quaternion(quaternion),
            };
            let translation = Translation3::new(translation[0], translation[1], translation[2]);
            Pose::exact(Isometry3::from_parts(translation, rotation))
        })
    }

    /// Translation in metres and quaternion (x, y, z, w).
    pub fn to_parts(&self) -> ([f64; 3], [f64; 4]) {
        let t = &self.map_from_frame.translation.vector;
        let q = &self.map_from_frame.rotation;
        ([t.x, t.y, t.z], [q.i, q.j, q.k, q.w])
    }
}

/// One stage of a message's way, on the log's time line.
#[derive(Clone, Debug, PartialEq)]
pub struct TraceEntry {
    /// Node id of the stage.
    pub node: Name,
    /// When the last input that it used was ready.
    pub input: Nanos,
    /// When the stage began with it.
    pub start: Nanos,
    /// When the stage was done.
    pub done: Nanos,
    /// When its output was ready; later than `done` where a link delays it.
    pub ready: Nanos,
}

/// What every message says of itself.
#[derive(Clone, Debug, PartialEq)]
pub struct Header {
    /// Names the run, so that recordings and reports can be told apart; no stage looks at it.
    pub run: Name,
    /// The agent that measured.
    pub agent: Name,
    /// What the stream carries.
    pub kind: Kind,
    /// Number of the measurement, per agent and kind, from 0 at its origin.
    pub seq: u64,
    /// Number of the message on the output that sent it last, from 0; set by the driver.
    pub hop: u64,
    /// The replay's clock, in a realtime run.
    pub clock: Option<Clock>,
    /// The measurement's reference time.
    pub stamp: Nanos,
    /// When the message exists at this point of the graph.
    pub ready: Nanos,
    /// Frame of the payload's coordinates, `<agent>/body` or `map`.
    pub frame: Name,
    /// Where the frame lies in `map` at `stamp`, once it is known.
    pub pose: Option<Pose>,
    /// Where the agent itself was in `map` at `stamp`, m, where `frame` is another agent's: its data were brought there.
    pub position: Option<[f64; 3]>,
    /// The agent that a link delivered the message to.
    pub to: Option<Name>,
    /// The stages that it came through, oldest first.
    pub trace: Vec<TraceEntry>,
}

impl Header {
    /// The header of a measurement at its origin.
    pub fn origin(run: &Name, agent: &Name, kind: Kind, seq: u64, stamp: Nanos, ready: Nanos) -> Self {
        Header {
            run: run.clone(),
            agent: agent.clone(),
            kind,
            seq,
            hop: 0,
            clock: None,
            stamp,
            ready,
            frame: body_frame(agent),
            pose: None,
            position: None,
            to: None,
            trace: Vec::new(),
        }
    }

    /// Where the agent that measured was in `map` at the stamp, m; `None` if nothing says so.
    pub fn sender_position(&self) -> Option<[f64; 3]> {
        let of_own_frame = || {
            let pose = self.pose.as_ref().filter(|_| self.frame == body_frame(&self.agent))?;
            Some(pose.map_from_frame.translation.vector.into())
        };
        self.position.or_else(of_own_frame)
    }

    /// Time from the measurement to `now`.
    pub fn age(&self, now: Nanos) -> Nanos {
        now - self.stamp
    }
}

impl fmt::Display for Header {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(
            f,
            "{} of {}, seq {}, stamp {} ns",
            self.kind, self.agent, self.seq, self.stamp
        )
    }
}

/// Name of an agent's gravity-aligned body frame, `<agent>/body`.
pub fn body_frame(agent: &str) -> Name {
    format!("{agent}/body").into()
}
