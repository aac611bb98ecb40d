use std::collections::BTreeMap;

use realo_operator::{Counter, Describe, Error, Inputs, Operator, Outputs, Settings};
use realo_schemas::geometry::{is_valid, relative, transform_box};
use realo_schemas::report::{ON_AIR, OnAir, from_report};
use realo_schemas::{Box3, Boxes, Elements, Header, Message, Name, Packet, Payload, PoseStatus, Report, body_frame};
use serde::{Deserialize, Serialize};

use crate::cells::Covering;
use crate::cpm::{Geodetic, OBJECTS};
use crate::{Budget, Dropped, EncodeError, Encoder};

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
    /// Whether `budget_bytes` is only the max, and the bytes of a frame follow what the input `on_air` says of the channel.
    pub follow: bool,
    /// Whether the sender's own boxes, on the input `detected`, cross before the map of the same sweep and on its budget.
    pub detected: bool,
    /// What the confidence of a cell counts under a box of score 1 among those that crossed before the map, of 1: cells that no box
    /// says everything about cross first.
    #[setting(default = 0.1, range = 0.0..=1.0)]
    pub covered: f32,
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
    BUDGETS,
    BUDGET_BYTES,
    UNSENT_MAPS,
    UNPAIRED_MAPS,
    DROPPED_PACKETS,
    OUT_OF_RANGE_BOXES,
    SURPLUS_BOXES,
    UNTRACKED_BOXES,
    UNPLACED_MESSAGES
))]
pub struct TransmissionEncoder {
    encoder: Encoder,
    budget_bytes: Option<usize>,
    follow: bool,
    detected: bool,
    covered: f32,
    senders: BTreeMap<Name, Sender>,
}

/// What is known of one sender.
#[derive(Default)]
struct Sender {
    /// Where it follows the link.
    budget: Option<Budget>,
    /// A map that waits for the boxes of its sweep.
    map: Option<Message>,
    /// The last boxes that crossed.
    boxes: Option<Crossed>,
}

/// Boxes that crossed before a map.
struct Crossed {
    header: Header,
    boxes: Vec<Box3>,
    bytes: usize,
}

impl Crossed {
    /// The boxes in the frame of a map; none where it is not known where that is.
    fn in_frame_of(&self, map: &Header) -> Vec<Box3> {
        let valid = self.boxes.iter().filter(|object| is_valid(object));
        if self.header.frame == map.frame {
            return valid.cloned().collect();
        }
        let (Some(to), Some(from)) = (&map.pose, &self.header.pose) else {
            return Vec::new();
        };
        let to_from_from = relative(&to.map_from_frame, &from.map_from_frame);
        valid.map(|object| transform_box(&to_from_from, object)).collect()
    }
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
const BUDGETS: Counter = Counter::plain("budgets", "frames whose bytes followed the link (`follow`)");
const BUDGET_BYTES: Counter = Counter::plain(
    "budget_bytes",
    "bytes that those frames might take, boxes included; by `budgets` it is the mean budget",
);
const UNSENT_MAPS: Counter = Counter::plain(
    "unsent_maps",
    "feature maps that did not cross: the budget had no room for a map beside the boxes, or none at all (`follow`, `detected`)",
);
const UNPAIRED_MAPS: Counter = Counter::plain(
    "unpaired_maps",
    "feature maps that did not cross: the boxes of their sweep did not come before the next map (`detected`)",
);
const DROPPED_PACKETS: Counter = Counter::plain(
    "dropped_packets",
    "packets that the sender's own queue dropped, as `on_air` says; those of a channel are `lost` in `links`",
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
const UNPLACED_MESSAGES: Counter = Counter::loss(
    "unplaced_messages",
    "messages in the sender's own frame that were not sent: it did not know where it was",
    "messages were not sent, because the agent did not know where it was",
    "localization says why: look at its notes, or at the agent's poses (`realo info`)",
);

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// What an agent says.
    #[port(any_of(PointCloud, FeatureMap, Boxes, AgentState), latest)]
    Messages(Message),
    /// What the agent detected in the sweeps of its maps.
    #[port(latest, needed_when("detected", "true"))]
    Detected(Header, Boxes),
    /// Topic `on_air`: what a link or radio says of the agent's own packets.
    #[port(state, feedback, needed_when("follow", "true"))]
    OnAir(Header, Report),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The points, features or boxes as bytes.
    Packets(Header, Packet),
    /// Where the agent is, as bytes.
    StatePackets(Header, Packet),
}

/// Whether nobody can use a message, since it is in a frame that nobody knows the place of; counts it.
fn is_unplaced(input: &Input, out: &mut Outputs<Output>) -> bool {
    let nowhere = |header: &Header| header.pose.is_none() && header.frame == body_frame(&header.agent);
    let (header, is_unplaced) = match input {
        Input::OnAir(..) => return false,
        Input::Detected(header, _) => (header, nowhere(header)),
        Input::Messages(Message { header, payload, .. }) => match payload {
            Payload::AgentState(state) => (header, matches!(state.status, PoseStatus::Init | PoseStatus::Lost)),
            _ => (header, nowhere(header)),
        },
    };
    out.count_of(&UNPLACED_MESSAGES, &header.agent, u64::from(is_unplaced), 1);
    is_unplaced
}

impl TransmissionEncoder {
    /// Sends a message of its own accord, whatever else its sender sends.
    fn send(&mut self, message: &Message, out: &mut Outputs<Output>) -> Result<usize, Error> {
        let (packet, dropped) = self.encoder.encode(message, out.steps())?;
        Ok(sent(message, packet, dropped, out))
    }

    /// Sends a map within the budget of its sender, beside the boxes of its sweep.
    fn send_map(&mut self, map: &Message, out: &mut Outputs<Output>) -> Result<(), Error> {
        let (now, agent) = (out.now(), map.header.agent.clone());
        let sender = self.senders.entry(agent.clone()).or_default();
        let whole = match (self.follow, self.budget_bytes) {
            (true, Some(max)) => {
                let budget = sender.budget.get_or_insert_with(|| Budget::new(max));
                let bytes = budget.next(now);
                out.count(&BUDGETS, &agent, 1);
                out.count(&BUDGET_BYTES, &agent, bytes as u64);
                Some(bytes)
            }
            (_, fixed) => fixed,
        };
        let crossed = sender
            .boxes
            .as_ref()
            .filter(|crossed| crossed.header.seq == map.header.seq);
        let taken = crossed.map_or(0, |crossed| crossed.bytes);
        let boxes = crossed.map(|crossed| crossed.in_frame_of(&map.header));
        let covering = boxes.as_ref().map(|boxes| Covering {
            boxes,
            covered: self.covered,
        });
        let rest = whole.map(|whole| whole.saturating_sub(taken));
        match self.encoder.encode_beside(map, rest, covering, out.steps()) {
            Ok((packet, dropped)) => {
                sent(map, packet, dropped, out);
                Ok(())
            }
            // A budget of the settings alone that holds no map is a mistake; what is left of one may be anything.
            Err(EncodeError::Budget { .. }) if self.follow || self.detected => {
                out.count(&UNSENT_MAPS, &agent, 1);
                Ok(())
            }
            Err(error) => Err(error.into()),
        }
    }

    /// Sends the boxes of a sweep, and the map that waits for them.
    fn send_detected(&mut self, header: Header, boxes: Boxes, out: &mut Outputs<Output>) -> Result<(), Error> {
        let message = Message::new(header, boxes.clone());
        let bytes = self.send(&message, out)?;
        let header = message.header;
        let sender = self.senders.entry(header.agent.clone()).or_default();
        let seq = header.seq;
        let boxes = boxes.0;
        sender.boxes = Some(Crossed { header, boxes, bytes });
        match sender.map.take_if(|map| map.header.seq == seq) {
            Some(map) => self.send_map(&map, out),
            None => Ok(()),
        }
    }

    /// Sends a map whose boxes have crossed; another one waits for them.
    fn take_map(&mut self, map: Message, out: &mut Outputs<Output>) -> Result<(), Error> {
        let sender = self.senders.entry(map.header.agent.clone()).or_default();
        let crossed = sender.boxes.as_ref().map(|crossed| crossed.header.seq);
        if crossed == Some(map.header.seq) {
            return self.send_map(&map, out);
        }
        if let Some(older) = sender.map.replace(map) {
            out.count(&UNPAIRED_MAPS, &older.header.agent, 1);
        }
        Ok(())
    }

    fn hear(&mut self, header: &Header, report: &Report, out: &mut Outputs<Output>) -> Result<(), Error> {
        if &*report.topic != ON_AIR {
            return Err(EncodeError::Topic(report.topic.to_string()).into());
        }
        let word: OnAir = from_report(report)?;
        out.count(&DROPPED_PACKETS, &header.agent, u64::from(word.dropped));
        if let (true, Some(max)) = (self.follow, self.budget_bytes) {
            let sender = self.senders.entry(header.agent.clone()).or_default();
            let budget = sender.budget.get_or_insert_with(|| Budget::new(max));
            budget.heard(&word, out.now());
        }
        Ok(())
    }
}

/// Sends a packet and counts what became of its message; gives the packet's bytes.
fn sent(message: &Message, packet: Packet, dropped: Dropped, out: &mut Outputs<Output>) -> usize {
    let agent = message.header.agent.clone();
    let is_state = matches!(message.payload, Payload::AgentState(_));
    let boxes = match &message.payload {
        Payload::Boxes(boxes) => boxes.0.len() as u64,
        _ => 0,
    };
    let bytes = packet.bytes.len();
    out.count(&BYTES, &agent, bytes as u64);
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
        ..message.header.clone()
    };
    match is_state {
        true => out.send(Output::StatePackets(header, packet)),
        false => out.send(Output::Packets(header, packet)),
    }
    bytes
}

impl Operator for TransmissionEncoder {
    fn build(settings: Settings) -> Result<Self, Error> {
        if settings.follow && settings.budget_bytes.is_none() {
            return Err(EncodeError::NoMax.into());
        }
        Ok(TransmissionEncoder {
            encoder: Encoder::new(&settings)?,
            budget_bytes: settings.budget_bytes,
            follow: settings.follow,
            detected: settings.detected,
            covered: settings.covered,
            senders: BTreeMap::new(),
        })
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        if is_unplaced(&input, out) {
            return Ok(());
        }
        match input {
            Input::Messages(message) => match message.payload {
                Payload::FeatureMap(_) if self.detected => self.take_map(message, out),
                Payload::FeatureMap(_) => self.send_map(&message, out),
                _ => self.send(&message, out).map(drop),
            },
            Input::Detected(header, boxes) => self.send_detected(header, boxes, out),
            Input::OnAir(header, report) => self.hear(&header, &report, out),
        }
    }

    fn on_end(&mut self, out: &mut Outputs<Output>) -> Result<(), Error> {
        for (agent, sender) in &mut self.senders {
            out.count(&UNPAIRED_MAPS, agent, u64::from(sender.map.take().is_some()));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
