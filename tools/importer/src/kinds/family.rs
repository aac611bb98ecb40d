//! The layout that OPV2V began, `SCENE/AGENT/NNNNNN.yaml` with a cloud beside each, and sets that differ in some ways from it.

mod finding;
mod frame_file;
mod poses;
mod stated;
mod times;

use std::path::Path;

use nalgebra::Isometry3;
use realo_logs::track_of;

pub use self::finding::is_number;
use self::finding::{find, first_labels};
pub use self::frame_file::FrameFile;
use self::frame_file::Object;
use self::poses::{mirrored, world_from_six};
use self::times::relative;
use super::{Importer, Job, Kind};
use crate::clouds::read_points;
use crate::faults::{FaultsOfSweep, FileKind};
use crate::options::Handed;
use crate::pcd::Points;
use crate::rows::read_rows;
use crate::scenes::{Found, Label, Layout, RawSweep, Stated, SweepFiles, TruthOf};
use crate::{ImportError, Options};

/// What the boxes of labels are relative to.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum LabelFrame {
    /// The world, as the poses.
    World,
    /// The LiDAR of the agent.
    Lidar,
}

/// How a set of the family differs from the others.
pub struct Family {
    /// In words.
    pub title: &'static str,
    /// How names of clouds end, the preferred first.
    pub clouds: &'static [&'static str],
    /// What the boxes of labels are relative to.
    pub labels_in: LabelFrame,
    /// Whether the id of an agent's own object is the name of its folder.
    pub agents_are_objects: bool,
    /// Whether the speeds of objects are measured.
    pub has_speeds: bool,
    /// Folders of roadside units, besides negative ones.
    pub roadside: &'static [&'static str],
    /// Classes whose names say something else than the object is, in words.
    pub note: Option<&'static str>,
}

/// A kind of the family.
pub struct FamilyKind {
    /// What it is.
    pub kind: &'static Kind,
    /// How it differs.
    pub family: &'static Family,
    /// Why a label file is of this kind, or why it is not.
    pub recognise: fn(&Path, &FrameFile) -> Result<String, String>,
    /// Why a label file that is not known may be of this kind nevertheless.
    pub undecided: fn(&Path, &FrameFile) -> Option<String>,
}

impl Importer for FamilyKind {
    fn kind(&self) -> &'static Kind {
        self.kind
    }

    fn recognise(&self, dir: &Path) -> Result<String, String> {
        let (path, file) = first_labels(dir)?;
        (self.recognise)(&path, &file)
    }

    fn undecided(&self, dir: &Path) -> Option<String> {
        let (path, file) = first_labels(dir).ok()?;
        (self.undecided)(&path, &file)
    }

    fn prepare(&self, dir: &Path, output: &Path, options: &Options) -> Result<Job, ImportError> {
        Job::of_scenes(self.family, dir, output, options)
    }
}

/// The options of a kind, with what it takes for level, hand and clouds by default.
pub const fn options(
    level: &'static str,
    handed: &'static str,
    cloud: &'static str,
) -> [(&'static str, &'static str); 18] {
    [
        ("scenes", ""),
        ("without", ""),
        ("frames", ""),
        ("agents", ""),
        ("rate", "10"),
        ("stamp", "start"),
        ("level", level),
        ("height", "ground"),
        ("handed", handed),
        ("pose-key", ""),
        ("class", "Car"),
        ("footprint", OPENCOOD_FOOTPRINT),
        ("cloud", cloud),
        ("columns", "4"),
        ("intensity-range", ""),
        ("jobs", ""),
        ("resume", ""),
        ("skip-incomplete", ""),
    ]
}

/// A vehicle's outline about its LiDAR, m: the points that readers of the set remove as the vehicle's own.
const OPENCOOD_FOOTPRINT: &str = "-1.95,2.95,-1.1,1.1";

/// What a label file says, right-handed.
struct Said {
    map_from_lidar: Isometry3<f64>,
    /// The key of a vehicle's pose that was taken for that of its LiDAR.
    pose_of: Option<&'static str>,
    stated: Stated,
    labels: Vec<Label>,
    /// Labels without a size.
    dropped: usize,
    /// Whether it says that its frame is not scored.
    is_unscored: bool,
}

impl Layout for Family {
    fn title(&self) -> &'static str {
        self.title
    }

    fn find(&self, dir: &Path, options: &Options) -> Result<Found, ImportError> {
        find(dir, self.clouds, self.roadside, options)
    }

    fn sweep(&self, files: &SweepFiles, options: &Options) -> Result<RawSweep, FaultsOfSweep> {
        let mut faults = FaultsOfSweep::default();
        let file = FrameFile::read(&files.labels);
        let said = faults.keep(FileKind::Labels, file.and_then(|file| self.said(&file, options)));
        let points = faults.keep(FileKind::Cloud, points(&files.cloud, options));
        let timed = |(said, mut points): (Said, Points)| {
            let timed = relative(&mut points, said.stated.stamp, options);
            let timed = timed.map_err(|reason| ImportError::content(&files.cloud, reason));
            timed.map(|()| (said, points))
        };
        let both = said.zip(points).map(timed);
        let both = both.and_then(|both| faults.keep(FileKind::Cloud, both));
        let sweep = both.map(|(said, points)| RawSweep {
            map_from_lidar: said.map_from_lidar,
            pose_of: said.pose_of,
            stated: said.stated,
            points,
            labels: said.labels,
            dropped: said.dropped,
            view: None,
            is_unscored: said.is_unscored,
            truth: TruthOf::AllAgents,
            noted: Vec::new(),
        });
        faults.or(sweep)
    }

    fn pose_file(&self) -> Option<&'static str> {
        Some("poses.csv")
    }

    fn agents_are_objects(&self) -> bool {
        self.agents_are_objects
    }

    fn scored(&self) -> &'static str {
        "all but those whose files say `scored: false`"
    }

    fn placing(&self) -> &'static str {
        "try --handed and --pose-key"
    }

    fn assumed(&self, options: &Options) -> Vec<String> {
        let handed = match options.handed {
            Handed::Left => {
                "left-handed, y to the right: y and the angles of points, poses and boxes are mirrored (--handed)"
            }
            Handed::Right => "right-handed, y to the left: taken as it is (--handed)",
        };
        let labels = match self.labels_in {
            LabelFrame::World => "world",
            LabelFrame::Lidar => "LiDAR frame of each agent",
        };
        let [x0, x1, y0, y1] = options.footprint;
        let mut lines = vec![
            format!("data set: {handed}"),
            format!("boxes are in the {labels}; extents are half sizes"),
            format!("objects without a class are `{}` (--class)", options.class),
            format!(
                "a vehicle reaches from {x0} to {x1} m along its LiDAR and from {y0} to {y1} m across (--footprint)"
            ),
        ];
        if self.clouds[0] == "bin" {
            let columns = options.columns;
            lines.push(format!(
                "points in `.bin` are rows of {columns} float32: x, y, z, intensity{} (--columns)",
                if columns > 4 { ", and what is not read" } else { "" }
            ));
        }
        lines.extend(self.note.map(String::from));
        lines
    }
}

impl Family {
    fn said(&self, file: &FrameFile, options: &Options) -> Result<Said, ImportError> {
        let turned = |pose: Isometry3<f64>| match options.handed {
            Handed::Left => mirrored(&pose),
            Handed::Right => pose,
        };
        let map_from_lidar = turned(file.pose(options.pose_key.as_deref())?);
        let objects = file.objects()?;
        let all = objects.len();
        let with_size = objects.into_iter().filter(|object| !object.extent.contains(&0.0));
        let labels: Vec<Label> = with_size
            .map(|object| {
                let [x, y, z] = object.center;
                let in_frame = turned(world_from_six(object.six()) * Isometry3::translation(x, y, z));
                let map_from_object = match self.labels_in {
                    LabelFrame::World => in_frame,
                    LabelFrame::Lidar => map_from_lidar * in_frame,
                };
                self.label(file, object, map_from_object, options)
            })
            .collect();
        let dropped = all - labels.len();
        Ok(Said {
            map_from_lidar,
            pose_of: file.vehicle_pose().filter(|_| options.pose_key.is_none()),
            stated: file.stated()?,
            labels,
            dropped,
            is_unscored: file.is_unscored(),
        })
    }

    fn label(&self, file: &FrameFile, object: Object, map_from_object: Isometry3<f64>, options: &Options) -> Label {
        let id = match (self.labels_in, object.joined) {
            (LabelFrame::World, _) => object.id,
            (LabelFrame::Lidar, Some(joined)) if !joined.starts_with('-') => joined,
            // What was not joined over the agents is one agent's own.
            (LabelFrame::Lidar, _) => format!("{}:{}", file.agent(), object.id),
        };
        Label {
            track: track_of(&id),
            id,
            class: object.class.unwrap_or_else(|| options.class.clone()),
            map_from_object,
            size: object.extent.map(|half| 2.0 * half),
            speed: object.speed_kmh.filter(|_| self.has_speeds).map(|kmh| kmh / 3.6),
            points: object.points,
        }
    }
}

/// Points of a cloud, right-handed.
fn points(cloud: &Path, options: &Options) -> Result<Points, ImportError> {
    let is_bin = cloud.extension().is_some_and(|extension| extension == "bin");
    let mut points = match is_bin {
        true => read_rows(cloud, options.columns)?,
        false => read_points(cloud)?,
    };
    if options.handed == Handed::Left {
        points.y.iter_mut().for_each(|y| *y = -*y);
    }
    Ok(points)
}
