//! Boxes as a Collective Perception Message: ETSI TS 103 324 v2.1.1 with the common data dictionary TS 102 894-2 v2.2.1, in
//! unaligned PER, as it goes on the air behind the headers of its network. docs/reference/packets.md says what survives.

mod classes;
mod clock;
mod reader;
mod station;
mod units;
mod writer;

use c_its_parser::standards::cdd_2_2_1::etsi_its_cdd::OrdinalNumber1B;
use c_its_parser::standards::cpm_2_1_1::cpm_pdu_descriptions::CollectivePerceptionMessage;
use realo_schemas::{Header, Kind, Message, Name, Nanos, Packet};

use crate::DecodeError;
pub use clock::timestamp_of;
pub(crate) use reader::Parser;
pub use reader::Unused;
pub use realo_geodesy::{Geodetic, NoOrigin};
pub use station::station_of;
pub(crate) use writer::Writer;

/// The codec of a packet whose bytes are a CPM, which stands alone in [`Packet::codec`].
pub const CODEC: &str = "cpm";

/// `protocolVersion` and `messageId` of the header.
const VERSION: u8 = 2;
const MESSAGE: u8 = 14;
/// Most objects of a CPM.
pub(crate) const OBJECTS: usize = 255;
/// How far from the map's origin a sender may be, m: farther away one of the two is a mistake.
const FAR_M: f64 = 100_000.0;
/// Bytes that a CPM may have, many times what one datagram of any network carries.
const LONGEST: usize = 1 << 16;

/// A CPM off the air as the message that `transmission-decoder` takes: of the agent `station-<stationId>`, and with the stamp
/// of its `referenceTime`.
///
/// `bytes`: the message in UPER, without GeoNetworking, BTP or security headers. `seq`: number of the message, which rises per
/// station. `ready`: when it came, ns.
///
/// # Errors
/// [`DecodeError`] if the bytes are no CPM.
pub fn received(bytes: &[u8], run: &Name, seq: u64, ready: Nanos) -> Result<Message, DecodeError> {
    let cpm = pdu(bytes)?;
    let stamp = reader::stamp_of(&cpm)?;
    let agent = station::agent_of(cpm.header.station_id.0);
    let header = Header::origin(run, &agent, Kind::Boxes, seq, stamp, ready);
    let packet = Packet {
        codec: vec![CODEC.into()],
        bytes: bytes.to_vec().into(),
    };
    Ok(Message::new(header, packet))
}

/// The message that bytes are, its containers not looked at yet.
fn pdu(bytes: &[u8]) -> Result<CollectivePerceptionMessage, DecodeError> {
    if bytes.len() > LONGEST {
        return Err(DecodeError::Oversized {
            bytes: bytes.len(),
            limit: LONGEST,
        });
    }
    let cpm: CollectivePerceptionMessage = whole(bytes, "CollectivePerceptionMessage")?;
    let OrdinalNumber1B(version) = cpm.header.protocol_version;
    let message = cpm.header.message_id.0;
    if (version, message) != (VERSION, MESSAGE) {
        return Err(DecodeError::Cpm {
            part: "header",
            found: format!(
                "protocolVersion {version} and messageId {message}, not {VERSION} and {MESSAGE} (a CPM of an earlier release \
                 is not read)"
            ),
        });
    }
    Ok(cpm)
}

/// What all of these bytes are.
fn whole<T: rasn::Decode>(bytes: &[u8], part: &'static str) -> Result<T, DecodeError> {
    let (value, rest) = rasn::uper::decode_with_remainder(bytes).map_err(|error| DecodeError::Cpm {
        part,
        found: error.kind.to_string(),
    })?;
    match rest.len() {
        0 => Ok(value),
        left => Err(DecodeError::Trailing(left)),
    }
}
