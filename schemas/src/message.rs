use std::fmt;

use serde::{Deserialize, Serialize};

use crate::{AgentState, Boxes, FeatureMap, GroundTruth, Header, Motion, Packet, PointCloud, Report, Selection};

/// A header and what it speaks of.
#[derive(Clone, Debug, PartialEq)]
pub struct Message {
    /// What the message says of itself.
    pub header: Header,
    /// What it carries.
    pub payload: Payload,
}

/// The content of a message. Columns are shared, so that a clone of a cloud or map copies no data.
#[derive(Clone, Debug, PartialEq)]
pub enum Payload {
    /// Points of a sweep.
    PointCloud(PointCloud),
    /// An agent's pose and motion.
    AgentState(AgentState),
    /// A BEV feature map.
    FeatureMap(FeatureMap),
    /// Bytes on a link.
    Packet(Packet),
    /// The bank's answer to a query.
    Selection(Selection),
    /// Counters, timings, scores.
    Report(Report),
    /// Detections.
    Boxes(Boxes),
    /// What is really there.
    GroundTruth(GroundTruth),
    /// Measurements of how an agent moves.
    Motion(Motion),
}

/// The type of a payload, as ports declare it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[allow(missing_docs)]
pub enum PayloadType {
    PointCloud,
    AgentState,
    FeatureMap,
    Packet,
    Selection,
    Report,
    Boxes,
    GroundTruth,
    Motion,
}

impl PayloadType {
    /// Every type.
    pub const ALL: [PayloadType; 9] = [
        PayloadType::PointCloud,
        PayloadType::AgentState,
        PayloadType::FeatureMap,
        PayloadType::Packet,
        PayloadType::Selection,
        PayloadType::Report,
        PayloadType::Boxes,
        PayloadType::GroundTruth,
        PayloadType::Motion,
    ];

    /// The type's name, also in graphs after `realo/v1/`.
    pub fn as_str(self) -> &'static str {
        match self {
            PayloadType::PointCloud => "PointCloud",
            PayloadType::AgentState => "AgentState",
            PayloadType::FeatureMap => "FeatureMap",
            PayloadType::Packet => "Packet",
            PayloadType::Selection => "Selection",
            PayloadType::Report => "Report",
            PayloadType::Boxes => "Boxes",
            PayloadType::GroundTruth => "GroundTruth",
            PayloadType::Motion => "Motion",
        }
    }
}

impl fmt::Display for PayloadType {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl std::str::FromStr for PayloadType {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        PayloadType::ALL
            .into_iter()
            .find(|t| t.as_str() == text)
            .ok_or_else(|| format!("unknown payload type `{text}`"))
    }
}

impl Payload {
    /// The payload's type.
    pub fn payload_type(&self) -> PayloadType {
        match self {
            Payload::PointCloud(_) => PayloadType::PointCloud,
            Payload::AgentState(_) => PayloadType::AgentState,
            Payload::FeatureMap(_) => PayloadType::FeatureMap,
            Payload::Packet(_) => PayloadType::Packet,
            Payload::Selection(_) => PayloadType::Selection,
            Payload::Report(_) => PayloadType::Report,
            Payload::Boxes(_) => PayloadType::Boxes,
            Payload::GroundTruth(_) => PayloadType::GroundTruth,
            Payload::Motion(_) => PayloadType::Motion,
        }
    }
}

macro_rules! conversions {
    ($($variant:ident),*) => {$(
        impl From<$variant> for Payload {
            fn from(payload: $variant) -> Self {
                Payload::$variant(payload)
            }
        }

        impl TryFrom<Message> for (Header, $variant) {
            type Error = UnexpectedPayload;

            fn try_from(message: Message) -> Result<Self, UnexpectedPayload> {
                match message.payload {
                    Payload::$variant(payload) => Ok((message.header, payload)),
                    other => Err(UnexpectedPayload {
                        expected: PayloadType::$variant,
                        found: other.payload_type(),
                        message: message.header.to_string(),
                    }),
                }
            }
        }
    )*};
}
conversions!(
    PointCloud,
    AgentState,
    FeatureMap,
    Packet,
    Selection,
    Report,
    Boxes,
    GroundTruth,
    Motion
);

/// A message of another type than the port's.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("expected a {expected}, found a {found} ({message})")]
pub struct UnexpectedPayload {
    /// What the port takes.
    pub expected: PayloadType,
    /// What came.
    pub found: PayloadType,
    /// The header of what came.
    pub message: String,
}

impl Message {
    /// A message.
    pub fn new(header: Header, payload: impl Into<Payload>) -> Self {
        Message {
            header,
            payload: payload.into(),
        }
    }

    /// Takes the message apart as one type: `let (header, boxes): (Header, Boxes) = message.into_parts()?`.
    ///
    /// # Errors
    /// [`UnexpectedPayload`] if it carries another type.
    pub fn into_parts<P>(self) -> Result<(Header, P), UnexpectedPayload>
    where
        (Header, P): TryFrom<Message, Error = UnexpectedPayload>,
    {
        self.try_into()
    }
}
