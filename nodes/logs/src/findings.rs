//! What is wrong with a log that can be read: what a run of it would stumble over, or score wrongly.

use std::collections::BTreeMap;

use realo_schemas::{Nanos, to_seconds};

use crate::timing::{self, AgentTimes, Times};
use crate::track_faults::track_faults;
use crate::{Log, LogError, Stream};

/// Classes of objects, and how often each is there.
pub(crate) type Classes = BTreeMap<String, u64>;

/// What a run of the log would stumble over, and the classes of its truth.
///
/// # Errors
/// A log that cannot be read.
pub(crate) fn problems(log: &Log) -> Result<(Vec<String>, Classes), LogError> {
    let (mut problems, mut unusable) = (Vec::new(), Vec::new());
    let (mut agents, mut classes) = (Vec::new(), Classes::new());
    for agent in &log.info().agents {
        let mut times = AgentTimes {
            agent: agent.name.clone(),
            ..AgentTimes::default()
        };
        for stream in [Stream::Pose, Stream::PoseTruth] {
            unusable.extend(unusable_poses(log, &agent.name, stream)?);
        }
        for stream in Stream::ALL {
            // Sweeps have the stamps of the points, in less bytes.
            let dear = stream == Stream::Points && log.has(&agent.name, Stream::Sweeps);
            if dear && log.has(&agent.name, stream) {
                let first = log.read_all(&[(&agent.name, stream)])?.next();
                let apart = first.ok().flatten().and_then(|first| first.published_apart());
                problems.extend(apart.map(|apart| two_values(&stream.topic(&agent.name), "the first message", apart)));
            }
            if dear || !log.has(&agent.name, stream) {
                continue;
            }
            match times_of(log, &agent.name, stream, &mut classes)? {
                Ok(known) => drop(times.streams.insert(stream, known)),
                Err(problem) => problems.push(problem),
            }
        }
        agents.push(times);
    }
    if problems.is_empty() {
        problems.extend(timing::findings(log, &agents)?);
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
            // What is there twice is told with its times.
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

/// What is wrong with messages whose publish time lies `apart` ns behind the stamp of their header.
fn two_values(topic: &str, which: &str, apart: Nanos) -> String {
    format!(
        "{topic}: the publish time of {which} is not the stamp of the header, the first lies {:.1} ms behind it: the header's counts; \
         write the stamp as both",
        apart as f64 / 1e6
    )
}

/// The times of a stream, or what is wrong with it: stamps of two values, or the first message that is there twice or starts
/// again. Classes of ground truth are counted.
fn times_of(log: &Log, agent: &str, stream: Stream, classes: &mut Classes) -> Result<Result<Times, String>, LogError> {
    let mut reader = log.read_all(&[(agent, stream)])?;
    let (mut times, mut apart) = (Times::new(), Vec::new());
    let mut next = || {
        let entry = reader.next()?;
        let truth = entry.as_ref().filter(|_| stream == Stream::GroundTruth);
        for object in truth.map(|entry| entry.boxes()).transpose()?.unwrap_or_default().0 {
            *classes.entry(object.class.to_string()).or_default() += 1;
        }
        Ok(entry)
    };
    loop {
        match next() {
            Ok(Some(entry)) => {
                times.push([entry.stamp(), entry.ready()]);
                apart.extend(entry.published_apart());
            }
            Ok(None) if apart.is_empty() => return Ok(Ok(times)),
            Ok(None) => {
                let which = format!("{} of {} messages", apart.len(), times.len());
                return Ok(Err(two_values(&stream.topic(agent), &which, apart[0])));
            }
            Err(LogError::Content {
                topic,
                log_time,
                reason,
            }) => {
                return Ok(Err(format!("{topic} at {:.3} s: {reason}", to_seconds(log_time))));
            }
            Err(error) => return Err(error),
        }
    }
}
