use realo_operator::{Counter, Describe, Error, Inputs, Operator, Outputs, Settings};
use realo_schemas::{AgentState, Header, Kind, Message, Packet, Payload};
use serde::{Deserialize, Serialize};

use crate::cpm::Geodetic;
use crate::{DecodeError, Decoder};

/// Settings of the decoder.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Max packet, and max feature map or quantised cloud in memory, bytes; a greater one is rejected.
    #[setting(default = 64 << 20, range = 1..)]
    pub max_bytes: usize,
    /// Where on Earth the origin of the map is, LAT,LON[,HEIGHT] in degrees and m (WGS84), for cpm.
    pub origin: Geodetic,
    /// Takes packets of one kind only, `points`, `features`, `boxes` or `agent_state`; null = all. Use it where several kinds
    /// cross to one ego.
    pub kind: Option<Kind>,
}

/// Gets points, features, boxes or states out of the bytes that crossed a link.
#[derive(Describe)]
#[stage(counters(UNUSABLE_OBJECTS, ASSUMED_OBJECTS, UNREAD_CONTAINERS, SEGMENTS))]
pub struct TransmissionDecoder {
    max_bytes: usize,
    kind: Option<Kind>,
    decoder: Decoder,
}

const UNUSABLE_OBJECTS: Counter = Counter::loss(
    "unusable_objects",
    "objects of CPMs that make no box",
    "objects of CPMs were left out, because they lack a position, length, width or angle, or the time of their measurement",
    "their sender has to say these (docs/reference/packets.md, \"From other stacks\")",
);
const ASSUMED_OBJECTS: Counter = Counter::loss(
    "assumed_objects",
    "boxes of CPMs of which something was assumed",
    "boxes of CPMs have a height, angle, class or score that was assumed, because their sender does not say it",
    "docs/reference/packets.md, \"From other stacks\", has what is assumed",
);
const UNREAD_CONTAINERS: Counter = Counter::loss(
    "unread_containers",
    "containers of CPMs that are not read",
    "containers of CPMs were not read",
    "objects are taken from perceived object containers only (docs/reference/packets.md)",
);
const SEGMENTS: Counter = Counter::loss(
    "segments",
    "CPMs that are one of several segments",
    "CPMs are one of several segments, and only the newest segment of a moment is fused",
    "have their sender put all objects into one message",
);

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// What a link delivered.
    #[port(latest)]
    Packets(Header, Packet),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The points, features or boxes that the sender sent.
    #[port(any_of(PointCloud, FeatureMap, Boxes))]
    Messages(Message),
    /// Where the sender was.
    States(Header, AgentState),
}

impl TransmissionDecoder {
    fn message(&mut self, header: Header, packet: &Packet, out: &mut Outputs<Output>) -> Result<Message, DecodeError> {
        if packet.bytes.len() > self.max_bytes {
            return Err(DecodeError::Oversized {
                bytes: packet.bytes.len(),
                limit: self.max_bytes,
            });
        }
        let (message, unused) = self.decoder.message(header, packet, out.steps())?;
        let agent = message.header.agent.clone();
        let boxes = match &message.payload {
            Payload::Boxes(boxes) => boxes.0.len() as u64,
            _ => 0,
        };
        out.count_of(&UNUSABLE_OBJECTS, &agent, unused.objects, boxes + unused.objects);
        out.count_of(&ASSUMED_OBJECTS, &agent, unused.assumed, boxes);
        out.count(&UNREAD_CONTAINERS, &agent, unused.containers);
        out.count_of(&SEGMENTS, &agent, unused.segments, 1);
        Ok(message)
    }
}

impl Operator for TransmissionDecoder {
    fn build(settings: Settings) -> Result<Self, Error> {
        Ok(TransmissionDecoder {
            max_bytes: settings.max_bytes,
            kind: settings.kind,
            decoder: Decoder::new(settings.max_bytes)?.with_origin(settings.origin),
        })
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        let Input::Packets(header, packet) = input;
        if self.kind.is_some_and(|kind| kind != header.kind) {
            return Ok(());
        }
        let message = self.message(header, &packet, out)?;
        match message.payload {
            Payload::AgentState(state) => out.send(Output::States(message.header, state)),
            _ => out.send(Output::Messages(message)),
        }
        Ok(())
    }
}
