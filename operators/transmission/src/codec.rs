//! A message to bytes and back.

use arrow::buffer::Buffer;
use realo_operator::{StageSettings, Steps};
use realo_schemas::{Header, Kind, Message, Packet, Payload};

use crate::bytes::Reader;
use crate::cells::Covering;
use crate::cpm::{self, Geodetic, Unused};
use crate::encoder::BoxesLayout;
use crate::envelope::Envelope;
use crate::error::{DecodeError, EncodeError};
use crate::{EncoderSettings, agent_state, boxes, envelope, features, points};

/// The last codec of every packet that is no CPM, in [`Packet::codec`]; before it stands how the points of a cloud or
/// the elements of a feature map crossed.
pub const CODEC: &str = "plain";

/// Columns of a cloud that cross beside coordinates and intensity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Columns {
    /// Time of each point.
    pub time: bool,
    /// Beam of each point.
    pub ring: bool,
}

/// What was left out of a packet, or bounded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Dropped {
    /// Points that are not finite.
    pub points: u64,
    /// Boxes that are not valid.
    pub boxes: u64,
    /// Features beyond the range of half precision; its largest number was sent for them.
    pub range: u64,
    /// Cells of a feature map that are not sure enough, or too many for its budget.
    pub cells: u64,
    /// Boxes that a CPM has no numbers for: farther than 1,310.7 m from its sender, or longer than 25.4 m.
    pub out_of_range: u64,
    /// Boxes beyond the number that a CPM may have, the least sure ones.
    pub surplus: u64,
    /// Boxes whose track another box of the same CPM has, or whose track has the same number of 16 bits.
    pub tracks: u64,
}

/// What bytes say; see [`Decoder::decode`].
pub struct Content {
    envelope: Envelope,
    /// Codecs that made the bytes.
    codec: Vec<String>,
    /// The payload.
    pub payload: Payload,
}

impl Content {
    /// The content as a message: agent, kind, seq, stamp, frame and pose are the sender's, the rest stays as in the
    /// packet's header.
    ///
    /// # Errors
    /// [`DecodeError::Forged`] if the packet says another codec, or its header another agent, kind, seq or stamp.
    pub fn into_message(self, packet: Header, codec: &[String]) -> Result<Message, DecodeError> {
        same("codec", &codec.join(", "), &self.codec.join(", "))?;
        let Envelope {
            kind,
            seq,
            stamp,
            agent,
            frame,
            pose,
            position,
        } = self.envelope;
        same("agent", &packet.agent, &agent)?;
        same("kind", &packet.kind, &kind)?;
        same("seq", &packet.seq, &seq)?;
        same("stamp", &packet.stamp, &stamp)?;
        Ok(Message {
            header: Header {
                kind,
                seq,
                stamp,
                agent,
                frame,
                pose,
                position,
                ..packet
            },
            payload: self.payload,
        })
    }
}

pub(crate) fn same<T: PartialEq + ToString>(field: &'static str, header: &T, content: &T) -> Result<(), DecodeError> {
    if header == content {
        return Ok(());
    }
    Err(DecodeError::Forged {
        field,
        header: header.to_string(),
        content: content.to_string(),
    })
}

/// Puts messages into bytes, laid out as the crate's documentation says; what it works in serves one after another.
pub struct Encoder {
    points: points::Writer,
    features: features::Writer,
    /// Where boxes cross as CPMs.
    cpm: Option<cpm::Writer>,
}

impl Encoder {
    /// An encoder.
    ///
    /// # Errors
    /// A setting outside its range, level 0 of zstd, or a step that clouds cannot have.
    pub fn new(config: &EncoderSettings) -> Result<Self, EncodeError> {
        config.check()?;
        // zstd takes it for level 3.
        if config.zstd == Some(0) {
            return Err(EncodeError::NoLevel);
        }
        if config.step_m != 0.0 && !points::STEPS.contains(&config.step_m) {
            return Err(EncodeError::Step(config.step_m));
        }
        let columns = Columns {
            time: config.time,
            ring: config.ring,
        };
        let no_memory = |error: std::io::Error| EncodeError::Zstd(error.to_string());
        let points = points::Writer::new(columns, config.step_m, config.zstd);
        let features = features::Writer::new(config);
        Ok(Encoder {
            points: points.map_err(no_memory)?,
            features: features.map_err(no_memory)?,
            cpm: (config.boxes == BoxesLayout::Cpm).then(|| cpm::Writer::new(config)),
        })
    }

    /// A message as a packet, and what was left out of it; of a cloud and a feature map the steps are timed.
    ///
    /// # Errors
    /// [`EncodeError`] if no link carries the payload, or a number or length in it cannot be sent.
    pub fn encode(&mut self, message: &Message, steps: &mut Steps) -> Result<(Packet, Dropped), EncodeError> {
        self.encode_beside(message, None, None, steps)
    }

    /// The same of a map with a budget of its own, whose cells are chosen by what crosses beside it.
    pub(crate) fn encode_beside(
        &mut self,
        message: &Message,
        budget: Option<usize>,
        covering: Option<Covering>,
        steps: &mut Steps,
    ) -> Result<(Packet, Dropped), EncodeError> {
        let (header, payload) = (&message.header, &message.payload);
        let refused = || EncodeError::Content {
            payload: payload.payload_type().as_str(),
            kind: header.kind.as_str(),
        };
        if kind_of(payload) != Some(header.kind) {
            return Err(refused());
        }
        if let (Some(writer), Payload::Boxes(boxes)) = (&self.cpm, payload) {
            let (bytes, dropped) = writer.write(header, boxes)?;
            let (codec, bytes) = (vec![cpm::CODEC.into()], Buffer::from_vec(bytes));
            return Ok((Packet { codec, bytes }, dropped));
        }
        let (mut out, mut dropped, mut codec) = (Vec::new(), Dropped::default(), Vec::new());
        let mut untimed = Steps::default();
        let steps = match header.kind {
            Kind::Points | Kind::Features => steps,
            _ => &mut untimed,
        };
        steps.time("packaging", || envelope::write(&mut out, header))?;
        match payload {
            Payload::PointCloud(cloud) => {
                let (coding, not_finite) = self.points.write(&mut out, cloud, steps)?;
                codec.extend(coding.steps().map(String::from));
                dropped.points = not_finite;
            }
            Payload::FeatureMap(map) => {
                let written = self.features.write(&mut out, map, budget, covering, steps)?;
                codec.extend(written.coding.steps().map(String::from));
                (dropped.range, dropped.cells) = (written.beyond, written.left_out);
            }
            Payload::Boxes(list) => dropped.boxes = boxes::write(&mut out, list)?,
            Payload::AgentState(state) => agent_state::write(&mut out, state)?,
            _ => return Err(refused()),
        }
        codec.push(CODEC.into());
        let bytes = Buffer::from_vec(out);
        Ok((Packet { codec, bytes }, dropped))
    }
}

/// What a link carries a payload as.
fn kind_of(payload: &Payload) -> Option<Kind> {
    match payload {
        Payload::PointCloud(_) => Some(Kind::Points),
        Payload::FeatureMap(_) => Some(Kind::Features),
        Payload::Boxes(_) => Some(Kind::Boxes),
        Payload::AgentState(_) => Some(Kind::AgentState),
        _ => None,
    }
}

/// Gets messages out of bytes; what it works in serves one after another.
pub struct Decoder {
    points: points::Parser,
    features: features::Parser,
    cpm: cpm::Parser,
}

impl Decoder {
    /// A decoder that makes feature maps and quantised clouds up to so many bytes.
    ///
    /// # Errors
    /// If zstd has no memory.
    pub fn new(max_bytes: usize) -> std::io::Result<Self> {
        Ok(Decoder {
            points: points::Parser::new(max_bytes)?,
            features: features::Parser::new(max_bytes)?,
            cpm: cpm::Parser::default(),
        })
    }

    /// The same decoder, of CPMs about a map with this origin; without it that is 0 degrees north, 0 degrees east.
    pub fn with_origin(mut self, origin: Geodetic) -> Self {
        self.cpm.origin = origin;
        self
    }

    /// The message in a packet, whatever its codec, and what of a CPM did not become boxes.
    ///
    /// # Errors
    /// [`DecodeError`] names the field that was wrong, or that the packet's header contradicts.
    pub fn message(
        &mut self,
        header: Header,
        packet: &Packet,
        steps: &mut Steps,
    ) -> Result<(Message, Unused), DecodeError> {
        let (codec, moved) = packet.origin();
        match codec.last().map(String::as_str) {
            Some(CODEC) => {
                let mut content = self.decode(&packet.bytes, steps)?;
                content.envelope.stamp = content.envelope.stamp.saturating_add(moved);
                Ok((content.into_message(header, codec)?, Unused::default()))
            }
            Some(cpm::CODEC) if codec.len() == 1 => self.cpm.read(header, &packet.bytes, moved),
            _ => Err(DecodeError::Codec(packet.codec.join(", "))),
        }
    }

    /// What bytes of [`Encoder::encode`] say. Any bytes may come in; what is not exactly one message is refused. Of a cloud and
    /// a feature map the steps are timed.
    ///
    /// # Errors
    /// [`DecodeError`] names the field that was wrong.
    pub fn decode(&mut self, bytes: &[u8], steps: &mut Steps) -> Result<Content, DecodeError> {
        let mut untimed = Steps::default();
        let steps = if envelope::says_points_or_features(bytes) {
            steps
        } else {
            &mut untimed
        };
        let mut bytes = Reader::new(bytes);
        let envelope = steps.time("parsing", || envelope::read(&mut bytes))?;
        let mut codec = Vec::new();
        let payload = match envelope.kind {
            Kind::Points => {
                let (cloud, coding) = self.points.read(&mut bytes, steps)?;
                codec.extend(coding.steps().map(String::from));
                cloud.into()
            }
            Kind::Features => {
                let (map, coding) = self.features.read(&mut bytes, steps)?;
                codec.extend(coding.steps().map(String::from));
                map.into()
            }
            Kind::Boxes => boxes::read(&mut bytes)?.into(),
            Kind::AgentState => agent_state::read(&mut bytes)?.into(),
            Kind::Truth | Kind::Report | Kind::Motion => {
                let found = envelope.kind.to_string();
                return Err(DecodeError::Value {
                    field: "content",
                    expected: "what a link carries",
                    found,
                });
            }
        };
        bytes.end()?;
        codec.push(CODEC.into());
        Ok(Content {
            envelope,
            codec,
            payload,
        })
    }
}

#[cfg(test)]
mod tests;
