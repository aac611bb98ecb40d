//! What is wrong with a log that can be read: what a run of it would stumble over, or score wrongly.

use std::collections::BTreeMap;

use realo_schemas::{Boxes, Nanos, to_seconds};

use crate::box_faults::box_faults;
use crate::motion_faults::motion_faults;
use crate::timing::{self, AgentTimes, Times};
use crate::truth_faults::{TruthFault, TruthFinding, truth_faults};
use crate::words::{seconds, side};
use crate::{AgentKind, Entry, Log, LogError, Stream};

/// Classes of the boxes of all agents, and how often each is there.
#[derive(Default)]
pub(crate) struct Classes {
    /// Of the ground truth.
    pub truth: BTreeMap<String, u64>,
    /// Of recorded detections.
    pub detections: BTreeMap<String, u64>,
}

/// What a run of the log would stumble over, and the classes of its boxes.
///
/// # Errors
/// A log that cannot be read.
pub(crate) fn problems(log: &Log) -> Result<(Vec<String>, Classes), LogError> {
    let (mut problems, mut unusable) = (Vec::new(), Vec::new());
    let (mut agents, mut classes) = (Vec::new(), Classes::default());
    let mut is_readable = true;
    for agent in &log.info().agents {
        let mut times = AgentTimes {
            agent: agent.name.clone(),
            ..AgentTimes::default()
        };
        for stream in [Stream::Pose, Stream::PoseTruth] {
            unusable.extend(unusable_poses(log, &agent.name, stream)?);
        }
        let there = Stream::ALL.into_iter().filter(|stream| log.has(&agent.name, *stream));
        let mut are_known = true;
        for stream in there {
            let looked = look(log, &agent.name, stream, &mut classes)?;
            problems.extend(looked.problems);
            match looked.times {
                // Sweeps have the stamps of the points.
                _ if stream == Stream::Points && log.has(&agent.name, Stream::Sweeps) => {}
                Some(known) => drop(times.streams.insert(stream, known)),
                None => are_known = false,
            }
        }
        problems.extend(missing_topics(log, &agent.name));
        problems.extend(sweeps_of_two_topics(log, &agent.name).map(|words| format!("`{}`: {words}", agent.name)));
        problems.extend(box_faults(log, &agent.name)?);
        problems.extend(motion_faults(log, &agent.name)?);
        is_readable &= are_known;
        if are_known {
            agents.push(times);
        }
    }
    let end = log.span().map_or(Nanos::MAX, |(_, last)| last);
    problems.extend(timing::findings(log, &agents, end)?);
    if is_readable {
        // What is around a roadside unit is mostly not scored.
        let is_scored = |found: &&TruthFinding| match found.fault {
            TruthFault::Lacking => {
                let info = found.agents.first().and_then(|agent| log.info().agent(agent));
                info.is_none_or(|info| info.kind == AgentKind::Vehicle)
            }
            _ => true,
        };
        let found = truth_faults(log)?;
        problems.extend(found.iter().filter(is_scored).map(ToString::to_string));
    }
    problems.extend(unusable);
    let [note, remedy] = UNDECLARED;
    let undeclared = log.undeclared().into_iter();
    problems.extend(undeclared.map(|(agent, count)| format!("`{agent}`: {count} {note}; {remedy}")));
    Ok((problems, classes))
}

/// What a run needs of an agent and the log lacks.
fn missing_topics(log: &Log, agent: &str) -> Option<String> {
    let has = |streams: [Stream; 2]| streams.into_iter().any(|stream| log.has(agent, stream));
    let sweeps = has([Stream::Points, Stream::Sweeps]);
    // What has sweeps and no poses is named with these.
    (!sweeps).then(|| {
        format!(
            "`{agent}` has no sweeps, and a run needs {} or {} of each agent; topics there: {}; leave the agent out of the log's \
             `agents`, or write its topics",
            Stream::Points.topic(agent),
            Stream::Sweeps.topic(agent),
            log.topics_beside(agent)
        )
    })
}

/// What is said of sweeps that one of two topics has, after how many of how many: what happened, and what to try.
pub const SWEEPS_OF_TWO_TOPICS: [&str; 2] = [
    "sweeps are on one of `points` and `sweeps` alone, so that a run with points and one without play others",
    "write both for each sweep, or no `sweeps` at all",
];

/// How many more sweeps of an agent one of its two topics has, and how many there are; `None` where both have as many. Of a log
/// that was cut, one may reach further.
pub fn sweeps_of_one_topic(log: &Log, agent: &str) -> Option<[u64; 2]> {
    let [points, sweeps] = [Stream::Points, Stream::Sweeps].map(|stream| log.count(agent, stream));
    let is_reported = points > 0 && sweeps > 0 && points != sweeps && log.truncation().is_none();
    is_reported.then(|| [points.abs_diff(sweeps), points.max(sweeps)])
}

fn sweeps_of_two_topics(log: &Log, agent: &str) -> Option<String> {
    let [count, of] = sweeps_of_one_topic(log, agent)?;
    let [note, remedy] = SWEEPS_OF_TWO_TOPICS;
    Some(format!("{count} of {of} {note}; {remedy}"))
}

/// What is said of poses whose covariance cannot be right, after how many of how many: what happened, and what to try.
pub const WRONG_COVARIANCES: [&str; 2] = [
    "have a covariance that cannot be right, and were played as if it were unknown",
    "write variances of 0 or more in m² and rad², or 36 zeros where they are unknown",
];

/// What is said of messages of an agent that the log does not name, after how many: what happened, and what to try.
pub const UNDECLARED: [&str; 2] = [
    "messages were not played, because `agents` of the log's record `realo` does not name the agent",
    "name it there, with its kind, or leave its topics out",
];

/// What is wrong with poses that cannot be used, or whose covariance cannot be right.
fn unusable_poses(log: &Log, agent: &str, stream: Stream) -> Result<Vec<String>, LogError> {
    if !log.has(agent, stream) {
        return Ok(Vec::new());
    }
    let mut reader = log.read_all(&[(agent, stream)])?;
    let (mut all, mut lost, mut first) = (0, 0, None);
    let (mut uncertain, mut first_covariance) = (0, None);
    loop {
        let entry = match reader.next() {
            Ok(Some(entry)) => entry,
            // What is there twice is named with its times.
            Ok(None) | Err(LogError::Content { .. }) => break,
            Err(error) => return Err(error),
        };
        all += 1;
        if let Err(error) = entry.pose() {
            lost += 1;
            first.get_or_insert(error.reason());
        }
        if let Some(fault) = entry.wrong_covariance() {
            uncertain += 1;
            first_covariance.get_or_insert(fault);
        }
    }
    let topic = stream.topic(agent);
    let [note, remedy] = WRONG_COVARIANCES;
    let unusable = first.map(|first| format!("{topic}: {lost} of {all} poses cannot be used: {first}"));
    let uncertain = first_covariance
        .map(|first| format!("{topic}: {uncertain} of {all} poses {note} (the first has {first}); {remedy}"));
    Ok(unusable.into_iter().chain(uncertain).collect())
}

/// What is wrong with messages whose publish time is `apart` ns later than the stamp of their header.
fn two_values(topic: &str, which: &str, apart: Nanos) -> String {
    format!(
        "{topic}: the publish time of {which} is not the stamp of the header, the first is {} s {} it: the header's counts; write the \
         stamp as both",
        seconds(apart),
        side(apart)
    )
}

/// What a stream is found to be.
struct Looked {
    /// Its times; `None` where it cannot be read.
    times: Option<Times>,
    problems: Vec<String>,
}

/// Looks at a stream: stamps of two values, and the first message that cannot be
/// read, is there twice or starts again. Classes of ground truth and detections are counted.
fn look(log: &Log, agent: &str, stream: Stream, classes: &mut Classes) -> Result<Looked, LogError> {
    let mut reader = log.read_all(&[(agent, stream)])?;
    let (mut times, mut apart) = (Times::new(), Vec::new());
    let (mut first_is_whole, mut unreadable) = (None, Unreadable::default());
    let mut next = || -> Result<Option<(Entry, Boxes)>, LogError> {
        let Some(entry) = reader.next()? else { return Ok(None) };
        let boxes = match stream {
            Stream::Points => {
                // Why the first cannot be read is said with how sweeps are read; the others are like it.
                match first_is_whole {
                    None => first_is_whole = Some(entry.look_at_cloud().is_ok()),
                    Some(true) => unreadable.take(entry.look_at_cloud())?,
                    Some(false) => {}
                }
                Boxes::default()
            }
            Stream::GroundTruth | Stream::OwnLabels | Stream::Detections => entry.boxes()?,
            _ => Boxes::default(),
        };
        Ok(Some((entry, boxes)))
    };
    let topic = stream.topic(agent);
    let mut problems = Vec::new();
    let is_whole = loop {
        match next() {
            Ok(Some((entry, boxes))) => {
                times.push([entry.stamp(), entry.ready()]);
                apart.extend(entry.published_apart());
                let counts = match stream {
                    Stream::GroundTruth => Some(&mut classes.truth),
                    Stream::Detections => Some(&mut classes.detections),
                    _ => None,
                };
                if let Some(counts) = counts {
                    for object in &boxes.0 {
                        *counts.entry(object.class.to_string()).or_default() += 1;
                    }
                }
            }
            Ok(None) => break true,
            Err(LogError::Content {
                topic,
                log_time,
                reason,
            }) => {
                problems.push(format!("{topic} at {:.3} s: {reason}", to_seconds(log_time)));
                break false;
            }
            Err(error) => return Err(error),
        }
    };
    problems.extend(unreadable.words(times.len()));
    if let Some(first) = apart.first() {
        let which = format!("{} of {} messages", apart.len(), times.len());
        problems.push(two_values(&topic, &which, *first));
    }
    let times = (is_whole && unreadable.count == 0).then_some(times);
    Ok(Looked { times, problems })
}

/// Sweeps of an agent that cannot be read.
#[derive(Default)]
struct Unreadable {
    count: usize,
    /// Topic, log time and reason of the first.
    first: Option<(String, Nanos, String)>,
}

impl Unreadable {
    /// Counts a message that is not what it should be; other errors are those of the log.
    fn take(&mut self, looked: Result<(), LogError>) -> Result<(), LogError> {
        match looked {
            Err(LogError::Content {
                topic,
                log_time,
                reason,
            }) => {
                self.count += 1;
                self.first.get_or_insert((topic, log_time, reason));
                Ok(())
            }
            other => other,
        }
    }

    /// One line for all of them.
    fn words(&self, all: usize) -> Option<String> {
        let (topic, log_time, reason) = self.first.as_ref()?;
        let at = to_seconds(*log_time);
        Some(match self.count {
            1 => format!("{topic} at {at:.3} s: {reason}"),
            count => format!("{count} of {all} sweeps cannot be read, the first is {topic} at {at:.3} s: {reason}"),
        })
    }
}
