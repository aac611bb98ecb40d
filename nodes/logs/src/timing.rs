//! What stamps tell that a run of the log would stumble over: clocks, poses, stamps that match nothing, data that stop.

mod gaps;
mod truth;

use std::collections::BTreeMap;

use realo_schemas::{Nanos, body_frame};

use crate::map_points::{TRANSFORMS_DIFFER, TransformsApart};
use crate::words::{millis, nearest_words, seconds};
use crate::{Log, LogError, MAX_GAP, Standing, Step, Stream, clock_words, is_posed};
use gaps::{apart, gaps, median_gap, nearest, unmatched};
pub use truth::{Outside, no_common_time};
use truth::{bare, lost_truth, mismatch};

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
        Stream::PoseTruth => format!(" on {}, which offline runs take", stream.topic(agent)),
        _ => String::new(),
    };
    Some(format!(
        "`{agent}`: {} of {} sweeps have no pose{whose}: {why}; at most {} ms are bridged: write poses at 10 Hz or more that span the \
         sweeps, or give `--set STAGE.max_gap_ms=…` of the stage `sync` more",
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
             that span the sweeps, or points in `{}`",
            sweeps.len(),
            seconds(first),
            body_frame(agent)
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
            "20 of 20 messages have the stamp of no sweep: the nearest is 35.100 s away: looks like TAI against UTC";
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
        assert!(said(Some(every(50, 0, 0)[..20].to_vec())).contains("the nearest is"));
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
