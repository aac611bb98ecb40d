//! KITTI: one vehicle, with clouds, labels and calibrations of the object benchmark, and poses where there are some.

mod calibration;
mod labels;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use nalgebra::Isometry3;
use realo_logs::AgentKind;
use realo_schemas::Nanos;

use self::calibration::{Calibration, poses, times};
use self::labels::labels;
use super::{Importer, Job, Kind};
use crate::faults::{FaultsOfSweep, FileKind};
use crate::rows::read_rows;
use crate::scenes::{Found, Layout, Lost, RawSweep, Scene, SceneAgent, Stated, SweepFiles, TruthOf};
use crate::{ImportError, Options};

/// KITTI.
pub struct Kitti;

static KIND: Kind = Kind {
    name: "kitti",
    title: "KITTI's layout, one vehicle",
    needs: "velodyne/000000.bin, label_2/000000.txt, calib/000000.txt; poses.txt and times.txt where the frames follow each other",
    unit: "frames",
    paths: None,
    is_exact: true,
    options: &[
        ("frames", ""),
        ("rate", "10"),
        ("stamp", "start"),
        ("level", "none"),
        ("height", "1.73"),
        ("footprint", FOOTPRINT),
        ("columns", "4"),
        ("skip-incomplete", ""),
    ],
};

/// The vehicle's outline about its LiDAR, m: a station wagon of 4.8 m × 1.8 m, the LiDAR 0.76 m before the rear axle.
const FOOTPRINT: &str = "-1.8,3,-0.9,0.9";

static LAYOUT: KittiLayout = KittiLayout;

struct KittiLayout;

impl Importer for Kitti {
    fn kind(&self) -> &'static Kind {
        &KIND
    }

    fn recognise(&self, dir: &Path) -> Result<String, String> {
        let folders = ["velodyne", "label_2", "calib"];
        let missing: Vec<&str> = folders
            .into_iter()
            .filter(|folder| !dir.join(folder).is_dir())
            .collect();
        match missing[..] {
            [] => Ok("there are `velodyne`, `label_2` and `calib`".into()),
            _ => Err(format!("there is no folder `{}`", missing.join("`, no `"))),
        }
    }

    fn prepare(&self, dir: &Path, output: &Path, options: &Options) -> Result<Job, ImportError> {
        Job::of_scenes(&LAYOUT, dir, output, options)
    }
}

impl Layout for KittiLayout {
    fn title(&self) -> &'static str {
        "KITTI"
    }

    fn find(&self, dir: &Path, _: &Options) -> Result<Found, ImportError> {
        if let Err(reason) = Kitti.recognise(dir) {
            let reason = format!("{reason}; expected {}", KIND.needs);
            return Err(ImportError::content(dir, reason));
        }
        let numbers = numbers(dir)?;
        let (poses, times) = (poses(dir)?, times(dir)?);
        // Frames without a pose or a time beside others with one would be somewhere else and at another time.
        for (name, count) in [
            ("poses.txt", poses.as_ref().map(Vec::len)),
            ("times.txt", times.as_ref().map(Vec::len)),
        ] {
            let last = numbers.keys().next_back().copied().unwrap_or(0);
            if let Some(count) = count.filter(|count| (*count as u64) <= last) {
                let reason = format!(
                    "expected a line for each of the frames 0 to {last}, found {count} lines; fetch the file anew, or remove the frames \
                     beyond it"
                );
                return Err(ImportError::content(&dir.join(name), reason));
            }
        }
        let placed = match poses {
            Some(_) => "the map is the LiDAR's frame of the first pose; poses.txt has poses of the left camera",
            None => {
                "without poses.txt each frame is at the origin of the map: frames of the object benchmark do not follow each other"
            }
        };
        let sweep = |(number, stem): (u64, String)| {
            let file = |folder: &str, end: &str| dir.join(folder).join(format!("{stem}.{end}"));
            let at =
                |list: &Option<Vec<Isometry3<f64>>>| list.as_ref().and_then(|list| list.get(number as usize).copied());
            let files = SweepFiles {
                cloud: file("velodyne", "bin"),
                labels: file("label_2", "txt"),
                calibration: file("calib", "txt"),
                map_from_lidar: at(&poses),
                since_first: since_first(times.as_deref(), number),
                ..SweepFiles::default()
            };
            (number, files)
        };
        let agent = SceneAgent {
            folder: "velodyne".into(),
            name: "cav_1".into(),
            kind: AgentKind::Vehicle,
            sweeps: numbers.into_iter().map(sweep).collect(),
        };
        let name = fs::canonicalize(dir)
            .ok()
            .and_then(|dir| Some(dir.file_name()?.to_string_lossy().into_owned()));
        let scenes = vec![Scene {
            name: name.unwrap_or_else(|| "kitti".into()),
            agents: vec![agent],
            unwanted: Vec::new(),
            assumed: vec![placed.into()],
            lost: Lost::default(),
        }];
        Ok(Found {
            scenes,
            ..Found::default()
        })
    }

    fn sweep(&self, files: &SweepFiles, options: &Options) -> Result<RawSweep, FaultsOfSweep> {
        let mut faults = FaultsOfSweep::default();
        let calibration = faults.keep(FileKind::Calibration, Calibration::read(&files.calibration));
        let points = faults.keep(FileKind::Cloud, read_rows(&files.cloud, options.columns));
        let read = calibration.zip(points);
        let sweep = read.and_then(|(calibration, points)| {
            let map_from_lidar = calibration.map_from_lidar(files.map_from_lidar.as_ref());
            let read = labels(&files.labels, &(map_from_lidar * calibration.lidar_from_camera()));
            let (labels, dropped) = faults.keep(FileKind::Labels, read)?;
            let view = faults.keep(FileKind::Calibration, calibration.view())?;
            Some(RawSweep {
                map_from_lidar,
                pose_of: None,
                stated: Stated::default(),
                points,
                labels,
                dropped,
                view: Some(view),
                is_unscored: false,
                truth: TruthOf::AllAgents,
                noted: Vec::new(),
            })
        });
        if sweep.is_none() && faults.0.iter().all(|fault| fault.kind != FileKind::Labels) {
            faults.keep(FileKind::Labels, labels(&files.labels, &Isometry3::identity()));
        }
        faults.or(sweep)
    }

    fn placing(&self) -> &'static str {
        "correct its poses"
    }

    fn assumed(&self, _: &Options) -> Vec<String> {
        vec![
            "labels are only in the image of 1242 × 375 pixels, which is the view of the truth; `DontCare` is no object".into(),
        ]
    }
}

/// Time since the first line.
fn since_first(times: Option<&[f64]>, number: u64) -> Option<Nanos> {
    let (first, time) = (times?.first()?, times?.get(number as usize)?);
    Some(((time - first) * 1e9).round() as Nanos)
}

/// Numbers of the frames that have a file, with their digits.
fn numbers(dir: &Path) -> Result<BTreeMap<u64, String>, ImportError> {
    let mut numbers = BTreeMap::new();
    for (folder, end) in [("velodyne", ".bin"), ("label_2", ".txt")] {
        let folder = dir.join(folder);
        for entry in fs::read_dir(&folder).map_err(ImportError::io(&folder))? {
            let name = entry.map_err(ImportError::io(&folder))?.file_name();
            let name = name.to_string_lossy();
            if let Some(stem) = name.strip_suffix(end)
                && let Ok(number) = stem.parse()
            {
                numbers.insert(number, stem.to_string());
            }
        }
    }
    match numbers.is_empty() {
        true => Err(ImportError::content(
            dir,
            "expected velodyne/000000.bin, found no frames; unpack the data set",
        )),
        false => Ok(numbers),
    }
}
