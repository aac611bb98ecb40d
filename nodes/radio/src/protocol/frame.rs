//! Frames on the wire: a part of a message, or its acknowledgement. Numbers are little endian.
//!
//! | bytes | part | acknowledgement |
//! |---|---|---|
//! | 0 | version, 1 | version, 1 |
//! | 1 | what: 0 | what: 1 |
//! | 2 | kind: 0 points, 1 features, 2 boxes, 3 agent_state | kind |
//! | 3 | 0, 1: asks for acknowledgement, 3: at once | 0 |
//! | 4–11 | session of the sender | session |
//! | 12–19 | number of the message | number |
//! | 20–23 | index of the part | index |
//! | 24–27 | number of parts | which of the 32 parts before came in: bit k for index − 1 − k |
//! | 28–35 | time of sending | time of sending, as it came |
//! | 36–43 | when what it reports was measured | time of receipt |
//! | 44– | the part | |

use bytes::Bytes;
use realo_schemas::{Kind, Nanos};

const VERSION: u8 = 1;
const PART: u8 = 0;
const ACKNOWLEDGEMENT: u8 = 1;
/// Bytes before a part.
pub const HEAD_BYTES: usize = 44;
/// Bytes of an acknowledgement.
pub const ACKNOWLEDGEMENT_BYTES: usize = 44;
/// Kinds by their number on the wire.
const KINDS: [Kind; 4] = [Kind::Points, Kind::Features, Kind::Boxes, Kind::AgentState];

/// What crosses the network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Frame {
    /// A part of a message.
    Part(Head, Bytes),
    /// That parts came in.
    Acknowledgement(Acknowledgement),
}

/// What is known of a part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Head {
    /// Kind of the message.
    pub kind: Kind,
    /// Whether the sender wants an acknowledgement.
    pub asks: bool,
    /// Whether it sends no more before that.
    pub waits: bool,
    /// Greater for a sender that was started later.
    pub session: u64,
    /// Counts the messages of a kind.
    pub seq: u64,
    /// Place of the part in the message.
    pub index: u32,
    /// Parts of the message.
    pub count: u32,
    /// When it was sent, on the sender's clock.
    pub sent: Nanos,
    /// When what the message reports was measured, on the log's time line.
    pub stamp: Nanos,
}

/// That a part came in, and which of those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Acknowledgement {
    /// Kind of the message.
    pub kind: Kind,
    /// As the part said.
    pub session: u64,
    /// As the part said.
    pub seq: u64,
    /// The part.
    pub index: u32,
    /// Bit k: the part `index − 1 − k` came in too.
    pub before: u32,
    /// As the part said.
    pub sent: Nanos,
    /// When it came in, on the receiver's clock.
    pub received: Nanos,
}

/// Why bytes are no frame.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// Too few bytes.
    #[error("expected a frame of at least {expected} bytes, found {found}")]
    Short {
        /// The smallest.
        expected: usize,
        /// How many there are.
        found: usize,
    },
    /// Another protocol, or a later one.
    #[error("expected version 1 of the protocol, found {0}: let both sides run the same release")]
    Version(u8),
    /// A number that stands for nothing.
    #[error("{field}: expected {expected}, found {found}")]
    Field {
        /// Which.
        field: &'static str,
        /// What it may be.
        expected: &'static str,
        /// What it is.
        found: u64,
    },
}

impl Acknowledgement {
    /// Whether it says that this part came in.
    pub fn covers(&self, index: u32) -> bool {
        match self.index.checked_sub(index) {
            Some(0) => true,
            Some(back) if back <= 32 => self.before >> (back - 1) & 1 == 1,
            _ => false,
        }
    }
}

impl Frame {
    /// The bytes that cross.
    pub fn to_bytes(&self) -> Bytes {
        let (what, kind, flags) = match self {
            Frame::Part(head, _) => (
                PART,
                head.kind,
                u8::from(head.asks) | u8::from(head.asks && head.waits) << 1,
            ),
            Frame::Acknowledgement(ack) => (ACKNOWLEDGEMENT, ack.kind, 0),
        };
        let mut bytes = Vec::with_capacity(self.len());
        bytes.extend([VERSION, what, number(kind), flags]);
        let (words, body): ([u64; 5], &[u8]) = match self {
            Frame::Part(head, part) => (
                [
                    head.session,
                    head.seq,
                    u64::from(head.index) | u64::from(head.count) << 32,
                    head.sent as u64,
                    head.stamp as u64,
                ],
                part,
            ),
            Frame::Acknowledgement(ack) => (
                [
                    ack.session,
                    ack.seq,
                    u64::from(ack.index) | u64::from(ack.before) << 32,
                    ack.sent as u64,
                    ack.received as u64,
                ],
                &[],
            ),
        };
        words.iter().for_each(|word| bytes.extend(word.to_le_bytes()));
        bytes.extend_from_slice(body);
        bytes.into()
    }

    /// Bytes that [`Frame::to_bytes`] makes.
    #[allow(clippy::len_without_is_empty, reason = "a frame is never empty")]
    pub fn len(&self) -> usize {
        match self {
            Frame::Part(_, part) => HEAD_BYTES + part.len(),
            Frame::Acknowledgement(_) => ACKNOWLEDGEMENT_BYTES,
        }
    }

    /// What a peer sent; a part shares the bytes.
    ///
    /// # Errors
    /// [`FrameError`] for anything that [`Frame::to_bytes`] does not make.
    pub fn parse(bytes: &Bytes) -> Result<Frame, FrameError> {
        let head: &[u8; HEAD_BYTES] = bytes.first_chunk().ok_or(FrameError::Short {
            expected: HEAD_BYTES,
            found: bytes.len(),
        })?;
        let [version, what, kind, flags] = [head[0], head[1], head[2], head[3]];
        if version != VERSION {
            return Err(FrameError::Version(version));
        }
        let kind = *KINDS
            .get(usize::from(kind))
            .ok_or(field("kind", "0 to 3", kind.into()))?;
        let (words, _) = head[4..].as_chunks();
        let [session, seq, places, sent, last] = [0, 1, 2, 3, 4].map(|at: usize| u64::from_le_bytes(words[at]));
        let (index, upper) = (places as u32, (places >> 32) as u32);
        match what {
            PART if ![0, 1, 3].contains(&flags) => Err(field("flags", "0, 1 or 3", flags.into())),
            PART if index >= upper => Err(field("index", "one below the number of parts", index.into())),
            PART => Ok(Frame::Part(
                Head {
                    kind,
                    asks: flags > 0,
                    waits: flags > 1,
                    session,
                    seq,
                    index,
                    count: upper,
                    sent: sent as Nanos,
                    stamp: last as Nanos,
                },
                bytes.slice(HEAD_BYTES..),
            )),
            ACKNOWLEDGEMENT if flags > 0 => Err(field("flags of an acknowledgement", "0", flags.into())),
            ACKNOWLEDGEMENT if bytes.len() > ACKNOWLEDGEMENT_BYTES => {
                Err(field("length of an acknowledgement", "44 bytes", bytes.len() as u64))
            }
            ACKNOWLEDGEMENT => Ok(Frame::Acknowledgement(Acknowledgement {
                kind,
                session,
                seq,
                index,
                before: upper,
                sent: sent as Nanos,
                received: last as Nanos,
            })),
            _ => Err(field("what", "0 or 1", what.into())),
        }
    }
}

fn field(field: &'static str, expected: &'static str, found: u64) -> FrameError {
    FrameError::Field { field, expected, found }
}

fn number(kind: Kind) -> u8 {
    let place = KINDS.iter().position(|known| *known == kind);
    place.expect("only kinds that cross links are offered") as u8
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn frames() -> impl Strategy<Value = Frame> {
        let kind = prop::sample::select(&KINDS[..]);
        let head = (kind, any::<[u64; 2]>(), any::<[u32; 2]>(), any::<[i64; 2]>(), 0..3u8);
        (head, prop::option::of(prop::collection::vec(any::<u8>(), 0..100))).prop_map(
            |((kind, [session, seq], [index, upper], [sent, last], asks), part)| match part {
                Some(part) => {
                    let head = Head {
                        kind,
                        asks: asks > 0,
                        waits: asks > 1,
                        session,
                        seq,
                        index: index / 2,
                        count: index / 2 + 1 + upper / 2,
                        sent,
                        stamp: last,
                    };
                    Frame::Part(head, part.into())
                }
                None => Frame::Acknowledgement(Acknowledgement {
                    kind,
                    session,
                    seq,
                    index,
                    before: upper,
                    sent,
                    received: last,
                }),
            },
        )
    }

    proptest! {
        #[test]
        fn a_frame_comes_back_as_it_was(frame in frames()) {
            let bytes = frame.to_bytes();
            prop_assert_eq!(bytes.len(), frame.len());
            prop_assert_eq!(Frame::parse(&bytes), Ok(frame));
        }

        #[test]
        fn any_bytes_are_a_frame_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..80), head in any::<[bool; 3]>()) {
            let mut bytes = bytes;
            let sound = [VERSION, ACKNOWLEDGEMENT, 2].into_iter().zip(head);
            for (byte, (value, is_sound)) in bytes.iter_mut().zip(sound) {
                if is_sound {
                    *byte = value;
                }
            }
            let bytes = Bytes::from(bytes);
            if let Ok(frame) = Frame::parse(&bytes) {
                prop_assert_eq!(frame.to_bytes(), bytes);
            }
        }
    }

    #[test]
    fn what_is_wrong_is_named() {
        let good = Frame::Part(
            Head {
                kind: Kind::Boxes,
                asks: false,
                waits: false,
                session: 7,
                seq: 3,
                index: 0,
                count: 1,
                sent: 5,
                stamp: 6,
            },
            Bytes::from_static(b"boxes"),
        )
        .to_bytes();
        let damaged = |at: usize, value: u8| {
            let mut bytes = good.to_vec();
            bytes[at] = value;
            Frame::parse(&bytes.into()).unwrap_err().to_string()
        };
        for (at, value, expected) in [
            (0, 2, "expected version 1 of the protocol, found 2"),
            (1, 9, "what: expected 0 or 1, found 9"),
            (2, 4, "kind: expected 0 to 3, found 4"),
            (3, 2, "flags: expected 0, 1 or 3, found 2"),
            (24, 0, "index: expected one below the number of parts, found 0"),
        ] {
            let error = damaged(at, value);
            assert!(error.starts_with(expected), "{error}");
        }
        let short = Frame::parse(&good.slice(..43)).unwrap_err().to_string();
        assert_eq!(short, "expected a frame of at least 44 bytes, found 43");
    }

    #[test]
    fn an_acknowledgement_covers_what_its_bits_say() {
        let ack = Acknowledgement {
            kind: Kind::Points,
            session: 0,
            seq: 0,
            index: 40,
            before: 1 << 31 | 1,
            sent: 0,
            received: 0,
        };
        let covered: Vec<u32> = (0..60).filter(|index| ack.covers(*index)).collect();
        assert_eq!(covered, [8, 39, 40]);
    }
}
