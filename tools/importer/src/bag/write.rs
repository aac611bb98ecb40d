//! Writes the log of bags.

use std::path::Path;

use realo_bags::messages::Kind;
use realo_logs::{AgentInfo, AgentKind, Levelled, LogInfo, LogWriter};
use realo_schemas::{Boxes, Nanos};

use super::agents::Agent;
use super::clocks::Clocks;
use super::objects::Timeline;
use super::small::{AgentSmall, Small};
use super::sweeps::{Sweep, Sweeps, height, mount};
use super::track::{Track, origin, track};
use super::{BagAgent, BagSummary, Counted, Import};
use crate::ImportError;
use crate::level::by_pose;
use crate::places::recorded;
use crate::scenes::{Placed, points_in_boxes, residual};

/// Sweeps of two agents that are so near are compared, ns.
const COMPARED: Nanos = 60_000_000;

/// An agent while its sweeps are written.
struct State {
    height: f64,
    truth: Option<Timeline>,
    detections: Option<Timeline>,
    /// Poses that are written already.
    posed: usize,
    sparse: bool,
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
    let origin = origin.filter(|_| is_earth || import.map.map_origin.is_some());
    let mut log = LogWriter::create_atomic(output, &info(import, &small, &states, origin))?;
    let all: u64 = import
        .agents
        .iter()
        .flat_map(|agent| agent.clouds.iter().map(move |topic| (agent.bag, topic.connection)))
        .map(|(bag, connection)| import.bags[bag].connections()[connection].messages)
        .sum();
    let mut readers = Vec::new();
    for (place, track) in tracks.iter().enumerate() {
        let AgentSmall { heads, .. } = &small.agents[place];
        let frames = &small.bags[import.agents[place].bag].frames;
        let clock = clocks.agents[place].clone();
        readers.push(Sweeps::new(
            import,
            place,
            frames,
            track,
            heads,
            clock,
            states[place].height,
        )?);
    }
    let mut summary = BagSummary::default();
    let mut next: Vec<Option<Sweep>> = Vec::new();
    for reader in &mut readers {
        next.push(reader.next(&mut faults)?);
    }
    loop {
        let soonest = (0..next.len()).filter(|place| next[*place].is_some());
        let soonest = soonest.min_by_key(|place| next[*place].as_ref().map(|sweep| sweep.ready));
        let Some((place, sweep)) = soonest.and_then(|place| Some((place, next[place].take()?))) else {
            break;
        };
        for (other, track) in tracks.iter().enumerate() {
            poses(&mut log, import, clocks, other, &mut states[other], track, sweep.ready)?;
        }
        one(
            &mut log,
            import,
            clocks,
            place,
            &mut states[place],
            &sweep,
            &mut summary,
        )?;
        compare(import, &states, place, &sweep, &mut summary);
        states[place].last = Some(sweep);
        report("importing", readers.iter().map(|reader| reader.read).sum(), all);
        next[place] = readers[place].next(&mut faults)?;
    }
    for (place, track) in tracks.iter().enumerate() {
        // A run needs no poses long after the last sweep.
        let until = states[place]
            .last
            .as_ref()
            .map_or(Nanos::MIN, |sweep| sweep.ready.saturating_add(500_000_000));
        poses(&mut log, import, clocks, place, &mut states[place], track, until)?;
    }
    summary.limited_intensities = readers.iter().map(|reader| reader.limited).sum();
    if let Some((agent, _)) = import
        .agents
        .iter()
        .zip(&states)
        .find(|(_, state)| state.last.is_none())
    {
        let reasons: Vec<String> = faults
            .0
            .iter()
            .map(|(reason, n)| format!("\n  {n} × {reason}"))
            .collect();
        let path = import.bags[agent.bag].path();
        let reason = format!(
            "agent `{}`: expected sweeps, none is left:{}",
            agent.name,
            reasons.concat()
        );
        return Err(ImportError::content(path, reason));
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
    Ok(BagSummary {
        log: output.into(),
        bags: import
            .bags
            .iter()
            .map(|bag| format!("`{}`, {}", bag.path().display(), bag.format()))
            .collect(),
        notes: import.bags.iter().flat_map(|bag| bag.notes().iter().cloned()).collect(),
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

fn state(
    import: &Import,
    small: &mut Small,
    place: usize,
    track: &Track,
    faults: &mut Counted,
) -> Result<State, ImportError> {
    let agent = &import.agents[place];
    let path = import.bags[agent.bag].path();
    let [truth, detections] =
        [&agent.truth, &agent.detections].map(|topic| topic.as_ref().map(|topic| topic.name.clone()));
    let ours = &mut small.agents[place];
    let messages = [std::mem::take(&mut ours.truth), std::mem::take(&mut ours.detections)];
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
    Ok(State {
        sparse: track.is_sparse(),
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
        let lidar = first.and_then(|(stamp, sensor, _)| mount(agent, frames, sensor, *stamp).ok());
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
        .bags
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

/// Writes the poses of an agent that were there at a time of the log.
fn poses(
    log: &mut LogWriter,
    import: &Import,
    clocks: &Clocks,
    place: usize,
    state: &mut State,
    track: &Track,
    until: Nanos,
) -> Result<(), ImportError> {
    if track.is_fixed {
        return Ok(());
    }
    let clock = &clocks.agents[place];
    while let Some((stamp, log_time, world_from_frame)) = track.poses.get(state.posed) {
        let stamp = stamp.saturating_add(clock.stamp);
        let ready = log_time.saturating_add(clock.ready).max(stamp);
        if ready > until {
            break;
        }
        state.posed += 1;
        if stamp >= 0 {
            let body = world_from_frame * by_pose(&world_from_frame.rotation, state.height).inverse();
            log.pose(&import.agents[place].name, stamp, ready, &recorded(body))?;
            state.summary.poses += 1;
        }
    }
    Ok(())
}

/// Writes a sweep with what belongs to it.
fn one(
    log: &mut LogWriter,
    import: &Import,
    clocks: &Clocks,
    place: usize,
    state: &mut State,
    sweep: &Sweep,
    summary: &mut BagSummary,
) -> Result<(), ImportError> {
    let agent = &import.agents[place];
    let clock = &clocks.agents[place];
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
        timeline.at(sweep.stamp, bridge, &sweep.world_from_body, &import.map)
    };
    if let Some(mut truth) = found(&state.truth, true) {
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
            *summary.classes.entry(object.class.to_string()).or_default() += 1;
        }
    }
    if let Some(detections) = found(&state.detections, false) {
        let there = detections.log_time.saturating_add(clock.ready).max(ready);
        log.detections(name, stamp, there, &Boxes(detections.boxes))?;
        state.summary.detections += 1;
    }
    Ok(())
}

/// Compares the clouds of every two agents, once.
fn compare(import: &Import, states: &[State], place: usize, sweep: &Sweep, summary: &mut BagSummary) {
    let name = &import.agents[place].name;
    for (agent, state) in import.agents.iter().zip(states) {
        let Some(other) = state.last.as_ref().filter(|_| agent.name != *name) else {
            continue;
        };
        let is_known = |known: &crate::Residual| known.agents.contains(name) && known.agents.contains(&agent.name);
        if (other.ready - sweep.ready).abs() > COMPARED || summary.residuals.iter().any(is_known) {
            continue;
        }
        summary
            .residuals
            .extend(residual(&placed(name, sweep), &placed(&agent.name, other)));
    }
}

fn placed<'a>(name: &'a str, sweep: &'a Sweep) -> Placed<'a> {
    Placed {
        name,
        cloud: &sweep.cloud,
        map_from_body: sweep.world_from_body,
    }
}
