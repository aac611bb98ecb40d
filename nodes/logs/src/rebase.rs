//! Stamps that are put right while a log is read: those of clocks that step, or count something else than the log's times.
//!
//! Each sensor has a clock; its stamps are watched against the log times ([`StampWatch`]). What is labelled with the stamp of a sweep,
//! boxes and truth, goes with that sweep.

use std::collections::BTreeMap;

use realo_schemas::report::SensorClock;
use realo_schemas::{Name, Nanos, SAME_STAMP, to_millis};
use realo_time_offset::{Epoch, Handling, Sensor, StampFault, StampWatch};

use crate::words::seconds;
use crate::{Log, LogError, Standing, Step, Stream};

/// The streams of sensors that may have a clock of their own.
const SENSED: [Stream; 7] = [
    Stream::Sweeps,
    Stream::Points,
    Stream::Pose,
    Stream::PoseTruth,
    Stream::Imu,
    Stream::Fix,
    Stream::Wheels,
];

/// What became of a stream's stamps.
#[derive(Clone, Debug, PartialEq)]
pub struct RebasedStream {
    /// The agent.
    pub agent: Name,
    /// The stream.
    pub stream: Stream,
    /// Its messages.
    pub messages: u64,
    /// Those that get another stamp.
    pub moved: u64,
    /// Those that are left out, because nothing says what their stamp should be.
    pub left_out: u64,
    /// What is wrong, in words.
    pub found: String,
    /// Its clock, as results name it.
    pub clock: SensorClock,
}

/// Shifts of stamps, by agent and stream.
#[derive(Debug, Default)]
pub(crate) struct Rebased {
    sensed: BTreeMap<(Name, Stream), Vec<Segment>>,
    /// By agent, stamp as written and log time of its sweeps: what becomes of them. Only of agents with a sweep that is moved.
    sweeps: BTreeMap<Name, BTreeMap<(Nanos, Nanos), Option<Nanos>>>,
}

/// From a log time on the stamps of a stream are shifted by so much, ns; or its messages are left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Segment {
    from: Nanos,
    shift: Option<Nanos>,
}

impl Rebased {
    /// The stamp of a message that was written with another one; `None` for a message to leave out.
    pub fn stamp(&self, (agent, stream): (&Name, Stream), stamp: Nanos, ready: Nanos) -> Option<Nanos> {
        if SENSED.contains(&stream) {
            let Some(segments) = self.sensed.get(&(agent.clone(), stream)) else {
                return Some(stamp);
            };
            let after = segments.partition_point(|segment| segment.from <= ready);
            let shift = after.checked_sub(1).map_or(Some(0), |at| segments[at].shift);
            return shift.map(|shift| stamp.saturating_add(shift));
        }
        let Some(sweeps) = self.sweeps.get(agent) else {
            return Some(stamp);
        };
        let [from, until] = [stamp.saturating_sub(SAME_STAMP), stamp.saturating_add(SAME_STAMP)];
        let near = sweeps.range((from, Nanos::MIN)..=(until, Nanos::MAX));
        // A clock that steps back gives a stamp twice: the sweep that was there at that time is meant.
        match near.min_by_key(|((_, at), _)| at.abs_diff(ready)) {
            Some((_, shift)) => shift.map(|shift| stamp.saturating_add(shift)),
            None => Some(stamp),
        }
    }

    fn take(&mut self, key: (Name, Stream), watched: Vec<Seen>) {
        let is_sweep = matches!(key.1, Stream::Sweeps | Stream::Points);
        if is_sweep && watched.iter().any(|seen| seen.shift != Some(0)) {
            let sweeps = self.sweeps.entry(key.0.clone()).or_default();
            sweeps.extend(watched.iter().map(|seen| ((seen.stamp, seen.ready), seen.shift)));
        }
        let mut segments: Vec<Segment> = Vec::new();
        for Seen { ready, shift, .. } in watched {
            if segments.last().map_or(Some(0), |last| last.shift) != shift {
                segments.push(Segment { from: ready, shift });
            }
        }
        if !segments.is_empty() {
            self.sensed.insert(key, segments);
        }
    }
}

/// A message, and what becomes of its stamp.
struct Seen {
    stamp: Nanos,
    ready: Nanos,
    shift: Option<Nanos>,
}

impl Log {
    /// Handles the stamps of all that is read of this log from now on: of clocks that step by 0.2 s or more, count from boot, by TAI or
    /// GPS, or lie 1,024 weeks off, and those that repeat, run backwards or stand still. Gives the streams of which something gets
    /// another stamp or is left out.
    ///
    /// With [`Handling::Drop`] messages that are seconds off are still read, as without this: whoever plays the log names them.
    ///
    /// # Errors
    /// A log that cannot be read.
    pub fn rebase(&mut self, handling: Handling) -> Result<Vec<RebasedStream>, LogError> {
        let (mut rebased, mut found) = (Rebased::default(), Vec::new());
        let agents: Vec<Name> = self
            .info()
            .agents
            .iter()
            .map(|agent| agent.name.as_str().into())
            .collect();
        for agent in agents {
            for stream in SENSED.into_iter().filter(|stream| self.has(&agent, *stream)) {
                let is_pose = matches!(stream, Stream::Pose | Stream::PoseTruth);
                // The pose of a unit that stands still may have any stamp.
                if is_pose && Standing::is_without_stamps(self, &agent, stream)? {
                    continue;
                }
                let (watched, of) = self.watch(&agent, stream, handling)?;
                rebased.take((agent.clone(), stream), watched);
                found.extend((of.moved + of.left_out > 0).then_some(of));
            }
        }
        self.rebased = Some(rebased.into());
        Ok(found)
    }

    fn watch(&self, agent: &Name, stream: Stream, handling: Handling) -> Result<(Vec<Seen>, RebasedStream), LogError> {
        let mut watch = StampWatch::new(handling);
        let mut reader = self.read_unjudged(&[(agent, stream)])?;
        let (mut all, mut first) = (Vec::new(), None);
        while let Some(entry) = reader.next()? {
            let (stamp, ready) = (entry.stamp(), entry.ready());
            let is_far = handling == Handling::Drop && Step::of(stream, stamp, ready) == Step::Off;
            let right = watch.take(stamp, ready).stamp.or(is_far.then_some(stamp));
            let shift = right.map(|right| right.saturating_sub(stamp));
            if shift != Some(0) {
                first.get_or_insert((stamp, ready));
            }
            all.push(Seen { stamp, ready, shift });
        }
        let count = |is: fn(&Option<Nanos>) -> bool| all.iter().filter(|seen| is(&seen.shift)).count() as u64;
        let of = RebasedStream {
            agent: agent.clone(),
            stream,
            messages: all.len() as u64,
            moved: count(|shift| shift.is_some_and(|shift| shift != 0)),
            left_out: count(Option::is_none),
            found: first.map_or_else(String::new, |first| words(stream, &watch, first)),
            clock: clock(agent, stream, all.len() as u64, &watch),
        };
        Ok((all, of))
    }
}

/// What the stamps of a stream say of its clock.
fn clock(agent: &Name, stream: Stream, messages: u64, watch: &StampWatch) -> SensorClock {
    let sensor = match stream {
        Stream::Imu => Sensor::Imu,
        Stream::Fix => Sensor::Gnss,
        Stream::Wheels => Sensor::Wheels,
        Stream::Pose | Stream::PoseTruth => Sensor::Poses,
        _ => Sensor::Lidar,
    };
    let step = watch.last_step();
    let faults = watch.faults();
    SensorClock {
        agent: agent.to_string(),
        sensor: sensor.name().into(),
        messages,
        offset_ms: Some(to_millis(watch.shift())),
        counts: watch.epoch().and_then(Epoch::name).map(String::from),
        step_ms: (step != 0).then(|| to_millis(step)),
        faults: faults.seen().map(|(fault, n)| (fault.name().into(), n)).collect(),
        ..SensorClock::default()
    }
}

/// What is wrong with a stream's stamps.
fn words(stream: Stream, watch: &StampWatch, (stamp, ready): (Nanos, Nanos)) -> String {
    let step = watch.last_step();
    let faults = watch.faults();
    let mut words = Vec::new();
    if step != 0 {
        words.push(format!("stamps step by {} s", seconds(step)));
    } else if watch.epoch() != Some(Epoch::Same) {
        words.push(crate::clock_words(stamp, ready));
    }
    for (fault, name) in [
        (StampFault::Repeated, "repeated"),
        (StampFault::StandsStill, "standing still"),
        (StampFault::Backwards, "running backwards"),
        (StampFault::Ahead, "ahead of their time"),
    ] {
        if faults.count(fault) > 0 {
            words.push(format!("{} {name}", faults.count(fault)));
        }
    }
    format!("{}: {}", stream.as_str(), words.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: Nanos = 1_000_000_000;

    fn seen(stamp: Nanos, ready: Nanos, shift: Option<Nanos>) -> Seen {
        Seen { stamp, ready, shift }
    }

    #[test]
    fn labels_go_with_their_sweep_and_sensors_by_themselves() {
        let car: Name = "car".into();
        let mut rebased = Rebased::default();
        // The clock steps back by 2 s at the third sweep; the third is left out.
        let sweeps = vec![
            seen(10 * S, 10 * S, Some(0)),
            seen(11 * S, 11 * S, Some(0)),
            seen(10 * S, 12 * S, None),
            seen(11 * S + 5, 13 * S, Some(2 * S)),
        ];
        rebased.take((car.clone(), Stream::Points), sweeps);
        let stamp = |stream, stamp, ready| rebased.stamp((&car, stream), stamp, ready);
        assert_eq!(stamp(Stream::Points, 11 * S, 11 * S), Some(11 * S));
        assert_eq!(stamp(Stream::Points, 10 * S, 12 * S), None);
        assert_eq!(stamp(Stream::Points, 11 * S + 5, 13 * S), Some(13 * S + 5));
        assert_eq!(stamp(Stream::Detections, 11 * S, 11 * S + 7), Some(11 * S));
        assert_eq!(stamp(Stream::Detections, 11 * S, 13 * S + 7), Some(13 * S));
        assert_eq!(stamp(Stream::GroundTruth, 10 * S, 12 * S), None);
        // Labels that have the right time already, and sensors whose clocks are right, stay.
        assert_eq!(stamp(Stream::GroundTruth, 12 * S, 12 * S), Some(12 * S));
        assert_eq!(stamp(Stream::Imu, 10 * S, 13 * S), Some(10 * S));
        assert_eq!(rebased.stamp((&"mast".into(), Stream::Points), 3, 4), Some(3));
    }
}
