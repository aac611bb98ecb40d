//! What is wrong with a log that can be read: what a run of it would stumble over, or score wrongly.

use std::collections::BTreeMap;

use realo_schemas::geometry::{PLAUSIBLE_BOX, box_fault};
use realo_schemas::{Boxes, Nanos, to_seconds};

use crate::timing::{self, AgentTimes, Times};
use crate::track_faults::track_faults;
use crate::words::{seconds, side};
use crate::{Entry, Log, LogError, Stream};

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
            // Sweeps have the stamps of the points, in less bytes.
            let is_dear = stream == Stream::Points && log.has(&agent.name, Stream::Sweeps);
            let looked = look(log, &agent.name, stream, is_dear, &mut classes)?;
            problems.extend(looked.problems);
            match looked.times {
                Some(_) if is_dear => {}
                Some(known) => drop(times.streams.insert(stream, known)),
                None => are_known = false,
            }
        }
        is_readable &= are_known;
        if are_known {
            agents.push(times);
        }
    }
    let end = log.span().map_or(Nanos::MAX, |(_, last)| last);
    problems.extend(timing::findings(log, &agents, end)?);
    if is_readable {
        problems.extend(track_faults(log)?.iter().map(ToString::to_string));
    }
    problems.extend(unusable);
    Ok((problems, classes))
}

/// What is wrong with poses that cannot be used.
fn unusable_poses(log: &Log, agent: &str, stream: Stream) -> Result<Option<String>, LogError> {
    if !log.has(agent, stream) {
        return Ok(None);
    }
    let mut reader = log.read_all(&[(agent, stream)])?;
    let (mut all, mut lost, mut first) = (0, 0, None);
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
    }
    let topic = stream.topic(agent);
    Ok(first.map(|first| format!("{topic}: {lost} of {all} poses cannot be used: {first}")))
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

/// Looks at a stream, or at its first message: stamps of two values, boxes that no object can have, and the first message that
/// cannot be read, is there twice or starts again. Classes of ground truth and detections are counted.
fn look(log: &Log, agent: &str, stream: Stream, only_first: bool, classes: &mut Classes) -> Result<Looked, LogError> {
    let mut reader = log.read_all(&[(agent, stream)])?;
    let (mut times, mut apart, mut implausible) = (Times::new(), Vec::new(), Implausible::default());
    let mut next = || -> Result<Option<(Entry, Boxes)>, LogError> {
        let Some(entry) = reader.next()? else { return Ok(None) };
        let boxes = match stream {
            Stream::GroundTruth | Stream::OwnLabels | Stream::Detections => entry.boxes()?,
            _ => Boxes::default(),
        };
        Ok(Some((entry, boxes)))
    };
    let topic = stream.topic(agent);
    let mut problems = Vec::new();
    let is_read = loop {
        match next() {
            Ok(Some((entry, boxes))) => {
                times.push([entry.stamp(), entry.ready()]);
                apart.extend(entry.published_apart());
                implausible.note(entry.stamp(), &boxes);
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
                if only_first {
                    break true;
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
    if let Some(first) = apart.first() {
        let which = match only_first {
            true => "the first message".to_string(),
            false => format!("{} of {} messages", apart.len(), times.len()),
        };
        problems.push(two_values(&topic, &which, *first));
    }
    problems.extend(implausible.problem(&topic));
    let times = is_read.then_some(times);
    Ok(Looked { times, problems })
}

/// Boxes that no object can have.
#[derive(Default)]
struct Implausible {
    count: usize,
    of: usize,
    /// Stamp of the first, and what is wrong with it.
    first: Option<(Nanos, String)>,
}

impl Implausible {
    fn note(&mut self, stamp: Nanos, boxes: &Boxes) {
        self.of += boxes.0.len();
        for fault in boxes.0.iter().filter_map(box_fault) {
            self.count += 1;
            self.first.get_or_insert((stamp, fault));
        }
    }

    fn problem(&self, topic: &str) -> Option<String> {
        let (stamp, fault) = self.first.as_ref()?;
        Some(format!(
            "{topic}: {} of {} boxes are left out, because no object can have such numbers: the first, at {:.3} s, has {fault}; {PLAUSIBLE_BOX}: \
             mend the program that wrote them",
            self.count,
            self.of,
            to_seconds(*stamp)
        ))
    }
}
