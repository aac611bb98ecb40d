//! Writes the log of bags.

use std::path::Path;

use realo_bags::messages::Kind;
use realo_logs::{AgentInfo, AgentKind, Levelled, LogInfo, LogWriter};
use realo_schemas::{Boxes, Nanos};

use super::agents::Agent;
use super::clocks::Clocks;
use super::motion::MotionQueue;
use super::objects::Timeline;
use super::small::{AgentSmall, Small};
use super::sweeps::{Sweep, Sweeps, height};
use super::track::{Track, origin, track};
use super::warnings::warnings;
use super::{BagAgent, BagSummary, Counted, Import};
use crate::ImportError;
use crate::level::by_pose;
use crate::places::recorded;
use crate::scenes::{Placed, points_in_boxes, residual};

/// What to try where clouds do not fit each other.
const PLACING: &str = "correct `pose`, `frame`, `mounts` or `offset` in the map file";
/// Sweeps of two agents that are so near are compared, ns.
const COMPARED: Nanos = 60_000_000;

/// An agent while its sweeps are written.
struct State {
    height: f64,
    truth: Option<Timeline>,
    detections: Option<Timeline>,
    /// Poses that are written already.
    posed: usize,
    motion: MotionQueue,
    sparse: bool,
    /// What is strange about its objects.
    notes: Vec<String>,
    tilts: [f64; 2],
    last: Option<Sweep>,
    summary: BagAgent,
}

/// Writes the log.
pub fn write(
    import: &Import,
    mut small: Small,
    clocks: &Clocks,
    output: &Path,
    report: &mut dyn FnMut(&'static str, u64, u64),
) -> Result<BagSummary, ImportError> {
    let mut faults = std::mem::take(&mut small.faults);
    let origin = origin(import, &small)?;
    let (mut tracks, mut states) = (Vec::new(), Vec::new());
    for place in 0..import.agents.len() {
        let track = track(import, &small, place, origin, &mut faults)?;
        states.push(state(import, &mut small, place, &track, &mut faults)?);
        tracks.push(track);
    }
    let is_earth = import
        .agents
        .iter()
        .any(|agent| agent.pose.as_ref().is_some_and(|pose| pose.kind == Kind::NavSatFix));
    if let Some(agent) = import.agents.iter().find(|agent| agent.fix.is_some())
        && !is_earth
        && import.map.map_origin.is_none()
    {
        let reason = format!(
            "agents.{}.fix: expected `map_origin: [latitude, longitude, height]` of the world `{}` in the map file, found none: without it \
             positions say nothing of that world; write it, or leave `fix` out",
            agent.name, import.map.world
        );
        return Err(ImportError::Option(reason));
    }
    let origin = origin.filter(|_| is_earth || import.map.map_origin.is_some());
    let mut readers = readers(import, &small, clocks, &tracks, &states)?;
    let mut writing = Writing {
        log: LogWriter::create_atomic(output, &info(import, &small, &states, origin))?,
        import,
        clocks,
        tracks: &tracks,
        states,
        summary: BagSummary::default(),
    };
    writing.sweeps(&mut readers, &mut faults, report)?;
    writing.summary.limited_intensities = readers.iter().map(|reader| reader.limited).sum();
    writing.summary.warnings = warnings(import, &small, &tracks, &readers);
    let notes = writing.states.iter().flat_map(|state| state.notes.iter().cloned());
    writing.summary.warnings.extend(notes);
    let unposed: Vec<Option<String>> = readers.iter().map(Sweeps::why_unposed).collect();
    writing.finish(output, faults, &unposed)
}

/// What reads the sweeps of each agent.
fn readers<'a>(
    import: &'a Import,
    small: &'a Small,
    clocks: &Clocks,
    tracks: &'a [Track],
    states: &[State],
) -> Result<Vec<Sweeps<'a>>, ImportError> {
    let reader = |(place, track): (usize, &'a Track)| {
        let AgentSmall { heads, .. } = &small.agents[place];
        let frames = &small.bags[import.agents[place].bag].frames;
        let clock = clocks.agents[place].clone();
        Sweeps::new(import, place, frames, track, heads, clock, states[place].height)
    };
    tracks.iter().enumerate().map(reader).collect()
}

fn state(
    import: &Import,
    small: &mut Small,
    place: usize,
    track: &Track,
    faults: &mut Counted,
) -> Result<State, ImportError> {
    let agent = &import.agents[place];
    let path = import.joined.bags[agent.bag].path();
    let [truth, detections] =
        [&agent.truth, &agent.detections].map(|topic| topic.as_ref().map(|topic| topic.name.clone()));
    let ours = &mut small.agents[place];
    let messages = [std::mem::take(&mut ours.truth), std::mem::take(&mut ours.detections)];
    let motion = std::mem::take(&mut ours.motion);
    let frames = &small.bags[agent.bag].frames;
    let heads = &small.agents[place].heads;
    let height = height(agent, frames, track, &heads[0])
        .map_err(|reason| ImportError::content(path, format!("agents.{}.{reason}", agent.name)))?;
    let mut timeline = |topic: Option<String>, messages| {
        let topic = topic?;
        Some(Timeline::new(
            messages,
            &topic,
            agent,
            &import.map,
            frames,
            track,
            faults,
        ))
    };
    let [of_truth, of_detections] = messages;
    let (truth, detections) = (timeline(truth, of_truth), timeline(detections, of_detections));
    let words = |of: fn(&super::heads::Heads) -> &String| heads.iter().map(of).cloned().collect::<Vec<_>>().join("; ");
    let clouds: Vec<String> = agent.clouds.iter().map(|topic| format!("`{}`", topic.name)).collect();
    let summary = BagAgent {
        name: agent.name.clone(),
        // To the centimetre, and 0 without a sign.
        height_m: (height * 100.0).round() / 100.0 + 0.0,
        clouds: clouds.join(" and "),
        pose_words: format!("{}{}", track.words, track.step_words()),
        times: words(|heads| &heads.time_words),
        intensities: words(|heads| &heads.intensity_words),
        ..BagAgent::default()
    };
    let motion = MotionQueue::new(motion, agent, frames, height, faults);
    Ok(State {
        motion,
        sparse: track.is_sparse(),
        notes: [&truth, &detections]
            .into_iter()
            .flatten()
            .filter_map(|timeline| timeline.note.clone())
            .collect(),
        height,
        truth,
        detections,
        posed: 0,
        tilts: [f64::INFINITY, 0.0],
        last: None,
        summary,
    })
}

fn info(import: &Import, small: &Small, states: &[State], origin: Option<[f64; 3]>) -> LogInfo {
    let agent = |(place, agent): (usize, &Agent)| {
        let heads = &small.agents[place].heads[0];
        let frames = &small.bags[agent.bag].frames;
        let first = heads.first.first();
        let lidar = first.and_then(|(stamp, sensor, _)| agent.map.mount(frames, sensor, *stamp).ok());
        let position = lidar.map(|pose| {
            let [x, y, z] = pose.translation.vector.into();
            [x, y, z + states[place].height]
        });
        AgentInfo {
            name: agent.name.clone(),
            kind: agent.map.kind,
            footprint: agent.map.footprint.filter(|_| agent.map.kind == AgentKind::Vehicle),
            sensor: format!("LiDAR on {}", agent.clouds[0].name),
            sensor_position: position,
        }
    };
    let agents = import.agents.iter().enumerate().map(agent).collect();
    let names: Vec<String> = import
        .files
        .iter()
        .map(|bag| {
            bag.path()
                .file_name()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned()
        })
        .collect();
    let mut info = LogInfo::new(format!("bags {}", names.join(", ")), agents);
    info.map_origin = origin;
    info.key_frames = match import.agents.iter().any(|agent| agent.truth.is_some()) {
        true => "sweeps with truth".into(),
        false => "none: the bags have no truth".into(),
    };
    info
}

/// A log that is written.
struct Writing<'a> {
    log: LogWriter,
    import: &'a Import,
    clocks: &'a Clocks,
    tracks: &'a [Track],
    states: Vec<State>,
    summary: BagSummary,
}

impl Writing<'_> {
    /// Writes the sweeps of all agents in the order in which they were there, with what belongs to them.
    fn sweeps(
        &mut self,
        readers: &mut [Sweeps],
        faults: &mut Counted,
        report: &mut dyn FnMut(&'static str, u64, u64),
    ) -> Result<(), ImportError> {
        let import = self.import;
        let messages = |agent: &Agent| {
            let connections = import.joined.bags[agent.bag].connections();
            let of = agent.clouds.iter().map(|topic| connections[topic.connection].messages);
            of.sum::<u64>()
        };
        let all = import.agents.iter().map(messages).sum();
        let mut next: Vec<Option<Sweep>> = Vec::new();
        for reader in readers.iter_mut() {
            next.push(reader.next(faults)?);
        }
        loop {
            let soonest = (0..next.len()).filter(|place| next[*place].is_some());
            let soonest = soonest.min_by_key(|place| next[*place].as_ref().map(|sweep| sweep.ready));
            let Some((place, sweep)) = soonest.and_then(|place| Some((place, next[place].take()?))) else {
                break;
            };
            for other in 0..self.states.len() {
                self.poses(other, sweep.ready)?;
                self.motion(other, sweep.ready)?;
            }
            self.sweep(place, &sweep)?;
            self.compare(place, &sweep);
            self.states[place].last = Some(sweep);
            report("importing", readers.iter().map(|reader| reader.read).sum(), all);
            next[place] = readers[place].next(faults)?;
        }
        for place in 0..self.states.len() {
            // A run needs no poses long after the last sweep.
            let last = self.states[place].last.as_ref();
            let until = last.map_or(Nanos::MIN, |sweep| sweep.ready.saturating_add(500_000_000));
            self.poses(place, until)?;
            self.motion(place, until)?;
        }
        Ok(())
    }

    /// Writes what motion sensors of an agent had measured at a time of the log.
    fn motion(&mut self, place: usize, until: Nanos) -> Result<(), ImportError> {
        let (name, clock) = (&self.import.agents[place].name, &self.clocks.agents[place]);
        let state = &mut self.states[place];
        state.motion.write(&mut self.log, name, clock, until)?;
        state.summary.motion = state.motion.counts();
        Ok(())
    }

    /// Writes the poses of an agent that were there at a time of the log.
    fn poses(&mut self, place: usize, until: Nanos) -> Result<(), ImportError> {
        let (track, clock, state) = (&self.tracks[place], &self.clocks.agents[place], &mut self.states[place]);
        if track.is_fixed {
            return Ok(());
        }
        while let Some((at, log_time, world_from_frame)) = track.poses.get(state.posed) {
            let stamp = at.saturating_add(clock.stamp);
            let ready = log_time.saturating_add(clock.ready).max(stamp);
            if ready > until {
                break;
            }
            state.posed += 1;
            if stamp >= 0 {
                let body = world_from_frame * by_pose(&world_from_frame.rotation, state.height).inverse();
                let name = &self.import.agents[place].name;
                let mut pose = recorded(body);
                pose.covariance = track.covariances.get(at).cloned();
                state.summary.covariances += usize::from(pose.covariance.is_some());
                self.log.pose(name, stamp, ready, &pose)?;
                state.summary.poses += 1;
            }
        }
        Ok(())
    }

    /// Writes a sweep with what belongs to it.
    fn sweep(&mut self, place: usize, sweep: &Sweep) -> Result<(), ImportError> {
        let (agent, clock) = (&self.import.agents[place], &self.clocks.agents[place]);
        let (log, state) = (&mut self.log, &mut self.states[place]);
        let (name, stamp, ready) = (&agent.name, sweep.stamp.saturating_add(clock.stamp), sweep.ready);
        if state.sparse {
            log.pose(name, stamp, ready, &recorded(sweep.world_from_body))?;
            state.summary.poses += 1;
        }
        log.cloud(name, stamp, ready, &sweep.cloud)?;
        state.summary.sweeps += 1;
        state.summary.points += sweep.cloud.len();
        state.tilts = [state.tilts[0].min(sweep.tilt), state.tilts[1].max(sweep.tilt)];
        let found = |timeline: &Option<Timeline>, bridge| {
            let timeline = timeline.as_ref()?;
            timeline.at(sweep.stamp, bridge, &sweep.world_from_body, &self.import.map)
        };
        let truth = found(&state.truth, true);
        state.summary.unplaced_truths += usize::from(truth.as_ref().is_some_and(|truth| !truth.is_whole));
        if let Some(mut truth) = truth.filter(|truth| truth.is_whole) {
            // What is centred in the outline is the agent itself.
            if let Some([x0, x1, y0, y1]) = agent.map.footprint {
                let is_itself = |[x, y, _]: [f64; 3]| (x0..=x1).contains(&x) && (y0..=y1).contains(&y);
                truth.boxes.retain(|object| !is_itself(object.center));
            }
            let points = points_in_boxes(&sweep.cloud, &truth.boxes);
            log.truth(name, stamp, ready, &truth.boxes, Some(&points), true)?;
            state.summary.truths += 1;
            state.summary.moved_truths += usize::from(truth.is_moved);
            for object in &truth.boxes {
                *self.summary.classes.entry(object.class.to_string()).or_default() += 1;
            }
        }
        let detections = found(&state.detections, false);
        if let Some(detections) = detections.filter(|found| found.is_whole || !found.boxes.is_empty()) {
            let there = detections.log_time.saturating_add(clock.ready).max(ready);
            log.detections(name, stamp, there, &Boxes(detections.boxes))?;
            state.summary.detections += 1;
        }
        Ok(())
    }

    /// Compares the clouds of every two agents, once.
    fn compare(&mut self, place: usize, sweep: &Sweep) {
        let (name, residuals) = (&self.import.agents[place].name, &mut self.summary.residuals);
        for (agent, state) in self.import.agents.iter().zip(&self.states) {
            let Some(other) = state.last.as_ref().filter(|_| agent.name != *name) else {
                continue;
            };
            let is_known = |known: &crate::Residual| known.agents.contains(name) && known.agents.contains(&agent.name);
            if (other.ready - sweep.ready).abs() > COMPARED || residuals.iter().any(is_known) {
                continue;
            }
            residuals.extend(residual(&placed(name, sweep), &placed(&agent.name, other), PLACING));
        }
    }

    /// Ends the log; an agent without sweeps is an error, with why it has none. `unposed`: why no pose is near sweeps of each agent.
    fn finish(self, output: &Path, faults: Counted, unposed: &[Option<String>]) -> Result<BagSummary, ImportError> {
        let Writing {
            mut log,
            import,
            clocks,
            states,
            summary,
            ..
        } = self;
        if let Some(place) = states.iter().position(|state| state.last.is_none()) {
            let agent = &import.agents[place];
            let reasons = faults.0.iter().map(|(reason, n)| format!("\n  {n} × {reason}"));
            let (name, reasons) = (&agent.name, reasons.collect::<String>());
            let why = unposed[place].as_ref().map_or(String::new(), |why| format!("\n{why}"));
            let reason = format!("agent `{name}`: expected sweeps, none is left:{reasons}{why}");
            return Err(ImportError::content(import.joined.bags[agent.bag].path(), reason));
        }
        let levelled = |(agent, state): (&Agent, &State)| {
            let levelled = Levelled {
                by: Levelled::BY_POSE.into(),
                degrees: state.tilts,
            };
            (agent.name.clone(), levelled)
        };
        log.levelled(import.agents.iter().zip(&states).map(levelled).collect());
        log.finish()?;
        let bags = import.files.iter();
        Ok(BagSummary {
            log: output.into(),
            bags: bags
                .clone()
                .map(|bag| format!("`{}`, {}", bag.path().display(), bag.format()))
                .collect(),
            decoded: bags.clone().flat_map(|bag| bag.decoded().iter().cloned()).collect(),
            notes: bags.flat_map(|bag| bag.notes().iter().cloned()).collect(),
            agents: states.into_iter().map(|state| state.summary).collect(),
            clocks: clocks.words.clone(),
            left_out: faults.0,
            draft: import.draft.clone(),
            world: format!(
                "the world is `{}`, stamps are {} times (`world` and `clock` in the map file)",
                import.map.world,
                import.map.clock.as_str()
            ),
            ..summary
        })
    }
}

fn placed<'a>(name: &'a str, sweep: &'a Sweep) -> Placed<'a> {
    Placed {
        name,
        cloud: &sweep.cloud,
        map_from_body: sweep.world_from_body,
    }
}
