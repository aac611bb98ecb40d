//! Signatures of what agents send each other.
//!
//! A sealed frame is a frame and, behind it:
//!
//! | bytes | content |
//! |---|---|
//! | i64, little endian | when it was signed, ns since 1970 on the wall clock of the sender |
//! | 64 | Ed25519 signature of the hash |
//! | 1 | algorithm: 1, Ed25519 over BLAKE3 |
//!
//! The hash is BLAKE3 (derived by [`CONTEXT`]) of the site, the sender, the topic and the receiver, each with a zero byte behind it,
//! then of the date and the frame. So a frame of one sender is worth nothing as another one's, on another key, or later; one that comes again within
//! the [`WINDOW`] has a number that has come in already. Every frame is signed, not only whole messages: who could forge acknowledgements,
//! answers about time or the session of a part could silence a peer or move its stamps.

use std::fmt;

use bytes::{BufMut, Bytes, BytesMut};
use ed25519_dalek::{Signature, Signer};
use realo_schemas::{Name, Nanos};

use crate::keys::{Own, Trusted};
use crate::refusal::Refusal;
use crate::station::Topic;

/// What hashes of frames are for, so that signatures of them fit nothing else.
const CONTEXT: &str = "realo radio, signed frames of version 1";
const ALGORITHM: u8 = 1;
/// Bytes behind a frame.
pub const SEAL_BYTES: usize = 8 + Signature::BYTE_SIZE + 1;
/// Wall clocks of agents that sign may differ by so much, with the time on the way, ns.
pub const WINDOW: Nanos = 10_000_000_000;

/// What signs an agent's frames, and checks those of others.
pub struct Seal {
    site: String,
    own: Own,
    trusted: Trusted,
}

impl fmt::Debug for Seal {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "Seal of {} on {}", self.own.agent, self.site)
    }
}

/// What one frame is about.
#[derive(Clone, Copy)]
struct Way<'a> {
    from: &'a str,
    topic: Topic,
    to: &'a str,
}

impl Seal {
    /// For an agent of a site.
    pub fn new(site: &str, own: Own, trusted: Trusted) -> Seal {
        Seal {
            site: site.into(),
            own,
            trusted,
        }
    }

    /// Whether an agent's frames may be taken at all.
    pub fn trusts(&self, agent: &str) -> bool {
        self.trusted.0.contains_key(agent)
    }

    /// A frame with its seal.
    pub fn close(&self, to: &str, topic: Topic, frame: &[u8], wall: Nanos) -> Bytes {
        let from = &*self.own.agent;
        let hash = self.hash(Way { from, topic, to }, frame, wall);
        let mut bytes = BytesMut::with_capacity(frame.len() + SEAL_BYTES);
        bytes.put_slice(frame);
        bytes.put_i64_le(wall);
        bytes.put_slice(&self.own.key.sign(hash.as_bytes()).to_bytes());
        bytes.put_u8(ALGORITHM);
        bytes.freeze()
    }

    /// The frame that a seal holds.
    ///
    /// # Errors
    /// Why it is not taken.
    pub fn open(&self, from: &Name, topic: Topic, bytes: &Bytes, wall: Nanos) -> Result<Bytes, Refusal> {
        let key = self.trusted.0.get(from).ok_or(Refusal::Stranger)?;
        let frame = bytes.len().checked_sub(SEAL_BYTES).ok_or(Refusal::Unsigned)?;
        let (frame, seal) = (bytes.slice(..frame), &bytes[frame..]);
        let (date, rest) = seal.split_first_chunk().ok_or(Refusal::Unsigned)?;
        let (signature, algorithm) = rest.split_first_chunk().ok_or(Refusal::Unsigned)?;
        if algorithm != [ALGORITHM] {
            return Err(Refusal::Unsigned);
        }
        let date = Nanos::from_le_bytes(*date);
        let to = &*self.own.agent;
        let hash = self.hash(Way { from, topic, to }, &frame, date);
        key.verify_strict(hash.as_bytes(), &Signature::from_bytes(signature))
            .map_err(|_| Refusal::Forged)?;
        match wall.saturating_sub(date) {
            past if past > WINDOW => Err(Refusal::Replayed),
            past if past < -WINDOW => Err(Refusal::Future),
            _ => Ok(frame),
        }
    }

    fn hash(&self, Way { from, topic, to }: Way, frame: &[u8], date: Nanos) -> blake3::Hash {
        let mut hasher = blake3::Hasher::new_derive_key(CONTEXT);
        // No name has a zero byte.
        for word in [&self.site, from, topic.as_str(), to] {
            hasher.update(word.as_bytes()).update(&[0]);
        }
        hasher.update(&date.to_le_bytes()).update(frame);
        hasher.finalize()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const NOW: Nanos = 1_700_000_000_000_000_000;

    /// cav1 and rsu1, who trust each other.
    fn pair() -> [Seal; 2] {
        let own = ["cav1", "rsu1"].map(|name| Own::new(name).unwrap());
        let mut trusted = Trusted::default();
        own.iter().for_each(|own| trusted.0.extend(own.public().0));
        own.map(|own| Seal::new("site", own, trusted.clone()))
    }

    #[test]
    fn a_sealed_frame_opens_for_whom_it_is_and_no_other() {
        let [cav1, rsu1] = pair();
        let sealed = rsu1.close("cav1", Topic::Small, b"frame", NOW);
        let open = |seal: &Seal, from: &str, topic| seal.open(&from.into(), topic, &sealed, NOW);
        assert_eq!(open(&cav1, "rsu1", Topic::Small), Ok(Bytes::from_static(b"frame")));
        assert_eq!(open(&cav1, "cav1", Topic::Small), Err(Refusal::Forged));
        assert_eq!(open(&cav1, "rsu1", Topic::Ack), Err(Refusal::Forged));
        assert_eq!(open(&rsu1, "rsu1", Topic::Small), Err(Refusal::Forged));
        assert_eq!(open(&cav1, "mallory", Topic::Small), Err(Refusal::Stranger));
        let elsewhere = Seal::new("other", cav1.own, cav1.trusted);
        assert_eq!(open(&elsewhere, "rsu1", Topic::Small), Err(Refusal::Forged));
    }

    #[test]
    fn time_tells_what_was_sent_before_and_what_cannot_be_yet() {
        let [cav1, rsu1] = pair();
        for (date, expected) in [
            (NOW, Ok(())),
            (NOW - WINDOW, Ok(())),
            (NOW - WINDOW - 1, Err(Refusal::Replayed)),
            (NOW + WINDOW, Ok(())),
            (NOW + WINDOW + 1, Err(Refusal::Future)),
            (Nanos::MAX, Err(Refusal::Future)),
            (Nanos::MIN, Err(Refusal::Replayed)),
        ] {
            let sealed = rsu1.close("cav1", Topic::Bulk, b"frame", date);
            let opened = cav1.open(&"rsu1".into(), Topic::Bulk, &sealed, NOW);
            assert_eq!(opened.map(|_| ()), expected, "{date}");
        }
    }

    proptest! {
        #[test]
        fn a_frame_that_was_changed_anywhere_is_not_taken(frame in prop::collection::vec(any::<u8>(), 0..80), place: prop::sample::Index, bit in 0u8..8) {
            let [cav1, rsu1] = pair();
            let sealed = rsu1.close("cav1", Topic::Clock, &frame, NOW);
            let mut changed = sealed.to_vec();
            let place = place.index(changed.len());
            changed[place] ^= 1u8 << bit;
            let opened = cav1.open(&"rsu1".into(), Topic::Clock, &changed.into(), NOW);
            let expected = if place == sealed.len() - 1 { Refusal::Unsigned } else { Refusal::Forged };
            prop_assert_eq!(opened, Err(expected));
        }

        #[test]
        fn any_bytes_are_refused(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let [cav1, _] = pair();
            prop_assert!(cav1.open(&"rsu1".into(), Topic::Books, &bytes.into(), NOW).is_err());
        }
    }
}
