//! Where agents said that they were, against the true poses of the log.

use std::collections::BTreeMap;
use std::path::Path;

use crate::GraphStages;
use nalgebra::Isometry3;
use realo_logs::{Log, LogError, MAX_GAP, Stream, pose_tracks};
use realo_schemas::geometry::PoseTrack;
use realo_schemas::{AgentState, Header, Name, Nanos, PoseStatus};
use realo_scoring::{LocalizationFrame, PoseDifference};
use realo_time_offset::{Handling, StampRule};

/// Estimates that are kept: those of an agent in half a day. Of later ones nothing is said.
const MOST: usize = 500_000;

/// Estimated states, by agent, in order of arrival.
#[derive(Debug, Default)]
pub(crate) struct Estimates {
    of: BTreeMap<Name, Vec<Estimated>>,
    count: usize,
}

/// A state, with the stamp of its sweep, and when that was there.
#[derive(Debug)]
struct Estimated {
    stamp: Nanos,
    ready: Nanos,
    state: AgentState,
}

/// True poses in parts, each with how far its clock is behind the log times, ns: a clock that is set back gives a time twice.
type Truth = Vec<(Nanos, PoseTrack)>;

/// A true pose is logged so much later than its stamp at most, ns.
const SLACK: Nanos = 50_000_000;

/// First line of a trajectory in the form of TUM's benchmark.
pub(crate) const TUM: &str = "# timestamp_s x_m y_m z_m qx qy qz qw";

/// What became of estimates.
#[derive(Debug, Default)]
pub(crate) struct Compared {
    /// By agent: its estimates, and their errors.
    pub frames: BTreeMap<String, Vec<LocalizationFrame>>,
    /// By agent, of the estimates that have an error: estimated and true poses of the map, in TUM's form.
    pub trajectories: BTreeMap<String, [String; 2]>,
    /// What a reader must know.
    pub notes: Vec<String>,
}

impl Estimates {
    /// Takes a state; poses that a log gave are none.
    pub fn add(&mut self, header: &Header, state: &AgentState) {
        if !PoseStatus::ESTIMATED.contains(&state.status) {
            return;
        }
        self.count += 1;
        if self.count <= MOST {
            let state = AgentState {
                velocity: None,
                angular_rate: None,
                ..state.clone()
            };
            self.of.entry(header.agent.clone()).or_default().push(Estimated {
                stamp: header.stamp,
                ready: header.ready,
                state,
            });
        }
    }

    /// All estimates with their errors, by the log's true poses. `stamps`: what became of the log's stamps when it was played.
    pub fn against(self, log: Option<&Path>, stamps: StampRule) -> Compared {
        let mut compared = Compared::default();
        let notes = &mut compared.notes;
        if self.of.is_empty() {
            return compared;
        }
        let truth = match log.map(|path| truth(path, stamps, self.of.keys())) {
            None => BTreeMap::new(),
            Some(Ok(truth)) => truth,
            Some(Err(error)) => {
                notes.push(format!(
                    "errors of localization are not known, because the log cannot be read: {error}"
                ));
                BTreeMap::new()
            }
        };
        if self.count > MOST {
            let left = self.count - MOST;
            notes.push(format!(
                "errors of localization are those of the first {MOST} estimates; {left} more are not counted"
            ));
        }
        for (agent, states) in self.of {
            let parts = truth.get(&agent);
            let mut trajectories = [TUM, TUM].map(|first| format!("{first}\n"));
            let frame = |Estimated { stamp, ready, state }: Estimated| {
                let usable = parts.filter(|_| state.status.is_usable());
                // Of a clock that was set back a sweep is the newest that can have arrived by then.
                let fits =
                    |(behind, _): &&(Nanos, PoseTrack)| stamp.saturating_add(*behind) <= ready.saturating_add(SLACK);
                let part = usable.and_then(|parts| parts.iter().rev().find(fits).or(parts.first()));
                let truth = part.and_then(|(_, track)| track.at(stamp));
                if let Some(truth) = &truth {
                    for (text, pose) in trajectories.iter_mut().zip([&state.map_from_body, truth]) {
                        text.push_str(&line_of_tum(stamp, pose));
                    }
                }
                LocalizationFrame {
                    status: state.status,
                    error: truth.map(|truth| PoseDifference::of(&state, &truth)),
                }
            };
            let frames: Vec<LocalizationFrame> = states.into_iter().map(frame).collect();
            if frames.iter().any(|frame| frame.error.is_some()) {
                compared.trajectories.insert(agent.to_string(), trajectories);
            }
            compared.frames.insert(agent.to_string(), frames);
        }
        compared
    }
}

fn line_of_tum(stamp: Nanos, pose: &Isometry3<f64>) -> String {
    let (seconds, nanos) = (stamp.div_euclid(1_000_000_000), stamp.rem_euclid(1_000_000_000));
    let (at, turn) = (&pose.translation.vector, pose.rotation.coords);
    format!(
        "{seconds}.{nanos:09} {:.6} {:.6} {:.6} {:.9} {:.9} {:.9} {:.9}\n",
        at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w
    )
}

/// The true poses of those agents of whom the log has some, at the stamps with which it was played.
fn truth<'a>(
    path: &Path,
    stamps: StampRule,
    agents: impl Iterator<Item = &'a Name>,
) -> Result<BTreeMap<Name, Truth>, LogError> {
    let mut log = Log::open(path)?;
    if stamps.handling() != Handling::Trust {
        log.rebase(stamps.handling())?;
    }
    agents
        .filter(|agent| log.has(agent, Stream::PoseTruth))
        .map(|agent| Ok((agent.clone(), pose_tracks(&log, agent, Stream::PoseTruth, MAX_GAP)?)))
        .collect()
}

/// What became of stamps when the log was played, as the graph that was run says it of its player.
pub(crate) fn stamp_rule(graph: &GraphStages) -> StampRule {
    let is_player = |stage: &&BTreeMap<String, String>| stage.get("runs").is_some_and(|runs| runs == "node player");
    let said = graph
        .values()
        .find(is_player)
        .and_then(|player| player.get("settings.stamps"));
    let rule = said.and_then(|said| serde_json::from_value(said.as_str().into()).ok());
    rule.unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use realo_logs::{AgentInfo, AgentKind, LogInfo, LogWriter};
    use realo_schemas::Kind;

    use super::*;

    fn state(x: f64, status: PoseStatus) -> AgentState {
        AgentState {
            map_from_body: Isometry3::translation(x, 0.0, 0.0),
            covariance: None,
            velocity: None,
            angular_rate: None,
            status,
        }
    }

    #[test]
    fn estimates_are_compared_with_the_log_and_recorded_poses_are_not() {
        let header = |stamp| Header::origin(&"run".into(), &"cav1".into(), Kind::AgentState, 0, stamp, stamp);
        let mut estimates = Estimates::default();
        estimates.add(&header(0), &state(1.0, PoseStatus::Recorded));
        let nothing = estimates.against(None, StampRule::default());
        assert!(nothing.frames.is_empty() && nothing.notes.is_empty());
        let mut estimates = Estimates::default();
        estimates.add(&header(50), &state(1.0, PoseStatus::Tracking));
        estimates.add(&header(150), &state(1.0, PoseStatus::Lost));
        let Compared { frames, notes, .. } =
            estimates.against(Some(Path::new("/nowhere/log.mcap")), StampRule::default());
        assert!(notes[0].contains("/nowhere/log.mcap"), "{notes:?}");
        let statuses: Vec<_> = frames["cav1"].iter().map(|frame| (frame.status, frame.error)).collect();
        assert_eq!(statuses, [(PoseStatus::Tracking, None), (PoseStatus::Lost, None)]);
    }

    #[test]
    fn errors_are_those_at_the_stamps() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.mcap");
        write(&path);
        let mut estimates = Estimates::default();
        let header = |stamp| Header::origin(&"run".into(), &"cav1".into(), Kind::AgentState, 0, stamp, stamp);
        estimates.add(&header(50_000_000), &state(0.7, PoseStatus::Tracking));
        estimates.add(&header(70_000_000), &state(9.0, PoseStatus::Init));
        let Compared {
            frames,
            notes,
            trajectories,
        } = estimates.against(Some(&path), StampRule::default());
        assert_eq!(notes, [""; 0]);
        let [first, second] = frames["cav1"][..] else {
            panic!("{frames:?}")
        };
        assert!(
            first.error.is_some_and(|error| (error.position_m - 0.2).abs() < 1e-9),
            "{first:?}"
        );
        assert_eq!((second.status, second.error), (PoseStatus::Init, None));
        let [estimated, truth] = &trajectories["cav1"];
        let line = |x: &str| {
            format!("{TUM}\n0.050000000 {x} 0.000000 0.000000 0.000000000 0.000000000 0.000000000 1.000000000\n")
        };
        assert_eq!((&estimated[..], &truth[..]), (&*line("0.700000"), &*line("0.500000")));
    }

    /// The agent's clock is 3 s behind all the time, and set back by 1 s after 5 s.
    #[test]
    fn truth_is_at_the_stamps_that_were_played() {
        const S: Nanos = 1_000_000_000;
        let folder = tempfile::tempdir().unwrap();
        let behind = |at: Nanos| at - 3 * S;
        let back = |at: Nanos| at - if at < 1_005 * S { 0 } else { S };
        type Clock<'a> = &'a dyn Fn(Nanos) -> Nanos;
        for (name, clock, rule) in [
            ("behind", &behind as Clock, StampRule::Rebase),
            ("back", &back, StampRule::DropFar),
            ("back", &back, StampRule::Rebase),
        ] {
            let path = folder.path().join(format!("{name}.mcap"));
            let agent = AgentInfo {
                name: "cav1".into(),
                kind: AgentKind::Vehicle,
                footprint: None,
                sensor: String::new(),
                sensor_position: None,
            };
            let mut writer = LogWriter::create(&path, &LogInfo::new("test", vec![agent])).unwrap();
            let mut estimates = Estimates::default();
            let mut wanted = 0;
            for k in 0..100 {
                let at = 1_000 * S + k * S / 10;
                writer
                    .pose_truth("cav1", clock(at), at, &state(k as f64, PoseStatus::Truth))
                    .unwrap();
                // Rebasing leaves out what comes before a step back is sure.
                if rule == StampRule::DropFar || !(50..60).contains(&k) {
                    let stamp = if rule == StampRule::Rebase { at } else { clock(at) };
                    let header = Header::origin(&"run".into(), &"cav1".into(), Kind::AgentState, 0, stamp, at);
                    estimates.add(&header, &state(k as f64, PoseStatus::Tracking));
                    wanted += 1;
                }
            }
            writer.finish().unwrap();
            let compared = estimates.against(Some(&path), rule);
            let errors: Vec<f64> = compared.frames["cav1"]
                .iter()
                .filter_map(|frame| Some(frame.error?.position_m))
                .collect();
            assert_eq!(errors.len(), wanted, "{name} {rule:?}");
            let worst = errors.iter().copied().fold(0.0, f64::max);
            assert!(worst < 1e-6, "{name} {rule:?}: {worst}");
        }
    }

    #[test]
    fn the_player_of_the_graph_says_what_became_of_stamps() {
        let stage = |runs: &str, stamps: &str| {
            BTreeMap::from(
                [("runs", runs), ("settings.stamps", stamps)].map(|(key, value)| (key.to_string(), value.into())),
            )
        };
        let mut graph = GraphStages::from([("a".to_string(), stage("operator sync", "drop"))]);
        assert_eq!(stamp_rule(&graph), StampRule::DropFar);
        graph.insert("player".into(), stage("node player", "rebase"));
        assert_eq!(stamp_rule(&graph), StampRule::Rebase);
    }

    /// A drive of 10 m/s along x.
    fn write(path: &Path) {
        let agent = AgentInfo {
            name: "cav1".into(),
            kind: AgentKind::Vehicle,
            footprint: None,
            sensor: String::new(),
            sensor_position: None,
        };
        let mut writer = LogWriter::create(path, &LogInfo::new("test", vec![agent])).unwrap();
        for k in 0..3 {
            let stamp = k * 100_000_000;
            let pose = state(k as f64, PoseStatus::Truth);
            writer.pose_truth("cav1", stamp, stamp, &pose).unwrap();
        }
        writer.finish().unwrap();
    }
}
