//! Where agents said that they were, against the true poses of the log.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::Isometry3;
use realo_logs::{Log, LogError, MAX_GAP, Stream, pose_track};
use realo_schemas::geometry::PoseTrack;
use realo_schemas::{AgentState, Header, Name, Nanos, PoseStatus};
use realo_scoring::{LocalizationFrame, PoseDifference};

/// Estimates that are kept: those of an agent in half a day. Of later ones nothing is said.
const MOST: usize = 500_000;

/// Estimated states, by agent, in order of arrival.
#[derive(Debug, Default)]
pub(crate) struct Estimates {
    of: BTreeMap<Name, Vec<(Nanos, AgentState)>>,
    count: usize,
}

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
            self.of
                .entry(header.agent.clone())
                .or_default()
                .push((header.stamp, state));
        }
    }

    /// All estimates with their errors, by the log's true poses.
    pub fn against(self, log: Option<&Path>) -> Compared {
        let mut compared = Compared::default();
        let notes = &mut compared.notes;
        if self.of.is_empty() {
            return compared;
        }
        let truth = match log.map(|path| truth(path, self.of.keys())) {
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
            let track = truth.get(&agent);
            let mut trajectories = [TUM, TUM].map(|first| format!("{first}\n"));
            let frame = |(stamp, state): (Nanos, AgentState)| {
                let usable = track.filter(|_| state.status.is_usable());
                let truth = usable.and_then(|track| track.at(stamp));
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

/// The true poses of those agents of whom the log has some.
fn truth<'a>(path: &Path, agents: impl Iterator<Item = &'a Name>) -> Result<BTreeMap<Name, PoseTrack>, LogError> {
    let log = Log::open(path)?;
    agents
        .filter(|agent| log.has(agent, Stream::PoseTruth))
        .map(|agent| Ok((agent.clone(), pose_track(&log, agent, Stream::PoseTruth, MAX_GAP)?)))
        .collect()
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
        let nothing = estimates.against(None);
        assert!(nothing.frames.is_empty() && nothing.notes.is_empty());
        let mut estimates = Estimates::default();
        estimates.add(&header(50), &state(1.0, PoseStatus::Tracking));
        estimates.add(&header(150), &state(1.0, PoseStatus::Lost));
        let Compared { frames, notes, .. } = estimates.against(Some(Path::new("/nowhere/log.mcap")));
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
        } = estimates.against(Some(&path));
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
