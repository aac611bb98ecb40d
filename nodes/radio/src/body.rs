//! A packet as it crosses: its codecs, then its bytes.
//!
//! | bytes | content |
//! |---|---|
//! | 1 | number of codecs |
//! | for each: 1, n | length of its name, name |
//! | rest | the packet's bytes |

use bytes::Bytes;
use realo_schemas::Packet;

/// A packet that cannot cross.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("codecs of a packet: expected at most 255 of at most 255 bytes, found {0}")]
pub struct NoBody(String);

/// What crosses.
///
/// # Errors
/// More codecs, or longer names, than a byte counts.
pub fn to_bytes(packet: &Packet) -> Result<Bytes, NoBody> {
    let wrong = || NoBody(packet.codec.join(", "));
    let names: usize = packet.codec.iter().map(|name| 1 + name.len()).sum();
    let mut bytes = Vec::with_capacity(1 + names + packet.bytes.len());
    bytes.push(u8::try_from(packet.codec.len()).map_err(|_| wrong())?);
    for name in &packet.codec {
        bytes.push(u8::try_from(name.len()).map_err(|_| wrong())?);
        bytes.extend(name.as_bytes());
    }
    bytes.extend_from_slice(&packet.bytes);
    Ok(bytes.into())
}

/// The packet that crossed, if it is one.
pub fn of_bytes(bytes: &Bytes) -> Option<Packet> {
    let (count, mut at) = (*bytes.first()?, 1);
    let mut codec = Vec::with_capacity(count.into());
    for _ in 0..count {
        let length = usize::from(*bytes.get(at)?);
        let name = bytes.get(at + 1..at + 1 + length)?;
        codec.push(std::str::from_utf8(name).ok()?.to_string());
        at += 1 + length;
    }
    Some(Packet {
        codec,
        bytes: bytes.slice(at..).into(),
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_packet_comes_back_as_it_was(codec in prop::collection::vec("[a-z0-9]{0,12}", 0..5), bytes in any::<Vec<u8>>()) {
            let packet = Packet { codec, bytes: bytes.into() };
            prop_assert_eq!(of_bytes(&to_bytes(&packet).unwrap()), Some(packet));
        }

        #[test]
        fn any_bytes_are_a_packet_or_none(bytes in any::<Vec<u8>>()) {
            let bytes = Bytes::from(bytes);
            if let Some(packet) = of_bytes(&bytes) {
                prop_assert_eq!(to_bytes(&packet).unwrap(), bytes);
            }
        }
    }

    #[test]
    fn what_cannot_be_counted_is_refused() {
        let packet = Packet {
            codec: vec!["x".repeat(256)],
            bytes: Vec::<u8>::new().into(),
        };
        assert!(to_bytes(&packet).unwrap_err().to_string().contains("255"));
    }
}
