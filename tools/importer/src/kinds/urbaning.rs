//! UrbanIng-V2X: arrays of LiDARs of vehicles and crossings, states of vehicles, a table of true times, and tracks.

mod calibration;
mod times;
mod tracks;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use nalgebra::{Isometry3, Point3};
use realo_logs::AgentKind;
use realo_schemas::Nanos;

use self::calibration::{Calibration, States};
use self::times::TimeTable;
use self::tracks::Tracks;
use super::folders::{frame_of, list, name_of, scene_name};
use super::numpy::array::Arrays;
use super::{Importer, Job, Kind};
use crate::faults::{Faults, FaultsOfSweep, FileKind};
use crate::options::BoxPlace;
use crate::pcd::{Intensities, Points};
use crate::scenes::{Found, Layout, RawSweep, Scene, SceneAgent, SweepFiles, agent_name};
use crate::{ImportError, Options};

/// UrbanIng-V2X.
pub struct Urbaning;

static KIND: Kind = Kind {
    name: "urbaning",
    title: "UrbanIng-V2X",
    needs: "dataset/SEQ/SENSOR/UNIX_MS.npz (x, y, z, intensity, time_offset_ms), SEQ/vehicleN_state/MS.json, calibration.json, \
            timesync_info.csv and labels/SEQ.json",
    unit: "frames",
    paths: None,
    options: &[
        ("scenes", ""),
        ("without", ""),
        ("frames", ""),
        ("agents", ""),
        ("rate", "10"),
        ("stamp", "start"),
        ("times", "table"),
        ("level", "pose"),
        ("height", "ground"),
        ("box-z", "middle"),
        ("pose-direction", "to-parent"),
        ("pose-key", ""),
        ("intensity-range", ""),
        ("footprint", "-2.5,2.5,-1,1"),
        ("jobs", ""),
        ("resume", ""),
        ("skip-incomplete", ""),
    ],
};

static LAYOUT: UrbaningLayout = UrbaningLayout {
    tracks: Mutex::new(None),
};

/// The labels of a sequence are in one file, which its sweeps share.
struct UrbaningLayout {
    tracks: Mutex<Option<(PathBuf, Arc<Tracks>)>>,
}

/// The table of times of a sequence.
const TIMES: &str = "timesync_info.csv";
/// The poses of sensors.
const CALIBRATION: &str = "calibration.json";
/// How names of folders of states end.
const STATE: &str = "_state";
/// Sweeps so near are of one frame, ms.
const TOGETHER_MS: u64 = 50;
/// Arrays of a sweep.
const ARRAYS: [&str; 5] = ["x", "y", "z", "intensity", "time_offset_ms"];

impl Importer for Urbaning {
    fn kind(&self) -> &'static Kind {
        &KIND
    }

    fn recognise(&self, dir: &Path) -> Result<String, String> {
        marks(dir).ok_or_else(|| {
            format!("there is no folder with `{TIMES}` or `vehicle1{STATE}` beside folders of `.npz`, at most two folders down")
        })
    }

    fn job(&self, dir: &Path, output: &Path, options: &Options) -> Result<Job, ImportError> {
        Job::of_scenes(&LAYOUT, dir, output, options)
    }
}

/// What shows that a folder is of this kind.
pub fn marks(dir: &Path) -> Option<String> {
    let sequences = sequences(dir).ok()?;
    let first = sequences.first()?;
    let name = |what: &str| format!("there is `{}`", first.join(what).display());
    let state = list(first)
        .ok()?
        .folders
        .into_iter()
        .find(|folder| name_of(folder).ends_with(STATE));
    match first.join(TIMES).is_file() {
        true => Some(name(TIMES)),
        false => state.map(|state| name(&name_of(&state))),
    }
}

/// Folders of sequences: `dir` itself, or folders in it, at most two down.
fn sequences(dir: &Path) -> Result<Vec<PathBuf>, ImportError> {
    let (mut found, mut open) = (Vec::new(), vec![(dir.to_path_buf(), 0)]);
    while let Some((folder, depth)) = open.pop() {
        let listed = list(&folder)?;
        let is_one = listed.files.contains(TIMES) || listed.folders.iter().any(|inner| name_of(inner).ends_with(STATE));
        match is_one {
            true => found.push(folder),
            false if depth < 2 => open.extend(listed.folders.into_iter().map(|inner| (inner, depth + 1))),
            false => {}
        }
    }
    found.sort();
    Ok(found)
}

/// A file beside a sequence or above it.
fn beside(sequence: &Path, name: &str) -> Option<PathBuf> {
    let folders = sequence.ancestors().take(3);
    let paths = folders.map(|folder| folder.join(name));
    paths.into_iter().find(|path| path.is_file())
}

/// The LiDARs of a sequence by the agents that have them: all of a vehicle together, each of a crossing by itself.
fn lidars(sequence: &Path) -> Result<BTreeMap<(AgentKind, String), Vec<PathBuf>>, ImportError> {
    let mut agents: BTreeMap<(AgentKind, String), Vec<PathBuf>> = BTreeMap::new();
    for folder in list(sequence)?.folders {
        let has_clouds = list(&folder)?
            .files
            .iter()
            .any(|name| frame_of(name).is_some_and(|(_, end)| end == "npz"));
        if !has_clouds {
            continue;
        }
        let name = name_of(&folder);
        let agent = match name.to_lowercase().starts_with("vehicle") {
            true => (AgentKind::Vehicle, name.split('_').next().unwrap_or(&name).to_string()),
            false => (AgentKind::Roadside, name.clone()),
        };
        agents.entry(agent).or_default().push(folder);
    }
    Ok(agents)
}

/// Clouds of a folder by the times in their names, ms since 1970.
fn clouds(folder: &Path) -> Result<BTreeMap<u64, PathBuf>, ImportError> {
    let names = list(folder)?.files.into_iter();
    let numbered = names.filter_map(|name| match frame_of(&name) {
        Some((ms, "npz")) => Some((ms, folder.join(&name))),
        _ => None,
    });
    Ok(numbered.collect())
}

/// The number of each time's frame: times that are near each other are of one.
fn frames(times: impl Iterator<Item = u64>) -> BTreeMap<u64, u64> {
    let times = std::collections::BTreeSet::from_iter(times);
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

impl Layout for UrbaningLayout {
    fn title(&self) -> &'static str {
        "UrbanIng-V2X"
    }

    fn find(&self, dir: &Path, options: &Options) -> Result<Found, ImportError> {
        let mut found = Found::default();
        for sequence in sequences(dir)? {
            let scene = Sequence::open(&sequence, options)?.scene(scene_name(dir, &sequence), &mut found.faults)?;
            found.scenes.extend(scene);
        }
        match found.scenes.is_empty() {
            false => Ok(found),
            true => {
                let reason = format!(
                    "expected {}; found no clouds at most two folders down; unpack the data set",
                    KIND.needs
                );
                Err(ImportError::content(dir, reason))
            }
        }
    }

    fn sweep(&self, files: &SweepFiles, options: &Options) -> Result<RawSweep, FaultsOfSweep> {
        let mut faults = FaultsOfSweep::default();
        let at = files.at.unwrap_or_default();
        let tracks = faults.keep(FileKind::Labels, self.tracks(&files.labels));
        let read = points(&files.cloud).and_then(|mut points| {
            for (cloud, first_from_this) in &files.more {
                add(&mut points, self::points(cloud)?, first_from_this);
            }
            Ok(points)
        });
        let points = faults.keep(FileKind::Cloud, read);
        let sweep = tracks.zip(points).map(|(tracks, points)| {
            let (labels, dropped) = tracks.at(at, options.box_place);
            RawSweep {
                // `find` gives no sweep without one.
                map_from_lidar: files.map_from_lidar.unwrap_or_default(),
                pose_of: None,
                height: None,
                points,
                labels,
                dropped,
                view: None,
                is_unscored: false,
            }
        });
        faults.or(sweep)
    }

    fn assumed(&self, options: &Options) -> Vec<String> {
        let z = match options.box_place {
            BoxPlace::Middle => "the middle of the box",
            BoxPlace::Bottom => "the middle of its bottom",
        };
        let times = match options.times_of_names {
            false => format!("of `{TIMES}` where it has one, else of the names of the files"),
            true => "of the names of the files".into(),
        };
        let way = match options.poses_from_parent {
            false => "bring points of the sensor to its vehicle or to the local frame",
            true => "bring points of the vehicle or of the local frame to the sensor",
        };
        vec![
            format!("times of sweeps are those {times} (--times)"),
            "the map is the local frame of the vehicles' states, right-handed; labels are in it too".into(),
            format!("the place of a label is {z} (--box-z); objects are interpolated over up to 250 ms; all agents have all labels"),
            format!("matrices of `{CALIBRATION}` {way} (--pose-direction); a matrix is the only 4×4 one of its entry (--pose-key)"),
            "all LiDARs of a vehicle are one sweep, in the frame of the first by name; `time_offset_ms` counts from the time of the sweep".into(),
        ]
    }
}

impl UrbaningLayout {
    fn tracks(&self, path: &Path) -> Result<Arc<Tracks>, ImportError> {
        let mut last = self.tracks.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        if let Some((_, tracks)) = last.as_ref().filter(|(known, _)| known == path) {
            return Ok(Arc::clone(tracks));
        }
        let tracks = Arc::new(Tracks::read(path)?);
        *last = Some((path.into(), Arc::clone(&tracks)));
        Ok(tracks)
    }
}

/// A sequence with what its sweeps need.
struct Sequence {
    folder: PathBuf,
    calibration: Calibration,
    times: Option<TimeTable>,
    labels: PathBuf,
    states: BTreeMap<String, States>,
}

impl Sequence {
    fn open(folder: &Path, options: &Options) -> Result<Self, ImportError> {
        let calibration = beside(folder, CALIBRATION).ok_or_else(|| {
            let reason = format!(
                "expected `{CALIBRATION}` in the sequence or at most two folders above it, found none; fetch it"
            );
            ImportError::content(folder, reason)
        })?;
        let labels = format!("labels/{}.json", name_of(folder));
        let times = folder.join(TIMES);
        let times = (times.is_file() && !options.times_of_names)
            .then(|| TimeTable::read(&times))
            .transpose()?;
        let mut states = BTreeMap::new();
        for inner in list(folder)?.folders {
            if let Some(vehicle) = name_of(&inner).strip_suffix(STATE) {
                states.insert(vehicle.to_string(), States::read(&inner, options.pose_key.as_deref())?);
            }
        }
        Ok(Sequence {
            calibration: Calibration::read(&calibration, options)?,
            times,
            labels: beside(folder, &labels).unwrap_or_else(|| folder.join(labels)),
            states,
            folder: folder.into(),
        })
    }

    fn scene(&self, name: String, faults: &mut Faults) -> Result<Option<Scene>, ImportError> {
        let lidars = lidars(&self.folder)?;
        let mut all: Vec<(&(AgentKind, String), Vec<(String, BTreeMap<u64, PathBuf>)>)> = Vec::new();
        for (agent, folders) in &lidars {
            let read = folders.iter().map(|folder| Ok((name_of(folder), clouds(folder)?)));
            all.push((agent, read.collect::<Result<_, ImportError>>()?));
        }
        let times = all
            .iter()
            .flat_map(|(_, lidars)| lidars)
            .flat_map(|(_, clouds)| clouds.keys().copied());
        let frames = frames(times);
        let mut agents: Vec<SceneAgent> = Vec::new();
        for ((kind, folder), lidars) in all {
            let sweeps = self.sweeps(*kind, folder, &lidars, &frames, faults)?;
            if sweeps.is_empty() {
                continue;
            }
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
        }))
    }

    /// The sweeps of an agent by their frames: those of its first LiDAR, with the clouds of the others at the same frames.
    fn sweeps(
        &self,
        kind: AgentKind,
        agent: &str,
        lidars: &[(String, BTreeMap<u64, PathBuf>)],
        frames: &BTreeMap<u64, u64>,
        faults: &mut Faults,
    ) -> Result<BTreeMap<u64, SweepFiles>, ImportError> {
        let mut sweeps = BTreeMap::new();
        let Some(((first, clouds), others)) = lidars.split_first() else {
            return Ok(sweeps);
        };
        let parent_from_first = self.calibration.pose(first)?;
        let mut mounts = Vec::new();
        for (other, clouds) in others {
            let clouds: BTreeMap<u64, &PathBuf> = clouds.iter().map(|(ms, cloud)| (frames[ms], cloud)).collect();
            mounts.push((parent_from_first.inverse() * self.calibration.pose(other)?, clouds));
        }
        for (ms, cloud) in clouds {
            let at = self.times.as_ref().and_then(|times| times.of(first, *ms));
            let at = at.unwrap_or_else(|| i64::try_from(*ms).unwrap_or(i64::MAX).saturating_mul(1_000_000));
            let Some(map_from_parent) = self.map_from_parent(kind, agent, at) else {
                faults.add(
                    format!("no state of `{agent}` within 200 ms"),
                    cloud.display().to_string(),
                );
                continue;
            };
            let number = frames[ms];
            let more = mounts
                .iter()
                .filter_map(|(pose, clouds)| Some(((*clouds.get(&number)?).clone(), *pose)));
            let files = SweepFiles {
                cloud: cloud.clone(),
                labels: self.labels.clone(),
                map_from_lidar: Some(map_from_parent * parent_from_first),
                at: Some(at),
                more: more.collect(),
                ..SweepFiles::default()
            };
            sweeps.insert(number, files);
        }
        Ok(sweeps)
    }

    /// Where a vehicle is; what stands at a crossing is placed in the map.
    fn map_from_parent(&self, kind: AgentKind, agent: &str, at: Nanos) -> Option<Isometry3<f64>> {
        match kind {
            AgentKind::Roadside => Some(Isometry3::identity()),
            AgentKind::Vehicle => self.states.get(agent)?.at(at),
        }
    }
}

/// Points of a sweep in the frame of its LiDAR.
fn points(path: &Path) -> Result<Points, ImportError> {
    let wrong = |reason: String| ImportError::content(path, reason);
    let mut arrays = Arrays::read(path)?;
    let mut column = |name: &str| -> Result<(Vec<f64>, &'static str), ImportError> {
        let array = arrays.array(name).map_err(wrong)?;
        let known = ARRAYS.join("`, `");
        let array = array.ok_or_else(|| {
            wrong(format!(
                "expected the arrays `{known}`, found no `{name}` among {}",
                arrays.names()
            ))
        })?;
        let (numbers, kind) = array
            .numbers()
            .map_err(|reason| wrong(format!("array `{name}`: {reason}")))?;
        match array.shape[..] {
            [_] | [_, 1] | [1, _] => Ok((numbers.to_vec(), kind)),
            _ => Err(wrong(format!(
                "array `{name}`: expected a column, found the shape {:?}",
                array.shape
            ))),
        }
    };
    let [(x, _), (y, _), (z, _)] = [column("x")?, column("y")?, column("z")?];
    let ((values, kind), (offsets, _)) = (column("intensity")?, column("time_offset_ms")?);
    if [y.len(), z.len(), values.len(), offsets.len()]
        .iter()
        .any(|count| *count != x.len())
    {
        return Err(wrong(format!(
            "expected arrays of one length, {} as `x`; fetch the file anew",
            x.len()
        )));
    }
    let offset = |ms: f64| match ms.abs() < 1000.0 {
        true => Ok((ms * 1e6).round() as i32),
        false => Err(wrong(format!(
            "array `time_offset_ms`: expected ms within ±1000 of the sweep, found {ms}"
        ))),
    };
    Ok(Points {
        x,
        y,
        z,
        intensity: Intensities::Others {
            kind,
            values: values.into_iter().map(|value| value as f32).collect(),
        },
        offset_ns: Some(offsets.into_iter().map(offset).collect::<Result<_, _>>()?),
        ..Points::default()
    })
}

/// Adds the points of another LiDAR.
fn add(points: &mut Points, other: Points, first_from_other: &Isometry3<f64>) {
    for ((x, y), z) in other.x.iter().zip(&other.y).zip(&other.z) {
        let point = first_from_other * Point3::new(*x, *y, *z);
        points.x.push(point.x);
        points.y.push(point.y);
        points.z.push(point.z);
    }
    if let (Intensities::Others { values, .. }, Intensities::Others { values: more, .. }) =
        (&mut points.intensity, other.intensity)
    {
        values.extend(more);
    }
    if let (Some(offsets), Some(more)) = (&mut points.offset_ns, other.offset_ns) {
        offsets.extend(more);
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
