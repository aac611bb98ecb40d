use realo_operator::{Argument, Describe, Error, Operator, Outputs, Port, PortId, unexpected, wrong_port};
use realo_schemas::{Header, Kind, Message, Packet, Payload, PayloadType};
use serde::{Deserialize, Serialize};

use crate::cpm::Geodetic;
use crate::{DecodeError, Decoder};

/// Settings of the decoder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DecoderConfig {
    /// Greatest packet that is taken, and greatest feature map or quantised cloud that is made of one, bytes.
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

impl Describe for TransmissionDecoder {
    type Config = DecoderConfig;
    const NAME: &'static str = "transmission-decoder";
    const ABOUT: &'static str = "Gets points, features, boxes or states out of the bytes that crossed a link";
    const ARGUMENTS: &'static [Argument] = &[
        Argument {
            name: "max_bytes",
            about: "greatest packet, and greatest feature map or quantised cloud in memory, bytes; a greater one is rejected",
        },
        Argument {
            name: "origin",
            about: "where on Earth the origin of the map is, LAT,LON[,HEIGHT] in degrees and m (WGS84), for cpm",
        },
        Argument {
            name: "kind",
            about: "take packets of this kind only, points, features, boxes or ego_state, for another decoder takes the others; null = all",
        },
    ];
    const INPUTS: &'static [Port] = &[Port::new("packets", &[PayloadType::Packet], "what a link delivered").latest()];
    const OUTPUTS: &'static [Port] = &[
        Port::new("messages", FUSED, "the points, features or boxes that the sender sent"),
        Port::new("states", &[PayloadType::EgoState], "where the sender was"),
    ];
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
        out.count("unusable_objects", unused.objects);
        out.count("assumed_objects", unused.assumed);
        out.count("unread_containers", unused.containers);
        out.count("segments", unused.segments);
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
            Payload::EgoState(_) => STATES,
            _ => MESSAGES,
        };
        out.send(port, message);
        Ok(())
    }
}
