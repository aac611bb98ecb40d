//! TUMTraf-V2X: clouds of roadside and vehicle LiDARs, and labels of OpenLABEL in the frame of their fused cloud.

mod open_label;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::Isometry3;
use realo_logs::AgentKind;
use realo_schemas::Nanos;

use self::open_label::OpenLabel;
use super::folders::{list, name_of, scene_name};
use super::{Importer, Job, Kind};
use crate::clouds::read_points;
use crate::faults::{FaultsOfSweep, FileKind};
use crate::options::{BoxPlace, SweepStamp};
use crate::pcd::Points;
use crate::scenes::{Found, Layout, Lost, RawSweep, Scene, SceneAgent, Stated, SweepFiles, TruthOf, agent_name};
use crate::{ImportError, Options};

/// TUMTraf-V2X.
pub struct TumTraf;

static KIND: Kind = Kind {
    name: "tumtraf",
    title: "TUMTraf-V2X",
    needs: "point_clouds/SENSOR/SEC_NSEC_SENSOR.pcd and labels_point_clouds/SENSORS_registered/SEC_NSEC_SENSORS.json, also below SPLIT/; \
            SENSORs that begin with `vehicle` are vehicles",
    unit: "frames",
    paths: None,
    is_exact: true,
    options: &[
        ("scenes", ""),
        ("without", ""),
        ("frames", ""),
        ("agents", ""),
        ("rate", "10"),
        ("stamp", "start"),
        ("level", "ground"),
        ("height", "ground"),
        ("box-z", "middle"),
        ("pose-direction", "to-parent"),
        ("label-frame", ""),
        ("intensity-range", "256"),
        ("footprint", "-2.5,2.5,-1,1"),
        ("jobs", ""),
        ("resume", ""),
        ("skip-incomplete", ""),
    ],
};

static LAYOUT: TumTrafLayout = TumTrafLayout;

struct TumTrafLayout;

/// The folders of clouds and of labels.
const CLOUDS: &str = "point_clouds";
const LABELS: &str = "labels_point_clouds";
/// How names of sensors end whose clouds are several LiDARs' together.
const FUSED: &str = "registered";
/// A cloud belongs to the labels of the nearest stamp within this, ns.
const TOGETHER: Nanos = 50_000_000;
/// Labels farther apart are of another scene, ns.
const GAP: Nanos = 2_000_000_000;

impl Importer for TumTraf {
    fn kind(&self) -> &'static Kind {
        &KIND
    }

    fn recognise(&self, dir: &Path) -> Result<String, String> {
        match splits(dir).map_err(|error| error.to_string())?.first() {
            Some(split) => Ok(format!("there are `{CLOUDS}` and `{LABELS}` in `{}`", split.display())),
            None => Err(format!(
                "there are no folders `{CLOUDS}` and `{LABELS}` beside each other"
            )),
        }
    }

    fn prepare(&self, dir: &Path, output: &Path, options: &Options) -> Result<Job, ImportError> {
        Job::of_scenes(&LAYOUT, dir, output, options)
    }
}

/// Folders with clouds and labels: `dir` itself, or folders in it.
fn splits(dir: &Path) -> Result<Vec<PathBuf>, ImportError> {
    let is_split = |dir: &Path| dir.join(CLOUDS).is_dir() && dir.join(LABELS).is_dir();
    if is_split(dir) {
        return Ok(vec![dir.into()]);
    }
    let mut found = list(dir)?.folders.clone();
    found.retain(|folder| is_split(folder));
    Ok(found)
}

/// The time in a name `SEC_NSEC_SENSOR`, ns; the second number is a count of ns, with or without zeros before it.
fn stamp_of(name: &str) -> Option<Nanos> {
    let (seconds, rest) = name.split_once('_')?;
    let (nanos, _) = rest.split_once('_').or_else(|| rest.split_once('.'))?;
    let [seconds, nanos] = [seconds, nanos].map(|digits| digits.parse::<Nanos>().ok().filter(|number| *number >= 0));
    seconds?
        .checked_mul(1_000_000_000)?
        .checked_add(nanos.filter(|nanos| *nanos < 1_000_000_000)?)
}

/// Files by their stamps.
type Files = BTreeMap<Nanos, PathBuf>;

/// Files of a folder by their times.
fn files(folder: &Path, end: &str) -> Result<Files, ImportError> {
    let names = list(folder)?.files.clone();
    let names = names
        .into_iter()
        .filter(|name| name.rsplit_once('.').is_some_and(|(_, found)| found == end));
    Ok(names
        .filter_map(|name| Some((stamp_of(&name)?, folder.join(name))))
        .collect())
}

/// The folder of labels: of the fused clouds where there is one, else the only one.
fn labels_folder(split: &Path) -> Result<PathBuf, ImportError> {
    let dir = split.join(LABELS);
    let folders = list(&dir)?.folders.clone();
    let fused = folders.iter().find(|folder| name_of(folder).ends_with(FUSED));
    match (fused, &folders[..]) {
        (Some(fused), _) => Ok(fused.clone()),
        (None, [only]) => Ok(only.clone()),
        (None, others) => {
            let names: Vec<String> = others.iter().map(|folder| name_of(folder)).collect();
            let reason = format!(
                "expected a folder `SENSORS_{FUSED}`, or one folder of labels, found {}: {}; remove those that are not wanted",
                names.len(),
                names.join(", ")
            );
            Err(ImportError::content(&dir, reason))
        }
    }
}

/// The sensor in whose frame the labels of a folder are: the first of `A_and_B_registered`.
fn label_frame(folder: &Path, options: &Options) -> String {
    let name = name_of(folder);
    let own = name.trim_end_matches(FUSED).trim_end_matches('_');
    let first = own.split("_and_").next().unwrap_or(own);
    options.label_frame.clone().unwrap_or_else(|| first.to_string())
}

impl Layout for TumTrafLayout {
    fn title(&self) -> &'static str {
        "TUMTraf-V2X"
    }

    fn find(&self, dir: &Path, _: &Options) -> Result<Found, ImportError> {
        let splits = splits(dir)?;
        if splits.is_empty() {
            let reason = format!("expected {}, found no such folders; unpack the data set", KIND.needs);
            return Err(ImportError::content(dir, reason));
        }
        let mut found = Found::default();
        for split in splits {
            let labels = labels_folder(&split)?;
            let labels = files(&labels, "json")?;
            let sensors = sensors(&split)?;
            let stamps: Vec<Nanos> = labels.keys().copied().collect();
            let runs: Vec<&[Nanos]> = stamps.chunk_by(|a, b| b - a <= GAP).collect();
            for (index, run) in runs.iter().enumerate() {
                let name = match (scene_name(dir, &split), runs.len()) {
                    (name, 1) => name,
                    (name, _) => format!("{name}/{}", index + 1),
                };
                found.scenes.push(scene(name, run, &labels, &sensors));
            }
            if labels.is_empty() {
                found
                    .faults
                    .add("folder of labels without files", scene_name(dir, &split));
            }
        }
        match found.scenes.is_empty() {
            false => Ok(found),
            true => Err(ImportError::content(
                dir,
                "expected labels `SEC_NSEC_SENSORS.json`, found none; unpack the data set",
            )),
        }
    }

    fn sweep(&self, files: &SweepFiles, options: &Options) -> Result<RawSweep, FaultsOfSweep> {
        let mut faults = FaultsOfSweep::default();
        let folder = |path: &Path| name_of(path.parent().unwrap_or(path));
        let sensor = folder(&files.cloud);
        let frame = label_frame(files.labels.parent().unwrap_or(&files.labels), options);
        let said = OpenLabel::read(&files.labels).and_then(|said| {
            let of_sensor = match sensor.ends_with(FUSED) {
                true => Ok(Isometry3::identity()),
                false => said.way(&frame, &sensor, options.poses_from_parent),
            };
            let labels = said.labels(options.box_place);
            let wrong = |reason: String| ImportError::content(&files.labels, reason);
            Ok((of_sensor.map_err(wrong)?, labels.map_err(wrong)?))
        });
        let said = faults.keep(FileKind::Labels, said);
        let points = faults.keep(FileKind::Cloud, points(&files.cloud, options));
        let sweep = said
            .zip(points)
            .map(|((map_from_lidar, (labels, dropped)), points)| RawSweep {
                map_from_lidar,
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
        "try --pose-direction"
    }

    fn assumed(&self, options: &Options) -> Vec<String> {
        let z = match options.box_place {
            BoxPlace::Middle => "the middle of the box",
            BoxPlace::Bottom => "the middle of its bottom, as in release R00",
        };
        let way = match options.poses_from_parent {
            false => "bring points of the sensor to its parent",
            true => "bring points of the parent to the sensor",
        };
        let frame = options
            .label_frame
            .as_deref()
            .unwrap_or("the first sensor in the name of their folder");
        vec![
            format!("the map is the frame of the labels: {frame} (--label-frame); quaternions are x, y, z, w"),
            format!("the place of a label is {z} (--box-z); all agents have the labels of the fused cloud"),
            format!("matrices `pose_wrt_parent` of LiDARs {way} (--pose-direction)"),
            "a cloud belongs to the labels of the nearest stamp within 50 ms; `t` counts ns from the start of its sweep".into(),
        ]
    }
}

/// LiDARs of a split with their clouds: each by itself, or where there are none, the fused ones.
fn sensors(split: &Path) -> Result<Vec<(String, Files)>, ImportError> {
    let folders = list(&split.join(CLOUDS))?.folders.clone();
    let (fused, single): (Vec<_>, Vec<_>) = folders.into_iter().partition(|folder| name_of(folder).ends_with(FUSED));
    let chosen = if single.is_empty() { fused } else { single };
    let read = |folder: PathBuf| Ok((name_of(&folder), files(&folder, "pcd")?));
    chosen.into_iter().map(read).collect()
}

/// A run of labels with the clouds of its sensors.
fn scene(name: String, run: &[Nanos], labels: &Files, sensors: &[(String, Files)]) -> Scene {
    let kind = |sensor: &str| match sensor.to_lowercase().starts_with("vehicle") {
        true => AgentKind::Vehicle,
        false => AgentKind::Roadside,
    };
    let mut sorted: Vec<&(String, Files)> = sensors.iter().collect();
    sorted.sort_by_key(|(sensor, _)| (kind(sensor), sensor.clone()));
    let mut agents: Vec<SceneAgent> = Vec::new();
    for (sensor, clouds) in sorted {
        let sweep = |(number, stamp): (u64, &Nanos)| {
            let (at, cloud) = nearest(clouds, *stamp)?;
            let files = SweepFiles {
                cloud: cloud.clone(),
                labels: labels.get(stamp)?.clone(),
                at: Some(at),
                ..SweepFiles::default()
            };
            Some((number, files))
        };
        let sweeps: BTreeMap<u64, SweepFiles> = (0..).zip(run).filter_map(sweep).collect();
        if sweeps.is_empty() {
            continue;
        }
        let kind = kind(sensor);
        let name = agent_name(sensor, kind, |name| agents.iter().any(|agent| agent.name == name));
        agents.push(SceneAgent {
            folder: sensor.clone(),
            name,
            kind,
            sweeps,
        });
    }
    Scene {
        name,
        agents,
        unwanted: Vec::new(),
        assumed: Vec::new(),
        lost: Lost::default(),
    }
}

fn nearest(clouds: &Files, stamp: Nanos) -> Option<(Nanos, &PathBuf)> {
    let around = clouds.range(stamp.saturating_sub(TOGETHER)..=stamp.saturating_add(TOGETHER));
    let nearest = around.min_by_key(|(at, _)| (*at - stamp).abs());
    nearest.map(|(at, cloud)| (*at, cloud))
}

/// Points of a cloud, with the times of Ouster's drivers as offsets from its stamp.
fn points(cloud: &Path, options: &Options) -> Result<Points, ImportError> {
    let mut points = read_points(cloud)?;
    // Counts of another field than Ouster's have no unit, and are refused.
    if let Some(t) = points.t.take_if(|_| !points.t_is_timestamp) {
        if let Some(other) = t.iter().find(|t| !(0.0..1e9).contains(*t)) {
            let reason =
                format!("field `t`: expected ns from the start of the sweep, from 0 to less than 10⁹, found {other}");
            return Err(ImportError::content(cloud, reason));
        }
        let last = t.iter().copied().fold(0.0, f64::max);
        let begin = match options.stamp {
            SweepStamp::Start => 0.0,
            SweepStamp::End => last,
        };
        points.offset_ns = Some(t.into_iter().map(|t| (t - begin) as i32).collect());
    }
    Ok(points)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_of_names_are_seconds_and_a_count_of_ns() {
        for (name, expected) in [
            (
                "1688625741_144451953_s110_lidar_ouster_south.pcd",
                Some(1_688_625_741_144_451_953),
            ),
            ("1688625741_7_s110.json", Some(1_688_625_741_000_000_007)),
            ("1688625741_7.json", Some(1_688_625_741_000_000_007)),
            ("1688625741_1444519530_s110.pcd", None),
            ("a_7_s110.pcd", None),
            ("000000.pcd", None),
        ] {
            assert_eq!(stamp_of(name), expected, "{name}");
        }
    }

    #[test]
    fn the_labels_are_in_the_frame_of_the_first_sensor() {
        let options = Options::default();
        let frame = |name: &str| label_frame(Path::new(name), &options);
        assert_eq!(
            frame("s110_lidar_ouster_south_and_vehicle_lidar_robosense_registered"),
            "s110_lidar_ouster_south"
        );
        assert_eq!(frame("s110_lidar_ouster_south"), "s110_lidar_ouster_south");
    }
}
