//! A sequence of UrbanIng-V2X: which clouds are of one sweep, when it was measured, and where its agent was.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::Isometry3;
use realo_logs::AgentKind;
use realo_schemas::Nanos;

use super::super::folders::{frame_of, list, name_of};
use super::calibration::{Calibration, States};
use super::times::TimeTable;
use super::tracks::TracksFile;
use crate::faults::Faults;
use crate::scenes::{FurtherCloud, Lost, Scene, SceneAgent, SharedLabels, SweepFiles, agent_name};
use crate::{ImportError, Options};

/// The table of times of a sequence.
pub const TIMES: &str = "timesync_info.csv";
/// The poses of sensors.
pub const CALIBRATION: &str = "calibration.json";
/// How names of folders of states end.
pub const STATE: &str = "_state";
/// Sweeps so near are of one frame, ms.
const TOGETHER_MS: u64 = 50;

/// A sequence with what its sweeps need.
pub struct Sequence {
    folder: PathBuf,
    calibration: Calibration,
    times: Option<TimeTable>,
    labels: PathBuf,
    shared: Arc<dyn SharedLabels>,
    states: BTreeMap<String, States>,
}

/// A LiDAR with its clouds by the times in their names, ms since 1970.
struct Lidar {
    name: String,
    clouds: BTreeMap<u64, PathBuf>,
}

/// The LiDARs of an agent.
struct LidarsOf {
    kind: AgentKind,
    folder: String,
    lidars: Vec<Lidar>,
}

/// Clouds of a LiDAR by their frames, with the times in their names.
type ByFrame<'a> = BTreeMap<u64, (u64, &'a PathBuf)>;

/// A LiDAR beside the first of its vehicle.
struct Further<'a> {
    name: &'a str,
    first_from_this: Isometry3<f64>,
    clouds: ByFrame<'a>,
}

/// A file beside a sequence or above it.
fn beside(sequence: &Path, name: &str) -> Option<PathBuf> {
    let folders = sequence.ancestors().take(3);
    let paths = folders.map(|folder| folder.join(name));
    paths.into_iter().find(|path| path.is_file())
}

/// The LiDARs of a sequence by the agents that have them: all of a vehicle together, each of a crossing by itself.
fn lidars(sequence: &Path) -> Result<Vec<LidarsOf>, ImportError> {
    let mut agents: BTreeMap<(AgentKind, String), Vec<Lidar>> = BTreeMap::new();
    for folder in list(sequence)?.folders.clone() {
        let clouds = clouds(&folder)?;
        if clouds.is_empty() {
            continue;
        }
        let name = name_of(&folder);
        let agent = match name.to_lowercase().starts_with("vehicle") {
            true => (AgentKind::Vehicle, name.split('_').next().unwrap_or(&name).to_string()),
            false => (AgentKind::Roadside, name.clone()),
        };
        agents.entry(agent).or_default().push(Lidar { name, clouds });
    }
    let agents = agents.into_iter();
    let agents = agents.map(|((kind, folder), lidars)| LidarsOf { kind, folder, lidars });
    Ok(agents.collect())
}

/// Clouds of a folder by the times in their names, ms since 1970.
fn clouds(folder: &Path) -> Result<BTreeMap<u64, PathBuf>, ImportError> {
    let names = list(folder)?.files.clone().into_iter();
    let numbered = names.filter_map(|name| match frame_of(&name) {
        Some((ms, "npz")) => Some((ms, folder.join(&name))),
        _ => None,
    });
    Ok(numbered.collect())
}

/// The number of each time's frame: times that are near each other are of one.
fn frames(times: impl Iterator<Item = u64>) -> BTreeMap<u64, u64> {
    let times = BTreeSet::from_iter(times);
    let (mut frames, mut begin, mut number) = (BTreeMap::new(), None, 0);
    for time in times {
        match begin {
            Some(first) if time - first < TOGETHER_MS => {}
            Some(_) => (begin, number) = (Some(time), number + 1),
            None => begin = Some(time),
        }
        frames.insert(time, number);
    }
    frames
}

/// The first cloud of each frame; a second one of the same LiDAR is a fault.
fn by_frame<'a>(lidar: &'a Lidar, frames: &BTreeMap<u64, u64>, faults: &mut Faults) -> ByFrame<'a> {
    let mut found = ByFrame::new();
    for (ms, cloud) in &lidar.clouds {
        let frame = frames[ms];
        match found.get(&frame) {
            Some((first, _)) => faults.add(
                format!("second cloud of a LiDAR within {TOGETHER_MS} ms: only the first is read"),
                format!("{}, behind {first}", cloud.display()),
            ),
            None => drop(found.insert(frame, (*ms, cloud))),
        }
    }
    found
}

/// A time in a name, ns.
fn of_name(ms: u64) -> Nanos {
    i64::try_from(ms).unwrap_or(i64::MAX).saturating_mul(1_000_000)
}

impl Sequence {
    /// Reads what all sweeps of a sequence need.
    ///
    /// # Errors
    /// A calibration, a table or states that are missing or of another form.
    pub fn open(folder: &Path, options: &Options) -> Result<Self, ImportError> {
        let calibration = beside(folder, CALIBRATION).ok_or_else(|| {
            let reason = format!(
                "expected `{CALIBRATION}` in the sequence or at most two folders above it, found none; fetch it"
            );
            ImportError::content(folder, reason)
        })?;
        let labels = format!("labels/{}.json", name_of(folder));
        let labels = beside(folder, &labels).unwrap_or_else(|| folder.join(labels));
        let times = folder.join(TIMES);
        let times = (times.is_file() && !options.times_of_names)
            .then(|| TimeTable::read(&times))
            .transpose()?;
        let mut states = BTreeMap::new();
        for inner in list(folder)?.folders.clone() {
            if let Some(vehicle) = name_of(&inner).strip_suffix(STATE) {
                states.insert(vehicle.to_string(), States::read(&inner, options.pose_key.as_deref())?);
            }
        }
        Ok(Sequence {
            calibration: Calibration::read(&calibration, options)?,
            times,
            shared: Arc::new(TracksFile::new(&labels)),
            labels,
            states,
            folder: folder.into(),
        })
    }

    /// The scene of the sequence, if it has clouds.
    ///
    /// # Errors
    /// A sensor without a pose; a table of times that has none of the clouds.
    pub fn scene(&self, name: String, faults: &mut Faults) -> Result<Option<Scene>, ImportError> {
        let all = lidars(&self.folder)?;
        let assumed = self.without_times(all.iter().flat_map(|agent| &agent.lidars))?;
        let times = all.iter().flat_map(|agent| &agent.lidars);
        let frames = frames(times.flat_map(|lidar| lidar.clouds.keys().copied()));
        let mut agents: Vec<SceneAgent> = Vec::new();
        for agent in &all {
            let sweeps = self.sweeps(agent, &frames, faults)?;
            if sweeps.is_empty() {
                continue;
            }
            let LidarsOf { kind, folder, .. } = agent;
            let name = agent_name(folder, *kind, |name| agents.iter().any(|agent| agent.name == name));
            agents.push(SceneAgent {
                folder: folder.clone(),
                name,
                kind: *kind,
                sweeps,
            });
        }
        Ok((!agents.is_empty()).then_some(Scene {
            name,
            agents,
            unwanted: Vec::new(),
            assumed,
            lost: Lost::default(),
        }))
    }

    /// Which sweeps the table does not have, a line for each LiDAR.
    fn without_times<'a>(&self, lidars: impl Iterator<Item = &'a Lidar>) -> Result<Vec<String>, ImportError> {
        let Some(table) = &self.times else {
            return Ok(Vec::new());
        };
        let (mut lines, mut names, mut is_of_use) = (Vec::new(), Vec::new(), false);
        for Lidar { name, clouds } in lidars {
            let missing = clouds.keys().filter(|ms| table.of(name, **ms).is_none()).count();
            is_of_use |= missing < clouds.len();
            names.push(name.as_str());
            if missing > 0 {
                let all = clouds.len();
                lines.push(format!(
                    "the times of {missing} of {all} clouds of `{name}` are those of their names: `{TIMES}` does not have them"
                ));
            }
        }
        if is_of_use || names.is_empty() {
            return Ok(lines);
        }
        let columns: Vec<String> = table.sensors().take(12).map(crate::shown).collect();
        let reason = format!(
            "expected columns `{}` as the folders are called, with the times in the names of their clouds, found columns `{}` without any of \
             them; correct the table, or take the times of the names of the files, as --times names",
            names.join("`, `"),
            columns.join("`, `")
        );
        Err(ImportError::content(&self.folder.join(TIMES), reason))
    }

    /// The sweeps of an agent by their frames: those of its first LiDAR, with the clouds of the others at the same frames.
    fn sweeps(
        &self,
        agent: &LidarsOf,
        frames: &BTreeMap<u64, u64>,
        faults: &mut Faults,
    ) -> Result<BTreeMap<u64, SweepFiles>, ImportError> {
        let mut sweeps = BTreeMap::new();
        let Some((first, others)) = agent.lidars.split_first() else {
            return Ok(sweeps);
        };
        let parent_from_first = self.calibration.pose(&first.name)?;
        let clouds = by_frame(first, frames, faults);
        let mut further = Vec::new();
        for other in others {
            further.push(Further {
                name: &other.name,
                first_from_this: parent_from_first.inverse() * self.calibration.pose(&other.name)?,
                clouds: by_frame(other, frames, faults),
            });
        }
        let of_others = further.iter().flat_map(|further| &further.clouds);
        for (_, (_, cloud)) in of_others.filter(|(frame, _)| !clouds.contains_key(*frame)) {
            faults.add(
                format!(
                    "cloud at a frame of which `{}`, the first LiDAR of `{}`, has none: it is left out",
                    first.name, agent.folder
                ),
                cloud.display().to_string(),
            );
        }
        for (frame, (ms, cloud)) in &clouds {
            let at = self.true_time(&first.name, *ms).unwrap_or_else(|| of_name(*ms));
            let Some(map_from_parent) = self.map_from_parent(agent, at) else {
                faults.add(
                    format!("no state of `{}` within 200 ms", agent.folder),
                    cloud.display().to_string(),
                );
                continue;
            };
            let files = SweepFiles {
                cloud: (*cloud).clone(),
                labels: self.labels.clone(),
                map_from_lidar: Some(map_from_parent * parent_from_first),
                at: Some(at),
                more: self.at_frame(*frame, (first.name.as_str(), *ms, cloud.as_path()), &further, faults),
                shared: Some(Arc::clone(&self.shared)),
                ..SweepFiles::default()
            };
            sweeps.insert(*frame, files);
        }
        Ok(sweeps)
    }

    /// The clouds of further LiDARs that belong to a cloud of the first.
    fn at_frame(
        &self,
        frame: u64,
        (first, ms, of_first): (&str, u64, &Path),
        further: &[Further],
        faults: &mut Faults,
    ) -> Vec<FurtherCloud> {
        let mut found = Vec::new();
        for lidar in further {
            let Some((own_ms, cloud)) = lidar.clouds.get(&frame) else {
                faults.add(
                    format!(
                        "cloud at a frame of which `{}`, a LiDAR of the same agent, has none",
                        lidar.name
                    ),
                    of_first.display().to_string(),
                );
                continue;
            };
            // One clock for both: that of the table, or that of the names.
            let later = match (self.true_time(first, ms), self.true_time(lidar.name, *own_ms)) {
                (Some(at), Some(own)) => own - at,
                _ => of_name(*own_ms) - of_name(ms),
            };
            found.push(FurtherCloud {
                cloud: (*cloud).clone(),
                first_from_this: lidar.first_from_this,
                later,
            });
        }
        found
    }

    /// When a cloud was measured, by the table.
    fn true_time(&self, lidar: &str, ms: u64) -> Option<Nanos> {
        self.times.as_ref()?.of(lidar, ms)
    }

    /// Where a vehicle is; a LiDAR of a crossing has its pose in the map.
    fn map_from_parent(&self, agent: &LidarsOf, at: Nanos) -> Option<Isometry3<f64>> {
        match agent.kind {
            AgentKind::Roadside => Some(Isometry3::identity()),
            AgentKind::Vehicle => self.states.get(&agent.folder)?.at(at),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::frames;

    #[test]
    fn times_that_are_near_are_of_one_frame() {
        let frames = frames([1000, 1012, 1049, 1050, 1100, 1300].into_iter());
        assert_eq!(Vec::from_iter(frames.into_values()), [0, 0, 0, 1, 2, 3]);
    }
}
