//! What is wrong with a log that can be read: what a run of it would stumble over, or score wrongly.

use std::collections::BTreeMap;

use realo_schemas::{Nanos, to_seconds};

use crate::timing::{self, AgentTimes, Times};
use crate::track_faults::track_faults;
use crate::{Log, LogError, Stream};

/// What a run of the log would stumble over.
///
/// # Errors
/// A log that cannot be read.
pub(crate) fn problems(log: &Log) -> Result<Vec<String>, LogError> {
    let (mut problems, mut agents) = (Vec::new(), Vec::new());
    for agent in &log.info().agents {
        let mut times = AgentTimes {
            agent: agent.name.clone(),
            ..AgentTimes::default()
        };
        for stream in [Stream::Pose, Stream::PoseTruth] {
            problems.extend(unusable_poses(log, &agent.name, stream)?);
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
            match times_of(log, &agent.name, stream)? {
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
    Ok(problems)
}

/// What is wrong with poses that cannot be used.
fn unusable_poses(log: &Log, agent: &str, stream: Stream) -> Result<Option<String>, LogError> {
    if !log.has(agent, stream) {
        return Ok(None);
    }
    let mut reader = log.read_all(&[(agent, stream)])?;
    let (mut all, mut lost, mut first) = (0, 0, None);
    while let Some(entry) = reader.next()? {
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
/// again.
fn times_of(log: &Log, agent: &str, stream: Stream) -> Result<Result<Times, String>, LogError> {
    let mut reader = log.read_all(&[(agent, stream)])?;
    let (mut times, mut apart) = (Times::new(), Vec::new());
    loop {
        match reader.next() {
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

/// Classes of the objects in the ground truth of all agents, and how often each is there.
///
/// # Errors
/// A log that cannot be read.
pub fn truth_classes(log: &Log) -> Result<BTreeMap<String, u64>, LogError> {
    let agents = log.info().agents.iter().map(|agent| agent.name.as_str());
    let wanted = agents.filter(|agent| log.has(agent, Stream::GroundTruth));
    let wanted: Vec<(&str, Stream)> = wanted.map(|agent| (agent, Stream::GroundTruth)).collect();
    let mut classes = BTreeMap::new();
    let mut reader = log.read_all(&wanted)?;
    while let Some(entry) = reader.next()? {
        for object in entry.boxes()?.0 {
            *classes.entry(object.class.to_string()).or_default() += 1;
        }
    }
    Ok(classes)
}
