//! Logs of several agents, each by its own clock, as one log by the clock of the first.

use std::collections::BTreeMap;
use std::path::Path;

use realo_schemas::{Boxes, Name, Nanos, to_millis, to_seconds};

use crate::clocks::Shift;
use crate::{Entry, Log, LogError, LogInfo, LogReader, LogWriter, PeerClock, Stream};

/// Logs that are to be one.
#[derive(Debug)]
pub struct Merge<'a> {
    logs: &'a [Log],
    clocks: Vec<Known>,
    /// What is written, by the clock of the first; `None`: all.
    within: Option<[Nanos; 2]>,
}

/// Poses are kept for so long before and after the common time: the sweeps at its ends need them.
const POSES_AROUND: Nanos = 300_000_000;

/// How the times of a log become those of the first.
#[derive(Clone, Debug, Default, PartialEq)]
struct Known {
    /// One after the other: from the log's clock to another's, and so on to the first log's.
    way: Vec<Shift>,
    /// What that is likely off by, ns.
    uncertainty: Nanos,
}

impl Known {
    fn moves(&self, time: Nanos) -> Nanos {
        let moved = self
            .way
            .iter()
            .fold(time, |time, shift| time.saturating_add(shift.of(time)));
        moved - time
    }
}

/// What the times of a log are moved by.
#[derive(Clone, Debug, PartialEq)]
pub struct Moved {
    /// What its first and its last message are, ns.
    pub by: [Nanos; 2],
    /// What that is likely off by, ns.
    pub uncertainty: Nanos,
}

impl<'a> Merge<'a> {
    /// Logs of agents that differ in name, the clocks of all related to the first log's: by what a log reports of the agents of
    /// another, or through others; or by `given`, what an agent's clock is ahead of the first log's, ns, which stands above.
    ///
    /// # Errors
    /// [`LogError::Merge`] says which logs do not fit together, and why.
    pub fn new(logs: &'a [Log], given: &BTreeMap<String, Nanos>) -> Result<Self, LogError> {
        let Some((first, others)) = logs.split_first() else {
            return Err(LogError::Merge("no log: expected two or more".into()));
        };
        for log in others {
            fit(first, log)?;
        }
        for (index, log) in logs.iter().enumerate() {
            for agent in &log.info().agents {
                let same = |other: &&Log| other.info().agent(&agent.name).is_some();
                if let Some(other) = logs[..index].iter().find(same) {
                    let (name, a, b) = (&agent.name, other.path().display(), log.path().display());
                    return Err(LogError::Merge(format!(
                        "{a} and {b} both have agent `{name}`: expected the logs of agents that differ in name"
                    )));
                }
            }
        }
        if let Some(stranger) = given
            .keys()
            .find(|agent| logs.iter().all(|log| log.info().agent(agent).is_none()))
        {
            let has: Vec<&str> = logs.iter().flat_map(|log| names(log.info())).collect();
            return Err(LogError::Merge(format!(
                "a clock is given for `{stranger}`, which no log has; they have: {}",
                has.join(", ")
            )));
        }
        let merge = Merge {
            clocks: clocks(logs, given)?,
            logs,
            within: None,
        };
        merge.overlap()?;
        Ok(merge)
    }

    /// The time that all logs have, and the time that any has, by the clock of the first.
    pub fn spans(&self) -> [[Nanos; 2]; 2] {
        let spans = (0..self.logs.len()).filter_map(|index| self.span(index));
        let widest = [[Nanos::MIN, Nanos::MAX], [Nanos::MAX, Nanos::MIN]];
        spans.fold(widest, |[common, any], [from, until]| {
            [
                [common[0].max(from), common[1].min(until)],
                [any[0].min(from), any[1].max(until)],
            ]
        })
    }

    /// Only what is of the time that all logs have.
    ///
    /// # Errors
    /// [`LogError::Merge`] if there is none.
    pub fn of_common_time(self) -> Result<Self, LogError> {
        let [common, _] = self.spans();
        if common[0] >= common[1] {
            return Err(self.no_common_time(common));
        }
        Ok(Merge {
            within: Some(common),
            ..self
        })
    }

    fn no_common_time(&self, [from, until]: [Nanos; 2]) -> LogError {
        let path_of = |is: &dyn Fn([Nanos; 2]) -> bool| {
            let index = (0..self.logs.len()).find(|index| self.span(*index).is_some_and(is));
            self.logs[index.unwrap_or_default()].path().display()
        };
        let gap = to_millis(from - until) * 1e-3;
        LogError::Merge(format!(
            "{} begins {gap:.3} s after {} ends, so no time is in all logs: merge fewer logs, or drop --common",
            path_of(&|[first, _]| first == from),
            path_of(&|[_, last]| last == until),
        ))
    }

    /// Whether a message is of the time that is written; by its stamp, which a sweep and its boxes share.
    fn is_within(&self, stream: Stream, stamp: Nanos) -> bool {
        let around = match stream {
            Stream::Pose | Stream::PoseTruth | Stream::Imu | Stream::Fix | Stream::Wheels => POSES_AROUND,
            _ => 0,
        };
        let in_it = |[from, until]: [Nanos; 2]| (from - around..=until + around).contains(&stamp);
        self.within.is_none_or(in_it)
    }

    /// When the first and the last message of a log were there, by the clock of the first.
    fn span(&self, index: usize) -> Option<[Nanos; 2]> {
        let (first, last) = self.logs[index].span()?;
        Some([first, last].map(|time| time.saturating_add(self.clocks[index].moves(time))))
    }

    /// What the times of each log are moved by.
    pub fn moved(&self) -> Vec<Moved> {
        let moved = |(log, clock): (&Log, &Known)| {
            let (first, last) = log.span().unwrap_or_default();
            Moved {
                by: [clock.moves(first), clock.moves(last)],
                uncertainty: clock.uncertainty,
            }
        };
        self.logs.iter().zip(&self.clocks).map(moved).collect()
    }

    /// Writes the log, which appears when it is finished.
    ///
    /// # Errors
    /// A log that cannot be read; one of them as the target; why writing failed.
    pub fn write(&self, target: &Path) -> Result<(), LogError> {
        self.write_with(target, |_, _| ())
    }

    /// Writes the log, as [`Merge::write`]; `progress` is called with the seconds of the logs that are written, and with all.
    ///
    /// # Errors
    /// Those of [`Merge::write`].
    pub fn write_with(&self, target: &Path, mut progress: impl FnMut(f64, f64)) -> Result<(), LogError> {
        let same = |log: &&Log| {
            let both = [log.path(), target].map(|path| path.canonicalize().ok());
            both[0].is_some() && both[0] == both[1]
        };
        if self.logs.iter().any(|log| same(&log)) {
            return Err(LogError::input(
                target,
                "it is one of the logs that are read; choose another file",
            ));
        }
        let mut writer = LogWriter::create_atomic(target, &self.info())?;
        let mut parts: Vec<Part> = self
            .logs
            .iter()
            .zip(&self.clocks)
            .map(Part::open)
            .collect::<Result<_, _>>()?;
        let (mut first, until) = (None, self.until());
        loop {
            let next = parts
                .iter()
                .enumerate()
                .filter_map(|(index, part)| Some((part.ready()?, index)));
            let Some((ready, index)) = next.min() else { break };
            let from = *first.get_or_insert(ready);
            progress(
                to_seconds(ready.saturating_sub(from)),
                to_seconds(until.saturating_sub(from).max(0)),
            );
            let next = parts[index].stream();
            match next.is_some_and(|(stream, stamp)| self.is_within(stream, stamp)) {
                true => parts[index].write(&mut writer)?,
                false => parts[index].leave_out()?,
            }
        }
        let mut levelled = BTreeMap::new();
        for log in self.logs {
            levelled.extend(log.levelled()?);
        }
        writer.levelled(levelled);
        writer.finish()
    }

    /// When the last message of all logs was there, by the clock of the first.
    fn until(&self) -> Nanos {
        let spans = (0..self.logs.len()).filter_map(|index| self.span(index));
        spans.map(|[_, last]| last).max().unwrap_or(0)
    }

    fn info(&self) -> LogInfo {
        let first = self.logs[0].info();
        let sources: Vec<&str> = self.logs.iter().map(|log| log.info().source.as_str()).collect();
        LogInfo {
            map_frame: first.map_frame.clone(),
            protocol: first.protocol.clone(),
            key_frames: first.key_frames.clone(),
            map_origin: self.logs.iter().find_map(|log| log.info().map_origin),
            ..LogInfo::new(
                format!("merged: {}", sources.join("; ")),
                self.logs.iter().flat_map(|log| log.info().agents.clone()).collect(),
            )
        }
    }

    /// Whether every log has a time in common with the first.
    fn overlap(&self) -> Result<(), LogError> {
        for index in 0..self.logs.len() {
            let path = self.logs[index].path().display();
            let Some([from, until]) = self.span(index) else {
                return Err(LogError::Merge(format!("{path} has no messages")));
            };
            let Some([first, last]) = self.span(0) else { continue };
            if from > last || until < first {
                let gap = to_millis(if from > last { from - last } else { first - until }) * 1e-3;
                return Err(LogError::Merge(format!(
                    "{path} has no time in common with {}: they are {gap:.3} s apart by its clock; expected recordings of one \
                     drive, or say what its clock is ahead (--clock {}=MS)",
                    self.logs[0].path().display(),
                    names(self.logs[index].info()).next().unwrap_or_default()
                )));
            }
        }
        Ok(())
    }
}

fn names(info: &LogInfo) -> impl Iterator<Item = &str> {
    info.agents.iter().map(|agent| agent.name.as_str())
}

/// Whether two logs say the same of what one log says once.
fn fit(first: &Log, log: &Log) -> Result<(), LogError> {
    let (one, other) = (first.info(), log.info());
    for (field, one, other) in [
        ("map_frame", &one.map_frame, &other.map_frame),
        ("protocol", &one.protocol, &other.protocol),
    ] {
        if one != other {
            let (a, b) = (first.path().display(), log.path().display());
            return Err(LogError::Merge(format!(
                "`{field}`: {a} has `{one}`, {b} has `{other}`: expected the same in all"
            )));
        }
    }
    match log.info().precomputed {
        None => Ok(()),
        Some(_) => Err(LogError::Merge(format!(
            "{} has precomputed packets: merge the log that it was made from, then precompute",
            log.path().display()
        ))),
    }
}

/// From the clock of each log to the first one's, by the surest steps.
fn clocks(logs: &[Log], given: &BTreeMap<String, Nanos>) -> Result<Vec<Known>, LogError> {
    let mut known: Vec<Option<Known>> = vec![None; logs.len()];
    known[0] = Some(Known::default());
    for (index, log) in logs.iter().enumerate().skip(1) {
        let ahead = names(log.info()).find_map(|agent| given.get(agent));
        known[index] = ahead.map(|ahead| Known {
            way: vec![Shift {
                by: -ahead,
                ..Shift::default()
            }],
            uncertainty: 0,
        });
    }
    // As many rounds as a way can have steps.
    for _ in 0..logs.len() {
        for (from, log) in logs.iter().enumerate() {
            for clock in log.clocks()? {
                let Some(to) = logs.iter().position(|log| log.info().agent(&clock.peer).is_some()) else {
                    continue;
                };
                offer(&mut known, from, to, clock.to_log(), &clock);
                offer(&mut known, to, from, clock.to_peer(), &clock);
            }
        }
    }
    let unknown = known.iter().position(Option::is_none);
    if let Some(index) = unknown {
        let (first, log) = (&logs[0], &logs[index]);
        let agent = names(log.info()).next().unwrap_or_default();
        return Err(LogError::Merge(format!(
            "no log gives the offset between the clocks of {} and {}: expected logs of agents that heard each other over the radio; \
             or say it, in ms: --clock {agent}=0 where both machines keep one time (GNSS, PTP)",
            log.path().display(),
            first.path().display()
        )));
    }
    Ok(known.into_iter().flatten().collect())
}

/// The clock of `to` becomes known by that of `from`, if it was not, or less surely.
fn offer(known: &mut [Option<Known>], from: usize, to: usize, step: Shift, clock: &PeerClock) {
    let Some(Known { way, uncertainty }) = known[from].clone() else {
        return;
    };
    let uncertainty = uncertainty.saturating_add(clock.uncertainty.max(1));
    if known[to].as_ref().is_none_or(|known| known.uncertainty > uncertainty) {
        known[to] = Some(Known {
            way: [vec![step], way].concat(),
            uncertainty,
        });
    }
}

/// One of the logs, being read.
struct Part<'a> {
    clock: &'a Known,
    reader: LogReader,
    ahead: Option<Entry>,
    /// Boxes that wait for their companion, by agent and stream.
    boxes: BTreeMap<(Name, Stream), Boxes>,
    /// Sweeps without points are written for agents that have none at all.
    bare: Vec<Name>,
}

impl<'a> Part<'a> {
    fn open((log, clock): (&'a Log, &'a Known)) -> Result<Self, LogError> {
        // Markers follow from the truth, and logs with packets are refused.
        let is_read = |stream: &Stream| !matches!(stream, Stream::GroundTruthMarkers | Stream::Packets);
        let streams = || Stream::ALL.into_iter().filter(is_read);
        let all = names(log.info()).flat_map(|agent| streams().map(move |stream| (agent, stream)));
        let wanted: Vec<(&str, Stream)> = all.filter(|(agent, stream)| log.has(agent, *stream)).collect();
        let bare = names(log.info()).filter(|agent| !log.has(agent, Stream::Points));
        let mut reader = log.read_all(&wanted)?;
        Ok(Part {
            clock,
            ahead: reader.next()?,
            reader,
            boxes: BTreeMap::new(),
            bare: bare.map(Name::from).collect(),
        })
    }

    /// When its next message existed, by the clock of the first log.
    fn ready(&self) -> Option<Nanos> {
        let ready = self.ahead.as_ref()?.ready();
        Some(ready.saturating_add(self.clock.moves(ready)))
    }

    /// What its next message is, and its stamp by the clock of the first log.
    fn stream(&self) -> Option<(Stream, Nanos)> {
        let entry = self.ahead.as_ref()?;
        let stamp = entry.stamp();
        Some((entry.stream, stamp.saturating_add(self.clock.moves(stamp))))
    }

    /// Goes on without its next message.
    fn leave_out(&mut self) -> Result<(), LogError> {
        self.ahead = self.reader.next()?;
        Ok(())
    }

    /// Writes its next message.
    fn write(&mut self, writer: &mut LogWriter) -> Result<(), LogError> {
        let Some(entry) = std::mem::replace(&mut self.ahead, self.reader.next()?) else {
            return Ok(());
        };
        let [stamp, ready] = [entry.stamp(), entry.ready()].map(|time| time.saturating_add(self.clock.moves(time)));
        let agent = &*entry.agent;
        match entry.stream {
            Stream::Points => writer.cloud(agent, stamp, ready, &entry.cloud()?),
            Stream::Sweeps if self.bare.contains(&entry.agent) => writer.sweep(agent, stamp, ready),
            Stream::Pose => writer.pose(agent, stamp, ready, &entry.pose()?),
            Stream::PoseTruth => writer.pose_truth(agent, stamp, ready, &entry.pose()?),
            Stream::Imu | Stream::Fix | Stream::Wheels => writer.copy_motion(&entry, stamp, ready),
            Stream::Detections | Stream::GroundTruth | Stream::OwnLabels => {
                self.boxes.insert((entry.agent.clone(), entry.stream), entry.boxes()?);
                Ok(())
            }
            Stream::DetectionsInfo => {
                let mut boxes = self.companion_of(&entry, Stream::Detections);
                entry.info(&mut boxes)?;
                writer.detections(agent, stamp, ready, &boxes)
            }
            Stream::GroundTruthInfo => {
                let mut boxes = self.companion_of(&entry, Stream::GroundTruth);
                let info = entry.info(&mut boxes)?;
                writer.truth(agent, stamp, ready, &boxes.0, info.points.as_deref(), info.key)
            }
            Stream::OwnLabelsInfo => {
                let mut boxes = self.companion_of(&entry, Stream::OwnLabels);
                let info = entry.info(&mut boxes)?;
                writer.own_labels(agent, stamp, ready, &boxes.0, info.points.as_deref(), info.key)
            }
            Stream::GroundTruthViews => writer.truth_views(agent, stamp, ready, &entry.views()?),
            Stream::OwnLabelsViews => writer.own_views(agent, stamp, ready, &entry.views()?),
            Stream::Sweeps | Stream::GroundTruthMarkers | Stream::Packets => Ok(()),
        }
    }

    fn companion_of(&mut self, entry: &Entry, stream: Stream) -> Boxes {
        self.boxes.remove(&(entry.agent.clone(), stream)).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests;
