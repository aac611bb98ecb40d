//! What of a header crosses a link.

use realo_schemas::{Header, Kind, Name, Nanos, Pose, body_frame};

use crate::bytes::{Reader, put_covariance6, put_f64s, put_pose, put_text};
use crate::error::{DecodeError, EncodeError};

const MAGIC: &[u8] = b"rl";
const VERSION: u8 = 2;
const POSE: u8 = 1;
const COVARIANCE: u8 = 2;
const FRAME: u8 = 4;
const POSITION: u8 = 8;

/// The part of a header that the sender says.
pub(crate) struct Envelope {
    pub kind: Kind,
    pub seq: u64,
    pub stamp: Nanos,
    pub agent: Name,
    pub frame: Name,
    pub pose: Option<Pose>,
    pub position: Option<[f64; 3]>,
}

fn code_of(kind: Kind) -> Option<u8> {
    match kind {
        Kind::Points => Some(1),
        Kind::Features => Some(2),
        Kind::Boxes => Some(3),
        Kind::AgentState => Some(4),
        Kind::Truth | Kind::Report | Kind::Motion => None,
    }
}

/// Whether bytes say that points or features follow, if they say anything.
pub(crate) fn says_points_or_features(bytes: &[u8]) -> bool {
    let code = bytes.get(3).copied();
    [Kind::Points, Kind::Features]
        .into_iter()
        .any(|kind| code == code_of(kind))
}

pub(crate) fn write(out: &mut Vec<u8>, header: &Header) -> Result<(), EncodeError> {
    let no_code = EncodeError::Content {
        payload: "message",
        kind: header.kind.as_str(),
    };
    let code = code_of(header.kind).ok_or(no_code)?;
    let covariance = header.pose.as_ref().and_then(|pose| pose.covariance.as_deref());
    let other_frame = *header.frame != *body_frame(&header.agent);
    let flag = |set: bool, flag: u8| if set { flag } else { 0 };
    out.extend(MAGIC);
    out.extend([VERSION, code]);
    out.push(
        flag(header.pose.is_some(), POSE)
            | flag(covariance.is_some(), COVARIANCE)
            | flag(other_frame, FRAME)
            | flag(header.position.is_some(), POSITION),
    );
    out.extend(header.seq.to_le_bytes());
    out.extend(header.stamp.to_le_bytes());
    put_text(out, &header.agent, "length of agent")?;
    if other_frame {
        put_text(out, &header.frame, "length of frame")?;
    }
    if let Some(pose) = &header.pose {
        put_pose(out, &pose.map_from_frame, "pose")?;
    }
    if let Some(covariance) = covariance {
        put_covariance6(out, covariance, "covariance of the pose")?;
    }
    if let Some(position) = &header.position {
        put_f64s(out, position, "position of the sender")?;
    }
    Ok(())
}

pub(crate) fn read(bytes: &mut Reader) -> Result<Envelope, DecodeError> {
    let kind = read_kind(bytes)?;
    let flags = bytes.flags(POSE | COVARIANCE | FRAME | POSITION, "flags of the envelope")?;
    if flags & POSE == 0 && flags & COVARIANCE != 0 {
        let found = "a covariance without a pose".into();
        return Err(DecodeError::Value {
            field: "flags of the envelope",
            expected: "a pose",
            found,
        });
    }
    let (seq, stamp) = (bytes.u64("seq")?, bytes.i64("stamp")?);
    let agent: Name = named(bytes.text("agent")?, "agent")?;
    let frame: Name = match flags & FRAME {
        0 => body_frame(&agent),
        _ => named(bytes.text("frame")?, "frame")?,
    };
    let pose = match flags & POSE {
        0 => None,
        _ => Some(read_pose(bytes, flags & COVARIANCE != 0)?),
    };
    let position = match flags & POSITION {
        0 => None,
        _ => Some(bytes.f64s::<3>("position of the sender")?),
    };
    Ok(Envelope {
        kind,
        seq,
        stamp,
        agent,
        frame,
        pose,
        position,
    })
}

/// What says that this is an envelope that is known, and of what.
fn read_kind(bytes: &mut Reader) -> Result<Kind, DecodeError> {
    let magic = bytes.take(MAGIC.len(), 1, "magic")?;
    if magic != MAGIC {
        return Err(DecodeError::Value {
            field: "magic",
            expected: "the bytes `rl`",
            found: format!("{magic:?}"),
        });
    }
    let version = bytes.u8("version")?;
    if version != VERSION {
        return Err(DecodeError::Version {
            expected: VERSION,
            found: version,
        });
    }
    let code = bytes.u8("content")?;
    let unknown = || DecodeError::Value {
        field: "content",
        expected: "1 to 4",
        found: code.to_string(),
    };
    let mut kinds = Kind::ALL.into_iter();
    kinds.find(|kind| code_of(*kind) == Some(code)).ok_or_else(unknown)
}

fn read_pose(bytes: &mut Reader, with_covariance: bool) -> Result<Pose, DecodeError> {
    Ok(Pose {
        map_from_frame: bytes.pose("pose")?,
        covariance: match with_covariance {
            true => Some(bytes.covariance6("covariance of the pose")?),
            false => None,
        },
    })
}

fn named(text: &str, field: &'static str) -> Result<Name, DecodeError> {
    if text.is_empty() {
        return Err(DecodeError::Value {
            field,
            expected: "a name",
            found: "none".into(),
        });
    }
    Ok(text.into())
}
