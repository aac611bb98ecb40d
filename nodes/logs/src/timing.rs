//! What stamps tell that a run of the log would stumble over: clocks, poses, stamps that match nothing, data that stop.

use std::collections::BTreeMap;

use realo_schemas::{Name, Nanos, SAME_STAMP};

use crate::gaps::{Bare, Gaps, SWEEPS_MISSING, SWEEPS_WITHOUT_DETECTIONS};
use crate::limits::{APART, TRUTH_WINDOW};
use crate::map_points::{TRANSFORMS_DIFFER, TransformsApart};
use crate::words::{millis, nearest_words, seconds, side};
use crate::{Log, LogError, MAX_GAP, Standing, Step, Stream, clock_words, is_posed, kind_of_clock};

/// A stamp nearer to its log time is of the same clock, ns.
const IN_STEP: Nanos = 2_000_000_000;

/// Stamp and log time of each message of a stream.
pub(crate) type Times = Vec<[Nanos; 2]>;

/// The times of an agent's messages.
#[derive(Default)]
pub(crate) struct AgentTimes {
    pub agent: String,
    pub streams: BTreeMap<Stream, Times>,
    /// Messages of each stream that are of another clock and left out here.
    pub off: BTreeMap<Stream, usize>,
}

impl AgentTimes {
    fn sweeps(&self) -> &[[Nanos; 2]] {
        let streams = [Stream::Sweeps, Stream::Points];
        let known = streams.into_iter().find_map(|stream| self.streams.get(&stream));
        known.map_or(&[], |times| times)
    }

    fn stamps(&self, stream: Stream) -> Vec<Nanos> {
        stamps(self.streams.get(&stream).map_or(&[], |times| times))
    }
}

fn stamps(times: &[[Nanos; 2]]) -> Vec<Nanos> {
    let mut stamps: Vec<Nanos> = times.iter().map(|[stamp, _]| *stamp).collect();
    stamps.sort_unstable();
    stamps
}

/// All that is found; `end`: the last log time.
///
/// # Errors
/// A log that cannot be read.
pub(crate) fn findings(log: &Log, agents: &[AgentTimes], end: Nanos) -> Result<Vec<String>, LogError> {
    let mut found = Vec::new();
    let mut in_step = Vec::new();
    for times in agents {
        let mut standing = false;
        for stream in [Stream::Pose, Stream::PoseTruth] {
            standing |= Standing::read(log, &times.agent, stream)?.is_some();
        }
        found.extend(clock(times, standing));
        let (times, is_off) = times.without_off(standing);
        // What follows would say the same again.
        if is_off {
            continue;
        }
        found.extend(poses(&times, standing));
        found.extend(unplaced(log, &times)?);
        found.extend(transforms_apart(log, &times.agent)?);
        found.extend(joins(&times, end));
        in_step.push(times);
    }
    let apart = apart(&in_step);
    found.extend(gaps(&in_step, apart.is_empty()));
    found.extend(apart);
    Ok(found)
}

fn is_pose(stream: Stream) -> bool {
    matches!(stream, Stream::Pose | Stream::PoseTruth)
}

fn is_sweep(stream: Stream) -> bool {
    matches!(stream, Stream::Sweeps | Stream::Points)
}

impl AgentTimes {
    /// The times that are of the log's clock, and whether most sweeps or poses are not. The poses of a unit that stands still may
    /// have any stamp.
    fn without_off(&self, standing: bool) -> (AgentTimes, bool) {
        let is_off = |stream: Stream, [stamp, ready]: &[Nanos; 2]| {
            !(standing && is_pose(stream)) && Step::of(stream, *stamp, *ready) == Step::Off
        };
        let mut rest = AgentTimes {
            agent: self.agent.clone(),
            ..AgentTimes::default()
        };
        let mut is_mostly_off = false;
        for (stream, times) in &self.streams {
            let (off, known): (Times, Times) = times.iter().copied().partition(|time| is_off(*stream, time));
            is_mostly_off |= (is_pose(*stream) || is_sweep(*stream)) && off.len() > known.len();
            rest.off.insert(*stream, off.len());
            rest.streams.insert(*stream, known);
        }
        (rest, is_mostly_off)
    }

    /// Sweeps that are of another clock.
    fn off_sweeps(&self) -> usize {
        let off = self.off.iter().filter(|(stream, _)| is_sweep(**stream));
        off.map(|(_, count)| *count).max().unwrap_or(0)
    }
}

/// Whether an agent's stamps are of another clock than its log times.
fn clock(times: &AgentTimes, standing: bool) -> Option<String> {
    let streams = times
        .streams
        .iter()
        .filter(|(stream, _)| !(standing && is_pose(**stream)));
    let messages = streams.flat_map(|(stream, times)| times.iter().map(move |time| (*stream, time)));
    let messages: Vec<(Stream, &[Nanos; 2])> = messages.collect();
    for wrong in [Step::Off, Step::Ahead] {
        let is_wrong = |(stream, [stamp, ready]): &(Stream, &[Nanos; 2])| Step::of(*stream, *stamp, *ready) == wrong;
        let lost: Vec<_> = messages.iter().filter(|message| is_wrong(message)).collect();
        let Some((_, [stamp, ready])) = lost.first() else {
            continue;
        };
        let mut topics: Vec<&str> = lost.iter().map(|(stream, _)| stream.as_str()).collect();
        topics.dedup();
        return Some(format!(
            "`{}`: {} of {} messages ({}) are of another clock than the log times: {}; set the clock of that sensor or computer, or \
             take the difference from its stamps when the log is written; log times say when messages existed, on the same clock",
            times.agent,
            lost.len(),
            messages.len(),
            topics.join(", "),
            clock_words(*stamp, *ready)
        ));
    }
    None
}

/// Sweeps that get no pose, of each stream of poses.
fn poses(times: &AgentTimes, standing: bool) -> Vec<String> {
    let (agent, sweeps) = (&times.agent, stamps(times.sweeps()));
    if sweeps.is_empty() || standing {
        return Vec::new();
    }
    let streams = [Stream::Pose, Stream::PoseTruth].into_iter();
    let there: Vec<Stream> = streams.filter(|stream| times.streams.contains_key(stream)).collect();
    if there.is_empty() {
        return vec![format!(
            "`{agent}` has sweeps and no poses: write {}, at 10 Hz or more",
            Stream::Pose.topic(agent)
        )];
    }
    there
        .into_iter()
        .filter_map(|stream| unposed(times, stream, &sweeps))
        .collect()
}

/// Sweeps that get no pose of a stream.
fn unposed(times: &AgentTimes, stream: Stream, sweeps: &[Nanos]) -> Option<String> {
    let (agent, poses) = (&times.agent, times.stamps(stream));
    let lost: Vec<Nanos> = sweeps
        .iter()
        .copied()
        .filter(|stamp| !is_posed(&poses, *stamp, MAX_GAP))
        .collect();
    let first = *lost.first()?;
    let why = match (poses.len(), median_gap(&poses)) {
        (1, _) => "it has one pose, which holds at all times for roadside units alone".to_string(),
        (_, gap) if gap > MAX_GAP => format!("poses come every {} ms", millis(gap)),
        _ => format!("at {} s {}", seconds(first), around(&poses, first)),
    };
    let whose = match stream {
        Stream::PoseTruth => format!(" on {}, which offline runs and `--pose true` take", stream.topic(agent)),
        _ => String::new(),
    };
    Some(format!(
        "`{agent}`: {} of {} sweeps have no pose{whose}: {why}; at most {} ms are bridged: write poses at 10 Hz or more that span the \
         sweeps, or give `--set NODE.max_gap_ms=…` of the node `sync` more",
        lost.len(),
        sweeps.len(),
        millis(MAX_GAP)
    ))
}

/// Where the poses around a stamp are, in words.
fn around(poses: &[Nanos], stamp: Nanos) -> String {
    let next = poses.partition_point(|pose| *pose < stamp);
    match (next.checked_sub(1).map(|before| poses[before]), poses.get(next)) {
        (Some(before), Some(after)) => format!("poses lie {} ms apart", millis(after - before)),
        _ => nearest_words(Some(nearest(poses, stamp))),
    }
}

/// Sweeps whose points lie in another frame than the body, and that no transform brings there at their time.
fn unplaced(log: &Log, times: &AgentTimes) -> Result<Option<String>, LogError> {
    let (agent, sweeps) = (&times.agent, stamps(times.sweeps()));
    let lost = log.unplaced(agent, &sweeps)?;
    Ok(lost.map(|(count, first, reason)| {
        format!(
            "`{agent}`: {count} of {} sweeps have no pose in the body frame: at {} s {reason}: write transforms on /tf at 10 Hz or more \
             that span the sweeps, or points in `{agent}/body`",
            sweeps.len(),
            seconds(first)
        )
    }))
}

/// Sweeps whose transform from the map is not at the agent's pose.
fn transforms_apart(log: &Log, agent: &str) -> Result<Option<String>, LogError> {
    let apart = TransformsApart::read(log, agent)?;
    let [note, remedy] = TRANSFORMS_DIFFER;
    Ok(apart
        .map(|TransformsApart { count, of, first }| format!("`{agent}`: {count} of {of} {note} ({first}); {remedy}")))
}

/// Messages whose stamp is that of none that they belong to.
fn joins(times: &AgentTimes, end: Nanos) -> Vec<String> {
    let sweeps = stamps(times.sweeps());
    let (mut found, mut elsewhere) = (Vec::new(), 0);
    let truths = [Stream::GroundTruth, Stream::OwnLabels];
    for stream in truths.into_iter().chain([Stream::Detections]) {
        let own = times.stamps(stream);
        let lost = match truths.contains(&stream) {
            true => lost_truth(&own, &sweeps),
            false => unmatched(&own, &sweeps),
        };
        if stream == Stream::Detections {
            elsewhere = lost.len() + times.off.get(&stream).copied().unwrap_or(0);
        }
        // What belongs to sweeps of another clock is named with these.
        if lost.len() > times.off_sweeps() {
            found.extend(mismatch(times, stream, &lost, own.len(), ("sweep", &sweeps)));
        }
    }
    found.extend(bare(times, end, elsewhere as u64));
    let pairs = [
        (Stream::DetectionsInfo, Stream::Detections),
        (Stream::GroundTruthInfo, Stream::GroundTruth),
        (Stream::OwnLabelsInfo, Stream::OwnLabels),
        (Stream::GroundTruthViews, Stream::GroundTruth),
        (Stream::OwnLabelsViews, Stream::OwnLabels),
    ];
    for (stream, of) in pairs {
        let (own, others) = (times.stamps(stream), times.stamps(of));
        let lost = unmatched(&own, &others);
        found.extend(mismatch(
            times,
            stream,
            &lost,
            own.len(),
            ("message of what it belongs to", &others),
        ));
    }
    found
}

/// Sweeps without detections, of an agent that has some.
fn bare(times: &AgentTimes, end: Nanos, elsewhere: u64) -> Option<String> {
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
fn lost_truth(own: &[Nanos], sweeps: &[Nanos]) -> Vec<Nanos> {
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

/// Stamps of a stream, in the order of their log times.
///
/// # Errors
/// A log that cannot be read.
pub(crate) fn read_stamps(log: &Log, agent: &str, stream: Stream) -> Result<Vec<Nanos>, LogError> {
    let mut reader = log.read_all(&[(agent, stream)])?;
    let mut stamps = Vec::new();
    while let Some(entry) = reader.next()? {
        stamps.push(entry.stamp());
    }
    stamps.sort_unstable();
    Ok(stamps)
}

fn mismatch(
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

/// Agents whose sweeps have no time in common with those of an agent before them.
fn apart(agents: &[AgentTimes]) -> Vec<String> {
    let spans = agents.iter().filter_map(|times| {
        let sweeps = stamps(times.sweeps());
        Some((&times.agent, [*sweeps.first()?, *sweeps.last()?]))
    });
    let spans: Vec<_> = spans.collect();
    let of = |index: usize| {
        let (other, span) = spans[index];
        let mut before = spans[..index].iter();
        let (one, words) = before.find_map(|(one, own)| {
            let words = no_common_time(*own, span, &format!("those of `{one}`"))?;
            Some((one, words))
        })?;
        Some(format!(
            "`{one}` and `{other}` have no time in common: the sweeps of `{other}` are apart, {words}; move stamps and log times of one \
             of them when the log is written"
        ))
    };
    (0..spans.len()).filter_map(of).collect()
}

/// Sweeps that are missing: in the middle of each agent's, and, where all have a time in common, at their beginning and end.
fn gaps(agents: &[AgentTimes], with_ends: bool) -> Vec<String> {
    let mut gaps = Gaps::default();
    for times in agents {
        let agent = Name::from(times.agent.as_str());
        let sweeps = stamps(times.sweeps()).into_iter().map(|stamp| (stamp, true));
        let streams = [Stream::Pose, Stream::PoseTruth].into_iter();
        let poses = streams
            .flat_map(|stream| times.stamps(stream))
            .map(|stamp| (stamp, false));
        let mut all: Vec<(Nanos, bool)> = sweeps.chain(poses).collect();
        all.sort_unstable();
        for (stamp, is_sweep) in all {
            match is_sweep {
                true => gaps.sweep(&agent, stamp),
                false => gaps.pose(&agent, stamp),
            }
        }
    }
    let found = match with_ends {
        true => gaps.end(None),
        false => gaps.middle(),
    };
    let [note, remedy] = SWEEPS_MISSING;
    let of_agent = |times: &AgentTimes| {
        let own: Vec<_> = found.iter().filter(|(agent, _)| **agent == *times.agent).collect();
        let (_, first) = own.first()?;
        let lost: u64 = own.iter().map(|(_, missing)| missing.sweeps).sum();
        let all = lost + times.sweeps().len() as u64;
        let agent = &times.agent;
        Some(format!("`{agent}`: {lost} of {all} {note} ({}); {remedy}", first.place))
    };
    // Where some sweeps are of another clock, that is said already.
    let known = agents.iter().filter(|times| times.off_sweeps() == 0);
    known.filter_map(of_agent).collect()
}

/// Those that are the same as none of the others, both rising.
fn unmatched(stamps: &[Nanos], others: &[Nanos]) -> Vec<Nanos> {
    let is_lost = |stamp: &Nanos| others.is_empty() || nearest(others, *stamp) > SAME_STAMP;
    stamps.iter().copied().filter(is_lost).collect()
}

/// How far the nearest of rising stamps lies, ns.
fn nearest(stamps: &[Nanos], stamp: Nanos) -> Nanos {
    let next = stamps.partition_point(|other| *other < stamp);
    let around = &stamps[next.saturating_sub(1)..stamps.len().min(next + 1)];
    around
        .iter()
        .map(|other| (other - stamp).abs())
        .min()
        .unwrap_or(Nanos::MAX)
}

fn median_gap(stamps: &[Nanos]) -> Nanos {
    let mut gaps: Vec<Nanos> = stamps.array_windows().map(|[one, next]| next - one).collect();
    gaps.sort_unstable();
    gaps.get(gaps.len() / 2).copied().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    const T: Nanos = 1_700_000_000_000_000_000;
    const MS: Nanos = 1_000_000;
    const END: Nanos = T + 2_050 * MS;

    /// Twenty messages, 0.1 s apart, moved by `stamp` and logged `late` after that, ms.
    fn every(period: Nanos, stamp: Nanos, late: Nanos) -> Times {
        (0..2_000 / period)
            .map(|k| T + (k * period + stamp) * MS)
            .map(|stamp| [stamp, stamp + late * MS])
            .collect()
    }

    fn agent(streams: &[(Stream, Times)]) -> AgentTimes {
        AgentTimes {
            agent: "car".into(),
            streams: streams.iter().cloned().collect(),
            ..AgentTimes::default()
        }
    }

    #[test]
    fn a_healthy_agent_has_no_findings() {
        let healthy = agent(&[
            (Stream::Pose, every(50, -200, 0)),
            (Stream::Sweeps, every(100, 0, 90)),
            (Stream::Detections, every(100, 0, 150)),
            (Stream::GroundTruth, every(200, 0, 90)),
        ]);
        assert_eq!(clock(&healthy, false), None);
        assert!(!healthy.without_off(false).1);
        assert_eq!((poses(&healthy, false), joins(&healthy, END)), (Vec::new(), Vec::new()));
        let two = [healthy, agent(&[(Stream::Sweeps, every(100, 20, 90))])];
        assert_eq!((apart(&two), gaps(&two, true)), (Vec::new(), Vec::new()));
    }

    #[test]
    fn stamps_that_match_nothing_say_how_far_the_nearest_is() {
        let off = |by: Nanos| {
            let moved = |times: Times| times.into_iter().map(|[stamp, ready]| [stamp + by, ready]).collect();
            joins(
                &agent(&[
                    (Stream::Sweeps, every(100, 0, 90)),
                    (Stream::GroundTruth, moved(every(100, 0, 90))),
                    (Stream::Detections, moved(every(100, 0, 90))),
                ]),
                END,
            )
        };
        assert_eq!(off(-128), Vec::<String>::new());
        let said = off(12 * MS);
        assert_eq!(said.len(), 2, "{said:?}");
        for (said, topic) in said.iter().zip(["/car/ground_truth", "/car/detections"]) {
            assert!(
                said.starts_with(&format!("{topic}: 20 of 20 ")) && said.contains("12.000 ms away"),
                "{said}"
            );
        }
    }

    #[test]
    fn sweeps_without_detections_are_named() {
        let said = |times: Times| {
            let streams = [(Stream::Sweeps, every(100, 0, 90)), (Stream::Detections, times)];
            joins(&agent(&streams), END)
        };
        let all = every(100, 0, 150);
        assert_eq!(said(all.clone()), Vec::<String>::new());
        assert!(said(all[..17].to_vec())[0].starts_with("`car`: 3 of 20 sweeps have no"));
        let holes = [&all[..5], &all[8..]].concat();
        let said = said(holes);
        assert!(
            said[0].starts_with("`car`: 3 of 20 sweeps have no recorded detections"),
            "{said:?}"
        );
    }

    #[test]
    fn truth_on_another_clock_is_found_whole_or_in_part() {
        let joined = |truth: Times, detections: Times| {
            let streams = [
                (Stream::Sweeps, every(100, 0, 90)),
                (Stream::GroundTruth, truth),
                (Stream::Detections, detections),
            ];
            joins(&agent(&streams), END)
        };
        let off = every(100, 37_000, 90);
        let said = joined(off.clone(), every(100, 0, 90));
        assert_eq!(said.len(), 1, "{said:?}");
        let words =
            "20 of 20 messages have the stamp of no sweep: the nearest lies 35.100 s away: looks like TAI against UTC";
        assert!(said[0].contains(words), "{said:?}");
        assert!(joined(every(100, 0, 90), off.clone())[0].contains(words));
        // The clock jumps midway; a clock is late.
        let half: Times = [&every(100, 0, 90)[..10], &off[10..]].concat();
        assert!(joined(half, every(100, 0, 90))[0].contains("10 of 20 messages"));
        let said = joined(every(100, -37_000, 90), every(100, 0, 90));
        assert!(said[0].contains("looks like UTC against TAI"), "{said:?}");
        // Truth that begins earlier and ends later, or comes at 2 Hz, is not a fault.
        let longer: Times = (-20..40).map(|k| T + k * 100 * MS).map(|t| [t, t + 90 * MS]).collect();
        let rare: Times = longer.iter().copied().step_by(5).collect();
        for truth in [longer, rare] {
            assert_eq!(joined(truth, every(100, 0, 90)), Vec::<String>::new());
        }
    }

    #[test]
    fn slow_single_and_missing_poses_are_named() {
        let said = |times: Option<Times>| {
            let sweeps = (Stream::Sweeps, every(100, 0, 90));
            let streams: Vec<_> = times
                .map(|times| (Stream::Pose, times))
                .into_iter()
                .chain([sweeps])
                .collect();
            poses(&agent(&streams), false).concat()
        };
        assert!(said(Some(every(200, 0, 0))).contains("10 of 20 sweeps have no pose: poses come every 200 ms"));
        assert!(said(Some(every(200, 0, 0)[..1].to_vec())).contains("19 of 20 sweeps have no pose: it has one pose"));
        assert!(said(Some(every(50, 0, 0)[..20].to_vec())).contains("the nearest lies"));
        assert!(said(None).contains("no poses: write /car/pose"));
    }

    #[test]
    fn clocks_and_ends_are_named() {
        let off = agent(&[(Stream::Points, every(100, 37_000, -36_910))]);
        assert!(off.without_off(false).1 && clock(&off, false).unwrap().contains("TAI"));
        let ahead = agent(&[(Stream::Points, every(100, 200, -110))]);
        assert!(!ahead.without_off(false).1 && clock(&ahead, false).unwrap().contains("0.110 s later than log times"));
        let named = |name: &str, times: Times| AgentTimes {
            agent: name.into(),
            ..agent(&[(Stream::Sweeps, times)])
        };
        let one = || named("one", every(100, 0, 90));
        let said = apart(&[one(), named("other", every(100, 37_000, 90))]);
        assert!(
            said[0].contains("`one` and `other` have no time in common") && said.len() == 1,
            "{said:?}"
        );
        assert!(
            said[0].contains("begin 37.000 s later than those of `one`: looks like TAI"),
            "{said:?}"
        );
        let said = gaps(&[one(), named("other", every(100, 0, 90)[..10].to_vec())], true);
        assert!(
            said.len() == 1 && said[0].starts_with("`other`: 10 of 20 sweeps are missing"),
            "{said:?}"
        );
        let holes = [&every(100, 0, 90)[..5], &every(100, 0, 90)[12..]].concat();
        let said = gaps(&[one(), named("other", holes)], false);
        assert!(
            said[0].contains("7 of 20") && said[0].contains("none for 0.800 s"),
            "{said:?}"
        );
    }

    #[test]
    fn one_sweep_of_another_clock_hides_nothing_else() {
        let mut sweeps = every(100, 0, 90);
        sweeps[0][0] -= 37_000 * MS;
        let mut detections = every(100, 0, 150);
        detections[0][0] = sweeps[0][0];
        detections.drain(4..7);
        let times = agent(&[(Stream::Sweeps, sweeps), (Stream::Detections, detections)]);
        assert!(clock(&times, false).unwrap().contains("1 of 37 messages (sweeps)"));
        let (rest, is_off) = times.without_off(false);
        assert!(!is_off);
        let said = joins(&rest, END);
        assert!(
            said.len() == 1 && said[0].starts_with("`car`: 3 of 19 sweeps have no"),
            "{said:?}"
        );
    }
}
