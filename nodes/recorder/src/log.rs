//! What an agent's sensors gave, as a log.
//!
//! Stamps and ready times are those of the messages. The file grows at least every half second of log time: that of a run that
//! was killed can be read.

mod motion;

use std::path::PathBuf;

use crate::RecorderError;
use realo_logs::{AgentInfo, AgentKind, Log, LogInfo, LogWriter, MapOrigin, PeerClock, refuse_foreign};
use realo_operator::{Books, Describe, Error, Inputs, NoOutput, Settings, Sink};
use realo_schemas::report::{self, Peer, from_report};
use realo_schemas::{AgentState, Boxes, GroundTruth, Header, Motion, Nanos, PointCloud, Report};
use serde::{Deserialize, Serialize};

/// Settings of the log recorder.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Path of the log; its folder is made.
    #[setting(default = "sensors.mcap", role = "recording", filled)]
    pub path: PathBuf,
    /// Whose sensors they are.
    #[setting(role = "ego", filled)]
    pub agent: String,
    /// What the agent is, `vehicle` or `roadside`, where `like` does not say.
    #[setting(default = AgentKind::Vehicle)]
    pub kind: AgentKind,
    /// A log with this agent, which gives its kind, outline and sensor: the one that is played; empty = none.
    #[setting(role = "log")]
    pub like: PathBuf,
    /// Whether sweeps have points.
    #[setting(default = true, role = "points")]
    pub points: bool,
}

/// Records what an agent's sensors gave, as a log; `realo merge` joins those of several agents.
#[derive(Describe)]
#[stage(output = NoOutput)]
pub struct LogRecorder {
    agent: String,
    points: bool,
    origin: Option<MapOrigin>,
    log: Option<LogWriter>,
}

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// The agent's sweeps.
    #[port(of(Ego))]
    Clouds(Header, PointCloud),
    /// What it believes of its pose.
    #[port(of(Ego))]
    Poses(Header, AgentState),
    /// What its motion sensors measured.
    #[port(optional, of(Ego))]
    Motion(Header, Motion),
    /// Detections that were recorded with the sweeps.
    #[port(optional, of(Ego))]
    Recorded(Header, Boxes),
    /// What was really there.
    #[port(optional, of(Ego))]
    Truth(Header, GroundTruth),
    /// Topic `peers`, of the radio: how far the clocks of others lie from the agent's.
    #[port(optional)]
    Peers(Header, Report),
}

impl Sink for LogRecorder {
    fn build(settings: Settings) -> Result<Self, Error> {
        let info = info(&settings)?;
        if let Some(folder) = settings.path.parent() {
            std::fs::create_dir_all(folder).map_err(|error| RecorderError::Folder(folder.into(), error))?;
        }
        refuse_foreign(&settings.path)?;
        let origin = info.map_origin.map(MapOrigin::new).transpose();
        Ok(LogRecorder {
            origin: origin.map_err(|reason| RecorderError::Origin(settings.like.clone(), reason))?,
            log: Some(LogWriter::create(&settings.path, &info)?),
            agent: settings.agent,
            points: settings.points,
        })
    }

    fn accept(&mut self, input: Input) -> Result<(), Error> {
        let Some(log) = &mut self.log else {
            return Err(RecorderError::LogFinished.into());
        };
        match input {
            Input::Clouds(Header { stamp, ready, .. }, cloud) => match self.points {
                true => log.cloud(&self.agent, stamp, ready, &cloud)?,
                false => log.sweep(&self.agent, stamp, ready)?,
            },
            Input::Poses(Header { stamp, ready, .. }, state) => log.pose(&self.agent, stamp, ready, &state)?,
            Input::Motion(header, motion) => {
                motion::write(log, &self.agent, &header, &motion, self.origin.as_ref())?;
            }
            Input::Recorded(Header { stamp, ready, .. }, boxes) => log.detections(&self.agent, stamp, ready, &boxes)?,
            Input::Truth(Header { stamp, ready, .. }, truth) => {
                let (agent, points) = (&self.agent, own_points(&truth, &self.agent));
                if !truth.views.is_empty() {
                    log.truth_views(agent, stamp, ready, &truth.views)?;
                }
                log.truth(agent, stamp, ready, &truth.boxes, points.as_deref(), truth.key)?;
                if let Some(own) = &truth.own {
                    if !own.views.is_empty() {
                        log.own_views(agent, stamp, ready, &own.views)?;
                    }
                    let points = (!own.points.is_empty()).then_some(&own.points[..]);
                    log.own_labels(agent, stamp, ready, &own.boxes, points, own.key)?;
                }
            }
            Input::Peers(header, report) => {
                if report.topic != report::PEERS.into() {
                    return Err(RecorderError::Topic(report.topic, Box::new(header)).into());
                }
                let peers: Vec<Peer> = from_report(&report)?;
                log.clocks(peers.iter().filter_map(|peer| clock(peer, header.stamp)).collect());
            }
        }
        Ok(())
    }

    fn finish(&mut self, _: &Books) -> Result<(), Error> {
        match self.log.take() {
            Some(log) => Ok(log.finish()?),
            None => Ok(()),
        }
    }
}

/// What the log says of itself.
fn info(settings: &Settings) -> Result<LogInfo, Error> {
    let Settings { agent, kind, like, .. } = settings;
    let source = format!("the sensors of {agent}");
    if like.as_os_str().is_empty() {
        let agent = AgentInfo {
            name: agent.clone(),
            kind: *kind,
            footprint: None,
            sensor: String::new(),
            sensor_position: None,
        };
        return Ok(LogInfo::new(source, vec![agent]));
    }
    let known = Log::open(like)?;
    known.need_agent(agent)?;
    let known = known.info();
    Ok(LogInfo {
        map_frame: known.map_frame.clone(),
        protocol: known.protocol.clone(),
        key_frames: known.key_frames.clone(),
        map_origin: known.map_origin,
        ..LogInfo::new(
            format!("{source}, played from {}", known.source),
            known.agent(agent).cloned().into_iter().collect(),
        )
    })
}

/// The agent's own points on each object, where somebody counted.
fn own_points(truth: &GroundTruth, agent: &str) -> Option<Vec<u32>> {
    let column = truth.agents.iter().position(|of| **of == *agent)?;
    let rows = truth.points.chunks_exact(truth.agents.len());
    let own: Vec<u32> = rows.map(|row| row[column]).collect();
    (own.len() == truth.boxes.len()).then_some(own)
}

fn clock(peer: &Peer, at: Nanos) -> Option<PeerClock> {
    let nanos = |millis: f64| (millis * 1e6).round() as Nanos;
    Some(PeerClock {
        peer: peer.name.clone(),
        at,
        offset: nanos(peer.clock_ms?),
        uncertainty: nanos(peer.clock_uncertainty_ms?),
        drift: peer.clock_drift_ms_s.unwrap_or(0.0) * 1e-3,
    })
}
