//! The plain codec: a message to bytes and back.

use realo_schemas::{Header, Kind, Message, Payload};

use crate::bytes::{DecodeError, EncodeError, Reader};
use crate::envelope::Envelope;
use crate::{boxes, ego_state, envelope, features, points};

/// The codec's name in [`realo_schemas::Packet::codec`].
pub const CODEC: &str = "plain";

/// Columns of a cloud that cross beside coordinates and intensity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Columns {
    /// Time of each point.
    pub time: bool,
    /// Beam of each point.
    pub ring: bool,
}

/// What was left out of a packet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Dropped {
    /// Points that are not finite.
    pub points: u64,
    /// Boxes that are not valid.
    pub boxes: u64,
}

/// What bytes say; see [`decode`].
pub struct Content {
    envelope: Envelope,
    /// The payload.
    pub payload: Payload,
}

impl Content {
    /// The content as a message: agent, kind, seq, stamp, frame and pose are the sender's, the rest stays as in the
    /// packet's header.
    ///
    /// # Errors
    /// [`DecodeError::Forged`] if the packet's header names another agent, kind, seq or stamp.
    pub fn into_message(self, packet: Header) -> Result<Message, DecodeError> {
        let Envelope {
            kind,
            seq,
            stamp,
            agent,
            frame,
            pose,
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
                ..packet
            },
            payload: self.payload,
        })
    }
}

fn same<T: PartialEq + ToString>(field: &'static str, header: &T, content: &T) -> Result<(), DecodeError> {
    if header == content {
        return Ok(());
    }
    Err(DecodeError::Forged {
        field,
        header: header.to_string(),
        content: content.to_string(),
    })
}

/// A message as bytes, laid out as the crate's documentation says, and what was left out of them.
///
/// # Errors
/// [`EncodeError`] if no link carries the payload, or a number or length in it cannot be sent.
pub fn encode(message: &Message, columns: Columns) -> Result<(Vec<u8>, Dropped), EncodeError> {
    let (header, payload) = (&message.header, &message.payload);
    let refused = || EncodeError::Content {
        payload: payload.payload_type().as_str(),
        kind: header.kind.as_str(),
    };
    if kind_of(payload) != Some(header.kind) {
        return Err(refused());
    }
    let mut out = Vec::new();
    envelope::write(&mut out, header)?;
    let mut dropped = Dropped::default();
    match payload {
        Payload::PointCloud(cloud) => dropped.points = points::write(&mut out, cloud, columns)?,
        Payload::FeatureMap(map) => features::write(&mut out, map)?,
        Payload::Boxes(list) => dropped.boxes = boxes::write(&mut out, list)?,
        Payload::EgoState(state) => ego_state::write(&mut out, state)?,
        _ => return Err(refused()),
    }
    Ok((out, dropped))
}

/// What a link carries a payload as.
fn kind_of(payload: &Payload) -> Option<Kind> {
    match payload {
        Payload::PointCloud(_) => Some(Kind::Points),
        Payload::FeatureMap(_) => Some(Kind::Features),
        Payload::Boxes(_) => Some(Kind::Boxes),
        Payload::EgoState(_) => Some(Kind::EgoState),
        _ => None,
    }
}

/// What bytes of [`encode`] say. Any bytes may come in; what is not exactly one message is refused.
///
/// # Errors
/// [`DecodeError`] names the field that was wrong.
pub fn decode(bytes: &[u8]) -> Result<Content, DecodeError> {
    let mut bytes = Reader::new(bytes);
    let envelope = envelope::read(&mut bytes)?;
    let payload = match envelope.kind {
        Kind::Points => points::read(&mut bytes)?.into(),
        Kind::Features => features::read(&mut bytes)?.into(),
        Kind::Boxes => boxes::read(&mut bytes)?.into(),
        Kind::EgoState => ego_state::read(&mut bytes)?.into(),
        Kind::Truth | Kind::Report => {
            let found = envelope.kind.to_string();
            return Err(DecodeError::Value {
                field: "content",
                expected: "what a link carries",
                found,
            });
        }
    };
    bytes.end()?;
    Ok(Content { envelope, payload })
}

#[cfg(test)]
mod tests;
