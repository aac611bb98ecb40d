//! A packet as it crosses: when it was given to the radio, its codecs, then its bytes.
//!
//! | bytes | content |
//! |---|---|
//! | i64, little endian | when its sender's radio had it, ns on the sender's time line |
//! | 1 | number of codecs |
//! | for each: 1, n | length of its name, name |
//! | rest | the packet's bytes |

use bytes::Bytes;
use realo_schemas::{Nanos, Packet};

/// Bytes before the codecs.
const GIVEN: usize = 8;

/// A packet that cannot cross.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("codecs of a packet: expected at most 255 of at most 255 bytes, found {0}")]
pub struct NoBody(String);

/// What crosses.
///
/// # Errors
/// More codecs, or longer names, than a byte counts.
pub fn to_bytes(packet: &Packet, given: Nanos) -> Result<Bytes, NoBody> {
    let wrong = || NoBody(packet.codec.join(", "));
    let names: usize = packet.codec.iter().map(|name| 1 + name.len()).sum();
    let mut bytes = Vec::with_capacity(GIVEN + 1 + names + packet.bytes.len());
    bytes.extend(given.to_le_bytes());
    bytes.push(u8::try_from(packet.codec.len()).map_err(|_| wrong())?);
    for name in &packet.codec {
        bytes.push(u8::try_from(name.len()).map_err(|_| wrong())?);
        bytes.extend(name.as_bytes());
    }
    bytes.extend_from_slice(&packet.bytes);
    Ok(bytes.into())
}

/// The packet that crossed, if it is one, and when its sender's radio had it.
pub fn of_bytes(bytes: &Bytes) -> Option<(Packet, Nanos)> {
    let given = Nanos::from_le_bytes(*bytes.first_chunk()?);
    let (count, mut at) = (*bytes.get(GIVEN)?, GIVEN + 1);
    let mut codec = Vec::with_capacity(count.into());
    for _ in 0..count {
        let length = usize::from(*bytes.get(at)?);
        let name = bytes.get(at + 1..at + 1 + length)?;
        codec.push(std::str::from_utf8(name).ok()?.to_string());
        at += 1 + length;
    }
    let packet = Packet {
        codec,
        bytes: bytes.slice(at..).into(),
    };
    Some((packet, given))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_packet_comes_back_as_it_was(codec in prop::collection::vec("[a-z0-9]{0,12}", 0..5), bytes in any::<Vec<u8>>(), given in any::<Nanos>()) {
            let packet = Packet { codec, bytes: bytes.into() };
            let bytes = to_bytes(&packet, given).unwrap();
            prop_assert_eq!(of_bytes(&bytes), Some((packet, given)));
        }

        #[test]
        fn any_bytes_are_a_packet_or_none(bytes in any::<Vec<u8>>()) {
            let bytes = Bytes::from(bytes);
            if let Some((packet, given)) = of_bytes(&bytes) {
                prop_assert_eq!(to_bytes(&packet, given).unwrap(), bytes);
            }
        }
    }

    #[test]
    fn what_cannot_be_counted_is_refused() {
        let packet = Packet {
            codec: vec!["x".repeat(256)],
            bytes: Vec::<u8>::new().into(),
        };
        assert!(to_bytes(&packet, 0).unwrap_err().to_string().contains("255"));
    }
}
