//! UrbanIng-V2X: arrays of LiDARs of vehicles and crossings, states of vehicles, a table of true times, and tracks.

mod calibration;
mod clouds;
mod sequence;
mod times;
mod tracks;

use std::path::{Path, PathBuf};

use self::sequence::{CALIBRATION, STATE, Sequence, TIMES};
use self::tracks::TracksFile;
use super::folders::{list, name_of, scene_name};
use super::{Importer, Job, Kind};
use crate::faults::{FaultsOfSweep, FileKind};
use crate::options::BoxPlace;
use crate::scenes::{Found, Layout, RawSweep, SharedLabels, Stated, SweepFiles, TruthOf};
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
    is_exact: false,
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

static LAYOUT: UrbaningLayout = UrbaningLayout;

struct UrbaningLayout;

impl Importer for Urbaning {
    fn kind(&self) -> &'static Kind {
        &KIND
    }

    fn recognise(&self, dir: &Path) -> Result<String, String> {
        marks(dir).ok_or_else(|| {
            format!("there is no folder with `{TIMES}` or `vehicle1{STATE}` beside folders of `.npz`, at most two folders down")
        })
    }

    fn prepare(&self, dir: &Path, output: &Path, options: &Options) -> Result<Job, ImportError> {
        Job::of_scenes(&LAYOUT, dir, output, options)
    }
}

/// What shows that a folder is of this kind.
pub fn marks(dir: &Path) -> Option<String> {
    let sequences = sequences(dir).ok()?;
    let first = sequences.first()?;
    let name = |what: &str| format!("there is `{}`", first.join(what).display());
    let listed = list(first).ok()?;
    let state = listed.folders.iter().find(|folder| name_of(folder).ends_with(STATE));
    match first.join(TIMES).is_file() {
        true => Some(name(TIMES)),
        false => state.map(|state| name(&name_of(state))),
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
            false if depth < 2 => open.extend(listed.folders.iter().map(|inner| (inner.clone(), depth + 1))),
            false => {}
        }
    }
    found.sort();
    Ok(found)
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
        let labels = match &files.shared {
            Some(shared) => shared.at(at, options.box_place),
            None => TracksFile::new(&files.labels).at(at, options.box_place),
        };
        let labels = faults.keep(FileKind::Labels, labels);
        let points = faults.keep(FileKind::Cloud, clouds::of_sweep(files));
        let sweep = labels.zip(points).map(|((labels, dropped), points)| RawSweep {
            // `find` gives no sweep without one.
            map_from_lidar: files.map_from_lidar.unwrap_or_default(),
            pose_of: None,
            stated: Stated::default(),
            points,
            labels,
            dropped,
            view: None,
            is_unscored: false,
            truth: TruthOf::AllAgents,
            noted: Vec::new(),
        });
        faults.or(sweep)
    }

    fn placing(&self) -> &'static str {
        "try --pose-direction and --pose-key"
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
