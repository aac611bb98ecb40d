//! Messages that are in a log twice: bags played in a loop, two recorders, two players.

use std::collections::BTreeMap;

use realo_schemas::{Nanos, to_seconds};

use crate::Stream;

/// Messages of a stream may overtake each other by less, ns.
const OVERTAKES: Nanos = 1_000_000_000;

/// A clock that is set back sends a stream back once; what two recorders wrote goes back all the time.
const SET_BACK: u64 = 2;

/// What is known of each stream of each agent.
#[derive(Debug, Default)]
pub(crate) struct Repeats(BTreeMap<(Stream, usize), Known>);

#[derive(Debug)]
struct Known {
    newest: Nanos,
    last: Nanos,
    /// How often a stamp was before the one before.
    back: u64,
}

impl Repeats {
    /// Notes a message; messages come in order of log time.
    ///
    /// # Errors
    /// The stamps of its stream start again, or it is there twice.
    pub fn note(&mut self, (stream, agent): (Stream, usize), stamp: Nanos) -> Result<(), String> {
        // What stamps of motion sensors do is for those to judge who estimate from them.
        if stream.is_motion() {
            return Ok(());
        }
        let Some(known) = self.0.get_mut(&(stream, agent)) else {
            let (newest, last) = (stamp, stamp);
            self.0.insert((stream, agent), Known { newest, last, back: 0 });
            return Ok(());
        };
        let back = known.newest - stamp;
        if stream != Stream::Packets && back > OVERTAKES {
            return Err(format!(
                "its stamp lies {:.3} s before the newest of its topic: the stamps start again here, as in a recording of a bag that \
                 was played in a loop, or of several bags; cut the log here, and write what follows into a log of its own",
                to_seconds(back)
            ));
        }
        // After a step of the clock backwards stamps come once more, but not twice in a row.
        let is_twice = stamp == known.last || (back == 0 && known.back > SET_BACK);
        if is_twice && !may_repeat(stream) {
            return Err(format!(
                "its stamp, {stamp} ns, is that of the message before: the message is there twice, as where two recorders or two \
                 players ran; write each message once, with the stamp of its own sweep"
            ));
        }
        known.back += u64::from(stamp < known.last);
        (known.newest, known.last) = (stamp.max(known.newest), stamp);
        Ok(())
    }
}

/// A pose twice says the same; several packets are of one sweep.
fn may_repeat(stream: Stream) -> bool {
    matches!(stream, Stream::Pose | Stream::PoseTruth | Stream::Packets)
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: Nanos = 1_000_000_000;

    fn noted(stream: Stream, stamps: &[Nanos]) -> Result<(), String> {
        let mut repeats = Repeats::default();
        stamps.iter().try_for_each(|stamp| repeats.note((stream, 3), *stamp))
    }

    #[test]
    fn loops_and_duplicates_are_named() {
        for stream in [Stream::Points, Stream::Pose, Stream::GroundTruth] {
            let error = noted(stream, &[5 * S, 6 * S, 7 * S, 5 * S]).unwrap_err();
            assert!(error.contains("2.000 s before") && error.contains("loop"), "{error}");
        }
        let bursts: Vec<Nanos> = (0..9)
            .flat_map(|at| [at, at + 1, at, at + 1].map(|tenth| tenth * S / 5))
            .collect();
        assert!(noted(Stream::Points, &bursts).unwrap_err().contains("twice"));
        let error = noted(Stream::Detections, &[5 * S, 5 * S]).unwrap_err();
        assert!(error.contains("5000000000 ns") && error.contains("twice"), "{error}");
    }

    #[test]
    fn what_may_repeat_or_overtake_is_fine() {
        assert_eq!(noted(Stream::Pose, &[5 * S, 5 * S, 6 * S]), Ok(()));
        assert_eq!(noted(Stream::Packets, &[5 * S, 5 * S, 3 * S]), Ok(()));
        assert_eq!(noted(Stream::Imu, &[5 * S, 5 * S, 3 * S]), Ok(()));
        assert_eq!(noted(Stream::Points, &[5 * S, 6 * S, 5 * S + 1]), Ok(()));
        let step = [48, 49, 40, 41, 42, 43, 44, 45, 46, 47, 48, 49, 50].map(|tenth| tenth * S / 10);
        assert_eq!(
            noted(Stream::GroundTruth, &step),
            Ok(()),
            "a clock that is set back by a second"
        );
        let mut two = Repeats::default();
        assert_eq!(two.note((Stream::Points, 1), 9 * S), Ok(()));
        assert_eq!(two.note((Stream::Points, 2), 2 * S), Ok(()));
    }
}
