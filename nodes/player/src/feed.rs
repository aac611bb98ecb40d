mod detections;
mod motion;
mod poses;
mod queued;
mod script;
mod sweeps;
mod truth_counts;

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

use nalgebra::Vector3;
use realo_logs::limits::TRUTH_WINDOW;
use realo_logs::{BEHIND_MOST, Bare, Entry, Gaps, Log, LogError, LogReader, Missing, Stream, side};
use realo_schemas::{Header, Kind, Name, Nanos, PointCloud, to_seconds};

use crate::Output;
use crate::counters::{INTENSITIES_LIMITED, STAMPS_DIFFER, SWEEPS_MISSING, TRUTH_NOT_JOINED};
use crate::joins::{Joins, PATIENCE};
use crate::nearest::Nearest;
use crate::standing::{Held, STEP};
use crate::truth::TruthJoin;
use motion::Waiting;
use queued::Queued;
use script::Levelling;
pub use script::Script;

/// Offline, messages leave in order of stamp, which may lie this much before they were ready.
const LATENCY: Nanos = 500_000_000;
/// Poses from so long before the first sweep are sent too, so that it has some.
const LEAD_IN: Nanos = 500_000_000;
/// Nothing on wheels is faster, m/s.
const MAX_SPEED_MPS: f64 = 150.0;
/// Noise of recorded poses is less, m.
const MIN_JUMP_M: f64 = 5.0;
/// Log time between the end of a pass and the start of the next, too long for a pose to be carried across.
const PAUSE: Nanos = 1_000_000_000;

/// A message on its way out, with its release time.
pub type Release = (Nanos, Output);

/// The output of the ego, and of any other agent.
type Sides<P> = [fn(Header, P) -> Output; 2];

/// Turns a log into messages in order of release.
pub struct Feed {
    script: Script,
    agents: Vec<Name>,
    /// By rank, how many numbers a pass takes: of poses, of sweeps and all that is of them, and of motion.
    per_pass: Vec<[u64; 3]>,
    pass: u32,
    period: Nanos,
    reader: LogReader,
    truth: TruthJoin,
    /// Says which sweeps are left out.
    nearest: Option<Nearest>,
    /// Agents whose body frames are made level.
    levels: BTreeMap<Name, Levelling>,
    /// Agents whose frames were levelled otherwise when the log was made: along the ground, where poses need not be level.
    along_ground: BTreeSet<Name>,
    /// By agent and stamp: number and release of recent sweeps.
    sweeps: BTreeMap<Name, BTreeMap<Nanos, (u64, Nanos)>>,
    /// By agent: stamp and position of its newest pose, m.
    last_positions: BTreeMap<Name, (Nanos, Vector3<f64>)>,
    /// By agent: the stamps of all sweeps of this pass.
    stamps: BTreeMap<Name, BTreeSet<Nanos>>,
    gaps: Gaps,
    joins: Joins,
    /// By rank: what motion sensors measured and no message has yet.
    motion: BTreeMap<usize, Waiting>,
    /// By rank: units whose pose holds at all times.
    held: BTreeMap<usize, Held>,
    /// By agent: the sweeps for which no detections have come.
    bare: BTreeMap<Name, Bare>,
    /// Agents some of whose sweeps are of another clock.
    off: BTreeSet<Name>,
    /// Whether it was looked how many of the ego's sweeps are of another clock.
    is_ego_checked: bool,
    /// By agent: intensities that did not fit, as they were counted.
    limited: BTreeMap<String, u64>,
    queue: BinaryHeap<Reverse<Queued>>,
    ended: bool,
    released_to: Nanos,
}

impl Feed {
    pub fn new(script: Script) -> Result<Self, LogError> {
        let agents = script.agents();
        let (first, last) = script.log.span().unwrap_or_default();
        let played = script.until.min(last) - script.from.max(first);
        let period = played.max(0) + PAUSE + LEAD_IN;
        let levels = script.levels()?;
        let held = script.held(&agents)?;
        let mut per_pass: Vec<[u64; 3]> = agents.iter().map(|agent| script.per_pass(agent)).collect();
        held.keys()
            .for_each(|rank| per_pass[*rank][0] = (period / STEP).unsigned_abs() + 1);
        script.count_truth_faults()?;
        script.count_times_apart(&agents)?;
        script.count_sweeps_of_one_topic();
        script.count_undeclared();
        script.count_transforms_apart()?;
        script.count_truth_outside(&agents[0])?;
        Ok(Feed {
            reader: script.open()?,
            truth: script.truth(&agents, &levels)?,
            along_ground: script.along_ground()?,
            nearest: script.nearest(&agents)?,
            levels,
            period: script
                .slot
                .map_or(period, |slot| (period + slot - 1).div_euclid(slot) * slot),
            sweeps: BTreeMap::new(),
            last_positions: BTreeMap::new(),
            stamps: BTreeMap::new(),
            gaps: Gaps::default(),
            joins: Joins::default(),
            motion: BTreeMap::new(),
            held,
            bare: BTreeMap::new(),
            off: BTreeSet::new(),
            is_ego_checked: false,
            limited: BTreeMap::new(),
            queue: BinaryHeap::new(),
            ended: false,
            released_to: Nanos::MIN,
            pass: 0,
            per_pass,
            agents,
            script,
        })
    }

    /// From one pass to the next, ns.
    pub fn period(&self) -> Nanos {
        self.period
    }

    /// By agent, how many numbers a pass takes: of poses, of all else, and of motion.
    pub fn per_pass(&self) -> BTreeMap<Name, [u64; 3]> {
        self.agents.iter().cloned().zip(self.per_pass.iter().copied()).collect()
    }

    /// The first time of the log that is played.
    pub fn begins(&self) -> Nanos {
        self.script.begins()
    }

    /// The next message, `None` after the last pass.
    pub fn next(&mut self) -> Result<Option<Release>, LogError> {
        loop {
            if let Some(release) = self.ripe() {
                return Ok(Some(release));
            }
            if self.ended {
                if self.pass + 1 >= self.script.repeat {
                    return Ok(None);
                }
                self.rewind()?;
            }
            match self.reader.next()? {
                Some(entry) => self.take(&entry)?,
                None => self.end()?,
            }
        }
    }

    fn rewind(&mut self) -> Result<(), LogError> {
        self.pass += 1;
        self.ended = false;
        self.sweeps.clear();
        self.last_positions.clear();
        self.rewind_motion();
        self.reader = self.script.open()?;
        self.truth = self.script.truth(&self.agents, &self.levels)?;
        let begins = self.begins();
        self.held.values_mut().for_each(|held| held.rewind(begins));
        self.released_to = Nanos::MIN;
        Ok(())
    }

    fn end(&mut self) -> Result<(), LogError> {
        self.expire(Nanos::MAX);
        self.send_waiting_motion(Nanos::MAX);
        let lost = self.truth.finish();
        self.count_lost_truth(lost);
        self.count_found_of_truth();
        let has_sweep = |agent: &Name, stamp: Nanos| {
            let stamps = self.stamps.get(agent);
            let near = stamp.saturating_sub(TRUTH_WINDOW)..=stamp.saturating_add(TRUTH_WINDOW);
            stamps.is_some_and(|stamps| stamps.range(near).next().is_some())
        };
        for (agent, [sweeps, of]) in self.truth.unjoined(self.script.is_whole(), has_sweep) {
            self.script.counters.add(&TRUTH_NOT_JOINED, &agent, sweeps, of);
        }
        self.stamps.clear();
        for (agent, Missing { sweeps, place }) in self.gaps.end(Some(&self.agents[0])) {
            self.script
                .counters
                .lost(&SWEEPS_MISSING, &agent, sweeps, sweeps, || place);
        }
        self.count_bare();
        for (agent, n) in self.script.log.limited_intensities() {
            let counted = self.limited.insert(agent.clone(), n).unwrap_or(0);
            self.script
                .counters
                .add(&INTENSITIES_LIMITED, &agent, n.saturating_sub(counted), 0);
        }
        self.ended = true;
        self.released_to = Nanos::MAX;
        Ok(())
    }

    /// The first waiting message, once nothing earlier can come.
    fn ripe(&mut self) -> Option<Release> {
        let first = self.queue.peek()?;
        if first.0.key.0 >= self.released_to {
            return None;
        }
        let Reverse(Queued { mut output, .. }) = self.queue.pop()?;
        Some((output.header_mut().ready, output))
    }

    fn take(&mut self, entry: &Entry) -> Result<(), LogError> {
        let late = entry.ready().saturating_sub(entry.stamp());
        self.hold(entry.ready());
        self.expire(entry.ready());
        self.send_waiting_motion(entry.ready());
        let reach = if self.script.offline { LATENCY + PATIENCE } else { 0 };
        self.released_to = self.released_to.max(entry.ready().saturating_sub(reach));
        if self.is_off(entry)? {
            return Ok(());
        }
        let apart = entry.published_apart();
        let differ = u64::from(apart.is_some());
        self.script
            .counters
            .lost(&STAMPS_DIFFER, &entry.agent, differ, 1, || apart_words(entry, apart));
        // Detections of another clock match no sweep, which is counted.
        let is_strange = late > BEHIND_MOST && self.sweep_of(entry).is_none();
        if self.script.offline && late > LATENCY && !is_strange {
            let (late, most) = (to_seconds(late), to_seconds(LATENCY));
            let reason = format!(
                "it was ready {late:.3} s after its stamp; played offline at most {most} s are expected. If its clock was set back, \
                 `--stamps rebase` gives the stamps that it would have had, and `--stamps drop` leaves such messages out; without \
                 --offline it is played as it is"
            );
            return Err(content(entry, reason));
        }
        let playing = entry.ready() >= self.script.from;
        match entry.stream {
            Stream::Pose | Stream::PoseTruth => self.send_pose(entry),
            Stream::Imu | Stream::Fix | Stream::Wheels => self.take_motion(entry),
            _ if !playing => {}
            Stream::Points => {
                let cloud = self.cloud(entry)?;
                self.send_sweep(entry, cloud)?;
            }
            Stream::Sweeps => self.send_sweep(entry, Some(PointCloud::empty()))?,
            Stream::Detections => self.take_detections(entry)?,
            Stream::DetectionsInfo => self.take_info(entry)?,
            Stream::Packets => self.send_packet(entry)?,
            _ => {}
        }
        Ok(())
    }

    /// Whether the sweep of a message is left out.
    fn is_left_out(&self, entry: &Entry) -> bool {
        let nearest = self.nearest.as_ref();
        nearest.is_some_and(|nearest| nearest.is_too_far(self.rank(entry), entry.stamp(), entry.ready()))
    }

    fn send<P>(&mut self, entry: &Entry, seq: u64, kind: Kind, sides: Sides<P>, payload: P) {
        let release = self.release(entry);
        let from = (self.rank(entry), [entry.stamp(), release]);
        let output = self.output(from, seq, kind, sides, payload);
        self.queue((from.0, release), output);
    }

    /// A message of this pass, by the rank of its agent, stamp and release.
    fn output<P>(
        &self,
        (rank, [stamp, release]): (usize, [Nanos; 2]),
        seq: u64,
        kind: Kind,
        [ego, other]: Sides<P>,
        payload: P,
    ) -> Output {
        let shift = Nanos::from(self.pass) * self.period;
        let [poses, sweeps, motion] = self.per_pass[rank];
        let per_pass = match kind {
            Kind::AgentState => poses,
            Kind::Motion => motion,
            _ => sweeps,
        };
        let seq = seq + u64::from(self.pass) * per_pass;
        let (run, agent) = (&self.script.run, &self.agents[rank]);
        let header = Header::origin(run, agent, kind, seq, stamp + shift, release + shift);
        let of = if rank == 0 { ego } else { other };
        of(header, payload)
    }

    fn queue(&mut self, (rank, release): (usize, Nanos), mut output: Output) {
        let seq = output.header_mut().seq;
        let key = (release, output.place(), rank, seq);
        self.queue.push(Reverse(Queued { key, output }));
    }

    fn rank(&self, entry: &Entry) -> usize {
        self.agents.iter().position(|agent| *agent == entry.agent).unwrap_or(0)
    }

    fn release(&self, entry: &Entry) -> Nanos {
        match self.script.offline {
            true => entry.stamp(),
            false => entry.ready(),
        }
    }
}

fn content(entry: &Entry, reason: String) -> LogError {
    LogError::Content {
        topic: entry.stream.topic(&entry.agent),
        log_time: entry.ready(),
        reason,
    }
}

/// Topic and times of a message whose publish time is not its stamp.
pub(crate) fn apart_words(entry: &Entry, apart: Option<Nanos>) -> String {
    let apart = apart.unwrap_or(0);
    let (topic, far) = (entry.stream.topic(&entry.agent), apart.abs() as f64 / 1e6);
    format!("the first on {topic} is {far:.1} ms {} the header's", side(apart))
}

/// By how much the number of a sweep, of its detections and of its truth rises from one pass over a log to the next.
pub fn sweeps_per_pass(log: &Log, agent: &str) -> u64 {
    // Of a log that was cut, one of the two topics may reach further.
    let streams = [Stream::Points, Stream::Sweeps];
    streams
        .map(|stream| log.count(agent, stream))
        .into_iter()
        .max()
        .unwrap_or(0)
}
