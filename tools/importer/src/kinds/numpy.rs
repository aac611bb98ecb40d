//! Arrays of numpy: a folder for each agent, with a `.npz` for each sweep, or a `.npy` of its points and files beside it.

pub mod array;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};
use realo_logs::{AgentKind, track_of};

use self::array::{Array, Arrays, Items};
use super::folders::{frame_of, list, name_of, scene_name};
use super::{Importer, Job, Kind};
use crate::faults::{Fault, FaultsOfSweep, FileKind};
use crate::pcd::{Intensities, IntensityFrom, Points};
use crate::places::of_rows;
use crate::scenes::{Found, Label, Layout, Lost, RawSweep, Scene, SceneAgent, Stated, SweepFiles, TruthOf, agent_name};
use crate::{ImportError, Options};

/// Arrays of numpy.
pub struct Numpy;

static KIND: Kind = Kind {
    name: "numpy",
    title: "arrays of numpy",
    needs: "SCENE/AGENT/000000.npz with `points`, `pose` and, where there are objects, `boxes`, `classes`, `tracks`; or \
            SCENE/AGENT/000000.npy, 000000_boxes.npy and poses.npy; roadside AGENTs begin with `rsu`, `infra` or `-`",
    unit: "frames",
    paths: None,
    is_exact: false,
    options: &[
        ("scenes", ""),
        ("without", ""),
        ("frames", ""),
        ("agents", ""),
        ("rate", "10"),
        ("stamp", "start"),
        ("level", "pose"),
        ("height", "ground"),
        ("class", "Car"),
        ("footprint", "-1.95,2.95,-1.1,1.1"),
        ("jobs", ""),
        ("resume", ""),
        ("skip-incomplete", ""),
    ],
};

static LAYOUT: NumpyLayout = NumpyLayout;

struct NumpyLayout;

/// Poses of the `.npy` files of a folder.
const POSES: &str = "poses.npy";
/// What stands for no track.
const NO_TRACK: f64 = -1.0;
/// Largest number of a track: all whole numbers up to it are exact.
const MOST_TRACK: f64 = (1u64 << 53) as f64;
/// Arrays of a sweep.
const ARRAYS: [&str; 5] = ["points", "pose", "boxes", "classes", "tracks"];
/// How names of boxes beside `.npy` points end.
const BOXES: &str = "_boxes.npy";

impl Importer for Numpy {
    fn kind(&self) -> &'static Kind {
        &KIND
    }

    fn recognise(&self, dir: &Path) -> Result<String, String> {
        let scenes = scenes(dir).map_err(|error| error.to_string())?;
        let first = scenes.first().and_then(|(_, agents)| agents.first());
        let found = first.and_then(|(folder, frames)| Some((folder, frames.values().next()?)));
        match found {
            Some(_) if super::urbaning::marks(dir).is_some() => {
                Err("there are a table of times or states of vehicles, as UrbanIng-V2X has them".into())
            }
            Some((folder, name)) => Ok(format!("there is `{}`", folder.join(name).display())),
            None => Err("there is no `AGENT/000000.npz` and no `AGENT/000000.npy`, at most two folders down".into()),
        }
    }

    fn prepare(&self, dir: &Path, output: &Path, options: &Options) -> Result<Job, ImportError> {
        Job::of_scenes(&LAYOUT, dir, output, options)
    }
}

/// Folders of agents, each with the names of its sweeps by their numbers.
type Agents = Vec<(PathBuf, BTreeMap<u64, String>)>;

/// Scenes by their folders: `dir` itself, or those in it or in their splits.
fn scenes(dir: &Path) -> Result<Vec<(PathBuf, Agents)>, ImportError> {
    let mut scenes = Vec::new();
    let mut open = vec![(dir.to_path_buf(), 0)];
    while let Some((folder, depth)) = open.pop() {
        let mut agents = Agents::new();
        for inner in list(&folder)?.folders.clone() {
            let frames = frames(&inner)?;
            match frames.is_empty() {
                false => agents.push((inner, frames)),
                true if depth < 2 => open.push((inner, depth + 1)),
                true => {}
            }
        }
        if !agents.is_empty() {
            scenes.push((folder, agents));
        }
    }
    scenes.sort();
    Ok(scenes)
}

/// Names of sweeps by their numbers; a `.npz` has all, so it goes before a `.npy` of the same number.
fn frames(agent: &Path) -> Result<BTreeMap<u64, String>, ImportError> {
    let mut frames = BTreeMap::new();
    for name in list(agent)?.files.clone() {
        let Some((stem, "npz" | "npy")) = name.rsplit_once('.') else {
            continue;
        };
        let Some((number, _)) = frame_of(&name) else {
            if stem.bytes().all(|byte| byte.is_ascii_digit()) {
                let reason = "expected a number below 2^64 as its name; number the sweeps anew";
                return Err(ImportError::content(&agent.join(&name), reason));
            }
            continue;
        };
        // Names are sorted: the `.npz` of a stem comes behind its `.npy`, and has all.
        if let Some(other) = frames.insert(number, name.clone())
            && other.rsplit_once('.').map(|(other, _)| other) != Some(stem)
        {
            let reason = format!("expected one file for number {number}, found `{other}` too; remove one");
            return Err(ImportError::content(&agent.join(&name), reason));
        }
    }
    Ok(frames)
}

impl Layout for NumpyLayout {
    fn title(&self) -> &'static str {
        "numpy"
    }

    fn find(&self, dir: &Path, _: &Options) -> Result<Found, ImportError> {
        let scenes = scenes(dir)?;
        if scenes.is_empty() {
            let reason = format!("expected {}; found none at most two folders down", KIND.needs);
            return Err(ImportError::content(dir, reason));
        }
        let scene = |(folder, agents): (PathBuf, Agents)| {
            Ok(Scene {
                name: scene_name(dir, &folder),
                agents: agents_of(agents)?,
                unwanted: Vec::new(),
                assumed: Vec::new(),
                lost: Lost::default(),
            })
        };
        Ok(Found {
            scenes: scenes.into_iter().map(scene).collect::<Result<_, ImportError>>()?,
            ..Found::default()
        })
    }

    fn sweep(&self, files: &SweepFiles, options: &Options) -> Result<RawSweep, FaultsOfSweep> {
        let mut faults = FaultsOfSweep::default();
        let is_archive = files.cloud.extension().is_some_and(|end| end == "npz");
        let read = match is_archive {
            true => archived(&files.cloud, options),
            false => beside(files, options),
        };
        let sweep = read.map_err(|fault| faults.0.push(fault)).ok();
        faults.or(sweep)
    }

    fn placing(&self) -> &'static str {
        "correct `pose` of the agents: from the frame of the LiDAR to the world"
    }

    fn assumed(&self, options: &Options) -> Vec<String> {
        vec![
            "right-handed, x ahead, y to the left, z up; points and boxes in the frame of the agent's LiDAR, poses from it to the world".into(),
            "points are x, y, z and, of four columns or more, intensity; boxes are x, y, z of the middle, length, width, height, yaw (rad)".into(),
            format!("objects without a class are `{}` (--class); without a track each agent's are its own", options.class),
        ]
    }
}

/// The agents of a scene, vehicles first. A folder of `.npy` sweeps has a pose for each in `poses.npy`.
fn agents_of(folders: Agents) -> Result<Vec<SceneAgent>, ImportError> {
    let kind = |folder: &str| match ["-", "rsu", "infra"]
        .iter()
        .any(|begin| folder.to_lowercase().starts_with(begin))
    {
        true => AgentKind::Roadside,
        false => AgentKind::Vehicle,
    };
    let mut folders: Vec<(AgentKind, String, PathBuf, BTreeMap<u64, String>)> = folders
        .into_iter()
        .map(|(path, frames)| (kind(&name_of(&path)), name_of(&path), path, frames))
        .collect();
    folders.sort_by(|a, b| (a.0, &a.1).cmp(&(b.0, &b.1)));
    let mut agents: Vec<SceneAgent> = Vec::new();
    for (kind, folder, path, frames) in folders {
        let poses = match frames.values().any(|name| name.ends_with(".npy")) {
            true => poses(&path.join(POSES), frames.len())?,
            false => Vec::new(),
        };
        let sweep = |(place, (number, name)): (usize, (u64, String))| {
            let stem = name.rsplit_once('.').map_or(&*name, |(stem, _)| stem);
            let (labels, labels_in) = match name.ends_with(".npz") {
                true => (path.join(&name), "array `boxes`"),
                false => (path.join(format!("{stem}{BOXES}")), ""),
            };
            let files = SweepFiles {
                labels,
                labels_in,
                cloud: path.join(&name),
                map_from_lidar: poses.get(place).copied(),
                ..SweepFiles::default()
            };
            (number, files)
        };
        let sweeps = frames.into_iter().enumerate().map(sweep).collect();
        let name = agent_name(&folder, kind, |name| agents.iter().any(|agent| agent.name == name));
        agents.push(SceneAgent {
            folder,
            name,
            kind,
            sweeps,
        });
    }
    Ok(agents)
}

/// The poses of a folder's sweeps, one for each in the order of their numbers.
fn poses(path: &Path, sweeps: usize) -> Result<Vec<Isometry3<f64>>, ImportError> {
    if !path.is_file() {
        let reason = format!(
            "expected it beside `.npy` sweeps, with a pose for each of the {sweeps}, found none; or save each sweep as `.npz`"
        );
        return Err(ImportError::content(path, reason));
    }
    let array = Array::read(path)?;
    let wrong = |reason: String| ImportError::content(path, reason);
    let (numbers, _) = array.numbers().map_err(wrong)?;
    let width = match array.shape[..] {
        [count, rows @ (3 | 4), 4] if count == sweeps => 4 * rows,
        [count, width @ (7 | 12 | 16)] if count == sweeps => width,
        _ => {
            return Err(wrong(format!(
                "expected a pose for each of the {sweeps} sweeps beside it, {sweeps}×4×4, ×3×4 or ×7 (x, y, z, qx, qy, qz, qw), found {}",
                array.words()
            )));
        }
    };
    numbers
        .chunks_exact(width)
        .map(|pose| pose_of(pose).map_err(wrong))
        .collect()
}

/// World from LiDAR: a matrix, row by row, or x, y, z, qx, qy, qz, qw.
fn pose_of(numbers: &[f64]) -> Result<Isometry3<f64>, String> {
    if numbers.iter().any(|number| !number.is_finite()) {
        return Err("expected a pose of finite numbers, found one that is not".into());
    }
    if let &[x, y, z, qx, qy, qz, qw] = numbers {
        let turn = Quaternion::new(qw, qx, qy, qz);
        return match (turn.norm() - 1.0).abs() < 0.01 {
            true => Ok(Isometry3::from_parts(
                Translation3::new(x, y, z),
                UnitQuaternion::from_quaternion(turn),
            )),
            false => Err(format!(
                "expected a quaternion qx, qy, qz, qw of length 1 behind x, y, z, found one of {:.3}",
                turn.norm()
            )),
        };
    }
    let is_pose = matches!(numbers.split_first_chunk::<12>(), Some((_, [] | [0.0, 0.0, 0.0, 1.0])));
    if !is_pose {
        return Err(format!(
            "expected a pose of 4×4 (last row 0, 0, 0, 1), 3×4 or 7 numbers (x, y, z, qx, qy, qz, qw), found {numbers:?}"
        ));
    }
    of_rows(numbers).ok_or_else(|| format!("expected a right-handed rotation in the pose, found {numbers:?}"))
}

/// A sweep of an archive.
fn archived(path: &Path, options: &Options) -> Result<RawSweep, Fault> {
    let fault = |kind: FileKind, reason: String| Fault {
        kind,
        error: ImportError::content(path, reason),
    };
    let mut arrays = Arrays::read(path).map_err(|error| Fault {
        kind: FileKind::Arrays,
        error,
    })?;
    if let Some(other) = arrays.other_than(&ARRAYS) {
        let known = ARRAYS.join("`, `");
        let reason = format!("expected no arrays but `{known}`, found `{other}`; rename it, or leave it out");
        return Err(fault(FileKind::Arrays, reason));
    }
    let missing = |name: &str, what: &str, names: String| {
        let reason = format!("expected an array `{name}`, found {names}; save {what} under this name by numpy.savez");
        fault(FileKind::Arrays, reason)
    };
    let of_cloud = |reason: String| fault(FileKind::Cloud, reason);
    let of_pose = |reason: String| fault(FileKind::Pose, reason);
    let points_array = arrays.array("points").map_err(of_cloud)?;
    let points_array =
        points_array.ok_or_else(|| missing("points", "N × 3 to 16 numbers (x, y, z, intensity)", arrays.names()))?;
    let pose = arrays.array("pose").map_err(of_pose)?;
    let pose = pose.ok_or_else(|| {
        missing(
            "pose",
            "4×4, 3×4 or 7 numbers (the world from the LiDAR)",
            arrays.names(),
        )
    })?;
    let pose = pose.numbers().and_then(|(numbers, _)| match pose.shape[..] {
        [4, 4] | [3, 4] | [7 | 12 | 16] => pose_of(numbers),
        _ => Err(format!(
            "expected a pose of 4×4, 3×4 or 7 numbers (x, y, z, qx, qy, qz, qw), found {}",
            pose.words()
        )),
    });
    let of_labels = |reason: String| fault(FileKind::Labels, reason);
    let mut optional = |name: &str| arrays.array(name).map_err(of_labels);
    let (boxes, classes, tracks) = (optional("boxes")?, optional("classes")?, optional("tracks")?);
    let map_from_lidar = pose.map_err(|reason| of_pose(format!("array `pose`: {reason}")))?;
    let agent = name_of(path.parent().unwrap_or(path));
    let labels = labels(
        boxes.as_ref(),
        classes.as_ref(),
        tracks.as_ref(),
        &agent,
        &map_from_lidar,
        options,
    )
    .map_err(of_labels)?;
    Ok(RawSweep {
        map_from_lidar,
        pose_of: None,
        stated: Stated::default(),
        points: points(&points_array).map_err(|reason| of_cloud(format!("array `points`: {reason}")))?,
        labels,
        dropped: 0,
        view: None,
        is_unscored: false,
        truth: TruthOf::AllAgents,
        noted: Vec::new(),
    })
}

/// A sweep of points with its boxes beside it, where there are some.
fn beside(files: &SweepFiles, options: &Options) -> Result<RawSweep, Fault> {
    let fault = |kind: FileKind| move |error: ImportError| Fault { kind, error };
    let array = Array::read(&files.cloud).map_err(fault(FileKind::Cloud))?;
    let points = points(&array).map_err(|reason| ImportError::content(&files.cloud, reason));
    let points = points.map_err(fault(FileKind::Cloud))?;
    // `find` has refused folders that lack one.
    let map_from_lidar = files.map_from_lidar.unwrap_or_default();
    let boxes = match files.labels.exists() {
        true => Some(Array::read(&files.labels).map_err(fault(FileKind::Labels))?),
        false => None,
    };
    let agent = name_of(files.cloud.parent().unwrap_or(&files.cloud));
    let labels = labels(boxes.as_ref(), None, None, &agent, &map_from_lidar, options)
        .map_err(|reason| ImportError::content(&files.labels, reason));
    Ok(RawSweep {
        map_from_lidar,
        pose_of: None,
        stated: Stated::default(),
        points,
        labels: labels.map_err(fault(FileKind::Labels))?,
        dropped: 0,
        view: None,
        is_unscored: false,
        truth: TruthOf::AllAgents,
        noted: Vec::new(),
    })
}

fn points(array: &Array) -> Result<Points, String> {
    let (_, kind) = array.numbers()?;
    let mut points = Points::default();
    let mut values = Vec::new();
    for row in array.rows(3..=16)? {
        points.x.push(row[0]);
        points.y.push(row[1]);
        points.z.push(row[2]);
        values.push(row.get(3).map_or(0.0, |value| *value as f32));
    }
    points.intensity = Intensities::Others { kind, values };
    if array.shape.last() == Some(&3) {
        points.intensity_from = IntensityFrom::Nothing("three columns".into());
    }
    Ok(points)
}

/// The labels of a sweep. Objects of one track are one, whoever labelled them.
fn labels(
    boxes: Option<&Array>,
    classes: Option<&Array>,
    tracks: Option<&Array>,
    agent: &str,
    map_from_lidar: &Isometry3<f64>,
    options: &Options,
) -> Result<Vec<Label>, String> {
    let Some(boxes) = boxes else { return Ok(Vec::new()) };
    let rows: Vec<&[f64]> = match boxes.shape[..] {
        // numpy.array([]) has one axis.
        [0] => Vec::new(),
        _ => boxes
            .rows(7..=7)
            .map_err(|reason| format!("boxes: {reason} (x, y, z, length, width, height, yaw are wanted)"))?
            .collect(),
    };
    let same = |name: &str, array: Option<&Array>| match array {
        Some(array) if array.shape != [rows.len()] => Err(format!(
            "{name}: expected one for each of the {} boxes, found {}",
            rows.len(),
            array.words()
        )),
        _ => Ok(()),
    };
    same("classes", classes)?;
    same("tracks", tracks)?;
    let tracks = tracks
        .map(|tracks| tracks.numbers())
        .transpose()
        .map_err(|reason| format!("tracks: {reason}"))?
        .map(|(numbers, _)| numbers);
    let class = |row: usize| match classes.map(|classes| &classes.items) {
        Some(Items::Texts(texts)) => Ok(texts[row].clone()),
        Some(Items::Numbers(_, kind)) => Err(format!(
            "classes: expected names, as [\"Car\", \"Bus\"], found numbers of {kind}"
        )),
        None => Ok(options.class.clone()),
    };
    let mut known = BTreeSet::new();
    let mut track_at = |row: usize| {
        let Some(track) = tracks.map(|tracks| tracks[row]).filter(|track| *track != NO_TRACK) else {
            return Ok(None);
        };
        if !(track.fract() == 0.0 && (0.0..=MOST_TRACK).contains(&track)) {
            return Err(format!(
                "tracks: expected whole numbers from 0 to 2^53, or -1 for none, found {track} in row {row}; number them anew"
            ));
        }
        match known.insert(track as u64) {
            true => Ok(Some(track as u64)),
            false => Err(format!(
                "tracks: expected each once in a sweep, found {track} again in row {row}"
            )),
        }
    };
    let label = |(row, numbers): (usize, &&[f64])| {
        let track = track_at(row)?;
        let id = match track {
            Some(track) => format!("{track}"),
            None => format!("{agent}:{row}"),
        };
        let (map_from_object, size) = placed(numbers, map_from_lidar)
            .ok_or_else(|| format!("boxes: expected 7 finite numbers in row {row}, found {numbers:?}"))?;
        realo_documents::in_radians(numbers[6]).map_err(|reason| {
            format!("boxes: yaw in row {row}: {reason}; if it is in degrees, save numpy.deg2rad of that column")
        })?;
        Ok(Label {
            track: track.and_then(|_| track_of(&id)),
            id,
            class: class(row)?,
            map_from_object,
            size,
            speed: None,
            points: None,
        })
    };
    rows.iter().enumerate().map(label).collect()
}

/// Pose and size of a box x, y, z, length, width, height, yaw.
fn placed(numbers: &[f64], map_from_lidar: &Isometry3<f64>) -> Option<(Isometry3<f64>, [f64; 3])> {
    let &[x, y, z, length, width, height, yaw] = numbers else {
        return None;
    };
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
    let pose = map_from_lidar * Isometry3::from_parts(Translation3::new(x, y, z), turn);
    let is_finite = numbers.iter().all(|number| number.is_finite());
    is_finite.then_some((pose, [length, width, height]))
}
