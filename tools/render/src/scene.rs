use nalgebra::Isometry3;
use realo_logs::AgentKind;
use realo_schemas::geometry::{PoseTrack, Region, relative, yaw_of};
use realo_schemas::{Kind, Nanos, is_same_stamp, to_millis};
use realo_scoring::same_truth;

use crate::{Chosen, Judged, RenderError, clouds};

/// What is to be seen of a frame, in the ego's body frame at its stamp: metres, radians, x forward, y left.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Name of the graph.
    pub graph: String,
    /// Name of the log.
    pub log: String,
    /// How the graph was run, in words.
    pub how: String,
    /// Name of the protocol and the smallest IoU of a true detection.
    pub rule: String,
    /// Number of the ego's sweep.
    pub seq: u64,
    /// Its reference time, ns since the epoch.
    pub stamp: Nanos,
    /// The same from the log's beginning, s.
    pub second: f64,
    /// Whether the frame is scored in the run's results.
    pub key: bool,
    /// Whether boxes came for it.
    pub processed: bool,
    /// Whether the log says what is there.
    pub has_truth: bool,
    /// Smallest points of the ego alone on an object that it counts as having seen.
    pub seen_points: u64,
    /// Where objects count.
    pub region: Region,
    /// The agents of the mode, ego first, whose pose is known.
    pub agents: Vec<Agent>,
    /// Agents, or points of agents, that are not drawn, each with the cause and a remedy.
    pub left_out: Vec<String>,
    /// What was detected and what is there.
    pub judged: Judged,
}

/// An agent and what it measured.
#[derive(Clone, Debug)]
pub struct Agent {
    /// Its name.
    pub name: String,
    /// What it is.
    pub kind: AgentKind,
    /// Its outline in its own body frame, [x min, x max, y min, y max], m, where it has one.
    pub footprint: Option<[f64; 4]>,
    /// Where it is at the ego's stamp, or at its sweep's where its poses do not reach, (x, y), m.
    pub position: [f64; 2],
    /// Its heading then, rad.
    pub yaw: f64,
    /// The points of its sweep nearest the ego's stamp, m.
    pub points: Vec<[f32; 3]>,
    /// Whether the pose at that sweep is known; without it the points are not.
    pub is_posed: bool,
    /// That sweep's stamp minus the ego's, ns; `None` where the log holds no points of it.
    pub sweep_offset: Option<Nanos>,
    /// Ages of its messages that were fused, ns from their stamps to when the ego asked; empty for the ego.
    pub fused: Vec<(Kind, Nanos)>,
}

impl Scene {
    /// Gathers a chosen frame with its points and poses from the log.
    ///
    /// # Errors
    /// A log that cannot be read; a log that does not hold the ego's sweep of that stamp.
    pub fn of(chosen: Chosen) -> Result<Self, RenderError> {
        check_log(&chosen)?;
        let settings = &chosen.result.settings;
        let exact = settings.mode == "offline";
        let level_from_body = level_from_body(&chosen, exact)?;
        let map_from_ego = ego_pose(&chosen, exact, clouds::max_gap(&settings.set, true), &level_from_body)?;
        // Points are drawn from the log, as its bodies lie.
        let map_from_body = map_from_ego * level_from_body;
        let (mut agents, mut left_out) = (Vec::new(), Vec::new());
        for name in &chosen.agents {
            let max_gap = clouds::max_gap(&settings.set, *name == chosen.ego);
            let track = clouds::poses(&chosen.log, name, chosen.stamp, exact, max_gap)?;
            let Some(found) = agent(&chosen, name, &track, [&map_from_ego, &map_from_body])? else {
                left_out.push(unposed(&format!("agent `{name}` is not drawn"), max_gap));
                continue;
            };
            if found.sweep_offset.is_some() && !found.is_posed {
                left_out.push(unposed(&format!("the points of agent `{name}` are not drawn"), max_gap));
            }
            agents.push(found);
        }
        let start = chosen.log.span().map_or(chosen.stamp, |(first, _)| first);
        Ok(Scene {
            graph: settings.graph.clone(),
            log: chosen.result.logs.join(", "),
            how: how(&settings.mode, &settings.link),
            rule: format!("protocol {}, IoU {}", chosen.protocol.name, chosen.iou),
            seq: chosen.seq,
            stamp: chosen.stamp,
            second: realo_schemas::to_seconds(chosen.stamp - start),
            key: chosen.key,
            processed: chosen.processed,
            has_truth: chosen.has_truth,
            seen_points: chosen.protocol.seen_points,
            region: chosen.protocol.region,
            agents,
            left_out,
            judged: chosen.judged,
        })
    }
}

/// Why something is not drawn, with the remedy. `max_gap`: longest gap between poses that was bridged, ns.
fn unposed(what: &str, max_gap: Nanos) -> String {
    format!(
        "{what}: the log has no pose of it then; poses must be at most {} ms apart and span the sweeps: record them at 10 Hz or \
         more, or run with `--set STAGE.max_gap_ms=…` of the stage `sync`",
        to_millis(max_gap)
    )
}

fn how(mode: &str, link: &str) -> String {
    match (mode, link) {
        ("", _) => String::new(),
        // Offline a link does nothing.
        (mode @ "offline", _) | (mode, "") => mode.into(),
        (mode, link) => format!("{mode}, link {link}"),
    }
}

/// Where the run placed the ego; else where the log does.
fn ego_pose(
    chosen: &Chosen,
    exact: bool,
    max_gap: Nanos,
    level_from_body: &Isometry3<f64>,
) -> Result<Isometry3<f64>, RenderError> {
    if let Some(pose) = chosen.header.pose.as_ref().filter(|_| chosen.processed) {
        return Ok(pose.map_from_frame);
    }
    let track = clouds::poses(&chosen.log, &chosen.ego, chosen.stamp, exact, max_gap)?;
    let pose = track
        .at(chosen.stamp)
        .ok_or_else(|| other_log(chosen, "it has no pose of the ego"))?;
    Ok(pose * level_from_body.inverse())
}

/// How the ego's body lies in the level frame in which it was played, at its stamp.
fn level_from_body(chosen: &Chosen, exact: bool) -> Result<Isometry3<f64>, RenderError> {
    let attitude = clouds::attitude(&chosen.log, &chosen.ego, exact)?;
    Ok(attitude.map_or_else(Isometry3::identity, |attitude| attitude.near(chosen.stamp)))
}

/// Refuses a log that does not have the ego's sweep, or has it with other objects than were recorded.
fn check_log(chosen: &Chosen) -> Result<(), RenderError> {
    let (log, ego, stamp) = (&chosen.log, &*chosen.ego, chosen.stamp);
    if !clouds::has_sweep(log, ego, stamp)? {
        return Err(other_log(chosen, "it has no sweep of the ego"));
    }
    let Some(recorded) = &chosen.truth else {
        return Ok(());
    };
    let logged = clouds::truth(log, ego, stamp)?;
    same_truth(recorded, &logged).map_err(|reason| {
        let what = format!("the ground truth is another ({reason}) at the sweep of the ego");
        other_log(chosen, &what)
    })
}

fn other_log(chosen: &Chosen, what: &str) -> RenderError {
    RenderError::OtherLog {
        log: chosen.log.path().into(),
        name: chosen.result.logs.join(", "),
        reason: format!("{what} `{}` at {} ns", chosen.ego, chosen.stamp),
    }
}

fn agent(
    chosen: &Chosen,
    name: &str,
    track: &PoseTrack,
    [map_from_ego, map_from_ego_body]: [&Isometry3<f64>; 2],
) -> Result<Option<Agent>, RenderError> {
    let log = &chosen.log;
    log.need_agent(name)?;
    let is_ego = name == chosen.ego;
    let at = |stamp: Nanos| match is_ego && is_same_stamp(stamp, chosen.stamp) {
        true => Some(*map_from_ego_body),
        false => track.at(stamp),
    };
    let sweep = clouds::nearest(log, name, chosen.stamp)?;
    let stamp = sweep.as_ref().map(|sweep| sweep.stamp());
    // Where poses are rare, the one of its sweep is the nearest that is known.
    let Some(map_from_agent) = at(chosen.stamp).or_else(|| at(stamp?)) else {
        return Ok(None);
    };
    let posed = sweep.as_ref().zip(sweep.as_ref().and_then(|sweep| at(sweep.stamp())));
    let is_posed = posed.is_some();
    let points = match posed {
        Some((sweep, pose)) => clouds::in_ego_frame(&sweep.cloud()?, sweep.stamp(), track, map_from_ego, &pose),
        None => Vec::new(),
    };
    let info = log.info().agent(name);
    let ego_from_agent = relative(map_from_ego, &map_from_agent);
    let ages = chosen.fused.iter().filter(|(message, _)| message.from == name);
    Ok(Some(Agent {
        name: name.into(),
        kind: info.map_or(AgentKind::Vehicle, |info| info.kind),
        footprint: info.and_then(|info| info.footprint),
        position: [ego_from_agent.translation.x, ego_from_agent.translation.y],
        yaw: yaw_of(&ego_from_agent.rotation),
        points,
        is_posed,
        sweep_offset: stamp.map(|stamp| stamp - chosen.stamp),
        fused: ages.map(|(message, age)| (message.kind, *age)).collect(),
    }))
}
