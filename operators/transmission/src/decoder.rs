use realo_operator::{Argument, Counter, Describe, Error, Operator, Outputs, Port, PortId, unexpected, wrong_port};
use realo_schemas::{Header, Kind, Message, Packet, Payload, PayloadType};
use serde::{Deserialize, Serialize};

use crate::cpm::Geodetic;
use crate::{DecodeError, Decoder};

/// Settings of the decoder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DecoderConfig {
    /// Largest packet that is taken, and largest feature map or quantised cloud that is made of one, bytes.
    pub max_bytes: usize,
    /// Where on Earth the origin of `map` is, for CPMs.
    pub origin: Geodetic,
    /// The only kind that is taken, where others are for another decoder; `None`: all.
    pub kind: Option<Kind>,
}

impl Default for DecoderConfig {
    fn default() -> Self {
        DecoderConfig {
            max_bytes: 64 << 20,
            origin: Geodetic::default(),
            kind: None,
        }
    }
}

/// Payloads that can be fused.
const FUSED: &[PayloadType] = &[PayloadType::PointCloud, PayloadType::FeatureMap, PayloadType::Boxes];

const MESSAGES: PortId = PortId(0);
const STATES: PortId = PortId(1);

/// Gets what an agent said out of its bytes.
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

impl Describe for TransmissionDecoder {
    type Config = DecoderConfig;
    const NAME: &'static str = "transmission-decoder";
    const ABOUT: &'static str = "Gets points, features, boxes or states out of the bytes that crossed a link";
    const ARGUMENTS: &'static [Argument] = &[
        Argument {
            name: "max_bytes",
            about: "max packet, and max feature map or quantised cloud in memory, bytes; a greater one is rejected",
        },
        Argument {
            name: "origin",
            about: "where on Earth the origin of the map is, LAT,LON[,HEIGHT] in degrees and m (WGS84), for cpm",
        },
        Argument {
            name: "kind",
            about: "take packets of this kind only, points, features, boxes or agent_state, for another decoder takes the others; null = all",
        },
    ];
    const INPUTS: &'static [Port] = &[Port::new("packets", &[PayloadType::Packet], "what a link delivered").latest()];
    const OUTPUTS: &'static [Port] = &[
        Port::new("messages", FUSED, "the points, features or boxes that the sender sent"),
        Port::new("states", &[PayloadType::AgentState], "where the sender was"),
    ];
    const COUNTERS: &'static [Counter] = &[UNUSABLE_OBJECTS, ASSUMED_OBJECTS, UNREAD_CONTAINERS, SEGMENTS];
}

impl TransmissionDecoder {
    fn message(&mut self, header: Header, packet: &Packet, out: &mut Outputs) -> Result<Message, DecodeError> {
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
    fn new(config: DecoderConfig) -> Result<Self, Error> {
        if config.max_bytes == 0 {
            return Err("argument `max_bytes`: expected at least 1, found 0; every packet would be rejected".into());
        }
        Ok(TransmissionDecoder {
            max_bytes: config.max_bytes,
            kind: config.kind,
            decoder: Decoder::new(config.max_bytes)?.with_origin(config.origin),
        })
    }

    fn on_input(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        if port != PortId(0) {
            return Err(wrong_port(Self::INPUTS, port));
        }
        if self.kind.is_some_and(|kind| kind != message.header.kind) {
            return Ok(());
        }
        let (header, packet): (Header, Packet) = message.into_parts().map_err(unexpected)?;
        let message = self.message(header, &packet, out)?;
        let port = match message.payload {
            Payload::AgentState(_) => STATES,
            _ => MESSAGES,
        };
        out.send(port, message);
        Ok(())
    }
}
