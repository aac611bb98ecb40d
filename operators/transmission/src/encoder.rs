use realo_operator::{Counter, Describe, Error, Inputs, Operator, Outputs, Settings};
use realo_schemas::{Elements, Header, Message, Packet, Payload};
use serde::{Deserialize, Serialize};

use crate::Encoder;
use crate::cpm::{Geodetic, OBJECTS};

/// What boxes cross as.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BoxesLayout {
    /// The layout of this crate.
    #[default]
    Plain,
    /// A Collective Perception Message of ETSI TS 103 324 v2.1.1.
    Cpm,
}

/// Settings of the encoder.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Whether the time of each point crosses (4 bytes a point).
    pub time: bool,
    /// Whether the beam of each point crosses (2 bytes a point).
    pub ring: bool,
    /// Step of the coordinates of points, at least 0.000001 m, so that they compress; 0 = exact, not compressed.
    #[setting(range = 0.0..=1.0)]
    pub step_m: f64,
    /// What numbers of feature maps cross as: `f32`, `f16`, or `int8` with a scale for each channel of each map.
    #[setting(default = Elements::Int8)]
    pub elements: Elements,
    /// Whether the bytes of a channel of a feature map lie together, so that they compress better.
    #[setting(default = true)]
    pub shuffle: bool,
    /// Min confidence of a cell of a feature map that crosses; 0 = any.
    #[setting(range = 0.0..=1.0)]
    pub min_confidence: f32,
    /// Bytes that the packet of a feature map may take: its surest cells cross, as many as fit; null = all.
    #[setting(range = 1..)]
    pub budget_bytes: Option<usize>,
    /// Level at which zstd compresses feature maps and quantised points, -7 the fastest, not 0; null = not at all.
    #[setting(default = Some(1), range = -7..=19)]
    pub zstd: Option<i32>,
    /// What boxes cross as: `plain`, or `cpm`, an ETSI Collective Perception Message (TS 103 324 v2.1.1, UPER).
    #[setting(default = BoxesLayout::Plain)]
    pub boxes: BoxesLayout,
    /// Where on Earth the origin of the map is, LAT,LON[,HEIGHT] in degrees and m (WGS84), for cpm.
    pub origin: Geodetic,
    /// Agents that are roadside units, by name, separated by commas; others are vehicles; for cpm.
    #[setting(role = "roadside")]
    pub roadside: String,
    /// Max objects of a CPM; the surest go first; 30 fit one radio frame.
    #[setting(default = OBJECTS, range = 1..=255)]
    pub max_objects: usize,
}

/// Puts points, features, boxes or states into the bytes that cross a link.
#[derive(Describe)]
#[stage(counters(
    BYTES,
    NAN_POINTS,
    INVALID_BOXES,
    BOUNDED_FEATURES,
    LEFT_OUT_CELLS,
    OUT_OF_RANGE_BOXES,
    SURPLUS_BOXES,
    UNTRACKED_BOXES
))]
pub struct TransmissionEncoder {
    encoder: Encoder,
}

const BYTES: Counter = Counter::plain(
    "bytes",
    "bytes made, before the link's range gate; those of a channel are in `links`",
);
const NAN_POINTS: Counter = Counter::plain("nan_points", "points that were not sent: not finite");
const INVALID_BOXES: Counter = Counter::loss(
    "invalid_boxes",
    "boxes that were not sent: not finite, without extent or above 100 m, or with a score outside [0, 1]",
    "boxes were not sent, because no object can have such numbers: they are not finite, their size is not 0 to 100 m or their score \
     not 0 to 1",
    "correct the stage that sends them to {node}",
);
const BOUNDED_FEATURES: Counter = Counter::loss(
    "bounded_features",
    "numbers of feature maps beyond half precision, sent as its max (`elements=f16`)",
    "numbers of feature maps were sent as the max of half precision, because they are beyond it",
    "`--set {node}.elements=f32` or `int8`",
);
const LEFT_OUT_CELLS: Counter = Counter::plain(
    "left_out_cells",
    "cells of feature maps that did not cross: not sure enough (`min_confidence`), or too many for `budget_bytes`",
);
const OUT_OF_RANGE_BOXES: Counter = Counter::loss(
    "out_of_range_boxes",
    "boxes that did not cross as a CPM: too far or too long for its numbers",
    "boxes were not sent, because a CPM has no numbers for them: farther than 1,310.7 m, or longer than 25.4 m",
    "`--set {node}.boxes=plain` sends any box",
);
const SURPLUS_BOXES: Counter = Counter::loss(
    "surplus_boxes",
    "boxes that did not cross as a CPM: beyond `max_objects`",
    "boxes were not sent, because a CPM takes no more (`max_objects`); the surest were",
    "`--set {node}.max_objects=…`, up to 255",
);
const UNTRACKED_BOXES: Counter = Counter::loss(
    "untracked_boxes",
    "boxes that crossed as a CPM without their track: another one of the message has the same `objectId`",
    "boxes were sent without their track, because another box of the message has the same track, or one with the same number of \
     16 bits, which is all that a CPM has",
    "`--set {node}.boxes=plain` sends tracks of 64 bits; tracks up to 65,535 keep their number",
);

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// What an agent says.
    #[port(any_of(PointCloud, FeatureMap, Boxes, AgentState), latest)]
    Messages(Message),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The points, features or boxes as bytes.
    Packets(Header, Packet),
    /// Where the agent is, as bytes.
    StatePackets(Header, Packet),
}

impl Operator for TransmissionEncoder {
    fn build(settings: Settings) -> Result<Self, Error> {
        Ok(TransmissionEncoder {
            encoder: Encoder::new(&settings)?,
        })
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        let Input::Messages(message) = input;
        let (packet, dropped) = self.encoder.encode(&message, out.steps())?;
        let agent = message.header.agent.clone();
        let is_state = matches!(message.payload, Payload::AgentState(_));
        let boxes = match &message.payload {
            Payload::Boxes(boxes) => boxes.0.len() as u64,
            _ => 0,
        };
        out.count(&BYTES, &agent, packet.bytes.len() as u64);
        out.count(&NAN_POINTS, &agent, dropped.points);
        out.count_of(&INVALID_BOXES, &agent, dropped.boxes, boxes);
        out.count(&BOUNDED_FEATURES, &agent, dropped.range);
        out.count(&LEFT_OUT_CELLS, &agent, dropped.cells);
        out.count_of(&OUT_OF_RANGE_BOXES, &agent, dropped.out_of_range, boxes);
        out.count_of(&SURPLUS_BOXES, &agent, dropped.surplus, boxes);
        out.count_of(&UNTRACKED_BOXES, &agent, dropped.tracks, boxes);
        // The pose crosses in the bytes only, so that a receiver cannot come to know it in another way.
        let header = Header {
            pose: None,
            position: None,
            ..message.header
        };
        match is_state {
            true => out.send(Output::StatePackets(header, packet)),
            false => out.send(Output::Packets(header, packet)),
        }
        Ok(())
    }
}
