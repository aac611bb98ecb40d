use arrow::buffer::Buffer;
use realo_operator::{Argument, Describe, Error, Operator, Outputs, Port, PortId, wrong_port};
use realo_schemas::{Header, Message, Packet, PayloadType};
use serde::{Deserialize, Serialize};

use crate::{CODEC, Columns, encode};

/// Payloads that a link carries.
pub(crate) const CARRIED: &[PayloadType] = &[
    PayloadType::PointCloud,
    PayloadType::FeatureMap,
    PayloadType::Boxes,
    PayloadType::EgoState,
];

/// Settings of the encoder.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EncoderConfig {
    /// Whether the times of points cross.
    pub time: bool,
    /// Whether the beams of points cross.
    pub ring: bool,
}

/// Puts what an agent says into bytes.
pub struct TransmissionEncoder {
    columns: Columns,
}

const MESSAGES: PortId = PortId(0);
const PACKETS: PortId = PortId(0);

impl Describe for TransmissionEncoder {
    type Config = EncoderConfig;
    const NAME: &'static str = "transmission-encoder";
    const ABOUT: &'static str = "Puts points, features, boxes or states into the bytes that cross a link";
    const ARGUMENTS: &'static [Argument] = &[
        Argument {
            name: "time",
            about: "whether the time of each point crosses (4 bytes a point)",
        },
        Argument {
            name: "ring",
            about: "whether the beam of each point crosses (2 bytes a point)",
        },
    ];
    const INPUTS: &'static [Port] = &[Port::new("messages", CARRIED, "what an agent says").latest()];
    const OUTPUTS: &'static [Port] = &[Port::new("packets", &[PayloadType::Packet], "the same as bytes")];
}

impl Operator for TransmissionEncoder {
    fn new(config: EncoderConfig) -> Result<Self, Error> {
        Ok(TransmissionEncoder {
            columns: Columns {
                time: config.time,
                ring: config.ring,
            },
        })
    }

    fn on_input(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        if port != MESSAGES {
            return Err(wrong_port(Self::INPUTS, port));
        }
        let (bytes, dropped) = encode(&message, self.columns)?;
        out.count("nan_points", dropped.points);
        out.count("invalid_boxes", dropped.boxes);
        out.count("bytes", bytes.len() as u64);
        // The pose crosses in the bytes only, so that a receiver cannot come to know it in another way.
        let header = Header {
            pose: None,
            ..message.header
        };
        let packet = Packet {
            codec: vec![CODEC.into()],
            bytes: Buffer::from_vec(bytes),
        };
        out.send(PACKETS, Message::new(header, packet));
        Ok(())
    }
}
