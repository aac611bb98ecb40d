//! The time that a message is of, and messages that are of the same time.

use std::collections::{BTreeMap, BTreeSet};

use realo_schemas::{Nanos, SAME_STAMP as SAME};

use crate::cdr::CdrReader;
use crate::log::nanos;
use crate::{RawMessage, Stream};

/// So many stamps of an agent are remembered.
const KEEP: usize = 256;

/// The stamp of a message's header, or its publish time where the header has none (0), or is missing.
pub(crate) fn stamp_of(stream: Stream, raw: &RawMessage) -> Nanos {
    let header = || CdrReader::new(raw.data())?.time();
    match (stream, header()) {
        // An array of markers has no header of its own.
        (Stream::GroundTruthMarkers, _) | (_, Ok(0) | Err(_)) => nanos(raw.publish_time),
        (_, Ok(stamp)) => stamp,
    }
}

/// The entry whose stamp is the same, the nearest of several.
pub fn same<T>(known: &BTreeMap<Nanos, T>, stamp: Nanos) -> Option<Nanos> {
    let around = known.range(stamp.saturating_sub(SAME)..=stamp.saturating_add(SAME));
    around
        .map(|(other, _)| *other)
        .min_by_key(|other| other.abs_diff(stamp))
}

/// Gives messages of one sweep one stamp, where some went through float seconds: the first that was read of it.
#[derive(Debug, Default)]
pub(crate) struct Stamps(BTreeMap<usize, BTreeSet<Nanos>>);

impl Stamps {
    /// The stamp that a message of an agent gets.
    pub fn unify(&mut self, stream: Stream, agent: usize, stamp: Nanos) -> Nanos {
        // Poses, packets and motion are not joined by their stamps.
        if stream.is_motion() || matches!(stream, Stream::Pose | Stream::PoseTruth | Stream::Packets) {
            return stamp;
        }
        let known = self.0.entry(agent).or_default();
        let around = known.range(stamp.saturating_sub(SAME)..=stamp.saturating_add(SAME));
        if let Some(other) = around.copied().min_by_key(|other| other.abs_diff(stamp)) {
            return other;
        }
        known.insert(stamp);
        while known.len() > KEEP {
            known.pop_first();
        }
        stamp
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_within_a_microsecond_become_the_first() {
        let (mut stamps, t) = (Stamps::default(), 1_700_000_000_000_000_000);
        assert_eq!(stamps.unify(Stream::Sweeps, 0, t), t);
        assert_eq!(stamps.unify(Stream::Detections, 0, t - 128), t);
        assert_eq!(stamps.unify(Stream::GroundTruth, 0, t + SAME), t);
        assert_eq!(stamps.unify(Stream::GroundTruth, 0, t + SAME + 1), t + SAME + 1);
        assert_eq!(
            stamps.unify(Stream::Detections, 1, t - 128),
            t - 128,
            "of another agent"
        );
        assert_eq!(
            stamps.unify(Stream::Pose, 0, t - 128),
            t - 128,
            "poses are interpolated"
        );
    }

    #[test]
    fn the_nearest_of_the_same_is_found() {
        let known: BTreeMap<Nanos, ()> = [(1_000, ()), (1_900, ()), (9_000, ())].into();
        assert_eq!(
            (same(&known, 1_600), same(&known, 400), same(&known, 5_000)),
            (Some(1_900), Some(1_000), None)
        );
    }
}
