//! Stamps that are put right while a log is read: those of clocks that step, or count something else than the log's times.
//!
//! Each sensor's stamps are watched against the log times ([`StampWatch`]). Sensors of an agent whose clocks are off by the same, up to
//! what messages may be delayed, have one clock ([`one_clock`]). What is labelled with the stamp of a sweep, boxes and truth, goes with
//! that sweep.

use std::collections::BTreeMap;
use std::ops::Range;

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
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Seen {
    stamp: Nanos,
    ready: Nanos,
    shift: Option<Nanos>,
    /// Whether the clock is another one from here on.
    is_new_clock: bool,
}

/// The messages of a stream, what was seen of their stamps, and the first that is not right.
struct WatchedStream {
    stream: Stream,
    watch: StampWatch,
    seen: Vec<Seen>,
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
            let mut streams = Vec::new();
            for stream in SENSED.into_iter().filter(|stream| self.has(&agent, *stream)) {
                let is_pose = matches!(stream, Stream::Pose | Stream::PoseTruth);
                // The pose of a unit that stands still may have any stamp.
                if is_pose && Standing::is_without_stamps(self, &agent, stream)? {
                    continue;
                }
                streams.push(self.watch(&agent, stream, handling)?);
            }
            if handling == Handling::Rebase {
                let mut seen: Vec<&mut [Seen]> = streams.iter_mut().map(|watched| &mut watched.seen[..]).collect();
                one_clock(&mut seen);
            }
            for watched in streams {
                let of = watched.told(&agent);
                rebased.take((agent.clone(), watched.stream), watched.seen);
                found.extend((of.moved + of.left_out > 0).then_some(of));
            }
        }
        self.rebased = Some(rebased.into());
        Ok(found)
    }

    fn watch(&self, agent: &Name, stream: Stream, handling: Handling) -> Result<WatchedStream, LogError> {
        let mut watch = StampWatch::new(handling);
        let mut reader = self.read_unjudged(&[(agent, stream)])?;
        let mut seen = Vec::new();
        while let Some(entry) = reader.next()? {
            let (stamp, ready) = (entry.stamp(), entry.ready());
            let is_far = handling == Handling::Drop && Step::of(stream, stamp, ready) == Step::Off;
            let watched = watch.take(stamp, ready);
            let right = watched.stamp.or(is_far.then_some(stamp));
            seen.push(Seen {
                stamp,
                ready,
                shift: right.map(|right| right.saturating_sub(stamp)),
                is_new_clock: watched.is_new_clock,
            });
        }
        Ok(WatchedStream { stream, watch, seen })
    }
}

impl WatchedStream {
    /// What becomes of the stream.
    fn told(&self, agent: &Name) -> RebasedStream {
        let count = |is: fn(&Option<Nanos>) -> bool| self.seen.iter().filter(|seen| is(&seen.shift)).count() as u64;
        let first = self.seen.iter().find(|seen| seen.shift != Some(0));
        let last = self.seen.iter().rev().find_map(|seen| seen.shift);
        let messages = self.seen.len() as u64;
        let shift = last.filter(|shift| *shift != 0).unwrap_or(self.watch.shift());
        RebasedStream {
            agent: agent.clone(),
            stream: self.stream,
            messages,
            moved: count(|shift| shift.is_some_and(|shift| shift != 0)),
            left_out: count(Option::is_none),
            found: first.map_or_else(String::new, |first| {
                words(self.stream, &self.watch, (first.stamp, first.ready))
            }),
            clock: clock(agent, self.stream, messages, shift, &self.watch),
        }
    }
}

/// Clocks that are off by the same, up to so much, ns, are one: a message may be delayed by as much.
const DELAYED: Nanos = 300_000_000;
/// And they were first seen, or stepped, within so much, ns: a step back is sure only after some messages.
const TOGETHER: Nanos = 3_000_000_000;

/// Messages of a stream from one step of its clock to the next.
#[derive(Clone, Copy)]
struct Era {
    stream: usize,
    /// Its first message, and the first after it.
    begin: usize,
    until: usize,
    /// When the first arrived.
    from: Nanos,
    /// What is added to its stamps at its end, ns, and by how much more that is than at the end of the era before.
    shift: Nanos,
    by: Nanos,
    is_first: bool,
}

/// Gives the same shift to streams of an agent that have one clock, from their first message on or since a step.
///
/// The stamps of one clock are all off by the same. By how much looks different to each sensor, because its messages are delayed by
/// as much as they are: a sweep arrives when it is whole. A clock that was never right is off by what the quickest sensor shows, for no
/// message comes early. A step is as large as the sensor with the most messages shows.
fn one_clock(streams: &mut [&mut [Seen]]) {
    let eras = streams
        .iter()
        .enumerate()
        .flat_map(|(stream, seen)| eras_of(stream, seen));
    let mut eras: Vec<Era> = eras.filter(|era| era.shift != 0).collect();
    eras.sort_by_key(|era| (era.from, era.stream));
    while let [lead, ..] = eras[..] {
        let is_same = |era: &Era| {
            era.is_first == lead.is_first
                && era.from.abs_diff(lead.from) <= TOGETHER.unsigned_abs()
                && era.shift.abs_diff(lead.shift) <= DELAYED.unsigned_abs()
        };
        let (same, others): (Vec<Era>, Vec<Era>) = eras.into_iter().partition(is_same);
        eras = others;
        let least = same.iter().map(|era| era.shift).min().unwrap_or(lead.shift);
        let surest = same.iter().max_by_key(|era| era.until - era.begin).unwrap_or(&lead).by;
        for era in same {
            let seen = &mut *streams[era.stream];
            let before = seen[..era.begin].iter().rev().find_map(|seen| seen.shift);
            let shift = before.map_or(least, |before| before.saturating_add(surest));
            put(seen, era.begin..era.until, shift);
        }
    }
}

/// Gives messages a shift. One that would not come after all before it is left out.
fn put(seen: &mut [Seen], messages: Range<usize>, shift: Nanos) {
    let shifted = |seen: &Seen, shift: Nanos| seen.stamp.saturating_add(shift);
    let before = seen[..messages.start].iter().rev();
    let last = before.filter_map(|seen| Some(shifted(seen, seen.shift?))).next();
    for seen in &mut seen[messages] {
        let rises = last.is_none_or(|last| shifted(seen, shift) > last);
        seen.shift = seen.shift.and(rises.then_some(shift));
    }
}

/// The eras of a stream that have any message to go on with.
fn eras_of(stream: usize, seen: &[Seen]) -> Vec<Era> {
    let begins: Vec<usize> = (0..seen.len()).filter(|at| seen[*at].is_new_clock).collect();
    let mut before = None;
    let mut eras = Vec::new();
    for (number, begin) in begins.iter().copied().enumerate() {
        let until = begins.get(number + 1).copied().unwrap_or(seen.len());
        let Some(shift) = seen[begin..until].iter().rev().find_map(|seen| seen.shift) else {
            continue;
        };
        eras.push(Era {
            stream,
            begin,
            until,
            from: seen[begin].ready,
            shift,
            by: shift.saturating_sub(before.unwrap_or(0)),
            is_first: before.is_none(),
        });
        before = Some(shift);
    }
    eras
}

/// What the stamps of a stream say of its clock.
fn clock(agent: &Name, stream: Stream, messages: u64, shift: Nanos, watch: &StampWatch) -> SensorClock {
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
        offset_ms: Some(to_millis(shift)),
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
    const MS: Nanos = 1_000_000;

    fn seen(stamp: Nanos, ready: Nanos, shift: Option<Nanos>) -> Seen {
        Seen {
            stamp,
            ready,
            shift,
            is_new_clock: false,
        }
    }

    /// What a watch makes of messages every `period` ms for 8 s, whose clock is off by `off`, and that arrive after `delay`, both ms at a
    /// time in ms.
    fn watched(period: i64, off: impl Fn(i64) -> i64, delay: impl Fn(i64) -> i64) -> Vec<Seen> {
        let mut watch = StampWatch::new(Handling::Rebase);
        let take = |number: i64| {
            let at = number * period;
            let (stamp, ready) = ((at + off(at)) * MS, (at + delay(at)) * MS);
            let watched = watch.take(1_000 * S + stamp, 1_000 * S + ready);
            Seen {
                stamp: 1_000 * S + stamp,
                ready: 1_000 * S + ready,
                shift: watched.stamp.map(|right| right - 1_000 * S - stamp),
                is_new_clock: watched.is_new_clock,
            }
        };
        (0..8_000 / period).map(take).collect()
    }

    /// Of each stream, how far the stamps that go on are off, ms: least and most, and how many are left out.
    fn errors(off: impl Fn(i64) -> i64 + Copy) -> Vec<(i64, i64, usize)> {
        // A sweep is there when it is whole; a receiver takes its time; an inertial unit is quick, with jitter.
        let mut streams = [
            watched(100, off, |at| 100 + at / 100 % 4),
            watched(10, off, |at| 1 + at / 10 % 7),
            watched(100, off, |at| 60 + at / 100 % 5 * 9),
        ];
        let mut all: Vec<&mut [Seen]> = streams.iter_mut().map(|seen| &mut seen[..]).collect();
        one_clock(&mut all);
        let told = [100, 10, 100].into_iter().zip(&streams).map(|(period, seen)| {
            let errors = seen.iter().enumerate().filter_map(|(number, seen)| {
                let right = 1_000 * S + number as i64 * period * MS;
                Some((seen.stamp + seen.shift? - right) / MS)
            });
            let errors: Vec<i64> = errors.collect();
            let [least, most] = [errors.iter().min(), errors.iter().max()].map(|error| error.copied().unwrap());
            (least, most, seen.len() - errors.len())
        });
        told.collect()
    }

    #[test]
    fn sensors_of_one_clock_are_put_right_by_the_same() {
        // A clock that is right stays as it is; one that is 2 h behind all the time is off by the delay of the quickest sensor.
        assert_eq!(errors(|_| 0), [(0, 0, 0); 3]);
        assert_eq!(errors(|_| -7_200_000), [(1, 1, 0); 3]);
        // Steps, ahead and back: until they are sure messages are left out.
        for step in [700, -900] {
            let errors = errors(|at| if at < 4_000 { 0 } else { step });
            assert!(
                errors.iter().all(|(least, most, _)| (*least, *most) == (0, 0)),
                "{step}: {errors:?}"
            );
        }
    }

    #[test]
    fn sensors_of_different_clocks_stay_apart() {
        let mut lidar = watched(100, |_| -5_000, |_| 100);
        let mut imu = watched(10, |_| -5_600, |_| 1);
        let before = [lidar.clone(), imu.clone()];
        one_clock(&mut [&mut lidar, &mut imu]);
        assert_eq!([lidar, imu], before);
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
