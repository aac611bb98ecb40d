use realo_operator::{Argument, Describe, Error, Operator, Outputs, Port, PortId, unexpected, wrong_port};
use realo_schemas::{Header, Message, Packet, Payload, PayloadType};
use serde::{Deserialize, Serialize};

use crate::{CODEC, DecodeError, Decoder};

/// Settings of the decoder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DecoderConfig {
    /// Greatest packet that is taken, and greatest feature map or quantised cloud that is made of one, bytes.
    pub max_bytes: usize,
}

impl Default for DecoderConfig {
    fn default() -> Self {
        DecoderConfig { max_bytes: 64 << 20 }
    }
}

/// Payloads that can be fused.
const FUSED: &[PayloadType] = &[PayloadType::PointCloud, PayloadType::FeatureMap, PayloadType::Boxes];

const MESSAGES: PortId = PortId(0);
const STATES: PortId = PortId(1);

/// Gets what an agent said out of its bytes.
pub struct TransmissionDecoder {
    max_bytes: usize,
    decoder: Decoder,
}

impl Describe for TransmissionDecoder {
    type Config = DecoderConfig;
    const NAME: &'static str = "transmission-decoder";
    const ABOUT: &'static str = "Gets points, features, boxes or states out of the bytes that crossed a link";
    const ARGUMENTS: &'static [Argument] = &[Argument {
        name: "max_bytes",
        about: "greatest packet, and greatest feature map or quantised cloud in memory, bytes; a greater one is rejected",
    }];
    const INPUTS: &'static [Port] = &[Port::new("packets", &[PayloadType::Packet], "what a link delivered").latest()];
    const OUTPUTS: &'static [Port] = &[
        Port::new("messages", FUSED, "the points, features or boxes that the sender sent"),
        Port::new("states", &[PayloadType::EgoState], "where the sender was"),
    ];
}

impl TransmissionDecoder {
    fn message(&mut self, header: Header, packet: &Packet, out: &mut Outputs) -> Result<Message, DecodeError> {
        if packet.codec.last().is_none_or(|last| last != CODEC) {
            return Err(DecodeError::Codec(packet.codec.join(", ")));
        }
        if packet.bytes.len() > self.max_bytes {
            return Err(DecodeError::Oversized {
                bytes: packet.bytes.len(),
                limit: self.max_bytes,
            });
        }
        let content = self.decoder.decode(&packet.bytes, out.steps())?;
        content.into_message(header, &packet.codec)
    }
}

impl Operator for TransmissionDecoder {
    fn new(config: DecoderConfig) -> Result<Self, Error> {
        if config.max_bytes == 0 {
            return Err("argument `max_bytes`: expected at least 1, found 0; every packet would be rejected".into());
        }
        Ok(TransmissionDecoder {
            max_bytes: config.max_bytes,
            decoder: Decoder::new(config.max_bytes)?,
        })
    }

    fn on_input(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        if port != PortId(0) {
            return Err(wrong_port(Self::INPUTS, port));
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
