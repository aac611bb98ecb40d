//! Scenes of data sets: runs of agents on one clock, with a cloud and labels for each frame.
//!
//! A [`Layout`] finds the files of a data set and reads one sweep of one agent. All that follows is the same for all layouts:
//! level frames, the truth of all agents together, points on boxes, stamps, and the log.

mod clock;
mod count;
mod frame;
mod known;
mod name;
mod plan;
mod poses;
mod residual;
mod summary;
mod truth;
mod write;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::Isometry3;
use realo_logs::AgentKind;
use realo_schemas::Nanos;
use realo_schemas::geometry::View;

pub use self::count::points_in_boxes;
pub use self::name::agent_name;
pub use self::plan::{Work, plan};
pub use self::residual::{Fit, Placed, Residual, residual};
pub use self::summary::{AgentSummary, SceneSummary};
use crate::dair::lists::{Frame, FrameId};
use crate::faults::{Faults, FaultsOfSweep};
use crate::options::BoxPlace;
use crate::pcd::Points;
use crate::{ImportError, Options};

/// A run of agents on one clock: it becomes one log.
pub struct Scene {
    /// Its folder below the data set's, with `/` between.
    pub name: String,
    /// Vehicles first.
    pub agents: Vec<SceneAgent>,
    /// Folders of the agents that are not wanted.
    pub unwanted: Vec<String>,
    /// What is assumed of this scene alone, a line each.
    pub assumed: Vec<String>,
    /// Frames that it lacks because of what is wrong with lists.
    pub lost: Lost,
}

/// Frames that lists name, and that cannot be found by them.
#[derive(Clone, Default)]
pub struct Lost {
    /// How many.
    pub frames: usize,
    /// Why.
    pub faults: Faults,
}

impl Lost {
    /// Adds a frame.
    pub fn add(&mut self, cause: String, name: String) {
        self.frames += 1;
        self.faults.add(cause, name);
    }
}

/// An agent of a scene.
pub struct SceneAgent {
    /// Its folder, in words.
    pub folder: String,
    /// Its name in the log.
    pub name: String,
    /// What it is.
    pub kind: AgentKind,
    /// Its sweeps by the numbers of their frames; an agent need not have all frames of its scene.
    pub sweeps: BTreeMap<u64, SweepFiles>,
}

/// The files of a sweep. Where one is missing, the name that it should have.
#[derive(Clone, Default)]
pub struct SweepFiles {
    /// Points.
    pub cloud: PathBuf,
    /// Labels, or labels and pose.
    pub labels: PathBuf,
    /// Calibration, where the layout has a file of its own for it.
    pub calibration: PathBuf,
    /// Map from LiDAR, where the labels do not say it.
    pub map_from_lidar: Option<Isometry3<f64>>,
    /// Time since the first frame, where the layout has times.
    pub since_first: Option<Nanos>,
    /// When it was measured, ns since 1970, where the layout has that.
    pub at: Option<Nanos>,
    /// Clouds of further LiDARs of the agent.
    pub more: Vec<FurtherCloud>,
    /// Labels of the whole scene, where one file has them.
    pub shared: Option<Arc<dyn SharedLabels>>,
    /// The pair of sweeps that it is of, where the layout has such.
    pub pair: Option<Arc<SweepPair>>,
    /// Where in their file the labels are, in words; empty where it has nothing else.
    pub labels_in: &'static str,
}

/// Sweeps of a vehicle and a roadside unit that were labelled together.
pub struct SweepPair {
    /// The vehicle's sweep, with the name of its frame.
    pub vehicle: (FrameId, Frame),
    /// The roadside unit's.
    pub roadside: (FrameId, Frame),
    /// What both sides labelled together.
    pub labels: PathBuf,
    /// Added to the roadside unit's position in the map, m.
    pub offset: [f64; 2],
}

/// A cloud of a further LiDAR of an agent, for the sweep of its first.
#[derive(Clone)]
pub struct FurtherCloud {
    /// Points.
    pub cloud: PathBuf,
    /// Brings points to the frame of the first LiDAR.
    pub first_from_this: Isometry3<f64>,
    /// How much later than the first LiDAR's cloud it was measured, ns.
    pub later: Nanos,
}

/// Labels of a whole scene, which are read once.
pub trait SharedLabels: Send + Sync {
    /// The labels at a time, and how many have no size.
    ///
    /// # Errors
    /// A file that cannot be read, or has another form.
    fn at(&self, at: Nanos, place: BoxPlace) -> Result<(Vec<Label>, usize), ImportError>;
}

/// A sweep as its files have it. All frames are right-handed, y to the left.
pub struct RawSweep {
    /// Pose of the LiDAR.
    pub map_from_lidar: Isometry3<f64>,
    /// What that is the pose of in truth, by its key in the file, if not of the LiDAR.
    pub pose_of: Option<&'static str>,
    /// What its files say that most layouts leave open.
    pub stated: Stated,
    /// In the frame of the LiDAR.
    pub points: Points,
    /// What the agent's side labelled.
    pub labels: Vec<Label>,
    /// Labels without a size or of classes that are nothing.
    pub dropped: usize,
    /// Where the labels could be, in the frame of the LiDAR; `None`: everywhere.
    pub view: Option<View>,
    /// Whether the files say that the frame is not scored.
    pub is_unscored: bool,
    /// What the agent is scored against.
    pub truth: TruthOf,
    /// What is strange in its files, and taken: causes with names.
    pub noted: Vec<(&'static str, String)>,
}

/// What an agent is scored against at a sweep.
#[derive(Default)]
pub enum TruthOf {
    /// The labels of all agents together.
    #[default]
    AllAgents,
    /// Labels that a file has of all agents together.
    Given {
        /// The labels.
        labels: Vec<Label>,
        /// Labels without a size.
        dropped: usize,
        /// Where the labels could be, in the frame of the LiDAR; without any: everywhere.
        views: Vec<View>,
    },
    /// Nothing: files have such labels at the sweeps of another agent.
    Nothing,
}

/// What files of a sweep say that most layouts leave open: it counts before what is assumed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Stated {
    /// Height of the LiDAR over the ground, m.
    pub height: Option<f64>,
    /// Stamp of the sweep, ns since 1970.
    pub stamp: Option<Nanos>,
    /// Outline of the agent in its body frame, m: [x min, x max, y min, y max].
    pub footprint: Option<[f64; 4]>,
}

/// A labelled object.
#[derive(Clone, Debug)]
pub struct Label {
    /// Objects of one text are one object, whoever labelled them.
    pub id: String,
    /// Its identity over time, where it has one.
    pub track: Option<u64>,
    /// As the data set names it.
    pub class: String,
    /// Pose of the middle of its box.
    pub map_from_object: Isometry3<f64>,
    /// Length, width and height, m.
    pub size: [f64; 3],
    /// Along its heading, m/s, where known.
    pub speed: Option<f64>,
    /// Points of the agent that labelled it, where its files count them.
    pub points: Option<u32>,
}

/// What a data set has.
#[derive(Default)]
pub struct Found {
    /// In the order of their names.
    pub scenes: Vec<Scene>,
    /// What is missing besides files of sweeps.
    pub faults: Faults,
    /// Frames that no scene has because of that.
    pub lost: usize,
    /// Whether such frames may be of any scene, so that none of them is known to be whole.
    pub is_unclear: bool,
    /// What is there, and in no scene.
    pub unneeded: Faults,
}

/// When sweeps are ready.
pub struct Readiness {
    /// So long after its stamp a vehicle's, ns.
    pub vehicle: Nanos,
    /// And a roadside unit's.
    pub roadside: Nanos,
    /// In words, with options.
    pub words: String,
}

/// How a data set is laid out.
pub trait Layout: Sync {
    /// What the kind is, in words, for the log.
    fn title(&self) -> &'static str;

    /// Finds the scenes below a folder.
    ///
    /// # Errors
    /// Another layout, or nothing.
    fn find(&self, dir: &Path, options: &Options) -> Result<Found, ImportError>;

    /// Reads a sweep.
    ///
    /// # Errors
    /// All that is wrong with its files.
    fn sweep(&self, files: &SweepFiles, options: &Options) -> Result<RawSweep, FaultsOfSweep>;

    /// When sweeps are ready, where `--stamp` and `--rate` do not say it.
    fn readiness(&self, _: &Options) -> Option<Readiness> {
        None
    }

    /// The protocol of its logs, where it has one of its own.
    fn protocol(&self) -> Option<&'static str> {
        None
    }

    /// Whether the labels of a side are its recorded detections, too.
    fn labels_are_detections(&self) -> bool {
        false
    }

    /// A file beside the labels of an agent that may have all its poses.
    fn pose_file(&self) -> Option<&'static str> {
        None
    }

    /// Whether the id of an agent's own object is the name of its folder.
    fn agents_are_objects(&self) -> bool {
        false
    }

    /// Which frames are scored, in words, for the log.
    fn scored(&self) -> &'static str {
        "all"
    }

    /// What to try where clouds do not fit each other: options of the kind, in words.
    fn placing(&self) -> &'static str;

    /// What else is assumed, a line each.
    fn assumed(&self, options: &Options) -> Vec<String>;
}
