//! Messages as they are on the wire: CDR with its head, which says the byte order.

use std::convert::Infallible;

use bytes::Bytes;
use rustdds::RepresentationIdentifier;
use rustdds::no_key::{Decode, DefaultDecoder, DeserializerAdapter, SerializerAdapter};

/// Bytes of the head.
const HEAD: usize = 4;

/// Reads and writes payloads without looking into them.
pub struct Raw;

/// Copies a payload.
#[derive(Clone)]
pub struct RawDecoder;

impl DeserializerAdapter<Vec<u8>> for Raw {
    type Error = Infallible;
    type Decoded = Vec<u8>;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        const BOTH: &[RepresentationIdentifier] = &[RepresentationIdentifier::CDR_LE, RepresentationIdentifier::CDR_BE];
        BOTH
    }

    fn transform_decoded(decoded: Vec<u8>) -> Vec<u8> {
        decoded
    }
}

impl DefaultDecoder<Vec<u8>> for Raw {
    type Decoder = RawDecoder;
    const DECODER: RawDecoder = RawDecoder;
}

impl<'a> Decode<'a, Vec<u8>> for RawDecoder {
    type Error = Infallible;

    fn decode_bytes(self, body: &'a [u8], encoding: RepresentationIdentifier) -> Result<Vec<u8>, Infallible> {
        let order = u8::from(encoding == RepresentationIdentifier::CDR_LE);
        let mut payload = Vec::with_capacity(HEAD + body.len());
        payload.extend([0, order, 0, 0]);
        payload.extend_from_slice(body);
        Ok(payload)
    }
}

impl SerializerAdapter<Vec<u8>> for Raw {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(payload: &Vec<u8>) -> Result<Bytes, Infallible> {
        // The head is written by whoever sends it.
        Ok(Bytes::copy_from_slice(payload.get(HEAD..).unwrap_or_default()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn payloads_get_the_head_of_their_byte_order() {
        let read = |encoding| RawDecoder.decode_bytes(&[7, 8], encoding).unwrap();
        assert_eq!(read(RepresentationIdentifier::CDR_LE), [0, 1, 0, 0, 7, 8]);
        assert_eq!(read(RepresentationIdentifier::CDR_BE), [0, 0, 0, 0, 7, 8]);
        assert_eq!(
            Raw::to_bytes(&vec![0, 1, 0, 0, 7, 8]).unwrap(),
            Bytes::from_static(&[7, 8])
        );
    }
}
