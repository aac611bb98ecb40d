//! DAIR-V2X-C in its original layout (root `cooperative-vehicle-infrastructure`); images are not read.
//!
//! Frames: the log's `map` is the dataset's world. A body frame has the heading of the LiDAR and its z = 0 on the ground
//! below it; [`Level`] says which way is up, and how the ground is found: [`lidar_height`] below the LiDAR, or by a plane
//! through the points. The recorded `system_error_offset` of a pair is added to the roadside unit's position in the world.
//!
//! Views: labels were drawn where image and cloud show the same, so those of a side lie in the image of its camera, and the
//! cooperative ones in either. The boxes of the image labels are exact projections without the lens's distortion, so the
//! views are pinholes. The vehicle's calibration does not say the size of the image; all images are 1920 × 1080.

mod index;
pub(crate) mod labels;
pub(crate) mod lists;
pub(crate) mod poses;
mod reading;
mod summary;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use realo_logs::{AgentInfo, AgentKind, Levelled, LogInfo, LogWriter};
use realo_schemas::{Boxes, Nanos};

use self::lists::Frame;
use self::reading::{Checked, Pair, Reader, Sweep};
pub use self::summary::Summary;
use crate::ImportError;
use crate::faults::FaultsOfSweep;
use crate::level::Level;
use crate::places::recorded;
use crate::scenes::{Placed, residual};

/// Name of the vehicle in the log.
pub const VEHICLE: &str = "vehicle";
/// Name of the roadside unit in the log.
pub const ROADSIDE: &str = "roadside";
/// Height of an agent's LiDAR over the ground, m: the data set does not say; the commonest -z of the points on the road
/// within 20 m (vehicle) and 40 m (roadside) in the sample's clouds.
pub fn lidar_height(agent: &str) -> f64 {
    if agent == VEHICLE { 2.0 } else { 1.6 }
}

/// The vehicle's outline about its LiDAR, m: the data set does not say; an ordinary car's, 4.6 m × 1.9 m, with the LiDAR
/// in the middle of its roof. Boxes that others have of the vehicle are centred in it and count for nothing.
const FOOTPRINT: [f64; 4] = [-2.3, 2.3, -0.95, 0.95];

/// Duration of a vehicle's sweep (10.00 Hz; its stamp is the start).
pub(crate) const VEHICLE_SWEEP: Nanos = 100_000_000;
/// Duration of a roadside sweep (about 10.4 Hz).
const ROADSIDE_SWEEP: Nanos = 96_000_000;

/// Pairs whose clouds are compared, until one says how well they fit.
const COMPARED: usize = 5;

/// What the recorded time of a roadside sweep is; the dataset does not say.
///
/// Either way it is the sweep's stamp, by which the dataset's authors paired the sides; what differs is when the sweep
/// is ready: a sweep's duration later, or at once.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum RoadsideStamp {
    /// The start of the sweep, as on the vehicle.
    #[default]
    Start,
    /// Its end.
    End,
}

impl RoadsideStamp {
    /// All, with their names and what they mean.
    pub const ALL: &[(RoadsideStamp, &str, &str)] =
        &[(RoadsideStamp::Start, "start", ""), (RoadsideStamp::End, "end", "")];

    /// How long after its stamp a roadside sweep is ready, ns.
    pub(crate) fn to_ready(self) -> Nanos {
        match self {
            RoadsideStamp::Start => ROADSIDE_SWEEP,
            RoadsideStamp::End => 0,
        }
    }

    /// `start` or `end`.
    pub(crate) fn as_str(self) -> &'static str {
        match self {
            RoadsideStamp::Start => "start",
            RoadsideStamp::End => "end",
        }
    }
}

/// How DAIR is imported.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DairOptions {
    /// What the recorded time of a roadside sweep is.
    pub roadside_stamp: RoadsideStamp,
    /// By what the body frames are levelled.
    pub level: Level,
    /// Leaves out pairs of which a file or an entry is missing or damaged.
    pub skip_incomplete: bool,
}

/// What an import is at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DairStep {
    /// It reads all files, to find what is missing or damaged.
    Checking,
    /// It reads them again and writes the log.
    Writing,
}

/// Imports a DAIR-V2X-C dataset into a log of the agents [`VEHICLE`] and [`ROADSIDE`].
///
/// Recorded detections are the single-side LiDAR labels in file order, score 1, and so are the own labels of both agents; the
/// vehicle's ground truth are the cooperative labels. Every frame is scored, without point counts, and has its views.
///
/// # Errors
/// All that is missing or damaged of pairs, at once. Entries that no pair needs are in the [`Summary`].
pub fn dair(dir: &Path, out: &Path, options: DairOptions) -> Result<Summary, ImportError> {
    dair_with(dir, out, options, |_, _, _| {})
}

/// As [`dair`]; calls `progress` with what it is at, the pairs that are done, and all pairs.
///
/// # Errors
/// As [`dair`].
pub fn dair_with(
    dir: &Path,
    out: &Path,
    options: DairOptions,
    mut progress: impl FnMut(DairStep, u64, u64),
) -> Result<Summary, ImportError> {
    let reader = Reader::new(dir, options.level);
    let checked = reader.check(|done, all| progress(DairStep::Checking, done, all))?;
    if checked.incomplete > 0 && (!options.skip_incomplete || checked.pairs.is_empty()) {
        return Err(ImportError::Incomplete {
            path: dir.into(),
            incomplete: checked.incomplete,
            pairs: checked.pairs.len() + checked.incomplete,
            missing: checked.faults.listed(),
            some: !checked.pairs.is_empty(),
        });
    }
    let roadside_sweep = options.roadside_stamp.to_ready();
    let Checked {
        pairs,
        incomplete,
        faults,
        unneeded,
        brightest,
    } = checked;
    let rules = [VEHICLE, ROADSIDE].into_iter().zip(&brightest);
    let mut import = Import {
        log: LogWriter::create_atomic(out, &info(&pairs, options, roadside_sweep))?,
        reader,
        summary: Summary {
            incomplete_pairs: incomplete,
            missing: faults.by_cause,
            unneeded: unneeded.by_cause,
            assumed: assumed(options),
            intensities: rules
                .map(|(agent, brightest)| format!("of `{agent}`: {}", brightest.rule()))
                .collect(),
            ..Summary::default()
        },
        tilts: BTreeMap::new(),
        brightest: brightest.map(|brightest| brightest.most),
        roadside_sweep,
    };
    import.pairs(&pairs, |done, all| progress(DairStep::Writing, done, all))?;
    import.summary.overlap = import.overlap(&pairs);
    import.log.levelled(levelled(options.level, import.tilts));
    import.log.finish()?;
    Ok(import.summary)
}

/// What the data set does not say.
fn assumed(options: DairOptions) -> Vec<String> {
    let stamp = options.roadside_stamp.as_str();
    let mut assumed = vec![
        format!(
            "the vehicle's stamps are the start of a sweep, those of the roadside unit its {stamp} (--roadside-stamp)"
        ),
        format!("frames levelled by: {} (--level)", options.level),
        "the vehicle is 4.6 m long and 1.9 m wide about its LiDAR".into(),
    ];
    if options.level != Level::Ground {
        let [vehicle, roadside] = [VEHICLE, ROADSIDE].map(lidar_height);
        assumed.push(format!(
            "the LiDAR of the vehicle is {vehicle} m over the ground, that of the roadside unit {roadside} m (--level ground finds both)"
        ));
    }
    assumed
}

/// What the log says of itself.
fn info(pairs: &[Pair], options: DairOptions, roadside_sweep: Nanos) -> LogInfo {
    let stamp = options.roadside_stamp.as_str();
    let mut info = LogInfo::new(
        format!("DAIR-V2X-C, roadside stamps taken as the {stamp} of a sweep"),
        vec![
            agent(VEHICLE, AgentKind::Vehicle, options.level),
            agent(ROADSIDE, AgentKind::Roadside, options.level),
        ],
    );
    info.protocol = "dair".into();
    info.key_frames = "all".into();
    let stamps = pairs.iter().flat_map(|pair| [pair.vehicle.stamp, pair.roadside.stamp]);
    let ends = |pair: &Pair| (pair.vehicle.stamp + VEHICLE_SWEEP).max(pair.roadside.stamp + roadside_sweep);
    (info.start, info.end) = (stamps.min(), pairs.iter().map(ends).max());
    info
}

fn agent(name: &str, kind: AgentKind, level: Level) -> AgentInfo {
    AgentInfo {
        name: name.into(),
        kind,
        footprint: (kind == AgentKind::Vehicle).then_some(FOOTPRINT),
        sensor: match level {
            Level::Ground => "LiDAR".into(),
            Level::Pose | Level::None => format!("LiDAR, {} m over the body frame", lidar_height(name)),
        },
        sensor_position: (level != Level::Ground).then_some([0.0, 0.0, lidar_height(name)]),
    }
}

fn levelled(level: Level, tilts: BTreeMap<&'static str, Vec<f64>>) -> BTreeMap<String, Levelled> {
    let of = |(agent, tilts): (&'static str, Vec<f64>)| {
        let degrees = [
            tilts.iter().copied().fold(f64::INFINITY, f64::min),
            tilts.iter().copied().fold(0.0, f64::max),
        ];
        let by = level.as_str().into();
        (agent.to_string(), Levelled { by, degrees })
    };
    tilts.into_iter().map(of).collect()
}

struct Import {
    reader: Reader,
    log: LogWriter,
    summary: Summary,
    /// What was levelled of each sweep, degrees.
    tilts: BTreeMap<&'static str, Vec<f64>>,
    /// The brightest intensity of the vehicle's and of the roadside unit's first clouds.
    brightest: [f32; 2],
    /// Duration of a roadside sweep from its stamp on, ns.
    roadside_sweep: Nanos,
}

impl Import {
    /// Writes all sweeps, each once.
    fn pairs(&mut self, pairs: &[Pair], mut progress: impl FnMut(u64, u64)) -> Result<(), ImportError> {
        let (mut vehicles, mut roadsides) = (BTreeSet::new(), BTreeSet::new());
        for (done, pair) in pairs.iter().enumerate() {
            progress(done as u64, pairs.len() as u64);
            self.summary.pairs += 1;
            let new_vehicle = vehicles.insert(pair.vehicle.stamp);
            let new_roadside = roadsides.insert(pair.roadside.stamp);
            self.summary.repeated_sweeps += usize::from(!new_vehicle) + usize::from(!new_roadside);
            let vehicle_first = pair.vehicle.stamp + VEHICLE_SWEEP <= pair.roadside.stamp + self.roadside_sweep;
            if new_vehicle && vehicle_first {
                self.vehicle(pair)?;
            }
            if new_roadside {
                self.roadside(pair)?;
            }
            if new_vehicle && !vehicle_first {
                self.vehicle(pair)?;
            }
        }
        Ok(())
    }

    /// How well the clouds of the first pairs fit each other, by the first that says anything.
    fn overlap(&mut self, pairs: &[Pair]) -> Option<String> {
        pairs.iter().take(COMPARED).find_map(|pair| {
            let vehicle = self.reader.vehicle(&pair.vehicle).ok()?;
            let roadside = self.reader.roadside(&pair.roadside, pair.offset()).ok()?;
            let [own, other] = [vehicle, roadside].map(|sweep| {
                let cloud = sweep.cloud.scaled(self.brightest[0].max(self.brightest[1]));
                cloud.map(|(cloud, _)| (cloud, sweep.map_from_body))
            });
            let ((own, map_from_own), (other, map_from_other)) = (own.ok()?, other.ok()?);
            let placed = |name, cloud, map_from_body| Placed {
                name,
                cloud,
                map_from_body,
            };
            let found = residual(
                &placed(VEHICLE, &own, map_from_own),
                &placed(ROADSIDE, &other, map_from_other),
                "compare other pairs: calibrations of some are off by a metre",
            );
            found.map(|residual| residual.to_string())
        })
    }

    fn vehicle(&mut self, pair: &Pair) -> Result<(), ImportError> {
        let frame = &pair.vehicle;
        let ready = frame.stamp + VEHICLE_SWEEP;
        let sweep = self.reader.vehicle(frame).map_err(changed)?;
        let together = self.reader.together(pair, &sweep).map_err(changed)?;
        self.summary.vehicle_boxes += self.sweep(VEHICLE, frame, ready, sweep)?;
        if let Some(views) = &together.views {
            self.log.truth_views(VEHICLE, frame.stamp, ready, views)?;
        }
        let truth = &together.truth;
        self.summary.placeholders_dropped += truth.placeholders;
        self.summary.truth_boxes += truth.boxes.len();
        self.log.truth(VEHICLE, frame.stamp, ready, &truth.boxes, None, true)?;
        Ok(())
    }

    fn roadside(&mut self, pair: &Pair) -> Result<(), ImportError> {
        let frame = &pair.roadside;
        let sweep = self.reader.roadside(frame, pair.offset()).map_err(changed)?;
        let ready = frame.stamp + self.roadside_sweep;
        self.summary.roadside_boxes += self.sweep(ROADSIDE, frame, ready, sweep)?;
        Ok(())
    }

    /// Pose, points and labels of a sweep: its labels are its recorded detections and its own labels. Returns their number.
    fn sweep(&mut self, agent: &'static str, frame: &Frame, ready: Nanos, sweep: Sweep) -> Result<usize, ImportError> {
        let Sweep {
            map_from_body,
            tilt,
            cloud,
            labels,
            view,
        } = sweep;
        self.tilts.entry(agent).or_default().push(tilt);
        self.log
            .pose(agent, frame.stamp, frame.stamp, &recorded(map_from_body))?;
        let brightest = self.brightest[usize::from(agent == ROADSIDE)];
        let (cloud, limited) = cloud
            .scaled(brightest)
            .map_err(|reason| ImportError::content(&frame.cloud, reason))?;
        self.summary.limited_intensities += limited;
        self.summary.points += cloud.len();
        self.log.cloud(agent, frame.stamp, ready, &cloud)?;
        self.summary.placeholders_dropped += labels.placeholders;
        let boxes = Boxes(labels.boxes);
        self.log.detections(agent, frame.stamp, ready, &boxes)?;
        if let Some(view) = view {
            self.log.own_views(agent, frame.stamp, ready, &[view])?;
        }
        self.log.own_labels(agent, frame.stamp, ready, &boxes.0, None, true)?;
        Ok(boxes.0.len())
    }
}

/// A file that could be read when all were checked, and cannot any more.
fn changed(faults: FaultsOfSweep) -> ImportError {
    faults.first().expect("what cannot be read has a fault")
}
