//! The vocabulary of realo: what the parts of a graph say to each other.
//!
//! A [`Message`] is a [`Header`] and a [`Payload`]; on the wire it is one row of an Arrow struct array ([`wire`]).
//! [`geometry`] holds what follows from frames and boxes alone. No I/O, no dora, no networks.

pub mod feature_map;
pub mod geometry;
mod header;
pub mod layout;
mod message;
pub mod motion;
mod payload;
pub mod report;
mod time;
pub mod wire;

pub use header::{Clock, Header, Kind, Name, Pose, TraceEntry, body_frame};
pub use message::{Message, Payload, PayloadType, UnexpectedPayload};
pub use motion::{FixQuality, GnssFix, ImuSample, Motion, WheelSpeed};
pub use payload::{
    AgentState, Box3, Boxes, DType, Elements, FeatureMap, GroundTruth, OwnLabels, Packet, PointCloud, PoseStatus,
    Report, Selection,
};
pub use time::{
    Nanos, OFFLINE_REACH, SAME_STAMP, are_one_time_line, from_seconds, is_same_stamp, to_millis, to_seconds,
};
