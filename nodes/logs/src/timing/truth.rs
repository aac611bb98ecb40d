//! Truth that no sweep goes with.

use realo_schemas::Nanos;

use super::gaps::{median_gap, nearest, unmatched};
use super::{AgentTimes, IN_STEP, read_stamps};
use crate::gaps::{Bare, SWEEPS_WITHOUT_DETECTIONS};
use crate::limits::{APART, TRUTH_WINDOW};
use crate::words::{nearest_words, seconds, side};
use crate::{Log, LogError, Stream, kind_of_clock};

/// Sweeps without detections, of an agent that has some.
pub(super) fn bare(times: &AgentTimes, end: Nanos, elsewhere: u64) -> Option<String> {
    let detections = times.streams.get(&Stream::Detections)?;
    let mut bare = Bare::default();
    for [stamp, ready] in times.sweeps() {
        bare.sweep(*stamp, *ready);
    }
    for [stamp, ready] in detections {
        bare.detections(*stamp, *ready);
    }
    let lack = bare.end(end, elsewhere)?;
    let [note, remedy] = SWEEPS_WITHOUT_DETECTIONS;
    Some(format!(
        "`{}`: {} of {} {note} ({}); {remedy}",
        times.agent, lack.count, lack.of, lack.place
    ))
}

/// Truth that belongs to a sweep and has the stamp of none. Truth at more times than sweeps, or at fewer, is not a fault; beside
/// sweeps that have none it is.
pub(super) fn lost_truth(own: &[Nanos], sweeps: &[Nanos]) -> Vec<Nanos> {
    let bare = unmatched(sweeps, own);
    let half = median_gap(sweeps) / 2;
    let is_between = |stamp: &Nanos| {
        let ends = sweeps.first().zip(sweeps.last());
        ends.is_some_and(|(first, last)| (*first - half..=*last + half).contains(stamp))
    };
    let is_near = |stamp: &Nanos| is_between(stamp) && nearest(&bare, *stamp) <= TRUTH_WINDOW;
    let outside = outside(own, sweeps);
    let is_outside = |stamp: &Nanos| outside.binary_search(stamp).is_ok();
    let lost = unmatched(own, sweeps).into_iter();
    lost.filter(|stamp| is_near(stamp) || is_outside(stamp)).collect()
}

/// Stamps before the first sweep or after the last one, where there are sweeps without any at the rhythm of these stamps.
fn outside(own: &[Nanos], sweeps: &[Nanos]) -> Vec<Nanos> {
    let (Some(first), Some(last)) = (sweeps.first(), sweeps.last()) else {
        return Vec::new();
    };
    let reach = TRUTH_WINDOW.max(median_gap(own));
    let inside = *first - TRUTH_WINDOW..=*last + TRUTH_WINDOW;
    let lacks = |sweep: &Nanos| nearest(own, *sweep) > reach;
    match sweeps.iter().any(lacks) {
        true => own.iter().copied().filter(|stamp| !inside.contains(stamp)).collect(),
        false => Vec::new(),
    }
}

/// Where stamps are relative to sweeps of which none has them, in words: the nearest one, and the clock that this looks like.
fn distance_words(lost: &[Nanos], own: &[Nanos], sweeps: &[Nanos]) -> String {
    let Some(first) = lost.first().filter(|_| !sweeps.is_empty()) else {
        return nearest_words(None);
    };
    let far = nearest(sweeps, *first);
    let words = nearest_words(Some(far));
    // The first that is lost belongs to the first sweep without any.
    let bare = unmatched(sweeps, own);
    let kind = bare.first().and_then(|sweep| kind_of_clock(*first, *sweep));
    match kind.filter(|_| far > TRUTH_WINDOW) {
        Some(kind) => format!("{words}: looks like {kind}"),
        None => words,
    }
}

/// Messages of an agent before its first sweep or after its last one, beside sweeps that have none.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outside {
    /// How many there are.
    pub count: u64,
    /// Of so many.
    pub of: u64,
    /// Where the nearest sweep is, and the clock that this looks like.
    pub words: String,
}

impl Outside {
    /// Looks at the messages of an agent's stream; `None` without sweeps, and where none are outside.
    ///
    /// # Errors
    /// A log that cannot be read.
    pub fn read(log: &Log, agent: &str, stream: Stream) -> Result<Option<Self>, LogError> {
        let sweeps = [Stream::Sweeps, Stream::Points].into_iter();
        let Some(of) = sweeps.into_iter().find(|stream| log.has(agent, *stream)) else {
            return Ok(None);
        };
        if !log.has(agent, stream) {
            return Ok(None);
        }
        let first = log.read_all(&[(agent, stream)])?.next()?;
        let in_step = first.is_none_or(|first| (first.ready() - first.stamp()).abs() <= IN_STEP);
        if in_step && is_within(log.times(&stream.topic(agent))?, log.times(&of.topic(agent))?) {
            return Ok(None);
        }
        let (own, sweeps) = (read_stamps(log, agent, stream)?, read_stamps(log, agent, of)?);
        let lost = outside(&own, &sweeps);
        Ok((!lost.is_empty()).then(|| Outside {
            count: lost.len() as u64,
            of: own.len() as u64,
            words: distance_words(&lost, &own, &sweeps),
        }))
    }
}

/// Whether the log times of messages lie within those of the sweeps, so that not all need to be read.
fn is_within(own: Option<(Nanos, Nanos)>, sweeps: Option<(Nanos, Nanos)>) -> bool {
    let (Some(own), Some(sweeps)) = (own, sweeps) else {
        return true;
    };
    own.0 >= sweeps.0 - TRUTH_WINDOW && own.1 <= sweeps.1 + TRUTH_WINDOW
}

pub(super) fn mismatch(
    times: &AgentTimes,
    stream: Stream,
    lost: &[Nanos],
    all: usize,
    (what, others): (&str, &[Nanos]),
) -> Option<String> {
    if lost.is_empty() {
        return None;
    }
    let topic = stream.topic(&times.agent);
    let nearest = distance_words(lost, &times.stamps(stream), others);
    Some(format!(
        "{topic}: {} of {all} messages have the stamp of no {what}: {nearest}; all that is of one sweep needs its stamp (within 1 µs)",
        lost.len()
    ))
}

/// How far the sweeps of two agents, each from its first to its last, are apart, in words; `None` where they have a time in common.
/// The words are about the second agent.
pub fn no_common_time([first, last]: [Nanos; 2], [begin, end]: [Nanos; 2], of_first: &str) -> Option<String> {
    if (begin - last).max(first - end) <= APART {
        return None;
    }
    let by = begin - first;
    let words = format!("they begin {} s {} {of_first}", seconds(by), side(by));
    Some(match kind_of_clock(begin, first) {
        Some(kind) => format!("{words}: looks like {kind}"),
        None => words,
    })
}
