//! V2X-Seq-SPD, the sequential perception data set: DAIR's folders with sequences, tracks, and cooperative labels in the frame of
//! the vehicle's LiDAR.

mod index;
mod labels;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use nalgebra::Isometry3;
use realo_logs::AgentKind;
use realo_schemas::geometry::View;

use self::index::Index;
use self::labels::LabelFile;
use super::{Importer, Job, Kind};
use crate::clouds::read_points;
use crate::dair::lists::{Frame, ListOf, ROADSIDE_SIDE, VEHICLE_SIDE, list_of};
use crate::dair::poses::{Camera, roadside_pose, vehicle_pose};
use crate::dair::{ROADSIDE, VEHICLE, VEHICLE_SWEEP};
use crate::faults::{FaultsOfSweep, FileKind};
use crate::options::BoxPlace;
use crate::scenes::{Found, Layout, RawSweep, Readiness, Scene, SceneAgent, Stated, SweepFiles, SweepPair, TruthOf};
use crate::{ImportError, Options};

/// V2X-Seq-SPD.
pub struct V2xSeq;

static KIND: Kind = Kind {
    name: "v2x-seq",
    title: "V2X-Seq-SPD in its original layout, images missing or not",
    needs: "cooperative/data_info.json with vehicle_frame and vehicle_sequence, cooperative/label/, vehicle-side/ and \
            infrastructure-side/, each with data_info.json",
    unit: "frames",
    paths: None,
    is_exact: true,
    options: &[
        ("scenes", ""),
        ("without", ""),
        ("frames", ""),
        ("agents", ""),
        ("roadside-stamp", "start"),
        ("level", "pose"),
        ("height", "ground"),
        ("box-z", "middle"),
        ("intensity-range", ""),
        ("footprint", "-2.3,2.3,-0.95,0.95"),
        ("jobs", ""),
        ("resume", ""),
        ("skip-incomplete", ""),
    ],
};

static LAYOUT: SeqLayout = SeqLayout;

struct SeqLayout;

impl Importer for V2xSeq {
    fn kind(&self) -> &'static Kind {
        &KIND
    }

    fn recognise(&self, dir: &Path) -> Result<String, String> {
        match list_of(dir)? {
            (ListOf::Seq, why) => Ok(why),
            (ListOf::DairC, why) => Err(format!("{why}, and no entry of it has `vehicle_frame`")),
        }
    }

    fn prepare(&self, dir: &Path, output: &Path, options: &Options) -> Result<Job, ImportError> {
        Job::of_scenes(&LAYOUT, dir, output, options)
    }
}

impl Layout for SeqLayout {
    fn title(&self) -> &'static str {
        "V2X-Seq-SPD"
    }

    fn find(&self, dir: &Path, _: &Options) -> Result<Found, ImportError> {
        V2xSeq.recognise(dir).map_err(|reason| {
            let reason = format!("{reason}; expected {}", KIND.needs);
            ImportError::content(dir, reason)
        })?;
        let Index {
            sequences,
            lost,
            mut unneeded,
        } = Index::read(dir)?;
        let mut found = Found {
            is_unclear: lost.frames > 0,
            faults: lost.faults,
            lost: lost.frames,
            ..Found::default()
        };
        for (name, sequence) in sequences {
            if sequence.pairs.is_empty() {
                found.lost += sequence.lost.frames;
                found.faults.append(sequence.lost.faults);
                continue;
            }
            let (agents, repeated) = agents(sequence.pairs);
            if repeated > 0 {
                let cause = "sequence with roadside sweeps in several pairs, which were taken once";
                unneeded.add(cause, format!("`{name}`: {repeated} times"));
            }
            found.scenes.push(Scene {
                name,
                agents,
                unwanted: Vec::new(),
                assumed: Vec::new(),
                lost: sequence.lost,
            });
        }
        found.unneeded = unneeded;
        match found.scenes.is_empty() {
            false => Ok(found),
            true => Err(ImportError::IncompleteFrames {
                path: dir.into(),
                incomplete: found.lost,
                frames: found.lost,
                missing: found.faults.listed(),
                some: false,
                written: Vec::new(),
            }),
        }
    }

    fn sweep(&self, files: &SweepFiles, options: &Options) -> Result<RawSweep, FaultsOfSweep> {
        // `find` gives no sweep without one.
        let Some(pair) = &files.pair else {
            return Err(FaultsOfSweep::default());
        };
        let is_vehicle = files.cloud == pair.vehicle.1.cloud;
        let side = usize::from(!is_vehicle);
        let frame = [&pair.vehicle.1, &pair.roadside.1][side];
        let mut faults = FaultsOfSweep::default();
        let pose = match is_vehicle {
            true => vehicle_pose(&frame.calibrations[0], &frame.calibrations[1]),
            false => roadside_pose(&frame.calibrations[0], pair.offset),
        };
        let pose = faults.keep(FileKind::Calibration, pose);
        let points = faults.keep(FileKind::Cloud, read_points(&frame.cloud));
        let place = options.box_place;
        let own = faults.keep(FileKind::Labels, LabelFile::read(&frame.labels, None, place));
        let frames = Some([&pair.vehicle.0, &pair.roadside.0]);
        let together = faults.keep(FileKind::Labels, LabelFile::read(&pair.labels, frames, place));
        let view = faults.keep(FileKind::Calibration, view(frame, &Isometry3::identity()));
        let read = || -> Option<RawSweep> {
            let (map_from_lidar, points, own, together, view) = (pose?, points?, own?, together?, view?);
            let mut noted = own.noted.clone();
            let truth = match is_vehicle {
                true => {
                    noted.extend(together.noted.iter().cloned().chain(together.apart(&own)));
                    TruthOf::Given {
                        labels: together.together(&map_from_lidar),
                        dropped: together.dropped,
                        views: faults.keep(FileKind::Calibration, views(pair, &map_from_lidar, view.as_ref()))?,
                    }
                }
                false => TruthOf::Nothing,
            };
            Some(RawSweep {
                labels: own.of_side(&map_from_lidar, side, &together),
                map_from_lidar,
                pose_of: None,
                stated: Stated::default(),
                points,
                dropped: own.dropped,
                view,
                is_unscored: false,
                truth,
                noted,
            })
        };
        let sweep = read();
        faults.or(sweep)
    }

    fn readiness(&self, options: &Options) -> Option<Readiness> {
        let end = options.roadside_stamp.as_str();
        Some(Readiness {
            vehicle: VEHICLE_SWEEP,
            roadside: options.roadside_stamp.to_ready(),
            words: format!(
                "stamps: pointcloud_timestamp of each side, by one clock; the vehicle's is the start of a sweep of 0.1 s, the roadside \
                 unit's is the {end} of one of 0.096 s (--roadside-stamp)"
            ),
        })
    }

    fn protocol(&self) -> Option<&'static str> {
        Some("dair")
    }

    fn labels_are_detections(&self) -> bool {
        true
    }

    fn placing(&self) -> &'static str {
        "see the calibrations and `system_error_offset` of the pair"
    }

    fn assumed(&self, options: &Options) -> Vec<String> {
        let z = match options.box_place {
            BoxPlace::Middle => "the middle of the box",
            BoxPlace::Bottom => "the middle of its bottom",
        };
        vec![
            "the map is the data set's world; system_error_offset is added to the roadside unit's place in it".into(),
            "cooperative labels are in the frame of the vehicle's LiDAR at its stamp, and are the vehicle's truth; the roadside unit \
             has none but its own labels"
                .into(),
            format!("the place of a label is {z} (--box-z); `rotation` is in rad from x of the LiDAR towards y"),
            "own labels have the track of the cooperative label that names theirs, else one of their own; TrafficCone has no tracks".into(),
            "objects were labelled where one of the two cameras sees them, in images of 1920 × 1080 pixels where calibrations do not \
             say it: protocol `dair` (realo run --protocol)"
                .into(),
        ]
    }
}

/// The agents of a sequence, and how many roadside sweeps are in a second pair.
fn agents(pairs: Vec<SweepPair>) -> (Vec<SceneAgent>, usize) {
    let (mut vehicle, mut roadside) = (BTreeMap::new(), BTreeMap::new());
    let (mut last, mut repeated) = (None, 0);
    for pair in pairs {
        let (number, pair) = (pair.vehicle.0.number, Arc::new(pair));
        let files = |frame: &Frame| SweepFiles {
            cloud: frame.cloud.clone(),
            labels: frame.labels.clone(),
            at: Some(frame.stamp),
            pair: Some(pair.clone()),
            ..SweepFiles::default()
        };
        vehicle.insert(number, files(&pair.vehicle.1));
        match last.replace(pair.roadside.0.number) == Some(pair.roadside.0.number) {
            true => repeated += 1,
            false => drop(roadside.insert(number, files(&pair.roadside.1))),
        }
    }
    let agent = |folder: &str, name: &str, kind, sweeps| SceneAgent {
        folder: folder.into(),
        name: name.into(),
        kind,
        sweeps,
    };
    let agents = vec![
        agent(VEHICLE_SIDE, VEHICLE, AgentKind::Vehicle, vehicle),
        agent(ROADSIDE_SIDE, ROADSIDE, AgentKind::Roadside, roadside),
    ];
    (agents, repeated)
}

/// What the camera of a side has in its image, if its list names one.
fn view(frame: &Frame, to_from_lidar: &Isometry3<f64>) -> Result<Option<View>, ImportError> {
    let Some([extrinsic, intrinsic]) = &frame.camera else {
        return Ok(None);
    };
    Camera::read(extrinsic, intrinsic)?.view(to_from_lidar).map(Some)
}

/// Where cooperative labels could be, in the frame of the vehicle's LiDAR: nowhere in particular, where a side has no camera.
fn views(pair: &SweepPair, map_from_lidar: &Isometry3<f64>, own: Option<&View>) -> Result<Vec<View>, ImportError> {
    let (_, roadside) = &pair.roadside;
    let map_from_other = roadside_pose(&roadside.calibrations[0], pair.offset)?;
    let other = view(roadside, &map_from_lidar.inv_mul(&map_from_other))?;
    Ok(own
        .cloned()
        .zip(other)
        .map_or_else(Vec::new, |(own, other)| vec![own, other]))
}
