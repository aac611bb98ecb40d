//! Where agents said that they were, against the true poses of the log.

use std::collections::BTreeMap;
use std::path::Path;

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

/// By agent: its estimates, and their errors.
type Frames = BTreeMap<String, Vec<LocalizationFrame>>;

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

    /// All estimates with their errors, by the log's true poses; and what a reader must know.
    pub fn against(self, log: Option<&Path>) -> (Frames, Vec<String>) {
        let mut notes = Vec::new();
        if self.of.is_empty() {
            return (Frames::new(), notes);
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
        let of_agent = |(agent, states): (Name, Vec<(Nanos, AgentState)>)| {
            let track = truth.get(&agent);
            let frame = |(stamp, state): &(Nanos, AgentState)| LocalizationFrame {
                status: state.status,
                error: track
                    .filter(|_| state.status.is_usable())
                    .and_then(|track| track.at(*stamp))
                    .map(|truth| PoseDifference::of(state, &truth)),
            };
            (agent.to_string(), states.iter().map(frame).collect())
        };
        (self.of.into_iter().map(of_agent).collect(), notes)
    }
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
    use nalgebra::Isometry3;
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
        assert_eq!(estimates.against(None), (Frames::new(), Vec::new()));
        let mut estimates = Estimates::default();
        estimates.add(&header(50), &state(1.0, PoseStatus::Tracking));
        estimates.add(&header(150), &state(1.0, PoseStatus::Lost));
        let (frames, notes) = estimates.against(Some(Path::new("/nowhere/log.mcap")));
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
        let (frames, notes) = estimates.against(Some(&path));
        assert_eq!(notes, [""; 0]);
        let [first, second] = frames["cav1"][..] else {
            panic!("{frames:?}")
        };
        assert!(
            first.error.is_some_and(|error| (error.position_m - 0.2).abs() < 1e-9),
            "{first:?}"
        );
        assert_eq!((second.status, second.error), (PoseStatus::Init, None));
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
