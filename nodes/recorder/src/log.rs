//! What an agent's sensors gave, as a log.
//!
//! | input | type | recorded as |
//! |---|---|---|
//! | `clouds` | PointCloud | `/<agent>/points` and `/<agent>/sweeps` |
//! | `poses` | AgentState | `/<agent>/pose`, `/tf` |
//! | `recorded` | Boxes | `/<agent>/detections`, `…_info` |
//! | `truth` | GroundTruth | `/<agent>/ground_truth`, `…_info`, `…_markers`, with the agent's own points; `…_views`; `/<agent>/own_labels` and theirs |
//! | `peers` | Report | how far the clocks of others lie from the agent's, by which `realo merge` joins logs |
//!
//! Stamps and ready times are those of the messages. The file grows at least every half second of log time: that of a run that
//! was killed can be read.

use std::path::PathBuf;

use realo_logs::{AgentInfo, AgentKind, Log, LogInfo, LogWriter, PeerClock, refuse_foreign};
use realo_operator::{Argument, Books, Decided, Describe, Error, Lane, Port, PortId, Sink};
use realo_schemas::report::{self, Peer, from_report};
use realo_schemas::{GroundTruth, Header, Message, Nanos, Payload, PayloadType};
use serde::{Deserialize, Serialize};

/// Settings of the log recorder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LogConfig {
    /// Path of the log; its folder is made.
    pub path: PathBuf,
    /// Whose sensors they are.
    pub agent: String,
    /// What the agent is, where no other log says so.
    pub kind: AgentKind,
    /// A log that has this agent, and says of it what no message does: what is played.
    pub like: PathBuf,
    /// Whether sweeps have points.
    pub points: bool,
}

impl Default for LogConfig {
    fn default() -> Self {
        LogConfig {
            path: "sensors.mcap".into(),
            agent: String::new(),
            kind: AgentKind::Vehicle,
            like: PathBuf::new(),
            points: true,
        }
    }
}

/// The sink that records sensors.
pub struct LogRecorder {
    agent: String,
    points: bool,
    log: Option<LogWriter>,
}

impl Describe for LogRecorder {
    type Config = LogConfig;
    const NAME: &'static str = "log-recorder";
    const ABOUT: &'static str =
        "records what an agent's sensors gave, as a log; `realo merge` joins those of several agents";
    const ARGUMENTS: &'static [Argument] = &[
        Argument {
            name: "path",
            about: "path of the log; its folder is made",
        },
        Argument {
            name: "agent",
            about: "whose sensors they are",
        },
        Argument {
            name: "kind",
            about: "vehicle or roadside, where `like` does not tell",
        },
        Argument {
            name: "like",
            about: "a log with this agent, which tells its kind, outline and sensor: the one that is played; empty = none",
        },
        Argument {
            name: "points",
            about: "whether sweeps have points",
        },
    ];
    const INPUTS: &'static [Port] = &[
        Port::new("clouds", &[PayloadType::PointCloud], "the agent's sweeps").of(Lane::Ego),
        Port::new("poses", &[PayloadType::AgentState], "what it believes of its pose").of(Lane::Ego),
        Port::new(
            "recorded",
            &[PayloadType::Boxes],
            "detections that were recorded with the sweeps",
        )
        .optional()
        .of(Lane::Ego),
        Port::new("truth", &[PayloadType::GroundTruth], "what was really there")
            .optional()
            .of(Lane::Ego),
        Port::new(
            "peers",
            &[PayloadType::Report],
            "topic `peers`, of the radio: how far the clocks of others lie from the agent's",
        )
        .optional(),
    ];
    const OUTPUTS: &'static [Port] = &[];
    const DECIDED: &'static [(Decided, &'static str)] = &[
        (Decided::Recording, "path"),
        (Decided::Log, "like"),
        (Decided::Ego, "agent"),
        (Decided::Points, "points"),
    ];

    fn examine(config: &LogConfig) -> Result<(), Error> {
        if config.agent.is_empty() {
            return Err("argument `agent`: expected whose sensors are recorded, found nothing".into());
        }
        Ok(())
    }
}

impl Sink for LogRecorder {
    fn new(config: LogConfig) -> Result<Self, Error> {
        Self::examine(&config)?;
        let info = info(&config)?;
        if let Some(folder) = config.path.parent() {
            std::fs::create_dir_all(folder)
                .map_err(|error| format!("argument `path`: {}: {error}", folder.display()))?;
        }
        refuse_foreign(&config.path)?;
        Ok(LogRecorder {
            log: Some(LogWriter::create(&config.path, &info)?),
            agent: config.agent,
            points: config.points,
        })
    }

    fn accept(&mut self, _: PortId, message: Message) -> Result<(), Error> {
        let Some(log) = &mut self.log else {
            return Err("a message after the log was finished".into());
        };
        let Header { stamp, ready, .. } = message.header;
        match &message.payload {
            Payload::PointCloud(cloud) if self.points => log.cloud(&self.agent, stamp, ready, cloud)?,
            Payload::PointCloud(_) => log.sweep(&self.agent, stamp, ready)?,
            Payload::AgentState(state) => log.pose(&self.agent, stamp, ready, state)?,
            Payload::Boxes(boxes) => log.detections(&self.agent, stamp, ready, boxes)?,
            Payload::GroundTruth(truth) => {
                let (agent, points) = (&self.agent, own_points(truth, &self.agent));
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
            Payload::Report(report) if report.topic == report::PEERS.into() => {
                let peers: Vec<Peer> = from_report(report)?;
                log.clocks(peers.iter().filter_map(|peer| clock(peer, stamp)).collect());
            }
            other => return Err(format!("a log takes no {} ({})", other.payload_type(), message.header).into()),
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
fn info(config: &LogConfig) -> Result<LogInfo, Error> {
    let LogConfig { agent, kind, like, .. } = config;
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
