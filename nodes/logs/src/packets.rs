//! What an agent sent over a link, computed beforehand: `realo_msgs/msg/SentPacket`.

use realo_schemas::{Kind, Nanos};

use crate::cdr::{CdrReader, CdrWriter};

/// A packet as its sender gave it to the link.
#[derive(Clone, Debug, PartialEq)]
pub struct SentPacket {
    /// Number of the sweep that it was made from.
    pub seq: u64,
    /// What it carries.
    pub kind: Kind,
    /// Frame of its content.
    pub frame: String,
    /// Codecs that made the bytes, first applied first.
    pub codec: Vec<String>,
    /// The bytes.
    pub bytes: Vec<u8>,
}

/// Appends the CDR payload.
pub fn encode(out: &mut Vec<u8>, stamp: Nanos, packet: &SentPacket) {
    let mut out = CdrWriter::new(out);
    out.header(stamp, &packet.frame);
    out.string(packet.kind.as_str());
    out.u64(packet.seq);
    out.length(packet.codec.len());
    packet.codec.iter().for_each(|codec| out.string(codec));
    out.bytes_mut(packet.bytes.len()).copy_from_slice(&packet.bytes);
}

/// Reads a CDR payload: the stamp and the packet.
///
/// # Errors
/// Bytes that are no such message; a kind that crosses no link.
pub fn decode(payload: &[u8]) -> Result<(Nanos, SentPacket), String> {
    let mut input = CdrReader::new(payload)?;
    let (stamp, frame) = input.header()?;
    let frame = frame.to_string();
    let kind: Kind = input.string()?.parse()?;
    if !matches!(kind, Kind::Points | Kind::Features | Kind::Boxes) {
        return Err(format!(
            "`kind`: expected points, features or boxes, which agents send of their sweeps, found {kind}"
        ));
    }
    let seq = input.u64()?;
    // A text takes its length and a zero.
    let codecs = input.length(5)?;
    let codec = (0..codecs).map(|_| input.string().map(str::to_string));
    let codec = codec.collect::<Result<_, _>>()?;
    let packet = SentPacket {
        seq,
        kind,
        frame,
        codec,
        bytes: input.bytes()?.to_vec(),
    };
    Ok((stamp, packet))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packet() -> SentPacket {
        SentPacket {
            seq: 7,
            kind: Kind::Features,
            frame: "rsu1/body".into(),
            codec: vec!["plain".into(), "zstd".into()],
            bytes: (0..200).collect(),
        }
    }

    #[test]
    fn packets_come_back() {
        let mut payload = Vec::new();
        encode(&mut payload, 1_234_567_890_123, &packet());
        assert_eq!(decode(&payload), Ok((1_234_567_890_123, packet())));
    }

    #[test]
    fn what_is_no_packet_is_refused() {
        let mut payload = Vec::new();
        encode(&mut payload, 5, &packet());
        for length in 0..payload.len() {
            assert!(decode(&payload[..length]).is_err(), "cut at {length}");
        }
        for (kind, expected) in [(Kind::Truth, "found truth"), (Kind::AgentState, "found agent_state")] {
            let mut payload = Vec::new();
            encode(&mut payload, 5, &SentPacket { kind, ..packet() });
            let error = decode(&payload).unwrap_err();
            assert!(error.contains("`kind`") && error.contains(expected), "{error}");
        }
        let at = payload.windows(8).position(|bytes| bytes == b"features").unwrap();
        payload[at] = b'x';
        assert!(decode(&payload).unwrap_err().contains("xeatures"));
    }
}
